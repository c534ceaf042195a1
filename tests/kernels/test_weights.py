"""The weights' filters: `x += (g - x) * a`, `w += (x - w) * a`, and the snap, in 32 bits over all weights and coefficients."""

import math
from fractions import Fraction

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from shared.formats import ALPHA_BITS, SNAP_Q28, WEIGHT_MAX, WEIGHT_ONE
from tests.checked import load_checked
from tests.kernels.values import ALPHA_LAST, alphas_q26, weights_q28, words

MODULE = load_checked("firmware/weights.py")

ROUNDING = Fraction(1, 2) + Fraction(1, 1 << 13)
"""Half a unit, and what is dropped below the 13 bits that are rounded."""


def integrate(target, x, w, rise, fall):
    """Return (x, w) after one frame of one entry."""
    arrays = [words([number]) for number in (target, x, w, rise, fall)]
    MODULE.integrate(1, *arrays)
    assert [arrays[i][0] for i in (0, 3, 4)] == [target, rise, fall]
    return arrays[1][0], arrays[2][0]


@st.composite
def states(draw):
    """A target, and where the two filters stand: anywhere, or about as near to it as the snap reaches."""
    target, x, w = draw(st.tuples(weights_q28, weights_q28, weights_q28))
    if draw(st.booleans()):
        x, w = (min(max(target + draw(st.integers(-4 * SNAP_Q28, 4 * SNAP_Q28)), 0), WEIGHT_MAX) for _ in range(2))
    return target, x, w


@given(states(), alphas_q26, alphas_q26)
@example((0, 2000, 1 << 20), 1, 1 << 25)  # x snaps in this frame, after w has followed it
def test_weights_follow_the_two_filters(state, rise, fall):
    target, x, w = state
    alpha = Fraction(rise if target > x else fall, 1 << ALPHA_BITS)
    expected_x = x + (target - x) * alpha
    found_x, found_w = integrate(target, x, w, rise, fall)
    assert min(x, target) <= found_x <= max(x, target)
    if found_x == target:
        assert abs(target - expected_x) < SNAP_Q28 + 1
        expected_w = w + (expected_x - w) * alpha
        if found_w == target:
            assert abs(target - expected_w) < SNAP_Q28 + 2
            return
        assert abs(found_w - expected_w) <= 2 * ROUNDING
    else:
        assert abs(found_x - expected_x) <= ROUNDING
        assert abs(found_w - (w + (found_x - w) * alpha)) <= ROUNDING
    assert 0 <= found_w <= WEIGHT_MAX


@given(weights_q28, st.integers(-1 - SNAP_Q28, SNAP_Q28 + 1), weights_q28)
def test_weights_snap_to_a_target_nearer_than_2_to_the_minus_18(target, distance, w):
    x = target + distance
    assume(0 <= x <= WEIGHT_MAX)
    found_x, found_w = integrate(target, x, w, 1, 1)  # a coefficient that moves neither by itself
    is_near = abs(distance) < SNAP_Q28
    assert found_x == (target if is_near else x)
    assert abs(found_w - w) <= 16 or (is_near and found_w == target and abs(w - target) < SNAP_Q28 + 16)
    if is_near and abs(w - target) < SNAP_Q28 - 16:
        assert found_w == target


@given(st.lists(st.tuples(weights_q28, weights_q28, weights_q28, alphas_q26, alphas_q26), min_size=2, max_size=64))
def test_weights_of_one_entry_do_not_touch_another(entries):
    arrays = [words(column) for column in zip(*entries, strict=True)]
    MODULE.integrate(len(entries) - 1, *arrays)
    *moved, last = zip(*arrays, strict=True)
    assert last == entries[-1]
    assert [(entry[1], entry[2]) for entry in moved] == [integrate(*entry) for entry in entries[:-1]]


@pytest.mark.parametrize("rate_hz", [10, 60])
@pytest.mark.parametrize("tau_s", [0.03, 0.25, 10])
@pytest.mark.parametrize(("start", "target"), [(0, WEIGHT_MAX), (WEIGHT_MAX, 0), (0, 1), (WEIGHT_ONE, 3 * WEIGHT_ONE)])
def test_weights_arrive_exactly_within_18_tau(rate_hz, tau_s, start, target):
    alpha = min(math.floor(math.ldexp(-math.expm1(-1 / (rate_hz * tau_s)), ALPHA_BITS) + 0.5), ALPHA_LAST)
    x = w = start
    for _ in range(math.floor(18 * tau_s * rate_hz)):
        x, w = integrate(target, x, w, alpha, alpha)
    assert (x, w) == (target, target)


def test_weights_at_rest_stay():
    for target in (0, 1, WEIGHT_ONE, WEIGHT_MAX):
        assert integrate(target, target, target, ALPHA_LAST, 1) == (target, target)
