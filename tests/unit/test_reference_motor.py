"""The motor layer's oracle against values worked out by hand, closed solutions, and its own convergence."""

import cmath
import itertools
import math
from fractions import Fraction

import numpy
import pytest

from tests.reference_motor import (
    GUESS_TAU_S,
    OFFSET_TAU_S,
    Character,
    Knots,
    characterised,
    characterised_spline,
    delay_s,
    driven,
    exponential,
    first_tick_of_frame,
    knots_of_targets,
    lag_s,
    least_ticks,
    place_of_tick,
    polynomials,
    pulse_us,
    tapped,
    trajectory,
)

CHARACTERS = list(itertools.product((0.2, 1.5, 10), (0.1, 0.7, 1, 3), (-4, 0, 1, 4)))
PERIODS_US = (20_000, 10_000, 3_008)


@pytest.mark.parametrize(("frame_rate", "delay"), [(10, "0.01"), (30, "0.01"), (50, "0.01"), (60, "1/120")])
def test_delay_is_10_ms_or_half_a_frame(frame_rate, delay):
    assert delay_s(frame_rate) == Fraction(delay)
    assert lag_s(frame_rate) == Fraction(delay) + Fraction(1, frame_rate)


def test_frame_takes_effect_at_the_first_tick_at_or_after_its_delay():
    # At 50 Hz and 50 frames a second frame n has effect from n * 20 ms + 10 ms on: between two ticks, so from n + 1 on.
    assert [place_of_tick(tick, 20_000, 50) for tick in range(4)] == [(-1, 0.5), (0, 0.5), (1, 0.5), (2, 0.5)]
    assert [first_tick_of_frame(n, 20_000, 50) for n in range(3)] == [1, 2, 3]
    # At 100 Hz the tick 10 ms after the frame is not too early.
    assert [place_of_tick(tick, 10_000, 50) for tick in range(3)] == [(-1, 0.5), (0, 0.0), (0, 0.5)]
    assert [first_tick_of_frame(n, 10_000, 50) for n in range(3)] == [1, 3, 5]


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize("frame_rate", [10, 30, 47, 60])
def test_every_tick_belongs_to_the_last_frame_that_has_taken_effect(period_us, frame_rate):
    first = [first_tick_of_frame(n, period_us, frame_rate) for n in range(200)]
    for tick in range(first[-1]):
        frame, fraction = place_of_tick(tick, period_us, frame_rate)
        assert frame == sum(1 for begin in first if begin <= tick) - 1
        assert 0 <= fraction < 1


def test_knots_follow_targets_from_the_pose_and_the_offset_dies_out_critically_damped():
    frame_rate, pose, target = 30, 0.25, 0.75
    knots = knots_of_targets([target] * 90, pose, frame_rate)
    for n, found in enumerate(knots.values[3:]):
        t_s = n / frame_rate
        offset = (pose - target) * (1 + t_s / OFFSET_TAU_S) * math.exp(-t_s / OFFSET_TAU_S)
        assert found == pytest.approx(target + offset, abs=1e-12)


def test_knots_that_start_at_the_pose_are_the_targets():
    targets = [0.5, 0.5, 0.6, 0.2, 1]
    assert knots_of_targets(targets, 0.5, 25).values == [0.5, 0.5, 0.5, *targets]


def test_guessed_knots_come_to_rest_exponentially():
    frame_rate = 20
    knots = knots_of_targets([0.5, 0.5, 0.52, 0.54], 0.5, frame_rate)
    for _ in range(200):
        knots.guess()
    steps = numpy.diff(knots.values[6:])
    assert steps == pytest.approx(0.02 * numpy.exp(-numpy.arange(1, 201) / (frame_rate * GUESS_TAU_S)), abs=1e-12)
    rho = math.exp(-1 / (frame_rate * GUESS_TAU_S))
    assert knots.values[-1] == pytest.approx(0.54 + 0.02 * rho / (1 - rho), abs=1e-9)


def test_late_frames_leave_an_offset_that_meets_the_targets_in_value_and_velocity():
    frame_rate = 30
    targets = [0.5 + 0.001 * n for n in range(400)]
    late = range(100, 106)
    knots = knots_of_targets(targets, 0.5, frame_rate, late).values[3:]
    assert knots[:100] == pytest.approx([0.5 + 0.001 * n for n in range(100)], abs=1e-12)
    rho = math.exp(-1 / (frame_rate * GUESS_TAU_S))
    # The knots of frames 100 .. 105 are guessed; that of frame 106 goes on alike, and has an offset from there.
    steps = numpy.diff(knots[99:107])
    assert steps == pytest.approx([0.001 * rho**n for n in range(1, 8)], abs=1e-12)
    offset, rate = knots[106] - targets[106], (steps[-1] - 0.001) * frame_rate
    for n in range(106, 400):
        t_s = (n - 106) / frame_rate
        left = (offset + (rate + offset / OFFSET_TAU_S) * t_s) * math.exp(-t_s / OFFSET_TAU_S)
        assert knots[n] - targets[n] == pytest.approx(left, abs=1e-12)
    assert abs(knots[-1] - targets[-1]) < 1e-12


def test_knots_stay_within_their_range():
    knots = knots_of_targets([0.5, 0.7, 0.9, 0.9, 0.9, 1], 0.5, 10, late=(3, 4))
    rho = math.exp(-1 / 3)
    assert knots.values[6:] == pytest.approx([1, 1, 1]) and knots.offset == 0
    assert knots.values[5] + 0.2 * rho > 1


def test_change_of_source_with_an_unknown_target_before_counts_as_standing_still():
    knots = Knots(0.2, 10)
    for target in (0.2, 0.3, 0.4):
        knots.follow(target, 0.2)
    knots.leave()
    knots.follow(0.9)
    step = 0.1 * math.exp(-1 / 3)
    assert knots.values[-1] == pytest.approx(0.4 + step)
    assert knots.offset == pytest.approx(0.4 + step - 0.9)
    assert knots.offset_rate == pytest.approx(10 * step)


@pytest.mark.parametrize("late", [(), (5,), (5, 6, 7, 20), range(8, 40)])
def test_trajectory_passes_the_knots_and_its_velocity_is_continuous(late):
    targets = [0.5 + 0.3 * math.sin(n * n / 50) for n in range(60)]
    knots = knots_of_targets(targets, 0.1, 30, late)
    pieces = polynomials(knots)
    value, slope, bend, jerk = pieces.T
    assert len(pieces) == len(targets)
    assert value == pytest.approx(knots.values[2:-1], abs=1e-12)
    assert value + slope + bend / 2 + jerk / 6 == pytest.approx(knots.values[3:], abs=1e-12)
    assert (slope + bend + jerk / 2)[:-1] == pytest.approx(slope[1:], abs=1e-12)
    assert slope[0] == 0


def test_trajectory_is_exact_for_parabolas():
    def curve(n):
        return 0.3 + 0.02 * n - 0.001 * n * n

    knots = Knots(0, 25)
    knots.values = [curve(n) for n in range(50)]
    value, slope, bend, jerk = polynomials(knots).T
    # The piece of frame 0 begins at the third knot, number 2, the first one with a slope of three targets.
    begins = numpy.arange(2, 49)
    assert value == pytest.approx(curve(begins), abs=1e-12)
    assert slope == pytest.approx(0.02 - 0.002 * begins, abs=1e-12)
    assert bend == pytest.approx(-0.002, abs=1e-12) and jerk == pytest.approx(0, abs=1e-12)


def test_trajectory_is_late_by_a_frame_and_the_delay_and_converges_with_the_third_power():
    def curve(t_s):
        return 0.5 + 0.4 * math.sin(2 * math.pi * 0.8 * t_s + 1)

    errors = []
    for frame_rate in (15, 30, 60):
        targets = [curve(n / frame_rate) for n in range(3 * frame_rate)]
        knots = knots_of_targets(targets, curve(0), frame_rate)
        ticks = range(math.ceil(2e6 / 3_008), math.floor(2.9e6 / 3_008))
        found = trajectory(knots, frame_rate, 3_008, ticks.stop)[ticks.start :]
        # By then the offset left from the start, which does not begin at the curve's velocity, has died out.
        late_s = float(lag_s(frame_rate))
        expected = [curve(tick * 3_008e-6 - late_s) for tick in ticks]
        errors.append(numpy.abs(found - expected).max())
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.25) and errors[1] / errors[2] == pytest.approx(8, rel=0.25)
    assert errors[2] < 2e-4


def test_trajectory_stands_at_the_pose_until_the_first_frame_takes_effect():
    positions = trajectory(knots_of_targets([1, 1, 1], 0.25, 30), 30, 3_008, 30)
    first = first_tick_of_frame(0, 3_008, 30)
    assert list(positions[: first + 1]) == [0.25] * (first + 1)
    assert (numpy.diff(positions) >= 0).all() and positions[-1] > 0.25


def test_exponential_of_known_matrices():
    assert exponential(numpy.zeros((3, 3))) == pytest.approx(numpy.eye(3))
    assert exponential(numpy.diag([1.0, -30.0])) == pytest.approx(numpy.diag([math.e, math.exp(-30)]), rel=1e-12)
    turn = exponential(numpy.array([[0.0, -7.0], [7.0, 0.0]]))
    assert turn == pytest.approx(numpy.array([[math.cos(7), -math.sin(7)], [math.sin(7), math.cos(7)]]), abs=1e-12)
    assert exponential(numpy.array([[0.0, 5.0], [0.0, 0.0]])) == pytest.approx(numpy.array([[1, 5], [0, 1]]))


def roots(f_hz, zeta):
    """Return the roots of `1 + k1*s + k2*s^2`."""
    natural = 2 * math.pi * f_hz
    root = cmath.sqrt(complex(zeta * zeta - 1))
    return natural * (-zeta + root), natural * (-zeta - root)


def response(f_hz, zeta, r, t_s, ramp):
    """Return the closed response to a unit step or ramp at t = 0, by partial fractions; not for zeta = 1."""
    one, two = roots(f_hz, zeta)
    natural = 2 * math.pi * f_hz
    k1, k3 = zeta / (math.pi * f_hz), r * zeta / natural
    residues = [
        natural**2 * (1 + k3 * pole) / ((pole - other) * (pole * pole if ramp else pole))
        for pole, other in ((one, two), (two, one))
    ]
    steady = t_s + k3 - k1 if ramp else 1.0
    return steady + sum(
        (residue * cmath.exp(pole * t_s)).real for residue, pole in zip(residues, (one, two), strict=True)
    )


@pytest.mark.parametrize(("f_hz", "zeta", "r"), [case for case in CHARACTERS if case[1] != 1])
def test_character_gives_the_closed_responses_to_step_and_ramp(f_hz, zeta, r):
    step_s = 0.1 / f_hz
    stepped, ramped = (Character(f_hz, zeta, r, 0) for _ in range(2))
    stepped.rate = stepped.k3 / stepped.k2  # what the step's infinite slope leaves behind in no time
    for n in range(1, 50):
        stepped.advance(step_s, 1.0)
        ramped.advance(step_s, (n - 1) * step_s, 1.0)
        assert stepped.y == pytest.approx(response(f_hz, zeta, r, n * step_s, ramp=False), abs=1e-9)
        assert ramped.y == pytest.approx(response(f_hz, zeta, r, n * step_s, ramp=True), abs=1e-9)


def test_character_with_critical_damping_gives_the_closed_step_response():
    f_hz, natural = 1.5, 3 * math.pi
    dynamics = Character(f_hz, 1, 0, 0)
    for n in range(1, 100):
        dynamics.advance(0.013, 1.0)
        t = natural * n * 0.013
        assert dynamics.y == pytest.approx(1 - (1 + t) * math.exp(-t), abs=1e-9)


def test_character_with_r_1_and_critical_damping_is_a_filter_of_first_order():
    # 1 + k3*s with r = 1 and zeta = 1 is one of the two factors of (1 + s/w)^2.
    natural = 2 * math.pi * 2
    dynamics = Character(2, 1, 1, 0)
    for n in range(1, 100):
        dynamics.advance(0.01, (n - 1) * 0.01, 1.0)
        t_s = n * 0.01
        assert dynamics.y == pytest.approx(t_s - (1 - math.exp(-natural * t_s)) / natural, abs=1e-9)


@pytest.mark.parametrize(("f_hz", "zeta", "r"), CHARACTERS)
def test_character_settles_to_the_gain_and_phase_of_its_transfer_function(f_hz, zeta, r):
    # After 40 time constants of the slowest root 1e-9 of the transient is left at most.
    frequency_hz = 0.7 * f_hz
    dynamics = Character(f_hz, zeta, r, 0)
    slowest = min(abs(root.real) for root in roots(f_hz, zeta))
    dynamics.y, dynamics.rate = 0.0, 0.0
    s = 2j * math.pi * frequency_hz
    gain = (1 + dynamics.k3 * s) / (1 + dynamics.k1 * s + dynamics.k2 * s * s)
    step_s = 1 / (400 * frequency_hz)
    settled = math.ceil(40 / slowest / step_s)
    u = [cmath.exp(s * n * step_s).imag for n in range(settled + 401)]
    for n in range(settled + 400):
        dynamics.advance(step_s, u[n], (u[n + 1] - u[n]) / step_s)
        if n >= settled:
            expected = (gain * cmath.exp(s * (n + 1) * step_s)).imag
            # A sine of straight pieces is smaller by (pi/400)^2 / 3, and has overtones no greater.
            assert dynamics.y == pytest.approx(expected, abs=1e-4 * max(1, abs(gain)))


@pytest.mark.parametrize(("f_hz", "zeta", "r"), [(0.2, 0.1, -4), (1.5, 0.7, 1), (10, 3, 4), (10, 0.1, 4)])
def test_character_of_linear_ticks_converges_to_that_of_the_spline_with_the_second_power(f_hz, zeta, r):
    frame_rate, frames = 20, 60
    targets = [0.5 + 0.3 * math.sin(0.2 * n) for n in range(frames + 2)]
    knots = knots_of_targets(targets, 0.5, frame_rate)
    expected = characterised_spline(knots, f_hz, zeta, r, frame_rate, frames)
    errors = []
    for ticks_per_frame in (10, 20, 40):
        period_us = 50_000 // ticks_per_frame
        inputs = trajectory(knots, frame_rate, period_us, frames * ticks_per_frame)
        output = characterised(inputs, f_hz, zeta, r, period_us)[::ticks_per_frame]
        errors.append(numpy.abs(output - expected).max())
    assert errors[2] < 2e-3
    assert all(later < 0.3 * earlier for earlier, later in itertools.pairwise(errors))


def test_character_of_a_steady_input_stands():
    assert characterised([0.3] * 20, 5, 0.1, -4, 20_000) == pytest.approx([0.3] * 20)


def test_tap_weighs_the_ticks_about_a_frame():
    # At 50 Hz and 50 frames a second each frame is at a tick: 1/8, 3/4 and 1/8. At 25 Hz half the frames are between two.
    positions = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    assert tapped(positions, 20_000, 50, 4) == pytest.approx([1 / 8, 3 / 4, 1 / 8, 0])
    assert tapped(positions, 40_000, 50, 4) == pytest.approx([1 / 8, 1 / 2, 3 / 4, 1 / 2])


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_tap_of_a_steady_motion_is_that_motion(period_us):
    # The last frame is at 299/30 s.
    positions = [0.1 + 0.07 * tick * period_us / 1e6 for tick in range(-1, math.ceil(10e6 / period_us) + 2)]
    assert tapped(positions, period_us, 30, 300) == pytest.approx([0.1 + 0.07 * n / 30 for n in range(300)], abs=1e-12)


def test_tap_of_a_parabola_is_off_by_an_eighth_of_its_bend():
    positions = [tick * tick / 2 for tick in range(-1, 100)]
    expected = [(n * 1.25) ** 2 / 2 + 1 / 8 for n in range(60)]
    assert tapped(positions, 16_000, 50, 60) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("distance", "speed", "acceleration", "ticks"),
    [(100, 10, 1, 20), (400, 10, 1, 50), (64, 100, 1, 16), (1, 1, 1, 2)],
)
def test_least_time_is_that_of_the_trapezoid_or_the_triangle(distance, speed, acceleration, ticks):
    assert least_ticks(distance, speed, acceleration) == ticks


@pytest.mark.parametrize(
    ("speed", "drive"),
    [(0, 0), (1 / 128, 0.1025), (1 / 64, 0.205), (-1 / 64, -0.205), (0.5, 0.36), (1, 0.52), (-1, -0.52)],
)
def test_wheel_gets_its_dead_band_from_a_64th_on_and_ends_at_its_top_speed(speed, drive):
    assert driven(speed, 0.2, 0.52) == pytest.approx(drive)


def test_pulse_goes_from_end_to_end():
    assert [pulse_us(level, 2000, 1000) for level in (0, 0.25, 1)] == [2000, 1750, 1000]
