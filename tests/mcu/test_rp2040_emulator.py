"""The emulated RP2040 itself: time, pins, flash, resets and links, by small programs on its raw REPL."""

import itertools
import os

import pytest

from marotte.errors import MarotteError
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu

CLOCK_NS = 8
PWM_BASE = 0x40050000

# Slice 1 (pins 2 and 3) at 125 MHz / 40 with 62500 counts: 320 ns a count, 20 ms a period.
PWM_SETUP = f"""
import machine
from machine import mem32
for gpio in (2, 3):
    machine.Pin(gpio, machine.Pin.OUT, value=0)
    mem32[{0x40014000} + 8 * gpio + 4] = 4
SLICE = {PWM_BASE} + 0x14
mem32[SLICE + 4] = 40 << 4
mem32[SLICE + 16] = 62499
def counts(a, b):
    mem32[SLICE + 12] = a | b << 16
"""
COUNT_NS = 320


def pulses(edges):
    """The widths, in ns, of the pulses that begin and end within `edges`."""
    return [fall - rise for (rise, level), (fall, _) in itertools.pairwise(edges) if level]


def test_boot_reaches_the_repl_and_runs_code(repl):
    assert repl.exec("print(6 * 7)") == "42\r\n"
    assert repl.mcu.now_us < 200_000


def test_exec_reports_an_exception_of_the_mcu(repl):
    with pytest.raises(MarotteError, match="ZeroDivisionError"):
        repl.exec("1 // 0")


@pytest.mark.parametrize("count", [1, 1563, 4687, 7812, 62499])
def test_pwm_pulse_is_exact(repl, count):
    repl.exec(PWM_SETUP + f"counts({count}, 1500)\nmem32[SLICE] = 1")
    repl.mcu.run_for(100_000)
    assert set(pulses(repl.mcu.edges(2))) == {count * COUNT_NS}
    assert set(pulses(repl.mcu.edges(3))) == {1500 * COUNT_NS}
    rises = [t for t, level in repl.mcu.edges(2) if level]
    assert {b - a for a, b in itertools.pairwise(rises)} == {62500 * COUNT_NS}


def test_pwm_compare_value_latches_at_the_wrap(repl):
    repl.exec(PWM_SETUP + "counts(25000, 0)\nmem32[SLICE] = 1")
    repl.mcu.run_for(50_000)
    rise_ns = [t for t, level in repl.mcu.edges(2) if level][-1] + 20_000_000
    repl.mcu.clear_edges()
    repl.mcu.run_until(rise_ns // 1000 + 100)
    repl.exec("counts(20000, 0)")
    assert repl.mcu.now_us < rise_ns // 1000 + 20_000 * COUNT_NS // 1000
    repl.mcu.run_for(60_000)
    after = [edge for edge in repl.mcu.edges(2) if edge[0] >= rise_ns]
    assert after[0] == (rise_ns, 1)
    assert pulses(after)[:2] == [25000 * COUNT_NS, 20000 * COUNT_NS]


def test_pin_edges_have_the_instants_of_the_instructions(repl):
    repl.exec(
        "import machine, time\n"
        "pin = machine.Pin(5, machine.Pin.OUT, value=0)\n"
        "def blink():\n"
        "    for wait_us in (100, 250, 1000):\n"
        "        pin.on(); time.sleep_us(wait_us); pin.off(); time.sleep_us(50)\n"
        "blink()"
    )
    widths = pulses(repl.mcu.edges(5))
    for wait_us, width_ns in zip((100, 250, 1000), widths, strict=True):
        assert wait_us * 1000 <= width_ns < wait_us * 1000 + 25_000
    assert {t % CLOCK_NS for t, _ in repl.mcu.edges(5)} == {repl.mcu.edges(5)[0][0] % CLOCK_NS}
    repl.mcu.clear_edges()
    assert repl.mcu.edges(5) == []


def noisy_run(image, piece_us):
    """Everything observable of a run with timers, PWM, printing and bytes at odd instants, in pieces of `piece_us`."""
    with Rp2040Mcu(image) as mcu:
        repl = RawRepl(mcu)
        start_us = mcu.now_us
        repl.start(
            PWM_SETUP + "counts(777, 4000)\nmem32[SLICE] = 1\n"
            "import sys\n"
            "led = machine.Pin(7, machine.Pin.OUT)\n"
            "timer = machine.Timer(period=3, callback=lambda t: led.toggle(), hard=True)\n"
            "for _ in range(2): print(sys.stdin.readline())\n"
            "with open('log.txt', 'w') as log: log.write('x' * 5000)\n"
            "print(sys.stdin.readline())\n"
        )
        received = []
        lines = [(start_us + 20_017, b"one\n"), (start_us + 61_003, b"two\n"), (start_us + 80_001, b"three\n")]
        while mcu.now_us < start_us + 400_000:
            until_us = min(mcu.now_us + piece_us, start_us + 400_000)
            while lines and lines[0][0] < until_us:  # handed over as late as possible
                at_us, line = lines.pop(0)
                mcu.send(line, at_us)
            mcu.run_until(until_us)
            received += mcu.receive()
        return received, mcu.edges(2), mcu.edges(3), mcu.edges(7), mcu.state(), mcu.report()


def test_runs_repeat_to_the_bit_in_whatever_pieces(rp2040_image_path):
    first = noisy_run(rp2040_image_path, 400_000)
    assert b"three" in b"".join(data for _, data in first[0])
    assert len(first[3]) >= 50
    assert noisy_run(rp2040_image_path, 400_000) == first
    assert noisy_run(rp2040_image_path, 333) == first


def test_compiled_core_equals_the_core_of_the_package(rp2040_image_path):
    with Rp2040Mcu(rp2040_image_path) as compiled, Rp2040Mcu(rp2040_image_path, core="js") as package:
        for mcu in (compiled, package):
            mcu.send(b"\r\x03\x03\r\x01import os; print(sum(i * 1.5 for i in range(50)), os.urandom(4))\x04", 130_000)
        for t_us in (1_000, 5_000, 20_000, 60_000, 110_000, 131_000, 140_000):
            for mcu in (compiled, package):
                mcu.run_until(t_us)
            assert compiled.state() == package.state()
        assert compiled.receive() == package.receive()


def test_hard_timer_keeps_its_period(repl):
    repl.exec(
        "import machine\n"
        "pin = machine.Pin(6, machine.Pin.OUT)\n"
        "def tick(timer): pin.toggle()\n"
        "timer = machine.Timer(period=10, callback=tick, hard=True)\n"
    )
    repl.mcu.run_for(200_000)
    instants = [t for t, _ in repl.mcu.edges(6)]
    assert len(instants) >= 19
    assert all(abs((b - a) - 10_000_000) < 5_000 for a, b in itertools.pairwise(instants))


def test_inputs_read_levels_pulls_and_their_own_output(repl):
    repl.exec("from machine import Pin\nup = Pin(10, Pin.IN, Pin.PULL_UP)\ndown = Pin(11, Pin.IN, Pin.PULL_DOWN)")
    assert repl.exec("print(up.value(), down.value())") == "1 0\r\n"
    repl.mcu.set_pin(10, 0)
    repl.mcu.set_pin(11, 1)
    assert repl.exec("print(up.value(), down.value())") == "0 1\r\n"
    repl.mcu.set_pin(10, None)
    assert repl.exec("print(up.value(), down.value())") == "1 1\r\n"
    assert repl.exec("up.init(Pin.OUT, value=0); print(up.value()); up.value(1); print(up.value())") == "0\r\n1\r\n"


def test_input_edge_interrupts_the_mcu(repl):
    repl.exec("from machine import Pin\nseen = []\nkey = Pin(12, Pin.IN, Pin.PULL_UP)")
    repl.exec("key.irq(seen.append, Pin.IRQ_FALLING)")
    repl.mcu.set_pin(12, 0)
    repl.mcu.run_for(1_000)
    assert repl.exec("print(len(seen))") == "1\r\n"


def test_flash_keeps_files_from_run_to_run(rp2040_image_path, tmp_path):
    chip = tmp_path / "flash.bin"
    with Rp2040Mcu(rp2040_image_path, flash=chip) as mcu:
        RawRepl(mcu).exec("with open('pose.txt', 'w') as file: file.write('0.25')")
        assert mcu.report()["flash_programs"] > 0
    with Rp2040Mcu(rp2040_image_path, flash=chip) as mcu:
        assert RawRepl(mcu).exec("print(open('pose.txt').read())") == "0.25\r\n"


def test_flash_operations_take_their_time(rp2040_image_path):
    code = (
        "import rp2, time\n"
        "flash, data = rp2.Flash(), bytes(4096)\n"
        "start = time.ticks_us()\n"
        "flash.writeblocks(200, data)\n"
        "print(time.ticks_diff(time.ticks_us(), start))\n"
    )
    took_us = {}
    for timed in (True, False):
        with Rp2040Mcu(rp2040_image_path, timed_flash=timed) as mcu:
            took_us[timed] = int(RawRepl(mcu).exec(code))
    assert took_us[False] < 5_000
    assert took_us[True] - took_us[False] == pytest.approx(45_000 + 16 * 400, abs=20)


def test_reset_restarts_the_chip_and_idles_its_pins(repl):
    repl.exec("with open('kept.txt', 'w') as file: file.write('yes')\n")
    repl.exec("import machine\nled = machine.Pin(4, machine.Pin.OUT, value=1)")
    repl.mcu.send(b"machine.reset()\x04")
    repl.mcu.run_for(300_000)
    assert repl.mcu.report()["resets"] == 1
    assert [level for _, level in repl.mcu.edges(4)] == [1, 0]
    repl.enter()
    assert repl.exec("print('led' in globals(), open('kept.txt').read())") == "False yes\r\n"


def test_watchdog_resets_a_chip_that_does_not_feed_it(repl):
    repl.exec("import machine\ndog = machine.WDT(timeout=100)")
    fed_us = repl.mcu.now_us
    repl.mcu.run_for(95_000)
    assert repl.mcu.report()["resets"] == 0
    repl.mcu.run_until(fed_us + 101_000)
    assert repl.mcu.report()["resets"] == 1
    repl.mcu.run_for(100_000)
    repl.enter()
    assert repl.exec("import machine; print(machine.reset_cause() == machine.WDT_RESET)") == "True\r\n"


def test_bytes_reach_the_chip_at_their_instant(repl):
    repl.start(
        "import sys, machine\n"
        "pin = machine.Pin(9, machine.Pin.OUT, value=0)\n"
        "while sys.stdin.read(1) != 'z': pin.toggle()\n"
    )
    repl.mcu.run_for(5_000)
    start_us = repl.mcu.now_us
    sent_us = [start_us + 7_001, start_us + 7_500, start_us + 30_123]
    for at_us in sent_us:
        repl.mcu.send(b"x", at_us)
    repl.mcu.run_for(40_000)
    delays_ns = [seen_ns - at_us * 1000 for (seen_ns, _), at_us in zip(repl.mcu.edges(9), sent_us, strict=True)]
    assert all(20_000 < delay_ns < 150_000 for delay_ns in delays_ns)
    assert max(delays_ns) - min(delays_ns) < 20_000


def test_bytes_for_the_past_are_refused(repl):
    with pytest.raises(ValueError, match="has passed"):
        repl.mcu.send(b"x", repl.mcu.now_us - 1)


def test_uart_carries_bytes_at_its_rate(repl):
    repl.exec("import machine\nuart = machine.UART(0, 115200, tx=machine.Pin(0), rx=machine.Pin(1))\ngot = b''")
    repl.start("while len(got) < 100:\n    got += uart.read(uart.any()) or b''\nuart.write(bytes(reversed(got)))\n")
    sent_us = repl.mcu.now_us
    repl.mcu.send(bytes(range(100)), link="uart")
    repl.finish()
    repl.mcu.run_for(20_000)
    received = repl.mcu.receive(link="uart")
    assert b"".join(data for _, data in received) == bytes(reversed(range(100)))
    assert received[0][0] > sent_us + 100 * 86
    assert all(86 <= b - a <= 87 for (a, _), (b, _) in itertools.pairwise(received))
    assert repl.mcu.report()["uart_lost"] == 0


def test_uart_loses_what_nobody_receives(pico):
    pico.run_until(20_000)
    pico.send(b"hello", link="uart")
    pico.run_for(10_000)
    assert pico.report()["uart_lost"] == 5


def test_host_that_stops_reading_holds_the_chip_up(repl):
    repl.mcu.set_host_reading(False)
    repl.mcu.send(b"for i in range(40): print('x' * 50)\x04")
    repl.mcu.run_for(50_000)
    assert repl.mcu.receive() == []
    repl.mcu.set_host_reading(True)
    repl.mcu.run_for(100_000)
    assert b"".join(data for _, data in repl.mcu.receive()).count(b"x" * 50) == 40


def test_report_tells_what_ran(repl, rp2040_image_path):
    before = repl.mcu.report()
    repl.exec("for i in range(1000): pass")
    after = repl.mcu.report()
    assert after["kind"] == "rp2040"
    assert after["clk_hz"] == 125_000_000
    assert len(after["image_sha256"]) == 64
    assert after["image"] == str(rp2040_image_path)
    assert before["instructions"] < after["instructions"] < after["cycles"]


@pytest.mark.parametrize("contents", [b"", b"not an image", b"\0" * 1024])
def test_file_that_is_no_image_is_refused_with_its_name(tmp_path, contents):
    path = tmp_path / "broken.uf2"
    path.write_bytes(contents)
    with pytest.raises(MarotteError, match=r"broken\.uf2"):
        Rp2040Mcu(path)


def test_missing_image_is_refused_with_its_name():
    with pytest.raises(MarotteError, match=r"nowhere\.uf2: no such image"):
        Rp2040Mcu("nowhere.uf2")


def test_emulator_that_dies_is_an_error_and_no_hang(pico):
    os.kill(pico._process.pid, 9)
    with pytest.raises(MarotteError, match="it has ended"):
        pico.run_for(1_000)
    with pytest.raises(MarotteError):
        pico.report()
    pico.close()
