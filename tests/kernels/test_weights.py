"""The weights' filters: `x += (g - x) * a`, `w += (x - w) * a`, and the snap, in 32 bits over all weights and coefficients.

The frame that is due, blocks of frames to come, and a few of those far apart.
"""

import math
from fractions import Fraction

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from shared.formats import ALPHA_BITS, SNAP_Q28, VALUE_ONE, WEIGHT_MAX, WEIGHT_ONE
from tests.checked import load_checked
from tests.kernels.values import ALPHA_LAST, alphas_q26, halves, integers, weights_q28, words

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


entries = st.tuples(states(), alphas_q26, alphas_q26).map(lambda entry: (*entry[0], *entry[1:]))
entry_lists = st.lists(entries, min_size=1, max_size=5)


def listed(entries, seed=0):
    """Return the numbers of all entries but the first in an order of their own, and the arrays of all."""
    items = list(range(1, len(entries)))
    items = items[seed % len(entries) :] + items[: seed % len(entries)]
    return items, [words(column) for column in zip(*entries, strict=True)]


@given(entry_lists, entries, integers(1, 16), st.integers(0, 4))
def test_weights_to_come_are_those_of_so_many_frames(entries, spare, frames, seed):
    items, arrays = listed([spare, *entries], seed)
    course, peak = words([-1] * 16 * len(items)), words([-1] * len(items))
    MODULE.foresee(bytes(items), len(items), frames, *arrays, course, peak)
    for n, i in enumerate(items):
        target, x, w, rise, fall = ([spare, *entries])[i]
        steps = []
        for _ in range(frames):
            x, w = integrate(target, x, w, rise, fall)
            steps.append(w)
        assert list(course[16 * n : 16 * n + 16]) == steps + [-1] * (16 - frames)
        assert peak[n] == max(steps)
        assert [array[i] for array in arrays] == [target, x, w, rise, fall]
    assert tuple(array[0] for array in arrays) == spare


STRIDES = (1, 1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 16, 24, 36, 54, 92)
NEVER = 255
SKETCHED = 1 / 40
"""Of the greatest distance on the way, 254 frames ahead. Powers in Q15 are off by up to a unit per frame, half of it from the
coefficient and half from the squares on the way, and both terms of `w` have them; a unit per frame is also what `s * a` has lost
of its coefficient: 3 * 254 * 2^-15 = 1/43, if all agree. Slow filters come close to it: 1/46 has been seen with tau 8.5 s at 60
Hz.
"""
QUICKLY_SKETCHED = 1 / 100
"""The same where the coefficient is at least 1/20, like tau 0.3 s at 60 Hz or 0.65 s at 30: after 100 frames nothing is left."""
UNIT_Q13 = 1 << 15


def sketch(entries, turns, turned_q13=0, strides=STRIDES, items=None):
    """Return the courses and peaks of the listed entries, in their order; all of them by default."""
    items = bytes(range(len(entries)) if items is None else items)
    arrays = [words(column) for column in zip(*entries, strict=True)]
    before = [array[:] for array in arrays]
    course, peak = words([-1] * 16 * len(items)), words([-1] * len(items))
    power = halves([0xAAAA] * 16)
    turn = bytes(turns)
    MODULE.sketch(items, len(items), len(strides), bytes(strides), turn, turned_q13, power, *arrays, course, peak)
    assert arrays == before
    return [list(course[at : at + 16]) for at in range(0, len(course), 16)], list(peak)


def in_floats(entry, turn, turned, strides):
    """Return `w` at the knots and the greatest distance from the target, of the two filters in float64."""
    target, x, w, rise, fall = (float(number) for number in entry)
    found, frame, greatest = [], 0, 0.0
    for stride in strides:
        for _ in range(stride):
            if frame == turn:
                target = turned
            greatest = max(greatest, abs(target - x), abs(target - w))
            share = math.ldexp(rise if target > x else fall, -ALPHA_BITS)
            x += (target - x) * share
            w += (x - w) * share
            frame += 1
        found.append(w)
    return found, greatest


turns = st.just(NEVER) | integers(0, 254)
strides = st.just(STRIDES) | st.lists(integers(0, 15, 1), min_size=1, max_size=16)


@st.composite
def futures(draw):
    """An entry, when it turns and where to: from anywhere with one coefficient, or as actions with two go, from rest and to 0.

    Which of two holds is decided where a sketch begins and where it turns; where `w` is far from a target that `x` has about
    reached, the filters change over on the way, which sketches leave out.
    """
    target, x, w, rise, fall = draw(entries)
    if draw(st.booleans()):
        return (target, x, w, rise, rise), draw(turns), draw(st.sampled_from([0, VALUE_ONE >> 2]))
    return (target, x, x, rise, fall), draw(turns), 0


@given(futures(), strides)
@example(((WEIGHT_MAX, 0, 0, ALPHA_LAST, 1), 3, 0), STRIDES)
@example(((WEIGHT_MAX, 0, 0, 1, ALPHA_LAST), NEVER, 0), STRIDES)
@example(((0, WEIGHT_MAX, 0, 1 << 20, 1 << 20), 253, VALUE_ONE >> 2), STRIDES)
@example(((0, 0, WEIGHT_MAX, 111_000, 111_000), NEVER, 0), STRIDES)
@example(((WEIGHT_MAX, 0, 790759356, 130503, 130503), 74, VALUE_ONE >> 2), STRIDES)
@example(((0, WEIGHT_MAX, WEIGHT_MAX, 4_000_000, 4_000_000), NEVER, 0), STRIDES)
@example(((1048576, 1048575, 1048575, 31744, 1), NEVER, 0), (1, 1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 16, 24, 36, 54, 92))
def test_weights_far_ahead_are_those_of_the_filters(future, strides):
    entry, turn, turned_q13 = future
    (course,), (peak,) = sketch([entry], [turn], turned_q13, strides)
    expected, greatest = in_floats(entry, turn, turned_q13 * UNIT_Q13, strides)
    error = QUICKLY_SKETCHED if min(entry[3:]) >= (1 << ALPHA_BITS) // 20 else SKETCHED
    for found, exact in zip(course, expected, strict=False):
        assert abs(found - exact) <= error * greatest + 8 * UNIT_Q13
    assert course[len(strides) :] == [-1] * (16 - len(strides))
    assert peak == max(course[: len(strides)])
    assert min(course[: len(strides)]) >= 0


@given(st.lists(st.tuples(entries, turns), min_size=2, max_size=6), st.lists(st.integers(0, 5), min_size=6, max_size=6))
def test_weights_far_ahead_do_not_depend_on_who_is_before_them(pairs, likeness):
    """Powers that serve several entries are those that each of them has for itself."""
    chosen = [pairs[k % len(pairs)] for k in likeness]
    shared = [((*pairs[0][0][:3], *entry[3:]), turn) for entry, turn in chosen]
    for some in (chosen, shared):
        together = sketch([entry for entry, _ in some], [turn for _, turn in some])
        alone = [sketch([entry], [turn]) for entry, turn in some]
        assert together == ([courses[0] for courses, _ in alone], [peaks[0] for _, peaks in alone])


def test_turns_belong_to_places_of_the_list():
    rising, falling = (WEIGHT_ONE, 0, 0, 1 << 23, 1 << 23), (0, WEIGHT_ONE, WEIGHT_ONE, 1 << 23, 1 << 23)
    courses, _ = sketch([rising, falling], [0, NEVER], items=[1, 0])
    assert courses == [sketch([falling], [0])[0][0], sketch([rising], [NEVER])[0][0]]
    assert sketch([falling], [0])[0] == sketch([falling], [NEVER])[0]  # it goes to 0 as it is
    assert sketch([rising], [0])[0] == [[0] * 16]


def test_turn_comes_in_its_frame_and_255_is_never():
    at_rest = (WEIGHT_ONE,) * 3 + (1 << 25, 1 << 25)
    every = [1] * 16
    for turn in (0, 1, 7, 15):
        (course,), _ = sketch([at_rest], [turn], strides=every)
        assert [value == WEIGHT_ONE for value in course] == [b < turn for b in range(16)]
    for turn in (16, 254, NEVER):
        assert sketch([at_rest], [turn], strides=every)[0] == [[WEIGHT_ONE] * 16]
    assert sketch([at_rest], [NEVER], strides=[92] * 16)[0] == [[WEIGHT_ONE] * 16]
