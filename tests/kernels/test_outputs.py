"""Motor and board: clamped values, calibrated pulses and PWM registers, in 32 bits over all values and pulse widths."""

import itertools
import math
import types
from array import array
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import Pointer, load_checked
from tests.kernels.values import halves, integers, values_q15

ONE = formats.VALUE_ONE
STILL = ONE // 2
MOTOR = load_checked("firmware/motor.py", bytecode=("Motor.move", "Motor._ease", "Motor.stand", "Motor._write"))
BOARD = load_checked("firmware/board_rp2040.py", overrides={"machine": types.SimpleNamespace()})

PWM_ADDRESS = 0x40050000
"""RP2040 data sheet, 2.2.4; its 8 slices of CSR, DIV, CTR, CC and TOP follow each other (4.5.3)."""

SLICE_BYTES = 0x14
CC = 3

pulses_q4us = integers(formats.PULSE_MIN_US << formats.PULSE_BITS, formats.PULSE_MAX_US << formats.PULSE_BITS)
any_halves = integers(0, 65535)


def rounded(fraction):
    """Return the nearest integer, halves up."""
    return math.floor(fraction + Fraction(1, 2))


def move(signal, relative, ease, low, high, pulse0, pulse1):
    """Return (motor_q15, pulse_q4us) of one DOF."""
    motor, pulse = halves([0]), halves([0])
    columns = (halves([value]) for value in (low, high))
    MOTOR._move(
        1, halves([signal]), bytes([relative]), ease, *columns, motor, halves([pulse0]), halves([pulse1]), pulse
    )
    return motor[0], pulse[0]


@given(values_q15, st.booleans(), values_q15, values_q15, values_q15, any_halves, any_halves)
def test_motor_clamps_and_calibrates(signal, relative, ease, one_limit, other_limit, pulse0, pulse1):
    low, high = sorted((one_limit, other_limit))
    value = rounded(STILL + Fraction((signal - STILL) * ease, ONE)) if relative else signal
    value = min(max(value, low), high)
    expected = rounded(pulse0 + (pulse1 - pulse0) * Fraction(value, ONE))
    assert move(signal, relative, ease, low, high, pulse0, pulse1) == (value, expected)


@pytest.mark.parametrize(
    ("signal", "low", "high", "pulse0", "pulse1", "expected"),
    [
        (0, 0, ONE, 16_000, 32_000, (0, 16_000)),
        (ONE, 0, ONE, 16_000, 32_000, (ONE, 32_000)),
        (ONE, 0, ONE, 32_000, 16_000, (ONE, 16_000)),
        (ONE, 0, 30_000, 0, ONE, (30_000, 30_000)),
        (0, 2_000, ONE, 0, ONE, (2_000, 2_000)),
        (STILL, 0, ONE, 16_000, 32_000, (STILL, 24_000)),
    ],
)
def test_motor_reaches_both_ends_exactly(signal, low, high, pulse0, pulse1, expected):
    assert move(signal, False, ONE, low, high, pulse0, pulse1) == expected


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
def test_motor_eases_relative_dofs_to_a_stand_within_300_ms(rate_hz):
    tables = types.SimpleNamespace(
        dofs=2,
        frame_rate_hz=rate_hz,
        relative=bytes([1, 0]),
        rest_q15=halves([STILL, 100]),
        limit_low_q15=halves([0, 0]),
        limit_high_q15=halves([ONE, ONE]),
        pulse0_q4us=halves([0, 0]),
        pulse1_q4us=halves([0, 0]),
    )
    motor = MOTOR.Motor(types.SimpleNamespace(quiet=lambda: None), tables)
    motor.load(tables)
    signal = halves([ONE, 20_000])
    speeds = []
    for frame in range(rate_hz):
        motor.move(signal, frame > 0)
        speeds.append(motor.motor_q15[0] - STILL)
        assert motor.motor_q15[1] == 20_000
    frames = math.ceil(Fraction(3, 10) * rate_hz)
    assert speeds[0] == STILL and speeds[frames] == 0 and speeds == sorted(speeds, reverse=True)
    assert max(a - b for a, b in itertools.pairwise(speeds)) <= STILL / (0.3 * rate_hz) + 2
    motor.move(signal, False)
    assert 0 < motor.motor_q15[0] - STILL <= STILL / (0.3 * rate_hz) + 2


class Peripheral:
    """The PWM block's registers; stands in for the cast of an address to `ptr32`."""

    def __init__(self):
        self.slices = [array("i", [0] * (SLICE_BYTES // 4)) for _ in range(8)]

    def __call__(self, address):
        number, rest = divmod(address - PWM_ADDRESS, SLICE_BYTES)
        assert rest == 0 and 0 <= number < 8, f"{address:#x} is no slice"
        return Pointer(self.slices[number], 32)

    def compare(self, pin):
        """Return the compare value of a pin's channel: A, the even pin's, is the lower half."""
        return self.slices[pin // 2 % 8][CC] >> (16 if pin % 2 else 0) & 0xFFFF


@pytest.fixture
def pwm():
    BOARD.ptr32 = Peripheral()
    return BOARD.ptr32


@given(widths=st.lists(pulses_q4us, min_size=16, max_size=16), first=st.integers(0, 12))
def test_board_sets_every_channel_to_its_pulse_within_half_a_count(widths, first):
    pwm = BOARD.ptr32 = Peripheral()
    pins = [*range(first, first + 16)]
    attached = bytearray([1] * 29)
    BOARD._pulses(16, bytes(pins), attached, halves(widths))
    for pin, width_q4us in zip(pins, widths, strict=True):
        counts = Fraction(width_q4us, 16) * Fraction(125, 40)  # 125 MHz divided by 40
        assert pwm.compare(pin) == rounded(counts)


def test_board_touches_attached_pins_alone(pwm):
    attached = bytearray(29)
    attached[3] = 1
    BOARD._pulses(4, bytes([2, 3, formats.NO_PIN, 28]), attached, halves([16_000] * 4))
    assert [pwm.compare(pin) for pin in range(16)] == [0, 0, 0, 3125, *[0] * 12]


def test_board_starts_a_slice_with_a_period_of_20_ms_and_both_outputs_low(pwm):
    pwm.slices[5][CC] = 77
    BOARD._start_slice((PWM_ADDRESS >> 2) + 5 * SLICE_BYTES // 4)
    enabled, divider_q4, _, compare, top = pwm.slices[5]
    assert (enabled, compare) == (1, 0)
    assert Fraction(divider_q4, 16) * (top + 1) / 125_000_000 == Fraction(formats.SERVO_PERIOD_US, 1_000_000)


@pytest.mark.parametrize("upper", [0, 1])
def test_board_compares_one_channel_and_leaves_the_other(pwm, upper):
    address = (PWM_ADDRESS >> 2) + 2 * SLICE_BYTES // 4
    BOARD._compare(address, 0, 9375)
    BOARD._compare(address, 1, 938)
    BOARD._compare(address, upper, 5)
    assert [pwm.compare(4), pwm.compare(5)] == ([9375, 5] if upper else [5, 938])
