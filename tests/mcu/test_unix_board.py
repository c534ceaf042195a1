"""The PC's virtual board, driven by small programs of its own: ticks, pins, inputs, I2C, watchdog, and what resets leave."""

import random

import pytest

from marotte.errors import MarotteError
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses

PROLOGUE = """
import sys
from array import array
from firmware.board_unix import Board

commands, records, kept, resets = sys.argv[1:]
board = Board(open(commands, "rb"), open(records, "wb"), kept, int(resets))
byte = bytearray(1)


def say(*words):
    text = " ".join(map(str, words)) + "\\n"
    board.send(text.encode(), len(text))


"""
IDLE = """
while True:
    while board.receive(byte):
        say("got", byte[0])
    board.wait(20000)
"""
MS = 1000
ONE_US_Q18 = 1 << 18


@pytest.fixture(params=[64, pytest.param(32, marks=pytest.mark.images)])
def start(request, tmp_path):
    """A function that starts a program, followed by a loop that tells the bytes received, on a virtual board."""
    started = []

    def start(program, loop=IDLE):
        script = tmp_path / f"{len(started)}.py"
        script.write_text(PROLOGUE + program + loop)
        started.append(UnixMcu(bits=request.param, program=script))
        return started[-1]

    yield start
    for mcu in started:
        mcu.close()


def said(mcu):
    """Return what the program has said since the last call: `(t_us, words)`."""
    return [(t_us, line) for t_us, data in mcu.receive() for line in data.decode().splitlines()]


# --- ticks

TICKING = """
def tick():
    say("tick", board.ticks_us())


board.start_ticks(3008, tick)
"""


def test_ticks_come_at_exact_multiples_of_their_period(start):
    mcu = start("board.wait(777)\n" + TICKING)
    rng = random.Random(1)
    while mcu.now_us < 400 * 3008:
        mcu.run_for(rng.choice((1, 5, 3007, 3008, 3009, 12345)))
    found = said(mcu)
    assert len(found) >= 399
    assert found == [(at_us, f"tick {at_us}") for at_us in range(777 + 3008, 777 + 3008 * (len(found) + 1), 3008)]


def test_tick_comes_before_anything_else_of_its_microsecond(start):
    mcu = start(TICKING)
    mcu.send(b"a", 3008)
    mcu.run_until(3008)
    mcu.run_until(2 * 3008)
    mcu.send(b"b")
    mcu.run_for(1)
    assert [line for _, line in said(mcu)] == ["tick 3008", "got 97", "tick 6016", "got 98"]


def test_wait_ends_with_a_tick_a_byte_or_its_time(start):
    loop = """
while True:
    board.wait(5000)
    say("back", board.receive(byte))
"""
    mcu = start("board.start_ticks(12000, lambda: None)\n", loop)
    mcu.send(b"x", 11_000)
    mcu.run_until(20_000)
    assert said(mcu) == [
        (5_000, "back 0"),
        (10_000, "back 0"),
        (11_000, "back 1"),
        (12_000, "back 0"),
        (17_000, "back 0"),
    ]


def test_changed_period_counts_from_now(start):
    program = """
def tick():
    say("tick", board.tick_due_us())


board.start_ticks(20000, tick)
board.wait(20000)
board.wait(10000)
board.start_ticks(3008, tick)
say("due", board.tick_due_us())
"""
    mcu = start(program)
    mcu.run_until(38_000)
    assert said(mcu) == [
        (20_000, "tick 40000"),
        (30_000, "due 33008"),
        (33_008, "tick 36016"),
        (36_016, "tick 39024"),
    ]


def test_period_changed_by_a_tick_counts_from_it(start):
    program = """
def tick():
    say("tick")
    board.start_ticks(5000, tick)


board.start_ticks(20000, tick)
"""
    mcu = start(program)
    mcu.run_until(31_000)
    assert [t_us for t_us, _ in said(mcu)] == [20_000, 25_000, 30_000]


def test_stopped_ticks_stay_away_until_they_are_started(start):
    program = TICKING + "board.wait(3008)\nboard.stop_ticks()\nboard.wait(100000)\nboard.start_ticks(4000, tick)\n"
    mcu = start(program)
    mcu.run_until(108_000)
    assert [t_us for t_us, _ in said(mcu)] == [3008, 107_008]


def test_ticks_go_on_when_the_timer_wraps(start):
    near_us = (1 << 30) - 50_000
    until_near = f"while board.ticks_us() < {near_us}:\n    board.wait(min(1000000, {near_us} - board.ticks_us()))\n"
    mcu = start(until_near + TICKING)
    mcu.run_until((1 << 30) + 50_000)
    found = said(mcu)
    assert [at_us for at_us, _ in found] == [near_us + 3008 * (n + 1) for n in range(100_000 // 3008)]
    assert [line for _, line in found] == [f"tick {at_us % (1 << 30)}" for at_us, _ in found]


def test_busy_main_loop_keeps_bytes_waiting_and_lets_ticks_go_on(start):
    loop = """
due_us = 33000
while True:
    while board.receive(byte):
        say("got", byte[0])
    if board.ticks_us() >= due_us:
        say("frame", board.ticks_us() - due_us)
        due_us += 33000
    board.wait(due_us - board.ticks_us())
"""
    mcu = start("board.start_ticks(20000, lambda: say('tick'))\n", loop)
    mcu.run_until(34_000)
    mcu.block(40_000)
    mcu.send(b"x", 70_000)
    mcu.run_until(140_000)
    assert said(mcu) == [
        (20_000, "tick"),
        (33_000, "frame 0"),
        (40_000, "tick"),
        (60_000, "tick"),
        (80_000, "tick"),
        (100_000, "tick"),
        (106_000, "got 120"),
        (106_000, "frame 40000"),
        (106_000, "frame 7000"),
        (120_000, "tick"),
        (132_000, "frame 0"),
        (140_000, "tick"),
    ]


def test_failure_in_a_tick_is_told(start):
    mcu = start("def tick():\n    raise ValueError('from the tick')\n\n\nboard.start_ticks(5000, tick)\n")
    with pytest.raises(MarotteError, match="from the tick"):
        mcu.run_until(10_000)


# --- pins

SERVOS = """
pin = bytearray([4, 5, 255])
pulse = array("I", [1500 << 18, 1000 << 18, 0])
count = 0


def tick():
    global count
    count += 1
    pulse[0] += 1 << 18
    board.servo_write(3, pin, 7 if count % 2 else 5, pulse)


board.start_ticks(20000, tick)
"""


def test_pulse_width_acts_from_the_end_of_the_period_on(start):
    mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\n")
    mcu.run_until(82_000)
    found = pulses(mcu.edges(4))
    assert [(pulse.start_ns // MS, pulse.width_ns // MS) for pulse in found] == [
        (21_000, 1501),
        (41_000, 1502),
        (61_000, 1503),
    ]
    assert mcu.edges(4)[-1] == (81_000 * MS, 1)
    assert mcu.edges(5) == []


def test_pins_of_a_slice_share_its_phase(start):
    mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\nboard.wait(7000)\nboard.servo_attach(5, 20000, 3000)\n")
    mcu.run_until(70_000)
    assert [pulse.start_ns // MS for pulse in pulses(mcu.edges(5))] == [21_000, 41_000, 61_000]


ENDS = {"release": "board.pin_low(4)\nboard.pin_low(5)\n", "quiet": "board.quiet()\n", "close": "board.close()\n"}


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_pulses_end_at_once(start, end):
    attach = "board.servo_attach(4, 20000, 21000)\nboard.servo_attach(5, 20000, 21000)\n"
    mcu = start(SERVOS + attach + "board.wait(20000)\nboard.wait(1300)\n" + end)
    mcu.run_until(100_000)
    assert mcu.edges(4) == mcu.edges(5) == [(21_000 * MS, 1), (21_300 * MS, 0)]


def test_reset_ends_pulses_at_once(start):
    mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\n")
    mcu.run_until(41_200)
    mcu.reset()
    assert mcu.edges(4)[-2:] == [(41_000 * MS, 1), (41_200 * MS, 0)]
    mcu.run_for(30_000)
    assert mcu.edges(4)[-2:] == [(62_200 * MS, 1), (63_701 * MS, 0)], "its time has begun anew"


def test_attached_pin_is_low_until_it_is_written(start):
    again = (
        "board.wait(20000)\nboard.wait(1300)\nboard.pin_low(4)\nboard.wait(200)\nboard.servo_attach(4, 20000, 5000)\n"
    )
    mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\n" + again)
    mcu.run_until(60_000)
    assert [t_ns // MS for t_ns, _ in mcu.edges(4)] == [21_000, 21_300, 46_500, 48_002]


def test_pin_that_comes_back_to_a_running_slice_waits_for_the_second_write(start):
    attach = "board.servo_attach(4, 20000, 21000)\nboard.servo_attach(5, 20000, 21000)\n"
    mcu = start(
        SERVOS + attach + "board.wait(20000)\nboard.wait(1300)\nboard.pin_low(4)\nboard.servo_attach(4, 20000, 7)\n"
    )
    mcu.run_until(90_000)
    assert [t_ns // MS for t_ns, level in mcu.edges(4) if level] == [21_000, 61_000, 81_000]


def test_bridge_has_its_duty_each_50_us(start):
    program = """
board.bridge_attach(6)
board.drive(7, 1)
board.bridge_write(6, 16384)
board.wait(500)
board.bridge_write(6, 65536)
board.wait(500)
board.drive(7, 0)
board.bridge_write(6, 0)
"""
    mcu = start(program)
    mcu.run_until(2000)
    found = pulses(mcu.edges(6))
    assert [(pulse.start_ns, pulse.width_ns) for pulse in found] == [
        *((start_us * MS, 12_500) for start_us in range(50, 501, 50)),
        (550 * MS, 500 * MS),
    ]
    assert mcu.edges(7) == [(0, 1), (1000 * MS, 0)]


def test_drives_are_all_that_was_written_at_full_resolution(start):
    mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\nboard.servo_attach(5, 20000, 21000)\n")
    mcu.run_until(100_000)
    drives = mcu.drives()
    assert drives.keys() == {4, 5}
    assert drives[4].t_us.tolist() == [20_000, 40_000, 60_000, 80_000, 100_000]
    assert drives[4].value.tolist() == [(1501 + n) * ONE_US_Q18 for n in range(5)]
    assert drives[5].t_us.tolist() == [20_000, 60_000, 100_000]
    mcu.clear_drives()
    mcu.run_until(140_000)
    assert mcu.drives()[4].value.tolist() == [1506 * ONE_US_Q18, 1507 * ONE_US_Q18]
    assert len(pulses(mcu.edges(4))) == 6
    mcu.clear_edges()
    assert mcu.edges(4) == []


def test_pin_that_kills_is_seen_by_the_next_tick(start):
    mcu = start("board.input_pullup(9)\nboard.start_ticks(5000, lambda: say(board.level(9)))\n")
    mcu.run_until(5000)
    mcu.set_pin(9, 0)
    mcu.run_until(10_000)
    mcu.set_pin(9, 1)
    mcu.run_until(15_000)
    mcu.set_pin(9, 0)
    mcu.reset()
    mcu.run_until(20_000)
    mcu.set_pin(9, None)
    mcu.run_until(25_000)
    assert [line for _, line in said(mcu)] == ["1", "0", "1", "0", "1"]


def test_analogue_input_is_read_when_it_is_started(start):
    program = """
def tick():
    say(board.adc_read())
    board.adc_start(26)


board.start_ticks(5000, tick)
"""
    mcu = start(program)
    for ratio in (0.25, 0.5, 1.0):
        mcu.set_adc(26, ratio)
        mcu.run_for(5000)
    mcu.run_for(5000)
    assert [line for _, line in said(mcu)] == ["0", "8194", "16388", "32768"]


# --- I2C

SERVO_CHIP = """
bus = board.i2c(2, 3, 400000)
board.drive(8, 1)


def write(*values):
    try:
        bus.writeto(0x41, bytes(values))
    except OSError as error:
        say("error", error.errno)


write(0, 0x30)
write(0xFE, 121)
write(0, 0x20)
write(6, 0, 0, 0x33, 1, 0, 2, 0x99, 3)
board.drive(8, 0)
"""


def test_device_that_is_absent_raises_an_error(start):
    mcu = start(SERVO_CHIP)
    mcu.run_until(1000)
    assert [line for _, line in said(mcu)] == ["error 5"] * 4


def test_pca9685_makes_the_pulses_that_it_is_told(start):
    mcu = start("board.wait(2000)\n" + SERVO_CHIP)
    chip = mcu.add_pca9685(1, 0x41, oe_pin=8)
    mcu.run_until(100_000)
    assert said(mcu) == []
    count_us = 122 * 0.04
    first, second = pulses(chip.edges(0))[0], pulses(chip.edges(1))[0]
    assert (first.start_ns / 1000, first.width_ns / 1000) == pytest.approx((2500, 0x133 * count_us), abs=0.001)
    assert second.start_ns / 1000 == pytest.approx(2500 + 0x200 * count_us, abs=0.001)
    assert second.width_ns / 1000 == pytest.approx((0x399 - 0x200) * count_us, abs=0.001)
    assert [pulse.start_ns - first.start_ns for pulse in pulses(chip.edges(0))[:3]] == pytest.approx(
        [0, 4096 * count_us * 1000, 8192 * count_us * 1000], abs=1
    )
    assert chip.edges(2) == []


def test_pca9685_that_is_pulled_out_forgets_everything(start):
    mcu = start("board.wait(2000)\n" + SERVO_CHIP + "\nwhile True:\n    board.wait(20000)\n    write(6)\n")
    chip = mcu.add_pca9685(1, 0x41)
    mcu.run_until(50_000)
    chip.remove()
    mcu.clear_edges()
    mcu.run_until(100_000)
    assert [line for _, line in said(mcu)] == ["error 5"] * 2
    chip.put_back()
    mcu.run_until(200_000)
    assert said(mcu) == []
    assert chip.edges(0) == []


def test_oe_cuts_the_outputs_of_a_pca9685_at_once(start):
    mcu = start(SERVO_CHIP + "board.wait(20000)\n" * 2 + "board.wait(1000)\nboard.drive(8, 1)\n")
    chip = mcu.add_pca9685(1, 0x41, oe_pin=8)
    mcu.run_until(100_000)
    assert chip.edges(0)[-2:] == [(pytest.approx(500_000 + 2 * 4096 * 122 * 40, abs=1), 1), (41_000 * MS, 0)]
    assert len(chip.edges(0)) == 6


# --- the watchdog, and what resets leave

WATCHED = """
say("begun", board.watchdog_resets(), board.ticks_us())
pose = array("I", [0] * 3)
say(board.kept_pose(3, pose, 77), list(pose))
"""


def test_watchdog_resets_an_mcu_that_does_not_feed_it(start):
    loop = """
board.watchdog(50)
while True:
    board.keep_pose(3, array("I", [0, 5000 << 9, 1 << 24]))
    board.wait(20000)
    board.feed()
"""
    mcu = start(WATCHED, loop)
    mcu.run_until(100_000)
    mcu.block(25_000)
    mcu.run_until(300_000)
    nothing = [(0, "begun 0 0"), (0, "False [0, 0, 0]")]
    assert said(mcu) == nothing
    mcu.block(1_000_000)
    mcu.send(b"lost", 310_000)
    mcu.run_until(800_000)
    kept = f"True {[0, 5000 << 9, 1 << 24]}"
    assert said(mcu) == [(335_000, "begun 1 0"), (335_000, kept)]
    mcu.reset()
    mcu.run_for(1000)
    assert said(mcu) == [(800_000, "begun 2 0"), (800_000, kept)]


def test_watchdog_that_is_off_lets_the_mcu_be(start):
    mcu = start(WATCHED + "board.watchdog(10)\nboard.wait(5000)\nboard.watchdog_off()\n")
    mcu.run_until(1_000_000)
    assert len(said(mcu)) == 2


def test_pose_is_known_by_its_tag_only_and_not_after_power_on(start):
    keep = "board.keep_pose(3, array('I', [1 << 23, 3, 511]))\nsay(board.kept_pose(3, pose, 78))\n"
    mcu = start(WATCHED + keep)
    mcu.run_until(1000)
    mcu.reset()
    mcu.run_for(1000)
    assert [line for _, line in said(mcu)] == [
        "begun 0 0",
        "False [0, 0, 0]",
        "False",
        "begun 1 0",
        f"True {[1 << 23, 0, 512]}",
        "False",
    ]
    mcu = start(WATCHED)
    mcu.run_until(1000)
    assert said(mcu)[1][1] == "False [0, 0, 0]"


def test_run_repeats_to_the_bit_however_it_is_cut(start):
    def performed(step_us):
        mcu = start(SERVOS + "board.servo_attach(4, 20000, 21000)\nboard.watchdog(300)\n", IDLE + "    board.feed()\n")
        mcu.send(b"a", 30_000)
        mcu.send(b"b", 50_000)
        while mcu.now_us < 200_000:
            mcu.run_for(min(step_us, 200_000 - mcu.now_us))
        return mcu.edges(4), mcu.receive(), {pin: (*drive.t_us, *drive.value) for pin, drive in mcu.drives().items()}

    expected = performed(200_000)
    assert len(expected[0]) > 10 and len(expected[1]) == 2
    for step_us in (1000, 19_999, 20_000, 33_333):
        assert performed(step_us) == expected
