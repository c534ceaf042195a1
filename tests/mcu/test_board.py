"""The Pico's board and the drivers on the emulated RP2040: ticks, pulses at the pins, buses, inputs, the watchdog.

Small programs on the raw REPL build a board of their own and drive it; what the pins and chips did is looked at from outside.
"""

import itertools

import pytest

pytestmark = pytest.mark.images

MS = 1000
LATE_MAX_US = 150
"""How long after its instant a tick's handler may begin: an interrupt, some bytecode, short locks."""

KILL_MAX_US = 400
AFTER_TICK_US = range(2200, 2500)
"""When a servo's period begins after its tick: 1 ms, and what attaching it takes in bytecode."""

COUNT_NS = 320

PROLOGUE = """
import gc, machine, micropython, sys, time
from array import array
from firmware.board_rp2040 import Board
from firmware.drivers import Drivers

micropython.alloc_emergency_exception_buf(300)

class Tables:
    pass

def tables_of(outputs, devices, period_us):
    tables = Tables()
    tables.dofs = len(outputs)
    tables.motor_period_us = period_us
    tables.turns = bytearray([1] * 16)
    tables.driver = bytearray([255] * 16)
    tables.settings = array('H', [0] * 96)
    tables.device_driver = bytearray([255] * 4)
    tables.device_settings = array('H', [0] * 32)
    tables.feedback_pin = bytearray([255] * 16)
    tables.kill_pin = 255
    for dof, output in enumerate(outputs):
        tables.driver[dof] = output[0]
        for number, value in enumerate(output[1:]):
            tables.settings[6 * dof + number] = value
    for device, settings in enumerate(devices):
        tables.device_driver[device] = 1
        for number, value in enumerate(settings):
            tables.device_settings[8 * device + number] = value
    return tables

board = Board()
drivers = Drivers(board)
level = array('i', [0x800000] * 16)
pulse = array('i', [1500 << 18] * 16)

class Loop:
    def __init__(self):
        self.ticks = self.late = self.due = 0

loop = Loop()

def step(n):
    pass

def tick():
    late = time.ticks_diff(time.ticks_us(), board.tick_due_us()) + period_us
    if late > loop.late:
        loop.late = late
    loop.ticks += 1
    step(loop.ticks)
    drivers.write(level, pulse, 0xffff)
    loop.due = 0xffff

def play(outputs, devices=(), period=20000):
    global period_us
    period_us = period
    tables = tables_of(outputs, devices, period)
    drivers.prepare(tables)
    state = board.lock()
    drivers.load(tables)
    board.unlock(state)
    board.start_ticks(period, tick)

def attach(*dofs):
    for dof in dofs:
        state = board.lock()
        drivers.attach(dof, time.ticks_diff(board.tick_due_us(), time.ticks_us()))
        board.unlock(state)

def run(ticks):
    end = loop.ticks + ticks
    while loop.ticks < end:
        board.wait(20000)
        due = loop.due
        loop.due = 0
        drivers.flush(level, pulse, due)
        drivers.attend(time.ticks_us())
"""


@pytest.fixture
def board(repl):
    """Run programs after the prologue: `board(code)` returns what they print; the board is closed then."""

    def run(code, timeout_us=20_000_000):
        body = "\n".join("    " + line for line in code.strip().splitlines())
        # fmt: off
        return repl.exec(
            PROLOGUE + f"try:\n{body}\nfinally:\n    board.close()\n", timeout_us
        )
        # fmt: on

    run.mcu = repl.mcu
    run.repl = repl
    return run


def pulses_of(edges):
    """Return `(start_ns, width_ns)` of the pulses among edges."""
    found = []
    for (start, level), (end, _) in itertools.pairwise(edges):
        if level:
            found.append((start, end - start))
    return found


# --- ticks


@pytest.mark.parametrize("period_us", [3008, 20000])
def test_ticks_keep_their_nominal_instants_and_none_is_left_out(board, period_us):
    told = board(f"""
times = array('i', [0] * 400)
instants = []
def tick():
    times[count[0]] = time.ticks_diff(time.ticks_us(), first)
    count[0] += 1
count = [0]
first = 0
board.start_ticks({period_us}, tick)
first = board.tick_due_us()
end = time.ticks_add(first, 20 * {period_us} + {period_us} // 2)
while time.ticks_diff(end, time.ticks_us()) > 0:
    instants.append([0] * 20)
    if len(instants) > 50:
        instants = []
        gc.collect()
state = board.lock()
while time.ticks_diff(time.ticks_us(), end) < 5 * {period_us}:
    pass
board.unlock(state)
print(*times[:count[0]])
print((board.tick_due_us() - first) % {period_us}, time.ticks_diff(board.tick_due_us(), time.ticks_us()))
""")
    first, second = told.splitlines()[:2]
    late = [int(instant) - n * period_us for n, instant in enumerate(first.split())]
    assert len(late) == 26
    assert all(0 <= us <= LATE_MAX_US for us in late[:20])
    assert max(late) > 3 * period_us and late[25] < period_us, "those that were kept away came one after the other"
    phase, until_us = map(int, second.split())
    assert phase == 0 and 0 < until_us <= period_us


def test_first_tick_is_where_it_was_said_to_be(board):
    told = board("""
def seen():
    at[count[0]] = time.ticks_us()
    count[0] += 1
at = array('i', [0] * 10)
count = [0]
for period_us in (3008, 20000, 3016):
    state = board.lock()
    board.start_ticks(period_us, seen)
    board.unlock(state)
    due = board.tick_due_us()
    while count[0] == 0:
        pass
    print(time.ticks_diff(at[0], due))
    count[0] = 0
board.stop_ticks()
time.sleep_ms(50)
print(count[0])
""")
    *late, more = map(int, told.split())
    assert len(late) == 3 and all(0 <= us <= LATE_MAX_US for us in late)
    assert more == 0


def test_wait_ends_with_a_tick_and_with_a_byte(board):
    board.repl.start(
        PROLOGUE
        + """
board.start_ticks(20000, tick)
period_us = 20000
for _ in range(3):
    board.wait(100000)
    print(time.ticks_diff(board.tick_due_us(), time.ticks_us()) // 1000)
board.stop_ticks()
before = time.ticks_us()
board.wait(100000)
print(time.ticks_diff(time.ticks_us(), before) // 1000)
buffer = bytearray(8)
board.wait(300000)
print(board.receive(buffer), time.ticks_diff(time.ticks_us(), before) // 1000)
board.close()
"""
    )
    board.mcu.run_for(300 * MS)
    board.mcu.send(b"x")
    told = [line.split() for line in board.repl.finish().splitlines()]
    assert told[:3] == [["19"]] * 3
    # It looks after each millisecond's interrupt, and stops where little more than one would be left: 98 or 99 are over.
    assert told[3] in (["98"], ["99"])
    received, after_ms = map(int, told[4])
    assert received == 1 and after_ms < 350


# --- servos


@pytest.mark.parametrize("period_us", [3008, 20000])
def test_servo_pulses_follow_their_tick_by_a_constant_time_and_are_never_cut(board, period_us):
    board(f"""
def step(n):
    for d in range(4):
        pulse[d] = ((1000 + 100 * d) << 18) + (n << 16)
play([(0, 2), (0, 3), (0, 20), (0, 26)], period={period_us})
attach(0, 1, 2, 3)
print(time.ticks_us())
run(40)
""")
    starts = []
    for d, pin in enumerate((2, 3, 20, 26)):
        pulses = pulses_of(board.mcu.edges(pin))
        starts.append(pulses[0][0])
        assert {after - before for (before, _), (after, _) in itertools.pairwise(pulses)} == {period_us * 1000}
        assert len(pulses) >= 38, "the last one is cut by the end of it all"
        for n, (_, width_ns) in enumerate(pulses[:38], start=1):
            assert abs(width_ns - 1000 * (1000 + 100 * d + n / 4)) <= COUNT_NS
    assert starts[0] == starts[1], "one slice"


def test_servo_period_begins_when_its_tick_has_been_written(board):
    told = board("""
play([(0, 2), (0, 7)])
attach(0, 1)
print(board.tick_due_us(), time.ticks_us())
run(3)
""")
    due_us = int(told.split()[0])
    # Ticks count from power on here.
    for pin in (2, 7):
        assert pulses_of(board.mcu.edges(pin))[0][0] // 1000 - due_us in AFTER_TICK_US


@pytest.mark.parametrize("one", [False, True], ids=["all", "one"])
def test_quiet_drives_all_pins_low_within_its_time_and_no_pulse_comes_back_cut(board, one):
    told = board(f"""
play([(0, 2), (0, 3), (2, 1, 8, 9, 0), (2, 0, 10, 11, 0)])
step = lambda n: None
for n in range(24):
    level[2] = level[3] = 0x200000 if n & 1 else 0xc00000
    attach(0, 1, 2, 3)
    run(5)
    time.sleep_us(977 * n)
    before = time.ticks_us()
    if {one}:
        drivers.release(0)
        attach(0)
        time.sleep_us(100)
        drivers.release(0)
    else:
        drivers.quiet()
    print(time.ticks_us(), time.ticks_diff(time.ticks_us(), before))
    if not {one}:
        time.sleep_us(1234)
    attach(0, 1, 2, 3)
run(5)
before = time.ticks_us()
drivers.quiet()
print(time.ticks_us(), time.ticks_diff(time.ticks_us(), before))
""")
    quiets = [tuple(map(int, line.split())) for line in told.splitlines()]
    if not one:
        for done_us, took_us in quiets:
            assert took_us < KILL_MAX_US
            for pin in (2, 3, 8, 9, 10):
                levels = [level for t_ns, level in board.mcu.edges(pin) if t_ns // 1000 <= done_us]
                assert [0, *levels][-1] == 0
    told_us = KILL_MAX_US + (0 if not one else 500)  # from the end of a pulse to the end of what ended it
    for pin in (2, 3):
        pulses = pulses_of(board.mcu.edges(pin))
        ends_us = [done_us for done_us, _ in quiets]
        cut = [start for start, width in pulses if abs(width - 1_500_000) > COUNT_NS]
        for start in cut:
            assert any(start // 1000 <= end_us <= start // 1000 + 1500 + told_us for end_us in ends_us)
        assert all(width <= 1_500_000 + COUNT_NS for _, width in pulses)


# --- bridges


@pytest.mark.parametrize("wiring", [0, 1])
def test_bridge_has_20_khz_and_its_duty_on_the_side_it_turns_to(board, wiring):
    told = board(f"""
def step(n):
    level[0] = 0x800000 + (0x200000 if n < 10 else -0x400000)
play([(2, {wiring}, 8, 9, 0)], period=3008)
attach(0)
run(8)
print(time.ticks_us())
run(12)
drivers.quiet()
""")
    turning_us = int(told.split()[0])
    for pin, level, part in ((8, 0, 0.25), (9 if wiring else 8, 1, 0.5)):
        edges = board.mcu.edges(pin)
        if level:
            edges = [edge for edge in edges if edge[0] // 1000 > turning_us + 15_000]
        else:
            edges = [edge for edge in edges if edge[0] // 1000 < turning_us]
        pulses = pulses_of(edges)[2:-2]
        assert len(pulses) > 100
        assert all(abs(width - part * 50_000) < 8 for _, width in pulses)
        gaps = {after - before for (before, _), (after, _) in itertools.pairwise(pulses)}
        assert gaps == {50_000}
    if wiring == 0:
        (turned, up), *rest = board.mcu.edges(9)
        assert up == 1 and [level for _, level in rest] in ([], [0])
        before = [start + width for start, width in pulses_of(board.mcu.edges(8)) if start < turned]
        assert 0 < turned - before[-1] < 4_000_000, "it stands for a tick"
        after = [start for start, _ in pulses_of(board.mcu.edges(8)) if start > turned]
        assert after


# --- the PCA9685

CHIP = (4, 5, 0x40, 6, 400, 25000)


def test_chip_pulses_stop_with_oe_and_start_after_a_fresh_burst(board):
    chip = board.mcu.add_pca9685(0, 0x40, 6)
    told = board(f"""
play([(1, 0, 3), (1, 0, 15)], [{CHIP}])
run(4)
attach(0, 1)
run(10)
drivers.quiet()
print(time.ticks_us())
run(5)
print(time.ticks_us(), drivers.bus_errors(), drivers.bus_gone())
attach(0)
run(10)
print(time.ticks_us())
""")
    quiet_us, again_us, errors, gone, end_us = map(int, told.split())
    assert (errors, gone) == (0, 0)
    for channel in (3, 15):
        pulses = [(start // 1000, width) for start, width in pulses_of(chip.edges(channel))]
        assert not [start for start, _ in pulses if quiet_us <= start < again_us]
        assert len([start for start, _ in pulses if start < quiet_us]) >= 8
        assert len([start for start, _ in pulses if start > again_us]) >= (8 if channel == 3 else 0)
        whole = [width for start, width in pulses if start < quiet_us - 2000][1:]
        # 307 counts of 122 cycles of 25 MHz
        assert set(whole) == {307 * 122 * 40}
    oe = board.mcu.edges(6)
    assert [level for _, level in oe] == [1, 0, 1, 0] or [level for _, level in oe][:4] == [1, 0, 1, 0]
    assert end_us > again_us


def test_chip_that_goes_is_noticed_and_set_up_again_when_it_is_back(board):
    chip = board.mcu.add_pca9685(0, 0x40, 6)
    board.repl.start(
        PROLOGUE
        + f"""
play([(1, 0, 0)], [{CHIP}])
run(4)
attach(0)
for _ in range(150):
    run(1)
    print(time.ticks_us(), drivers.bus_errors(), drivers.bus_gone())
board.close()
"""
    )
    board.mcu.run_for(600 * MS)
    chip.remove()
    board.mcu.run_for(700 * MS)
    chip.put_back()
    back_ns = board.mcu.now_us * 1000
    told = [tuple(map(int, line.split())) for line in board.repl.finish(10_000_000).splitlines()]
    gone = [t_us for t_us, _, gone in told if gone]
    assert 980 * MS < gone[-1] - gone[0] < 1030 * MS, "the second question finds it"
    assert {errors for _, errors, _ in told} == {0, 3, 4}
    pulses = pulses_of(chip.edges(0))
    assert pulses[-1][0] > back_ns and {width for _, width in pulses[-5:]} == {307 * 122 * 40}


def test_stuck_bus_holds_the_main_loop_up_for_3_ms_a_time_and_is_freed(board):
    board.mcu.add_pca9685(0, 0x40, 6)
    board.repl.start(
        PROLOGUE
        + f"""
play([(1, 0, 0)], [{CHIP}])
run(4)
attach(0)
longest = []
for _ in range(100):
    before = board.tick_due_us()
    board.wait(20000)
    begun = time.ticks_us()
    due = loop.due
    loop.due = 0
    drivers.flush(level, pulse, due)
    drivers.attend(time.ticks_us())
    longest.append(time.ticks_diff(time.ticks_us(), begun))
    while time.ticks_diff(board.tick_due_us(), before) <= 0:
        pass
print(*longest)
print(drivers.bus_errors(), drivers.bus_gone(), loop.late)
board.close()
"""
    )
    board.mcu.run_for(500 * MS)
    board.mcu.set_i2c_stuck(0, True)
    board.mcu.run_for(700 * MS)
    board.mcu.set_i2c_stuck(0, False)
    first, second = board.repl.finish(10_000_000).splitlines()[:2]
    held_us = sorted(map(int, first.split()))
    errors, gone, late_us = map(int, second.split())
    assert held_us[-1] < 3 * 3_500 and held_us[-2] < 5_000 and held_us[-5] < 2_500
    assert (errors, gone) == (4, 0)
    assert late_us < LATE_MAX_US, "ticks do not wait for the bus"


# --- allocation


def test_tick_and_its_driver_calls_allocate_nothing(board):
    chip = board.mcu.add_pca9685(0, 0x40, 6)
    told = board(f"""
def step(n):
    for d in range(16):
        pulse[d] = (1000 + (n * 7 + d * 50) % 1000) << 18
        level[d] = 0x800000 + ((n * 0x12345 + d * 0x54321) & 0x7fffff) - 0x400000
    if n % 7 == 3:
        drivers.release(2)
        drivers.release(9)
        drivers.release(12)
    if n % 7 == 5:
        for d in range(2, 14, 5):
            drivers.attach(d, 20000)
    if n % 50 == 30:
        drivers.quiet()
    if n % 50 == 32:
        for d in range(14):
            drivers.attach(d, 20000)
    board.keep_pose(16, pulse)
    board.adc_start(28)
    board.adc_read()
    board.level(15)
    board.feed()
pins = [(0, pin) for pin in (16, 17, 2, 3, 20, 21, 22, 7)]
play(pins + [(2, 0, 8, 9, 0), (2, 1, 10, 11, 1)] + [(1, 0, channel) for channel in (0, 5, 9, 15)], [{CHIP}])
run(4)
attach(*range(14))
run(4)
before = loop.ticks
micropython.heap_lock()
try:
    run(300)
finally:
    micropython.heap_unlock()
print(loop.ticks - before, drivers.bus_errors(), loop.late)
""")
    ticks, errors, late_us = map(int, told.split())
    assert ticks == 300 and errors == 0 and late_us < LATE_MAX_US
    assert len(pulses_of(board.mcu.edges(16))) > 250
    assert len(pulses_of(chip.edges(15))) > 250


# --- inputs


@pytest.mark.parametrize("pin", [26, 27, 28])
def test_adc_measures_ratios(board, pin):
    for ratio in (0.0, 0.25, 0.7, 1.0):
        board.mcu.set_adc(pin, ratio)
        told = board(f"board.adc_start({pin})\ntime.sleep_us(3)\nprint(board.adc_read())")
        assert abs(int(told) - ratio * 32768) <= 9, "a count of twelve bits"


def test_kill_pin_is_high_if_nobody_drives_it(board):
    levels = []
    for level in (None, 0, 1, None):
        board.mcu.set_pin(15, level)
        levels.append(int(board("board.input_pullup(15)\ntime.sleep_us(10)\nprint(board.level(15))")))
    assert levels == [1, 0, 1, 1]


# --- the watchdog, and what a reset leaves


def test_pose_and_count_of_resets_outlive_the_watchdog(board):
    told = board("""
pose = array('i', [0, 1 << 24, 0x123456, 0x800000])
print(board.kept_pose(4, pose, 0x3abcdef0), board.watchdog_resets())
board.keep_pose(4, pose)
""")
    assert told.split() == ["False", "0"]
    for count in (1, 2):
        board.repl.start(PROLOGUE + "board.watchdog(50)\nwhile True: pass")
        board.mcu.run_for(1000 * MS)
        assert board.mcu.report()["resets"] == count
        board.repl.enter()
        told = board("""
pose = array('i', [7] * 4)
print(board.kept_pose(4, pose, 0x1), *pose)
print(board.kept_pose(4, pose, 0x3abcdef0), *pose)
print(board.watchdog_resets())
""")
        other, kept, resets = told.splitlines()
        assert other == "False 7 7 7 7"
        assert kept == f"True 0 {1 << 24} {(0x123456 + 256) >> 9 << 9} {0x800000}"
        assert int(resets) == count
    assert board("print(board.watchdog_resets())").strip() == "2", "a restart by hand is none"


def test_watchdog_that_is_fed_or_off_does_not_bite(board):
    board("""
board.watchdog(50)
for _ in range(30):
    time.sleep_ms(40)
    board.feed()
board.watchdog_off()
time.sleep_ms(300)
board.watchdog(100)
""")
    board.mcu.run_for(500 * MS)
    assert board.mcu.report()["resets"] == 0, "close has switched it off"


def test_close_leaves_pins_low_and_the_timer_off(board):
    board.mcu.add_pca9685(0, 0x40, 6)
    board(f"""
play([(0, 2), (2, 0, 8, 9, 0), (1, 0, 0)], [{CHIP}])
run(4)
attach(0, 1, 2)
level[0] = level[1] = 0x400000
run(12)
""")
    closed_ns = board.mcu.now_us * 1000
    board.mcu.run_for(100 * MS)
    for pin in (2, 8):
        edges = board.mcu.edges(pin)
        assert len(edges) > 10 and edges[-1][1] == 0 and edges[-1][0] < closed_ns
    assert board.repl.exec("from machine import mem32\nprint([mem32[0x40014004 + 8 * p] & 31 for p in (4, 5)])") == (
        "[5, 5]\r\n"
    )
