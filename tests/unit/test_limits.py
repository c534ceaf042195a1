"""Limits of DOFs: what holds when puppet and robot both have some."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.limits import (
    DEFAULT_ACCEL_ABSOLUTE,
    DEFAULT_ACCEL_RELATIVE,
    DEFAULT_SPEED,
    Limits,
    LimitsInUse,
    tightest,
)
from marotte.puppet import Dof

CASES = [
    (False, [], LimitsInUse((0.0, 1.0), 10.0, 200.0)),
    (True, [], LimitsInUse((-1.0, 1.0), 10.0, 20.0)),
    (False, [Limits((0.1, 0.9)), Limits((0.0, 0.8))], LimitsInUse((0.1, 0.8), 10.0, 200.0)),
    (False, [Limits(speed=50.0), Limits()], LimitsInUse((0.0, 1.0), 50.0, 200.0)),
    (False, [Limits(speed=3.0, accel=1000.0), Limits(speed=5.0, accel=25.0)], LimitsInUse((0.0, 1.0), 3.0, 25.0)),
    (True, [Limits((-0.8, 0.8), accel=40.0), Limits((-1.0, 0.5))], LimitsInUse((-0.8, 0.5), 10.0, 40.0)),
]


@pytest.mark.parametrize(("relative", "limits", "expected"), CASES)
def test_limits_in_use_are_the_tightest(relative, limits, expected):
    assert tightest(relative, *limits) == expected
    assert tightest(relative, *reversed(limits)) == expected


def test_limits_of_a_dof_hold_with_the_robots():
    dof = Dof("A", limits=(0.2, 1.0), speed=2.0)
    assert dof.limits_with() == LimitsInUse((0.2, 1.0), 2.0, DEFAULT_ACCEL_ABSOLUTE)
    assert dof.limits_with(Limits((0.0, 0.9), 4.0, 8.0)) == LimitsInUse((0.2, 0.9), 2.0, 8.0)


def test_limits_by_default_leave_all_that_a_servo_can_do():
    assert (DEFAULT_SPEED, DEFAULT_ACCEL_ABSOLUTE, DEFAULT_ACCEL_RELATIVE) == (10, 200, 20)


ranges = st.tuples(st.floats(-1, 0), st.floats(0, 1))
limits = st.builds(Limits, st.none() | ranges, st.none() | st.floats(0.05, 50), st.none() | st.floats(4, 1000))


@given(relative=st.booleans(), some=st.lists(limits, max_size=3))
def test_limits_in_use_exceed_none_of_them(relative, some):
    used = tightest(relative, *some)
    for one in some:
        assert one.range is None or (one.range[0] <= used.range[0] and used.range[1] <= one.range[1])
        assert one.speed is None or used.speed <= one.speed
        assert one.accel is None or used.accel <= one.accel
