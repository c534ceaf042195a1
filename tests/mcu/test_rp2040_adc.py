"""The ADC of the emulated RP2040 against its data sheet (section 4.9): 12 bits, 96 cycles of 48 MHz for a conversion."""

import itertools

import pytest

ADC_BASE = 0x4004C000
CONVERSION_US = 2
RATIOS = [0.0, 1 / 4096, 0.25, 0.5, 0.9, 4095 / 4096, 1.0]

REGISTERS = f"""
from machine import mem32
CS, RESULT = {ADC_BASE}, {ADC_BASE + 4}
def convert(channel):
    mem32[CS] = channel << 12 | 1
    mem32[CS] = channel << 12 | 5
    while not mem32[CS] & 0x100: pass
    return mem32[RESULT]
"""


def code_of(ratio):
    """What an ideal converter of 12 bits makes of a part of its reference."""
    return min(int(ratio * 4096), 4095)


def read_u16_of(code):
    """MicroPython's scale: the 12 bits, and the highest of them again below."""
    return code << 4 | code >> 8


@pytest.mark.parametrize("pin", [26, 27, 28])
def test_adc_gives_the_level_at_its_pin(repl, pin):
    repl.exec(f"import machine\nadc = machine.ADC({pin})")
    assert repl.exec("print(adc.read_u16())") == "0\r\n"
    for ratio in RATIOS:
        repl.mcu.set_adc(pin, ratio)
        assert int(repl.exec("print(adc.read_u16())")) == read_u16_of(code_of(ratio))


def test_adc_inputs_are_apart(repl):
    for pin, ratio in ((26, 0.1), (27, 0.5), (28, 0.8)):
        repl.mcu.set_adc(pin, ratio)
    repl.exec("import machine\nadcs = [machine.ADC(pin) for pin in (26, 27, 28)]")
    for order in itertools.permutations(range(3)):
        got = repl.exec(f"print(*[adcs[i].read_u16() for i in {order}])").split()
        assert [int(value) for value in got] == [read_u16_of(code_of((0.1, 0.5, 0.8)[i])) for i in order]


def test_adc_registers_convert_once(repl):
    repl.exec(REGISTERS)
    repl.mcu.set_adc(27, 0.6)
    assert int(repl.exec("print(convert(1))")) == code_of(0.6)
    repl.mcu.set_adc(27, 0.3)
    repl.exec("mem32[CS] = 1 << 12 | 1")  # no START_ONCE: the old result stays
    assert int(repl.exec("print(mem32[RESULT])")) == code_of(0.6)
    assert int(repl.exec("print(convert(1))")) == code_of(0.3)


def test_adc_starts_no_conversion_by_itself(repl):
    # As the SDK does it: START_ONCE by the register's alias that sets bits, the channel by the one that flips them.
    repl.exec(REGISTERS + "mem32[CS] = 1\nmem32[CS + 0x2000] = 4")
    repl.mcu.set_adc(26, 0.4)
    repl.mcu.set_adc(27, 0.7)
    assert repl.exec("print(mem32[CS] & 4)") == "0\r\n"
    repl.exec("mem32[CS + 0x1000] = 1 << 12")
    assert repl.exec("print(mem32[RESULT])") == "0\r\n"


def test_adc_is_ready_only_when_enabled(repl):
    repl.exec(REGISTERS)
    assert repl.exec("print(mem32[CS])") == "0\r\n"
    assert repl.exec("mem32[CS] = 1\nprint(mem32[CS] & 0x100)") == "256\r\n"


def test_adc_conversion_takes_2_us(repl):
    # Counts the turns of a loop that watches READY; a turn takes 6 to 9 cycles of 8 ns, by what a read of CS costs.
    code = """
import micropython
@micropython.asm_thumb
def wait(r0):
    mov(r2, 5)
    str(r2, [r0, 0])
    mov(r3, 1)
    lsl(r3, r3, 8)
    mov(r1, 0)
    label(AGAIN)
    add(r1, 1)
    ldr(r2, [r0, 0])
    tst(r2, r3)
    beq(AGAIN)
    mov(r0, r1)
"""
    repl.exec(REGISTERS + code + "mem32[CS] = 1")
    turns = int(repl.exec("print(wait(CS))"))
    assert 6 * 8 * turns <= CONVERSION_US * 1000 + 100
    assert 9 * 8 * turns >= CONVERSION_US * 1000 - 100


def test_adc_keeps_its_inputs_over_a_reset(repl):
    repl.mcu.set_adc(28, 0.75)
    repl.mcu.send(b"import machine; machine.reset()\x04")
    repl.mcu.run_for(300_000)
    repl.enter()
    assert int(repl.exec("import machine; print(machine.ADC(28).read_u16())")) == read_u16_of(code_of(0.75))


@pytest.mark.parametrize("pin, ratio", [(25, 0.5), (29, 0.5), (26, -0.01), (26, 1.01), (26, float("nan"))])
def test_adc_refuses_what_is_not_there(pico, pin, ratio):
    with pytest.raises(ValueError, match=r"must be"):
        pico.set_adc(pin, ratio)
