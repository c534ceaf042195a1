"""The motor layer's oracle: what one DOF's motor is told, tick by tick, in float64.

Written from the definitions of `docs/motion.md` alone and sharing no code with `firmware`, `shared` or `host`. Times that
decide which frame a tick belongs to are fractions; everything else is a float64. Values are positions 0..1; a relative
DOF's -1..1 is shifted and halved first, as it travels.

Readings where the definitions leave a choice:
- Frame 0 stands for the instant of tick 0. What a DOF did before is its pose, at rest.
- A frame that is late is guessed, once for all: when it comes, its target serves for the velocity of the next one alone.
- Knots stay within 0..1; what they lack then is not made up for.
- The target before the first one of a source is unknown; the source then counts as standing still.
- Within a tick the input of the character is linear; it and its output rest at the pose before tick 0.
- The tap is the quadratic B-spline whose control points are the positions of the ticks, at the ticks' instants.
"""

import itertools
import math
from fractions import Fraction

import numpy

GUESS_TAU_S = 0.3
"""With this time constant a guessed motion comes to rest."""

OFFSET_TAU_S = 0.25
OFFSET_RATE_MAX = 4.0
"""Ranges a second with which an offset may begin to move: a target alone may jump."""

"""With this time constant, critically damped, what a change of source has left over dies out."""

_US = 1_000_000
_KNOTS_BEFORE = 3
_TAYLOR_TERMS = 18


def delay_s(frame_rate):
    """Return, as a fraction, how long after its instant a frame takes effect: 10 ms or half a frame."""
    return min(Fraction(1, 100), Fraction(1, 2 * frame_rate))


def lag_s(frame_rate):
    """Return how far the trajectory is behind the frames' targets: it passes that of frame `n` at `n/F` and so much."""
    return Fraction(1, frame_rate) + delay_s(frame_rate)


def place_of_tick(tick, period_us, frame_rate):
    """Return (frame, fraction): the frame that has taken effect by a tick, and how far the tick is on the way to its target."""
    frames = (Fraction(tick * period_us, _US) - delay_s(frame_rate)) * frame_rate
    frame = math.floor(frames)
    return frame, float(frames - frame)


def first_tick_of_frame(frame, period_us, frame_rate):
    """Return the first tick at or after `n/F + D`."""
    return math.ceil((Fraction(frame, frame_rate) + delay_s(frame_rate)) * _US / period_us)


class Knots:
    """The knots of one DOF's trajectory, one a frame: targets, guesses, and what keeps changes of source smooth.

    Args:
        pose: where the DOF stands at first.
        frame_rate: frames per second.

    Attributes:
        values: all knots, those of the frames -3, -2 and -1 first, which are the pose.
        offset, offset_rate: how far the last knot is from its source's target, and that per second.
    """

    def __init__(self, pose, frame_rate):
        self.values = [float(pose)] * _KNOTS_BEFORE
        self.offset = self.offset_rate = 0.0
        self._frame_s = 1 / frame_rate
        self._follows = False

    def guess(self):
        """Go on without a target: the last step again, a little shorter."""
        self._follows = False
        self._append(self.values[-1] + self._next_step())

    def follow(self, target, earlier=None):
        """Take a target; `earlier` is the same source's one of the frame before, None if there was none.

        It continues what the last call followed, unless a guess or `leave` came between: then the source is a new one.
        """
        if self._follows:
            self._shrink_offset()
            self._append(target + self.offset)
            return
        step = self._next_step()
        self._append(self.values[-1] + step)
        self.offset = self.values[-1] - target
        rate = (step - (0.0 if earlier is None else target - earlier)) / self._frame_s
        self.offset_rate = min(max(rate, -OFFSET_RATE_MAX), OFFSET_RATE_MAX)
        self._follows = True

    def leave(self):
        """Let the next target be that of another source."""
        self._follows = False

    def slopes(self):
        """Return the slope at every knot, per frame: `D + S/2` of the backward differences, 0 at the first two."""
        knots = numpy.array(self.values)
        first = numpy.diff(knots, prepend=knots[0])
        return first + numpy.diff(first, prepend=0.0) / 2

    def _append(self, knot):
        self.values.append(min(max(knot, 0.0), 1.0))

    def _next_step(self):
        return (self.values[-1] - self.values[-2]) * math.exp(-self._frame_s / GUESS_TAU_S)

    def _shrink_offset(self):
        kept = math.exp(-self._frame_s / OFFSET_TAU_S)
        drift = self.offset_rate + self.offset / OFFSET_TAU_S
        self.offset = kept * (self.offset + drift * self._frame_s)
        self.offset_rate = kept * (self.offset_rate - drift * self._frame_s / OFFSET_TAU_S)


def knots_of_targets(targets, pose, frame_rate, late=()):
    """Return the knots of targets that come frame by frame from frame 0 on; those of the frames in `late` come too late."""
    knots = Knots(pose, frame_rate)
    for frame, target in enumerate(targets):
        if frame in late:
            knots.guess()
        else:
            knots.follow(target, targets[frame - 1] if frame else None)
    return knots


def polynomials(knots):
    """Return an array [frames, 4]: per frame from 0 on the value and its derivatives, per frame, where its piece begins.

    The piece of frame `n` begins `n/F + D` after frame 0, at the knot of frame `n - 1`, and ends at that of frame `n`.
    """
    values, slopes = numpy.array(knots.values), knots.slopes()
    rise = numpy.diff(values)
    begin, end = slopes[:-1], slopes[1:]
    pieces = numpy.stack((values[:-1], begin, 6 * rise - 4 * begin - 2 * end, 6 * (begin + end) - 12 * rise), axis=-1)
    return pieces[_KNOTS_BEFORE - 1 :]


def trajectory(knots, frame_rate, period_us, ticks):
    """Return the spline's positions at ticks 0 .. `ticks` - 1, which must lie before the end of the last piece."""
    pieces = polynomials(knots)
    positions = numpy.full(ticks, knots.values[0])
    for tick in range(ticks):
        frame, x = place_of_tick(tick, period_us, frame_rate)
        if frame >= 0:
            value, slope, bend, jerk = pieces[frame]
            positions[tick] = value + x * (slope + x * (bend / 2 + x * jerk / 6))
    return positions


def exponential(matrix):
    """Return the exponential of a small square matrix."""
    halvings = max(0, math.ceil(math.log2(max(numpy.abs(matrix).sum(axis=1).max(), 1e-300))) + 1)
    scaled = matrix / 2.0**halvings
    total = term = numpy.eye(len(matrix))
    for n in range(1, _TAYLOR_TERMS):
        term = term @ scaled / n
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


class Character:
    """Second-order dynamics, `y + k1*y' + k2*y'' = u + k3*u'`, solved exactly for inputs that are polynomials.

    Args:
        f_hz, zeta, r: natural frequency, damping, and initial response.
        position: where input and output rest at first.

    Attributes:
        y, rate: the output and its derivative, per second.
    """

    def __init__(self, f_hz, zeta, r, position):
        self.k1 = zeta / (math.pi * f_hz)
        self.k2 = 1 / (2 * math.pi * f_hz) ** 2
        self.k3 = r * zeta / (2 * math.pi * f_hz)
        self.y, self.rate = float(position), 0.0
        self._solutions = {}

    def advance(self, duration_s, *derivatives):
        """Go on for a time in which the input begins with this value and these derivatives, per second, and has no others."""
        key = duration_s, len(derivatives)
        if key not in self._solutions:
            self._solutions[key] = exponential(self._system(len(derivatives)) * float(duration_s))
        state = self._solutions[key] @ numpy.array([self.y, self.rate, *derivatives])
        self.y, self.rate = state[:2]

    def _system(self, derivatives):
        """Return the matrix of the state y, y', u, u', u'' .. of which the last one is constant."""
        system = numpy.zeros((2 + derivatives, 2 + derivatives))
        system[0, 1] = 1
        system[1, :4] = numpy.array([-1, -self.k1, 1, self.k3])[: 2 + derivatives] / self.k2
        for n in range(2, 1 + derivatives):
            system[n, n + 1] = 1
        return system


def characterised(positions, f_hz, zeta, r, period_us):
    """Return the character's output at the ticks at which the input, linear between them, has these positions."""
    period_s = Fraction(period_us, _US)
    dynamics = Character(f_hz, zeta, r, positions[0])
    output = [dynamics.y]
    for begin, end in itertools.pairwise(positions):
        dynamics.advance(period_s, begin, (end - begin) / float(period_s))
        output.append(dynamics.y)
    return numpy.array(output)


def characterised_spline(knots, f_hz, zeta, r, frame_rate, frames):
    """Return the character's output at the instants of frames 0 .. `frames` - 1 if the spline itself is its input."""
    pieces = polynomials(knots) * float(frame_rate) ** numpy.arange(4)
    dynamics = Character(f_hz, zeta, r, knots.values[0])
    before_s, after_s = delay_s(frame_rate), Fraction(1, frame_rate) - delay_s(frame_rate)
    output = []
    for frame in range(frames):
        output.append(dynamics.y)
        # The rest of the piece before, and then the beginning of the frame's own.
        earlier = _moved(pieces[frame - 1], float(after_s)) if frame else [knots.values[0], 0, 0, 0]
        dynamics.advance(before_s, *earlier)
        dynamics.advance(after_s, *pieces[frame])
    return numpy.array(output)


def _moved(piece, s):
    """Return a polynomial's value and derivatives at another place."""
    value, slope, bend, jerk = piece
    return [
        value + s * (slope + s * (bend / 2 + s * jerk / 6)),
        slope + s * (bend + s * jerk / 2),
        bend + s * jerk,
        jerk,
    ]


def tapped(positions, period_us, frame_rate, frames):
    """Return the tap of frames 0 .. `frames` - 1: the B-spline of the ticks' positions at `n/F`.

    The positions begin with tick -1; the last one has to be at least 3/2 ticks after the last frame.
    """
    values = []
    for frame in range(frames):
        ticks = Fraction(frame * _US, frame_rate * period_us)
        middle = math.floor(ticks + Fraction(1, 2))
        x = float(ticks - middle)
        before, at, after = positions[middle : middle + 3]
        values.append(before * (0.5 - x) ** 2 / 2 + at * (0.75 - x * x) + after * (0.5 + x) ** 2 / 2)
    return numpy.array(values)


def driven(speed, dead, top):
    """Return a wheel's share of full drive, -1..1, at a speed of -1..1: `dead` is added from a 64th on, `top` is that at 1."""
    size = abs(speed)
    return math.copysign(dead * min(64 * size, 1) + (top - dead) * size, speed)


def pulse_us(level, end0_us, end1_us):
    """Return the pulse width at a level of 0..1; a wheel's drive of -1..1 is shifted and halved first."""
    return end0_us + (end1_us - end0_us) * level


def least_ticks(distance, speed, acceleration):
    """Return how many ticks a motion from rest to rest takes at least, as a real number; speeds are per tick."""
    if distance * acceleration >= speed * speed:
        return distance / speed + speed / acceleration
    return 2 * math.sqrt(distance / acceleration)
