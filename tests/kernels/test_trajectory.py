"""From frames to a smooth course: knots, guesses and offsets, and the spline, in 32 bits over all targets and rates."""

import itertools
import math
import random
from fractions import Fraction
from types import SimpleNamespace

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, rates_hz, words
from tests.reference_motor import Knots, first_tick_of_frame, knots_of_targets, place_of_tick, trajectory

MODULE = load_checked(
    "firmware/trajectory.py",
    bytecode=("Trajectory.advance", "Trajectory._next", "Trajectory.put", "Trajectory.start"),
)
ONE_Q24 = 1 << formats.POSITION_BITS
TO_Q24 = formats.POSITION_BITS - formats.VALUE_BITS
DOFS = formats.DOFS_MAX

periods_us = integers(formats.MOTOR_PERIOD_MIN_US // 8, formats.MOTOR_PERIOD_MAX_US // 8, 1250).map(lambda n: 8 * n)
positions_q24 = integers(0, ONE_Q24, ONE_Q24 // 2)
parts_q15 = integers(0, formats.VALUE_ONE - 1)

SNAP = 2.0**-18
"""An offset smaller than this, whose rate per frame is, is dropped."""

FACTOR_ERROR = 2.0**-16
"""The factors of a frame, `rho`, `k` and `h / tau`, are rounded to Q15."""


def made(frame_rate, period_us, pose_q24):
    """Return a trajectory of DOFs that stand at their poses, which frame 0 is about to take on."""
    course = MODULE.Trajectory()
    course.load(SimpleNamespace(frame_rate_hz=frame_rate, motor_period_us=period_us))
    course.prepare()
    course.start(len(pose_q24), words(pose_q24))
    return course


def references(course, dofs):
    """Return where the DOFs should be, in Q24."""
    return [course.reference_q24[d] - MODULE.ZERO_Q24 for d in range(dofs)]


def newest_knots(course, dofs):
    return [course._knot[d] for d in range(dofs)]


def play(course, targets_q15, frame_rate, period_us, ticks, late=(), done_late=3):
    """Return an array [ticks, dofs] of positions, one of knots [frames, dofs], and the frames that were not there in time.

    Frame `n` is computed in time, or if it is `late` so many frames after its own, in order.
    """
    dofs = len(targets_q15[0])
    positions, knots, missed, computed = [], [], [], 0
    for tick in range(ticks):
        frame = place_of_tick(tick, period_us, frame_rate)[0]
        while computed <= frame and (computed not in late or computed + done_late <= frame):
            course.put(computed, dofs, halves(targets_q15[computed]))
            computed += 1
        missed += range(max(computed, len(knots)), frame + 1)
        course.advance(dofs, True, None)
        positions.append(references(course, dofs))
        while len(knots) <= frame:  # where two frames take effect in one tick, only the second one's is seen
            knots.append(newest_knots(course, dofs) if len(knots) == frame else [math.nan] * dofs)
    return numpy.array(positions) / ONE_Q24, numpy.array(knots) / ONE_Q24, missed


@given(st.integers(0, 60000), st.integers(1, 30000))
def test_exponential_is_rounded_to_nearest(numerator, denominator):
    numerator = min(numerator, 2 * denominator)
    exact = math.exp(-numerator / denominator) * 32768
    found = MODULE.exp_q15(numerator, denominator)
    assert abs(found - exact) <= 0.5 + 1e-9


@given(rates_hz, periods_us, st.integers(0, 400))
def test_frames_take_effect_at_the_first_tick_at_or_after_their_delay(frame_rate, period_us, ticks):
    course = made(frame_rate, period_us, [0])
    for tick in range(ticks):
        course.advance(1, True, None)
        # No frame is ever there, so every one that should have taken effect has been counted as late.
        assert course.late == place_of_tick(tick, period_us, frame_rate)[0] + 1


def test_frames_take_effect_at_their_ticks_after_a_day():
    # Millionths of a frame add up exactly: after a day of 333 Hz and 47 frames a second it is still the same tick.
    frame_rate, period_us = 47, 3_008
    course = made(frame_rate, period_us, [0])
    ticks = 86_400 * 1_000_000 // period_us
    course._part = (course._part + ticks * course._step) % 1_000_000
    frame, fraction = place_of_tick(ticks - 1, period_us, frame_rate)
    assert course._part == round(fraction * 1_000_000) and frame == first_frame_by(ticks - 1, period_us, frame_rate)


def first_frame_by(tick, period_us, frame_rate):
    """Return the last frame whose first tick is not after `tick`, searched for."""
    frame = tick * period_us * frame_rate // 1_000_000 + 2
    while first_tick_of_frame(frame, period_us, frame_rate) > tick:
        frame -= 1
    return frame


@pytest.mark.parametrize("done_late", [1, 4, 12])
@pytest.mark.parametrize("seed", range(6))
def test_course_is_that_of_the_reference_with_frames_late_and_without(seed, done_late):
    rng = random.Random(seed)
    frame_rate = rng.choice((10, 30, 60, rng.randint(10, 60)))
    period_us = rng.choice((3_008, 20_000, 8 * rng.randint(376, 2500)))
    frames = 5 * frame_rate
    signals = [random_signal(rng, frames) for _ in range(5)]
    poses = [rng.randint(0, ONE_Q24) for _ in signals]
    late = {n for n in range(1, frames) if rng.random() < 0.04} if seed % 2 else set()
    course = made(frame_rate, period_us, poses)
    ticks = first_tick_of_frame(frames - 1, period_us, frame_rate)
    found, knots, missed = play(course, list(zip(*signals, strict=True)), frame_rate, period_us, ticks, late, done_late)
    assert course.late == len(missed) and (late == set() or len(missed) > 0)
    for d, (signal, pose) in enumerate(zip(signals, poses, strict=True)):
        targets = [value / formats.VALUE_ONE for value in signal]
        expected = knots_of_targets(targets, pose / ONE_Q24, frame_rate, missed)
        error = numpy.nanmax(numpy.abs(knots[:, d] - expected.values[3 : 3 + len(knots)]))
        assert error < knot_bound(frame_rate)
        spline = trajectory(expected, frame_rate, period_us, ticks)
        assert numpy.abs(found[:, d] - spline).max() < spline_bound(frame_rate)


def random_signal(rng, frames):
    """Return values in Q15 that move smoothly, jump, and touch the ends."""
    kind = rng.choice(("sine", "steps", "noise"))
    if kind == "sine":
        rate, phase = rng.uniform(0.02, 1), rng.uniform(0, 6)
        return [round(16384 + 16384 * math.sin(rate * n + phase)) for n in range(frames)]
    if kind == "noise":
        return [rng.randint(0, 32768) for _ in range(frames)]
    level = 0
    return [
        level := rng.choice((0, 32768, 16384, rng.randint(0, 32768))) if rng.random() < 0.1 else level
        for _ in range(frames)
    ]


def knot_bound(frame_rate, rate=2):
    """Return how far a knot may be from the exact one; `rate` is how much more a frame one source may move than the other.

    An offset that begins at 1 with such a rate reaches `1 + rate * (F / 4) / e` at most. Its two factors a frame, each off by
    2^-16 of itself, have counted twice F/4 times when it has shrunk again. Then the snap, and some units of Q24 a frame for
    what is cut off.
    """
    frames = frame_rate / 4
    greatest = 1 + rate * frames / math.e
    return FACTOR_ERROR * 2 * 2 * frames * greatest + SNAP + 16 * frames / ONE_Q24


def spline_bound(frame_rate, rate=2):
    """Return how far a position may be from the exact one: the knots' errors, times the greatest sum of a spline's weights.

    The fraction of the frame is cut to Q15, which shifts it by 2^-15 of a slope of at most 3 a frame.
    """
    return 3 * knot_bound(frame_rate, rate) + 3 * 2.0**-15


@pytest.mark.parametrize("frame_rate", [10, 30, 60])
def test_course_of_a_smooth_motion_is_exact_to_an_eight_thousandth_with_frames_late(frame_rate):
    # Both sources move by at most 0.05 a frame; what is left is the rounding of factors, of which the fade's counts 0.3 s.
    frames, late = 8 * frame_rate, {n for n in range(frame_rate, 5 * frame_rate) if n % frame_rate < 7}
    signal = [[round(16384 + 10000 * math.sin(n * 0.08))] for n in range(frames)]
    ticks = first_tick_of_frame(frames - 1, 3_008, frame_rate)
    course = made(frame_rate, 3_008, [ONE_Q24 // 2])
    found, _, missed = play(course, signal, frame_rate, 3_008, ticks, late, 8)
    knots = knots_of_targets([value / 32768 for (value,) in signal], 0.5, frame_rate, missed)
    assert len(missed) >= 28 and numpy.abs(found[:, 0] - trajectory(knots, frame_rate, 3_008, ticks)).max() < 2**-13


def spline_weights(x):
    """Return what the last four knots, the newest first, count at a fraction of the frame."""
    weights = []
    for n in range(4):
        knots = Knots(0, 30)
        knots.values = [0.0, 0.0, 0.0, *(1.0 if n == 3 - i else 0.0 for i in range(4))]
        slopes = knots.slopes()
        u1, u0, m1, m0 = *knots.values[-2:], *slopes[-2:]
        weights.append(u1 + x * (m1 + x * (3 * (u0 - u1) - 2 * m1 - m0 + x * (m1 + m0 - 2 * (u0 - u1)))))
    return weights


@given(
    st.lists(st.tuples(positions_q24, positions_q24, positions_q24, positions_q24), min_size=1, max_size=DOFS),
    parts_q15,
)
def test_spline_is_that_of_the_knots(columns, x_q15):
    knot = words([0] * (4 * DOFS))
    for d, column in enumerate(columns):
        for n, value in enumerate(column):
            knot[n * DOFS + d] = value
    found = words([-1] * DOFS)
    MODULE._evaluate(knot, found, len(columns), x_q15)
    weights = spline_weights(x_q15 / 32768)
    for d, column in enumerate(columns):
        expected = sum(weight * value for weight, value in zip(weights, column, strict=True))
        # Three products, each cut off to a unit of twice the position and taken in limbs, each of which may lose one.
        assert abs(found[d] - MODULE.ZERO_Q24 - expected) <= 4
    assert list(found[len(columns) :]) == [-1] * (DOFS - len(columns))


def test_spline_leaves_the_range_by_less_than_half():
    # It is linear in the knots, so it is greatest at corners of their cube.
    knot, found = words([0] * (4 * DOFS)), words([0] * DOFS)
    for d, corner in enumerate(itertools.product((0, ONE_Q24), repeat=4)):
        for n, value in enumerate(corner):
            knot[n * DOFS + d] = value
    reached = []
    for x_q15 in range(0, 32768, 64):
        MODULE._evaluate(knot, found, DOFS, x_q15)
        reached += [value - MODULE.ZERO_Q24 for value in found]
    assert -0.5 * ONE_Q24 < min(reached) < -0.3 * ONE_Q24 and 1.3 * ONE_Q24 < max(reached) < 1.5 * ONE_Q24


@st.composite
def frames_of_knots(draw):
    """Frames of one DOF: targets, late or not, or a change of source; and the frame rate."""
    return (
        draw(rates_hz),
        draw(positions_q24),
        draw(
            st.lists(
                st.tuples(integers(0, formats.VALUE_ONE), st.sampled_from(("on", "on", "late", "changed"))), max_size=80
            )
        ),
    )


@given(frames_of_knots())
def test_knots_are_those_of_the_reference_whatever_comes(drawn):
    frame_rate, pose_q24, frames = drawn
    course = made(frame_rate, 20_000, [pose_q24])
    expected = Knots(pose_q24 / ONE_Q24, frame_rate)
    before = None
    for number, (target_q15, kind) in enumerate(frames):
        course._changed[0] |= kind == "changed"
        if kind == "late":
            expected.guess()
        else:
            if kind == "changed":
                expected.leave()
            expected.follow(target_q15 / 32768, before)
        earlier_q15 = target_q15 if before is None else round(before * 32768)
        next_knots(course, 1, halves([target_q15]), halves([earlier_q15]), kind == "late")
        assert 0 <= course._knot[0] <= ONE_Q24
        error = abs(course._knot[0] / ONE_Q24 - expected.values[-1])
        assert error < knot_bound(frame_rate) + 1e-9, f"frame {number}"
        before = target_q15 / 32768


def next_knots(course, dofs, target_q15, before_q15, late):
    MODULE._next_knots(
        course._knot,
        course._glide,
        course._changed,
        dofs,
        target_q15,
        0,
        before_q15,
        0,
        int(late),
        course._fade_q15,
        course._keep_q15,
        course._share_q15,
        course._most_q24,
    )


def test_targets_that_are_followed_are_passed_exactly():
    course = made(30, 20_000, [5 << TO_Q24] * DOFS)
    rng = random.Random(7)
    signal = [[5] * DOFS, *([rng.randint(0, 32768) for _ in range(DOFS)] for _ in range(100))]
    _, knots, _ = play(course, signal, 30, 20_000, first_tick_of_frame(100, 20_000, 30))
    assert (knots * 32768 == signal[: len(knots)]).all()


@pytest.mark.parametrize("frame_rate", [10, 60])
def test_offset_dies_out_without_a_last_step(frame_rate):
    course = made(frame_rate, 20_000, [ONE_Q24])
    offsets = []
    for _ in range(8 * frame_rate):
        next_knots(course, 1, halves([0]), halves([0]), False)
        offsets.append(course._knot[0])
    last = max(n for n, offset in enumerate(offsets) if offset)
    assert offsets == sorted(offsets, reverse=True) and last < 8 * frame_rate - 1
    assert offsets[last] < SNAP * ONE_Q24 * 2


def test_dof_that_is_held_stands_until_it_is_let_go():
    course = made(50, 3_008, [ONE_Q24 // 3] * 2)
    found = []
    for tick in range(400):
        if tick <= 200:
            course.stand_one(0, ONE_Q24 // 3)
        course.put(max(place_of_tick(tick, 3_008, 50)[0], 0), 2, halves([0, 0]))
        course.advance(2, True, None)
        found.append(references(course, 2))
    standing, going = (numpy.array(column) for column in zip(*found, strict=True))
    assert (numpy.abs(standing[:201] - ONE_Q24 // 3) <= 1).all() and (numpy.diff(going[10:200]) < 0).all()
    # Let go it takes the way that the other one has taken; the first knot is still where it stands, so from the second frame on.
    begin = next(tick for tick in range(400) if going[tick] != going[0])
    again = next(tick for tick in range(400) if standing[tick] < standing[0] - 1)
    assert 200 < again <= 200 + 2 * 7
    assert standing[again + 150] == pytest.approx(going[begin + 150], abs=ONE_Q24 / 100)


@pytest.mark.parametrize("frame_rate", [10, 30, 60])
def test_silence_leads_to_rest_and_back_without_a_step(frame_rate):
    period_us = 3_008
    course = made(frame_rate, period_us, [ONE_Q24 // 2])
    rest = halves([16384 - 3277])
    found, knots = [], []
    for tick in range(math.ceil(9e6 / period_us)):
        t_s = tick * period_us * 1e-6
        frame = place_of_tick(tick, period_us, frame_rate)[0]
        if frame >= 0:
            course.put(frame, 1, halves([round(16384 + 6554 * math.sin(frame * 6 / frame_rate))]))
        course.advance(1, True, rest if 2 < t_s < 5 else None)
        found.append(references(course, 1)[0] / ONE_Q24)
        if frame == len(knots):
            knots.append(newest_knots(course, 1)[0] / ONE_Q24)
        if 4.9 < t_s < 5:
            assert abs(found[-1] - 0.4) < 1e-4
    # The sine is 0.2 high and bends by 7 per s^2. It or rest may be 0.3 away, 1.2 per s faster: the offset then bends by
    # (0.3 / 0.25 + 2 * 1.2) / 0.25 per s^2 at most. The spline's slopes, D + S / 2, overdo a sudden change at most fourfold.
    bends = numpy.diff(found[round(1e6 / period_us) :], 2) / (period_us * 1e-6) ** 2
    assert numpy.abs(bends).max() < 4 * (7.2 + 14.4)
    assert numpy.abs(numpy.diff(knots[frame_rate:], 2)).max() * frame_rate**2 < 1.1 * (7.2 + 14.4)
    assert course.late == 0


def test_derivatives_are_those_of_the_last_targets():
    course = made(30, 20_000, [0, 0])
    for before, now in ((0, 0), (0, 300), (300, 1000)):
        next_knots(course, 2, halves([now, 32768 - now]), halves([before, 32768 - before]), False)
    course._glide[:] = words([MODULE.ZERO_Q24] * len(course._glide))
    for number, knot in enumerate((1000, 300, 0)):
        course._knot[number * DOFS] = knot << TO_Q24
        course._knot[number * DOFS + 1] = (32768 - knot) << TO_Q24
    slope_q16, bend_q15 = words([0, 0]), words([0, 0])
    course.derive(2, slope_q16, bend_q15)
    # Slope 700 + 400 / 2 in Q15, so twice that in Q16.
    assert (list(slope_q16), list(bend_q15)) == ([1800, -1800], [400, -400])


def test_delay_of_the_reference_is_that_of_the_definition():
    course = made(60, 3_008, [0])
    assert Fraction(course._delay, 1_000_000) == Fraction(1, 2)
    assert Fraction(made(30, 3_008, [0])._delay, 1_000_000) == Fraction(3, 10)
