"""What a reset of the emulated RP2040 leaves and takes away, and the watchdog by its registers (RP2040 data sheet, 4.7)."""

import pytest

RAM = 0x20040000
PATTERN = [0x01234567, 0x3FFFFFFF, 0, 0x2AAAAAAA, 0x15555555, 1, 2, 3]
COUNTS_PER_US = 2
"""The watchdog counts down twice a microsecond (erratum RP2040-E1)."""

REGISTERS = """
import machine, time
from machine import Pin, PWM, mem32
CTRL, LOAD, SET, CLEAR = 0x40058000, 0x40058004, 0x40058000 + 0x2000, 0x40058000 + 0x3000
ENABLE = 1 << 30
WDSEL, ALL_BUT_OSCILLATORS = 0x40010008, 0x1fffc
mem32[WDSEL] = ALL_BUT_OSCILLATORS
mark = Pin(5, Pin.OUT, value=0)
"""

# Load the watchdog and enable it; the mark is high while it is being enabled.
ENABLE_MARKED = """
import micropython
@micropython.asm_thumb
def enable(r0, r1, r2, r3):
    str(r3, [r0, 4])
    str(r2, [r1, 0x14])
    mov(r3, 1)
    lsl(r3, r3, 30)
    str(r3, [r0, 0])
    str(r2, [r1, 0x18])
def start(counts):
    enable(CTRL, 0xd0000000, 1 << 5, counts)
"""


def resets(repl):
    return repl.mcu.report()["resets"]


def reset_by_watchdog(repl):
    repl.exec("import machine; machine.WDT(timeout=50)")


def reset_by_call(repl):
    repl.mcu.send(b"import machine; machine.reset()\x04")


@pytest.mark.parametrize("reset", [reset_by_watchdog, reset_by_call])
def test_reset_keeps_the_ram_that_the_runtime_leaves_alone(repl, reset):
    repl.exec(f"from machine import mem32\nfor i, word in enumerate({PATTERN}): mem32[{RAM} + 4 * i] = word")
    for count in (1, 2):
        reset(repl)
        repl.mcu.run_for(300_000)
        assert resets(repl) == count
        repl.enter()
        kept = repl.exec(f"from machine import mem32\nprint([mem32[{RAM} + 4 * i] for i in range({len(PATTERN)})])")
        assert kept == f"{PATTERN}\r\n"


@pytest.mark.parametrize("reset", [reset_by_watchdog, reset_by_call])
def test_reset_lets_go_of_pins_and_stops_pwm_at_once(repl, reset):
    repl.exec(REGISTERS + "high = Pin(4, Pin.OUT, value=1)\nservo = PWM(Pin(8), freq=50, duty_u16=40000)")
    repl.exec("full = PWM(Pin(11), freq=1000, duty_u16=65535)")
    repl.mcu.run_for(50_000)
    reset(repl)
    repl.mcu.run_for(300_000)
    reset_ns = repl.mcu.edges(4)[-1][0]
    assert repl.mcu.edges(11)[-1] == (reset_ns, 0)
    for pin in (4, 8):
        assert repl.mcu.edges(pin)[-1][1] == 0
        assert repl.mcu.edges(pin)[-1][0] <= reset_ns
    repl.enter()
    assert repl.exec("from machine import mem32\nprint(mem32[0xd0000020] & (1 << 4 | 1 << 5))") == "0\r\n"
    enabled = repl.exec("print([mem32[0x40050000 + 20 * slice] & 1 for slice in range(8)])")
    assert enabled == f"{[0] * 8}\r\n"
    assert repl.exec("print([mem32[0x40014004 + 8 * pin] & 31 for pin in (4, 8, 11)])") == "[31, 31, 31]\r\n"


@pytest.mark.parametrize("timeout_us", [1_000, 30_000, 2_000_000])
def test_watchdog_resets_when_its_counts_have_run_out(repl, timeout_us):
    repl.exec(REGISTERS + ENABLE_MARKED + "high = Pin(4, Pin.OUT, value=1)")
    repl.start(f"start({COUNTS_PER_US * timeout_us})\nwhile True: pass")
    repl.mcu.run_for(timeout_us + 100_000)
    (up_ns, _), (down_ns, _) = repl.mcu.edges(5)[:2]
    reset_ns = repl.mcu.edges(4)[-1][0]
    assert resets(repl) == 1
    assert up_ns <= reset_ns - timeout_us * 1000 <= down_ns


def test_watchdog_is_fed_by_its_load_register(repl):
    repl.exec(REGISTERS + f"mem32[LOAD] = {COUNTS_PER_US * 50_000}\nmem32[SET] = ENABLE")
    repl.exec(f"for _ in range(10):\n    time.sleep_ms(45)\n    mem32[LOAD] = {COUNTS_PER_US * 50_000}\n")
    fed_us = repl.mcu.now_us
    assert resets(repl) == 0
    repl.mcu.run_until(fed_us + 45_000)
    assert resets(repl) == 0
    repl.mcu.run_until(fed_us + 51_000)
    assert resets(repl) == 1


def test_watchdog_tells_the_time_left(repl):
    repl.exec(REGISTERS + f"mem32[LOAD] = {COUNTS_PER_US * 50_000}\nmem32[SET] = ENABLE")
    repl.exec("before = time.ticks_us(); first = mem32[CTRL] & 0xffffff; time.sleep_ms(20)")
    counts, us = repl.exec("print(first - (mem32[CTRL] & 0xffffff), time.ticks_diff(time.ticks_us(), before))").split()
    assert abs(int(counts) - COUNTS_PER_US * int(us)) < 1000  # the timer and the counter are read some 0.2 ms apart


def test_watchdog_disabled_by_its_registers_stays_quiet(repl):
    repl.exec(REGISTERS + f"mem32[LOAD] = {COUNTS_PER_US * 20_000}\nmem32[SET] = ENABLE")
    assert repl.exec("mem32[CLEAR] = ENABLE\nprint(mem32[CTRL] & ENABLE)") == "0\r\n"
    repl.mcu.run_for(500_000)
    assert resets(repl) == 0
    repl.exec(f"mem32[LOAD] = {COUNTS_PER_US * 20_000}\nmem32[SET] = ENABLE")
    repl.mcu.run_for(30_000)
    assert resets(repl) == 1


def test_watchdog_resets_only_what_was_chosen(repl):
    repl.exec(REGISTERS + f"mem32[WDSEL] = 0\nmem32[LOAD] = {COUNTS_PER_US * 20_000}\nmem32[SET] = ENABLE")
    repl.mcu.run_for(100_000)
    assert resets(repl) == 0
    assert repl.exec("print(6 * 7)") == "42\r\n"
