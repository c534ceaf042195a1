"""The board's kernels: what they write to the RP2040's registers, in 32 bits, over all pins, widths and positions.

Addresses and bits are those of the RP2040 data sheet.
"""

import math
import types
from collections import defaultdict
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import Pointer, load_checked
from tests.kernels.values import integers, words

ADDRESSES = [
    "_start_slice",
    "_clear",
    "_drive",
    "_quiet",
    "_compare",
    "_pulses",
    "_level",
    "_convert",
    "_converted",
    "_later",
    "_alarm_us",
    "_guard",
    "_feed",
    "_bitten",
    "_usb_is_idle",
    "_keep",
    "_kept",
    "_keep_pose",
    "_tag",
]
"""Kernels that compute addresses or bit patterns, for which 32 bits need no sign."""

BOARD = load_checked(
    "firmware/board_rp2040.py", overrides={"machine": types.SimpleNamespace()}, patterns=frozenset(ADDRESSES)
)

PSM_WDSEL = 0x40010008
PADS_BANK0 = 0x4001C000
PAD_AFTER_RESET = 0x56  # RP2040 data sheet, table 341: its output is enabled
IO_BANK0 = 0x40014000
PADS_BANK0 = 0x4001C000
ADC = 0x4004C000
PWM = 0x40050000
TIMER_ALARM3 = 0x4005401C
USB_CONTROL = 0x50100080
"""Buffer controls of endpoints, for each one to the host and one from it (data sheet, 4.1.2.5.1)."""
USB_AVAILABLE, USB_FULL = 1 << 10, 1 << 15
WATCHDOG = 0x40058000
GPIO_IN, GPIO_OUT_SET, GPIO_OUT_CLR, GPIO_OE_SET = 0xD0000004, 0xD0000014, 0xD0000018, 0xD0000024
KEPT = 0x20040000
SET, CLEAR = 0x2000, 0x3000
"""Offsets of a register's aliases that set and clear the bits written as 1 (data sheet, 2.1.2)."""

SLICE_BYTES = 0x14
CSR, DIV, CTR, CC, TOP = range(0, SLICE_BYTES, 4)
FUNCTION_PWM, FUNCTION_SIO, FUNCTION_NULL = 4, 5, 31

OFF, PULSES, CONNECTS, CLEARS = range(4)
PINS = (*range(2, 23), *range(26, 29))
SERVO_COUNT_US = Fraction(40, 125)

pulses_q18us = integers(formats.PULSE_MIN_US << 18, formats.PULSE_MAX_US << 18)
periods_us = st.integers(formats.MOTOR_PERIOD_MIN_US // 8, 20968 // 8).map(lambda eighths: 8 * eighths)
pins = st.sampled_from(PINS)


class Memory:
    """All registers; stands in for the cast of an address to `ptr32`. `written` lists the stores in order."""

    def __init__(self):
        self.word = defaultdict(int)
        self.written = []

    def __call__(self, address):
        if not isinstance(address, int):
            return Pointer(address, 32)
        return _Words(self, address & 0xFFFFFFFF)

    def compare(self, pin):
        """Return the compare value of a pin's channel: A, the even pin's, is the lower half."""
        return self.word[slice_of(pin) + CC] >> (16 if pin % 2 else 0) & 0xFFFF

    def function(self, pin):
        return self.word[IO_BANK0 + 8 * pin + 4]


class _Words:
    def __init__(self, memory, address):
        assert address % 4 == 0
        self._memory = memory
        self._address = address

    def __getitem__(self, index):
        word = self._memory.word[self._address + 4 * index]
        return word - (1 << 32) if word >> 31 else word

    def __setitem__(self, index, value):
        address = self._address + 4 * index
        assert -(1 << 31) <= value < 1 << 31
        value &= 0xFFFFFFFF
        self._memory.written.append((address, value))
        if address >> 28 == 4 and address & 0x3000 == SET:
            self._memory.word[address - SET] |= value
        elif address >> 28 == 4 and address & 0x3000 == CLEAR:
            self._memory.word[address - CLEAR] &= ~value
        else:
            self._memory.word[address] = value


def slice_of(pin):
    """Return the address of the slice that a pin belongs to."""
    return PWM + SLICE_BYTES * (pin // 2 % 8)


def rounded(fraction):
    """Return the nearest integer, halves up."""
    return math.floor(fraction + Fraction(1, 2))


@pytest.fixture
def memory():
    return fresh_memory()


def fresh_memory():
    """Put memory that is all 0 under the kernels, as one property test needs it for each example."""
    BOARD.ptr32 = Memory()
    return BOARD.ptr32


def uses(of):
    """Return the bytes that say what each pin does."""
    return bytearray(of.get(pin, OFF) for pin in range(30))


@pytest.mark.parametrize("pin", PINS)
def test_slice_starts_with_both_outputs_low_and_stands_while_it_is_set(memory, pin):
    memory.word[slice_of(pin) + CC] = 0x12345678
    BOARD._start_slice(pin >> 1 & 7, 640, 62500, 41)
    assert memory.written[0] == (slice_of(pin) + CSR, 0)
    assert memory.written[-1] == (slice_of(pin) + CSR, 1)
    found = {offset: memory.word[slice_of(pin) + offset] for offset in (DIV, CTR, CC, TOP)}
    assert found == {DIV: 640, CTR: 41, CC: 0, TOP: 62499}
    assert len(memory.written) == 6


@given(widths=st.lists(pulses_q18us, min_size=16, max_size=16), first=st.integers(0, 12))
def test_pulses_are_set_within_half_a_count_on_every_channel(widths, first):
    memory = fresh_memory()
    pins = [*range(first, first + 16)]
    for pin in pins:
        memory.word[slice_of(pin) + TOP] = 62499
    BOARD._pulses(16, bytes(pins), 0xFFFF, words(widths), uses(dict.fromkeys(pins, PULSES)))
    for pin, width in zip(pins, widths, strict=True):
        assert memory.compare(pin) == rounded(Fraction(width, 1 << 18) / SERVO_COUNT_US)


@given(pulses_q18us, periods_us)
def test_pulse_leaves_200_us_of_its_period_low(width, period_us):
    memory = fresh_memory()
    counts = Fraction(period_us) / SERVO_COUNT_US
    assert counts.denominator == 1
    memory.word[slice_of(3) + TOP] = int(counts) - 1
    BOARD._pulses(1, bytes([3]), 1, words([width]), uses({3: PULSES}))
    assert memory.compare(3) <= counts - 625
    if width >> 18 <= period_us - 201:
        assert memory.compare(3) == rounded(Fraction(width, 1 << 18) / SERVO_COUNT_US)


def test_pulses_touch_only_what_is_due_attached_and_in_use(memory):
    pins = bytes([2, 3, formats.NO_PIN, 28, 20])
    for pin in (2, 3, 28, 20):
        memory.word[slice_of(pin) + TOP] = 62499
    use = uses({2: PULSES, 3: PULSES, 28: OFF, 20: PULSES})
    BOARD._pulses(5, pins, 0b01110, words([1000 << 18] * 5), use)
    assert [pin for pin in PINS if memory.compare(pin)] == [3, 19], "3 and 19 are one channel"
    assert {address for address, _ in memory.written} == {slice_of(3) + CC}


@pytest.mark.parametrize("pin", [4, 5])
def test_pulse_leaves_the_other_channel_of_its_slice_alone(memory, pin):
    memory.word[slice_of(4) + TOP] = 62499
    memory.word[slice_of(4) + CC] = 0xFFFF8001
    BOARD._pulses(1, bytes([pin]), 1, words([1000 << 18]), uses({pin: PULSES}))
    assert [memory.compare(4), memory.compare(5)] == ([3125, 0xFFFF] if pin == 4 else [0x8001, 3125])


@pytest.mark.parametrize("kernel", ["_pulses", "_compare"])
def test_pin_is_connected_by_the_write_after_its_channel_was_cleared(memory, kernel):
    memory.word[slice_of(7) + TOP] = 62499
    use = uses({7: CLEARS})
    seen = []
    for _ in range(3):
        if kernel == "_pulses":
            BOARD._pulses(1, bytes([7]), 1, words([1000 << 18]), use)
        else:
            BOARD._compare(7, 32768, use)
        seen.append((use[7], memory.compare(7), memory.function(7)))
    assert seen == [(CONNECTS, 0, 0), (PULSES, 3125, FUNCTION_PWM), (PULSES, 3125, FUNCTION_PWM)]
    assert memory.written[0][0] == slice_of(7) + CC, "the width is set before the pin is connected"


def test_compare_leaves_the_other_channel_and_unused_pins_alone(memory):
    memory.word[slice_of(8) + CC] = 0xFFFF8001
    BOARD._compare(9, 65536, uses({9: PULSES}))
    assert [memory.compare(8), memory.compare(9)] == [0x8001, 6250]
    BOARD._compare(8, 17, uses({9: PULSES}))
    assert memory.compare(8) == 0x8001


@given(integers(0, 65536))
def test_compare_gives_the_nearest_part_of_50_us(duty_q16):
    memory = fresh_memory()
    BOARD._compare(9, duty_q16, uses({9: PULSES}))
    assert memory.compare(9) == rounded(Fraction(duty_q16 * 6250, 65536))


@pytest.mark.parametrize("pin", PINS)
def test_clearing_a_channel_leaves_the_other_alone(memory, pin):
    memory.word[slice_of(pin) + CC] = 0xABCDEF01
    BOARD._clear(pin)
    assert memory.word[slice_of(pin) + CC] == (0x0000EF01 if pin % 2 else 0xABCD0000)
    assert memory.written[0][0] == slice_of(pin) + CC + CLEAR, "in one store, whatever an interrupt writes meanwhile"


@pytest.mark.parametrize("pin", PINS)
@pytest.mark.parametrize("level", [0, 1])
def test_pin_has_its_level_before_it_drives(memory, pin, level):
    BOARD._drive(pin, level)
    assert memory.written == [
        (GPIO_OUT_SET if level else GPIO_OUT_CLR, 1 << pin),
        (GPIO_OE_SET, 1 << pin),
        (PADS_BANK0 + 4 * pin + 4, PAD_AFTER_RESET),
        (IO_BANK0 + 8 * pin + 4, FUNCTION_SIO),
    ]


@given(st.dictionaries(pins, st.sampled_from([PULSES, CONNECTS, CLEARS])))
def test_quiet_drives_all_pins_in_use_low_and_no_other(of):
    memory = fresh_memory()
    for number in range(8):
        memory.word[PWM + SLICE_BYTES * number + CC] = 0xFFFFFFFF
    use = uses(of)
    BOARD._quiet(30, use)
    assert not any(use)
    lowered = {bit.bit_length() - 1 for address, bit in memory.written if address == GPIO_OUT_CLR}
    driving = {bit.bit_length() - 1 for address, bit in memory.written if address == GPIO_OE_SET}
    assert lowered == driving == set(of) == {pin for pin in PINS if memory.function(pin) == FUNCTION_SIO}
    cleared = {pin % 16 for pin in of}
    assert {pin for pin in range(16) if memory.compare(pin) == 0} == cleared


@pytest.mark.parametrize("pin", [0, 15, 28])
def test_level_is_that_of_the_pin(memory, pin):
    memory.word[GPIO_IN] = 1 << pin | 1 << 31
    assert BOARD._level(pin) == 1
    memory.word[GPIO_IN] ^= 0x3FFFFFFF
    assert BOARD._level(pin) == 0


@pytest.mark.parametrize(("pin", "channel"), [(26, 0), (27, 1), (28, 2)])
def test_conversion_takes_the_pin_from_everything_digital(memory, pin, channel):
    BOARD._convert(pin)
    assert memory.function(pin) == FUNCTION_NULL
    pad = memory.word[PADS_BANK0 + 4 + 4 * pin]
    input_enable, pulls, output_disable = pad >> 6 & 1, pad >> 2 & 3, pad >> 7
    assert (input_enable, pulls, output_disable) == (0, 0, 1)
    assert memory.written[-1] == (ADC, channel << 12 | 1 << 2 | 1)  # AINSEL, START_ONCE, EN


def test_conversion_gives_ratios_to_the_nearest(memory):
    for raw in range(4096):
        memory.word[ADC + 4] = raw
        assert abs(BOARD._converted() - Fraction(raw * 32768, 4095)) <= Fraction(1, 2) + Fraction(1, 500)
    assert BOARD._converted() == formats.VALUE_ONE


@given(integers(0, (1 << 30) - 1), integers(0, 1 << 29))
def test_instants_follow_each_other_modulo_2_to_the_30(ticks_us, us):
    assert BOARD._later(ticks_us, us) == (ticks_us + us) % (1 << 30)


def test_alarm_is_that_of_the_fourth_comparator_modulo_2_to_the_30(memory):
    memory.word[TIMER_ALARM3] = 0xC0000123
    assert BOARD._alarm_us() == 0x123


def test_watchdog_is_off_while_it_is_set_and_then_resets_all_but_the_oscillators(memory):
    memory.word[WATCHDOG] = 0xFFFFFFFF
    memory.word[WATCHDOG + 0x1C] = 0xB007C0D3
    BOARD._guard(1, 2_000_000)
    enable = 1 << 30
    assert memory.written[0] == (WATCHDOG + CLEAR, enable)
    assert memory.written[-1] == (WATCHDOG + SET, enable)
    assert memory.word[PSM_WDSEL] == 0x1FFFF & ~0b11
    assert memory.word[WATCHDOG + 4] == 2_000_000
    assert memory.word[WATCHDOG + 0x1C] == 0, "the boot ROM finds no address to go to"
    BOARD._guard(0, 0)
    assert memory.word[WATCHDOG] == 0xFFFFFFFF & ~enable


def test_watchdog_is_fed_by_its_load_register(memory):
    BOARD._feed(0xFFFFFF)
    assert memory.written == [(WATCHDOG + 4, 0xFFFFFF)]


@pytest.mark.parametrize(("reason", "bitten"), [(0, 0), (1, 1), (2, 0), (3, 1)])
def test_watchdog_tells_whether_its_time_ran_out(memory, reason, bitten):
    memory.word[WATCHDOG + 8] = reason
    assert BOARD._bitten() == bitten


@pytest.mark.parametrize("half", [0, 16])
def test_usb_is_idle_when_the_host_has_taken_both_halves(memory, half):
    serial_to_host = USB_CONTROL + 8 * 2
    memory.word[serial_to_host] = (USB_AVAILABLE | USB_FULL | 64) << half
    assert not BOARD._usb_is_idle()
    memory.word[serial_to_host] = (USB_FULL | 64) << half
    assert BOARD._usb_is_idle()
    memory.word[serial_to_host + 4] = USB_AVAILABLE  # what comes from the host does not matter
    assert BOARD._usb_is_idle()


@given(st.integers(0, 18), integers(0, 0xFFFF), st.integers(0, 31))
def test_kept_words_find_every_damaged_bit(place, value, bit):
    memory = fresh_memory()
    BOARD._keep(place, value)
    assert BOARD._kept(place) == value
    memory.word[KEPT + 4 * place] ^= 1 << bit
    assert BOARD._kept(place) == -1


def test_memory_as_it_comes_up_holds_no_kept_words(memory):
    for content in (0, 0xFFFFFFFF):
        memory.word[KEPT] = content
        assert BOARD._kept(0) == -1


@given(st.lists(integers(0, 1 << 24, 255, 256), min_size=1, max_size=16), integers(1, (1 << 30) - 1))
def test_pose_is_kept_to_the_nearest_q15_under_its_tag(positions_q24, tag):
    memory = fresh_memory()
    BOARD._keep_pose(len(positions_q24), words(positions_q24), tag)
    assert BOARD._tag() == tag
    kept = [BOARD._kept(1 + d) for d in range(len(positions_q24))]
    assert kept == [rounded(Fraction(position, 512)) for position in positions_q24]
    assert {address for address, _ in memory.written} <= {KEPT + 4 * place for place in range(17)}


def test_pose_of_another_wiring_has_no_tag_while_it_is_overwritten(memory):
    BOARD._keep_pose(2, words([0, 1 << 24]), 7)
    memory.written.clear()
    BOARD._keep_pose(2, words([1 << 24, 0]), 8)
    assert memory.written[0] == (KEPT, 0) and memory.written[-1] == (KEPT, 8)
