"""What the motor tick remembers of itself, in 32 bits: the positions of the last ticks, how long it took, how late it came."""

from hypothesis import given
from hypothesis import strategies as st

from shared.formats import DOFS_MAX, MOTOR_PERIOD_MAX_US, MOTOR_PERIOD_MIN_US, POSITION_ONE
from tests.checked import load_checked
from tests.kernels.values import integers, words

MOTOR = load_checked("firmware/motor.py")
TICKS_MODULUS = 1 << 30

positions_q24 = st.lists(integers(0, POSITION_ONE, POSITION_ONE // 2), min_size=DOFS_MAX, max_size=DOFS_MAX)
instants_us = integers(0, TICKS_MODULUS - 1, TICKS_MODULUS // 2)
periods_us = integers(MOTOR_PERIOD_MIN_US, MOTOR_PERIOD_MAX_US)


@given(st.integers(1, DOFS_MAX), positions_q24, positions_q24, positions_q24)
def test_positions_of_the_last_two_ticks_are_shifted(dofs, now, before, oldest):
    remembered = words([*before, *oldest])
    MOTOR._remember(words(now), remembered, dofs)
    assert list(remembered[:dofs]) == now[:dofs]
    assert list(remembered[DOFS_MAX : DOFS_MAX + dofs]) == before[:dofs]
    assert list(remembered[dofs:DOFS_MAX]) == before[dofs:]
    assert list(remembered[DOFS_MAX + dofs :]) == oldest[dofs:]


@given(
    instants_us, periods_us, st.lists(st.tuples(integers(0, 300_000), integers(0, 300_000)), min_size=1, max_size=20)
)
def test_longest_and_latest_tick_are_measured_against_the_first(first_us, period_us, ticks):
    times_us = words([0, 0, -1])
    for number, (late_us, took_us) in enumerate(ticks):
        begun_us = first_us + number * period_us + (late_us if number else 0)
        MOTOR._measure(times_us, period_us, begun_us % TICKS_MODULUS, (begun_us + took_us) % TICKS_MODULUS)
    assert times_us[0] == max(took_us for _, took_us in ticks)
    assert times_us[1] == max((late_us for late_us, _ in ticks[1:]), default=0)
