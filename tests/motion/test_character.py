"""Character, from file to tap: the motor tap against the exact response to the course through the signal tap.

Every tap here comes from the firmware in virtual time. Speed and acceleration limits are as wide as files allow, and the
responses small enough never to meet them, which is checked.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import numpy
import pytest

from tests.motion.playing import Case, play, tap
from tests.reference_motor import (
    Character,
    characterised,
    characterised_spline,
    knots_of_targets,
    polynomials,
    tapped,
    trajectory,
)

SECONDS = 8
REST = 0.5
SPEED, ACCEL = 50, 1000
Q15 = 2.0**-15


class Kind(NamedTuple):
    f_hz: float
    zeta: float
    r: float
    swing: float
    """How far the input goes, so that no response leaves the range or meets a limit."""


CORNERS = [
    Kind(0.2, 0.1, -4, 0.1),
    Kind(0.2, 0.1, 4, 0.1),
    Kind(0.2, 3, -4, 0.05),
    Kind(0.2, 3, 4, 0.05),
    Kind(2, 0.1, 0, 0.05),
    Kind(2, 0.1, 4, 0.05),
    Kind(2, 0.7, -2, 0.08),
    Kind(2, 1, 1, 0.1),
    Kind(2, 1, 0, 0.1),
    Kind(10, 0.1, -4, 0.01),
    Kind(10, 0.1, 4, 0.01),
    Kind(10, 3, -4, 0.01),
    Kind(10, 3, 4, 0.01),
    Kind(10, 1, 0, 0.02),
]
INPUTS = {
    "step": {"function": "live(STEP)", "cues": [{"at": 1, "live": {"STEP": 1.0}}, {"at": 5, "live": {"STEP": 0.2}}]},
    "ramp": {"function": "RAMP", "cues": []},
    "sine": {"function": "rsin(1.5*t)", "cues": [{"at": 4, "tempo": {"MOVE": 2.0}}]},
}


def case(shape, frame_rate, rate_hz):
    """Return a puppet whose DOFs have one character each and the same input."""
    wide = {"range": [0.0, 1.0], "speed": SPEED, "accel": ACCEL}
    given = INPUTS[shape]
    puppet = {
        "frame_rate": frame_rate,
        "dof": {
            f"DOF_{n}": {"rest": REST, "limits": wide, "character": {"f": kind.f_hz, "zeta": kind.zeta, "r": kind.r}}
            for n, kind in enumerate(CORNERS)
        },
        "live": {"STEP": {"rest": 0.5, "tau": 0.05}},
        "function": {"RAMP": {"table": [0.0, 1.0, 0.5, 0.5]}},
        "action": {
            "MOVE": {
                "tempo": 0.5,
                "map": [
                    [f"DOF_{n}", REST - kind.swing, REST + kind.swing, given["function"]]
                    for n, kind in enumerate(CORNERS)
                ],
            }
        },
    }
    score = {"cue": [{"at": 0, "weights": {"MOVE": 1.0}}, *given["cues"]]}
    return Case(f"{shape} at {rate_hz} Hz", puppet, score, {"rate": rate_hz})


def period_us(rate_hz):
    return math.ceil(Fraction(1_000_000, rate_hz) / 8) * 8


def gain_of(kind, tick_s):
    """Return the sum of what the character's answer to a unit impulse of input, linear within ticks, is at each tick."""
    dynamics = Character(*kind[:3], 0)
    total, before = 0.0, 0.0
    for begin, end in ((0.0, 1.0), (1.0, 0.0)):
        dynamics.advance(tick_s, begin, (end - begin) / tick_s)
        total += abs(dynamics.y)
    while max(abs(dynamics.y), before) > 1e-5:
        before = abs(dynamics.y)
        dynamics.advance(tick_s, 0.0, 0.0)
        total += abs(dynamics.y)
    return total


RUNS = [(shape, frame_rate, rate_hz) for shape in INPUTS for frame_rate, rate_hz in ((30, 333), (60, 50), (24, 120))]


class Answers:
    """What one DOF of a rendering was led by and answered; arrays by frame, or by tick from the one before frame 0 on."""

    def __init__(self, rendering, number, frame_rate, tick_us):
        self.kind = CORNERS[number]
        self.signal, self.motor = (tap(rendering, name)[:, number] for name in ("signal", "motor"))
        assert numpy.ptp(self.signal) > self.kind.swing, "the input moves"
        self.knots = knots_of_targets(self.signal, REST, frame_rate)
        ticks = math.floor((len(self.signal) - 1) * 1e6 / frame_rate / tick_us)
        course = numpy.concatenate(([REST], trajectory(self.knots, frame_rate, tick_us, ticks)))
        self.answer = characterised(course, *self.kind[:3], tick_us)
        self.frames = len(self.signal) - 4  # for the last ones the ticks behind them would be needed
        self.gain = gain_of(self.kind, tick_us / 1e6)
        assert_within_limits(self.answer, tick_us)

    @property
    def course_error(self):
        """How far the firmware's course may be from the reference's.

        Its place in the frame is cut to 2^-15, so it may be behind by that much of a frame's slope; the offset of the start is
        dropped when it is below 2^-18; and there are some units of Q24.
        """
        return numpy.abs(self.knots.slopes()).max() * Q15 + 2.0**-18 + 8 * 2.0**-24

    @property
    def tap_error(self):
        """The character's own rounding, which the tests of its kernel hold to 2^-16, and that of the tap."""
        return 2.0**-16 + 0.51 * Q15


@pytest.fixture(scope="module", params=RUNS, ids=lambda run: "{} at {} and {} Hz".format(*run))
def answered(request):
    """Answers of all corners to one input, the frame rate and the ticks' period."""
    shape, frame_rate, rate_hz = request.param
    rendering = play(case(shape, frame_rate, rate_hz), SECONDS)
    tick_us = period_us(rate_hz)
    return [Answers(rendering, n, frame_rate, tick_us) for n in range(len(CORNERS))], frame_rate, tick_us


def test_motor_tap_is_the_characters_answer_to_the_course_through_the_signal(answered):
    answers, frame_rate, tick_us = answered
    for one in answers:
        expected = tapped(one.answer, tick_us, frame_rate, one.frames)
        error = numpy.abs(one.motor[: one.frames] - expected).max()
        bound = one.gain * one.course_error + one.tap_error
        assert error <= bound, f"{one.kind}: off by {error / Q15:.2f} of Q15, {error / bound:.2f} of the bound"


def test_motor_tap_is_the_continuous_answer_to_what_ticks_leave(answered):
    answers, frame_rate, tick_us = answered
    for one in answers:
        expected = characterised_spline(one.knots, *one.kind[:3], frame_rate, one.frames)
        error = numpy.abs(one.motor[: one.frames] - expected).max()
        # Straight lines between ticks miss the course by an eighth of its bend in a tick squared, and the tap the answer alike.
        bend, jerk = polynomials(one.knots)[:, 2:].T
        bend_most = numpy.abs(numpy.concatenate((bend, bend + jerk))).max() * (frame_rate * tick_us / 1e6) ** 2
        answer_bend_most = numpy.abs(numpy.diff(one.answer, 2)).max()
        ticks_error = one.gain * bend_most / 8 + answer_bend_most / 8
        # The answer bends most where its input has a kink, between ticks of which the ticks' second difference shows a part.
        bound = ticks_error + answer_bend_most / 8 + one.gain * one.course_error + one.tap_error
        assert error <= bound, f"{one.kind}: off by {error / Q15:.2f} of Q15, {error / bound:.2f} of the bound"
        assert tick_us > 4_000 or bound < one.kind.swing / 20, "at 333 Hz the bound has to say something"


def assert_within_limits(positions, tick_us):
    """Hold that a motion keeps clear of the limits, which have to be without effect here."""
    tick_s = tick_us / 1e6
    assert positions.min() > 0 and positions.max() < 1
    assert numpy.abs(numpy.diff(positions)).max() / tick_s < SPEED
    assert numpy.abs(numpy.diff(positions, 2)).max() / tick_s**2 < ACCEL


def test_slow_dofs_have_no_dead_zone_above_a_4096th():
    """Each step of 1/4096 of the input arrives, whatever the character; a weight target that steps moves the base that little."""
    kinds = [(0.2, 0.1, 0), (0.2, 3, 0), (10, 3, 0), (0.2, 1, -4), (10, 0.1, 4), (1, 1, 0)]
    puppet = {
        "dof": {
            f"DOF_{n}": {"character": dict(zip(("f", "zeta", "r"), kind, strict=True))} for n, kind in enumerate(kinds)
        },
        "live": {"STEP": {"rest": 0.5, "tau": 0.03}},
        "action": {"MOVE": {"map": [[f"DOF_{n}", 0.5, 0.5 + 1 / 2048, "live(STEP)"] for n in range(len(kinds))]}},
    }
    # The slowest parts have time constants of 8 s (zeta = 0.1) and 4.6 s (zeta = 3): of a step less than a tenth is left.
    settled_s = 24
    cues = [{"at": 0, "weights": {"MOVE": 1.0}}, {"at": settled_s, "live": {"STEP": 1.0}}]
    score = {"cue": [*cues, {"at": 2 * settled_s, "live": {"STEP": 0.5}}]}
    rendering = play(Case("dead zone", puppet, score, {"rate": 333}), 3 * settled_s)
    motor, signal = (tap(rendering, name)[settled_s * 30 - 1 :: settled_s * 30] for name in ("motor", "signal"))
    assert (numpy.abs(numpy.diff(signal, axis=0)) * 4096 == 1).all()
    assert numpy.abs(motor - signal).max() < 1 / 16384
