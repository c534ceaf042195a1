"""What drivers compute in the tick, in 32 bits: the duty and direction of bridges, and the registers of a PCA9685."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.formats import DOFS_MAX, POSITION_ONE, PULSE_MAX_US, PULSE_MIN_US
from tests.checked import load_checked
from tests.kernels.values import integers, words

BRIDGE = load_checked("firmware/driver_bridge.py")
PCA9685 = load_checked("firmware/driver_pca9685.py")
STOP_Q24 = POSITION_ONE // 2
DUTY_ONE = 1 << 16

levels_q24 = integers(0, POSITION_ONE, STOP_Q24, STOP_Q24 - 63, STOP_Q24 + 64)
pulses_q18us = integers(PULSE_MIN_US << 18, PULSE_MAX_US << 18)
masks = integers(0, (1 << DOFS_MAX) - 1)


def steered(levels, invert, due, duty, backward):
    duty_q16, back = words(duty), bytearray(backward)
    BRIDGE._steer(len(levels), words(levels), bytearray(invert), due, duty_q16, back)
    return list(duty_q16), list(back)


@given(levels_q24, st.sampled_from((0, 1)))
def test_bridge_gets_the_share_of_the_level(level_q24, invert):
    """To 1/65536, half a step of it rounded up."""
    speed = (level_q24 - STOP_Q24) * (-1 if invert else 1)
    (duty,), (back,) = steered([level_q24], [invert], 1, [0], [0])
    assert abs(duty / DUTY_ONE - abs(speed) / STOP_Q24) <= 0.5 / DUTY_ONE
    assert back == (1 if speed < 0 and duty else 0)


@given(st.lists(st.tuples(levels_q24, st.sampled_from((0, 1)), st.booleans()), min_size=1, max_size=30))
def test_bridge_turns_round_only_after_a_tick_at_rest(ticks):
    duty, back = [0], [0]
    for level_q24, invert, due in ticks:
        before = duty[0], back[0]
        duty, back = steered([level_q24], [invert], int(due), duty, back)
        if not due:
            assert (duty[0], back[0]) == before
        assert back[0] == before[1] or before[0] == 0, "the direction changes under power"


@given(
    st.lists(pulses_q18us, min_size=16, max_size=16), masks, masks, integers(3000, 20000), st.permutations(range(16))
)
def test_registers_of_the_pca9685_are_the_nearest_counts(pulses, attached, due, period_us, dofs):
    scale_q21 = round(4096 * (1 << 21) / period_us)
    dof = bytearray(d if d % 3 else 255 for d in dofs)
    registers = bytearray(b"\xee" * 65)
    PCA9685._fill(16, dof, attached, due, words(pulses), scale_q21, registers)
    for channel, d in enumerate(dof):
        assert registers[1 + 4 * channel : 3 + 4 * channel] == b"\xee\xee", "ON is 0 for good"
        low, high = registers[3 + 4 * channel : 5 + 4 * channel]
        if d > 15 or (attached >> d & 1 and not due >> d & 1):
            assert (low, high) == (0xEE, 0xEE)
        elif not attached >> d & 1:
            assert (low, high) == (0, 0x10)
        else:
            counts = pulses[d] / (1 << 18) * 4096 / period_us
            # The pulse is taken to 1/32 us, which is less than 1/20 of a count.
            assert low | high << 8 == pytest.approx(min(counts, 4095), abs=0.56)
