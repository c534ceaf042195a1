"""From frames to a smooth course: the cache of recent targets, and the spline through them.

Frame `n` takes effect at the first motor tick at or after `n / F + D`, `D` being 10 ms or half a frame, whichever is
shorter. A cubic spline passes the frames' targets one frame later than that, with slopes from first and second
differences: `m = d + s / 2` per frame, `d = u(n) - u(n-1)`, `s = d(n) - d(n-1)`. Position and velocity are continuous
whatever the targets do.

A frame that is not there in time is guessed: the motion goes on, its velocity dying out with 0.3 s. Where the source
of the targets changes (a start, frames that come again after a gap, going to rest in silence and back, a DOF that has
just been attached) the motion goes on likewise, and the difference to the new source dies out critically damped with
0.25 s. All of this happens to the targets, so the spline keeps it smooth.

Values are Q24, a relative DOF's -1..1 as (v + 1) / 2. Signed words are stored with `ZERO_Q24` added, because a 64-bit
port reads words without their sign.

Source: SPEC of motor control; the paper's section on motor control (a cache of targets and their derivatives).
"""

import micropython
from micropython import const

from firmware.tables import halves, words
from shared.formats import DOFS_MAX, FRAMES_KEPT, NEW, POSITION_ONE

ZERO_Q24 = 1 << 28
KNOTS = 4  # recent targets per DOF, the newest first

_DOFS = const(16)
_ZERO = const(0x10000000)
_ONE = const(0x1000000)
_MICRO = const(1000000)
_FADE_MS = const(300)  # of the velocity while frames are late
_GLIDE_MS = const(250)  # of the difference to a new source
_GLIDE_PER_S = const(4)  # ranges a second with which that may begin
_SETTLED = const(64)  # a difference below 2^-18 and as slow is gone


def exp_q15(numerator, denominator):
    """Return `exp(-numerator / denominator)` in Q15, rounded, for ratios of 0..2. Allocates; the same on every port."""
    term = total = 1 << 60
    for n in range(1, 40):
        term = -term * numerator // (n * denominator)
        total += term
    return (total + (1 << 44)) >> 45


@micropython.viper
def _next_knots(
    knot: ptr32,
    glide: ptr32,
    changed: ptr16,
    dofs: int,
    target_q15: ptr16,
    at: int,
    before_q15: ptr16,
    before_at: int,
    late: int,
    fade_q15: int,
    keep_q15: int,
    share_q15: int,
    most_q24: int,
):
    """Shift the knots of every DOF by one frame and append the newest.

    `knot` holds 4 x 16 words, the newest first; `glide` 2 x 16, the difference to the source and its velocity per
    frame. The target is `target_q15[at + dof]`, that of the frame before `before_q15[before_at + dof]`; `late` not 0
    means that there is none. `share` is the frame's length by 0.25 s, `keep` is `exp(-share)`. A glide begins with the
    difference of the velocities, `most` at most: one target alone may jump.
    Bits: differences stay within 2^25, products are taken in limbs of 13 + 12 and 15 bits, below 2^29.
    """
    d = 0
    while d < dofs:
        newest = knot[d]
        run = newest - knot[_DOFS + d]
        run = ((run >> 12) * fade_q15 >> 3) + ((run & 0xFFF) * fade_q15 >> 15)
        knot[3 * _DOFS + d] = knot[2 * _DOFS + d]
        knot[2 * _DOFS + d] = knot[_DOFS + d]
        knot[_DOFS + d] = newest
        value = newest + run
        if late:
            changed[d] = 1
        else:
            target = int(target_q15[at + d]) << 9
            if changed[d]:
                changed[d] = 0
                if value < 0:
                    value = 0
                if value > _ONE:
                    value = _ONE
                glide[d] = value - target + _ZERO
                rate = run - (target - (int(before_q15[before_at + d]) << 9))
                if rate > most_q24:
                    rate = most_q24
                if rate < -most_q24:
                    rate = 0 - most_q24
                glide[_DOFS + d] = rate + _ZERO
            else:
                off = glide[d] - _ZERO
                rate = glide[_DOFS + d] - _ZERO
                if off or rate:
                    pull = rate + ((off >> 12) * share_q15 >> 3) + ((off & 0xFFF) * share_q15 >> 15)
                    off += pull
                    off = ((off >> 12) * keep_q15 >> 3) + ((off & 0xFFF) * keep_q15 >> 15)
                    rate -= ((pull >> 12) * share_q15 >> 3) + ((pull & 0xFFF) * share_q15 >> 15)
                    rate = ((rate >> 12) * keep_q15 >> 3) + ((rate & 0xFFF) * keep_q15 >> 15)
                    if -_SETTLED < off and off < _SETTLED and -_SETTLED < rate and rate < _SETTLED:
                        off = 0
                        rate = 0
                    glide[d] = off + _ZERO
                    glide[_DOFS + d] = rate + _ZERO
                value = target + off
        if value < 0:
            value = 0
        if value > _ONE:
            value = _ONE
        knot[d] = value
        d += 1


@micropython.viper
def _evaluate(knot: ptr32, reference_q24: ptr32, dofs: int, x_q15: int):
    """Write where every DOF should be, `x` of a frame (Q15) behind the last knot but one on its way to the newest.

    With `u` the last knot but one, `d` and `r` the differences that end there, `s` the second difference of the newest:
    `u + x * (d + r / 2 + x * (3 s / 2 - r + x * (r - s) / 2))`, the bracket in Q25. It may leave 0..1, by less than half.
    Bits: differences stay within 2^24, second ones within 2^25, brackets within 2^27.4; times 15 in limbs of 16 + 12.
    """
    d = 0
    while d < dofs:
        u1 = knot[_DOFS + d]
        u2 = knot[2 * _DOFS + d]
        step = knot[d] - u1
        before = u1 - u2
        bend = step - before
        bend_before = before - (u2 - knot[3 * _DOFS + d])
        value = bend_before - bend
        value = ((value >> 12) * x_q15 >> 3) + ((value & 0xFFF) * x_q15 >> 15) + 3 * bend - 2 * bend_before
        value = ((value >> 12) * x_q15 >> 3) + ((value & 0xFFF) * x_q15 >> 15) + 2 * before + bend_before
        value = ((value >> 12) * x_q15 >> 3) + ((value & 0xFFF) * x_q15 >> 15)
        reference_q24[d] = u1 + ((value + 1) >> 1) + _ZERO
        d += 1


@micropython.viper
def _stand(knot: ptr32, glide: ptr32, changed: ptr16, dofs: int, position_q24: ptr32):
    """Let all knots be where each DOF is: it stands there until the next knot."""
    d = 0
    while d < dofs:
        value = position_q24[d]
        knot[d] = value
        knot[_DOFS + d] = value
        knot[2 * _DOFS + d] = value
        knot[3 * _DOFS + d] = value
        glide[d] = _ZERO
        glide[_DOFS + d] = _ZERO
        changed[d] = 1
        d += 1


@micropython.viper
def _derive(knot: ptr32, slope_q16: ptr32, bend_q15: ptr32, dofs: int):
    """Write first (Q16) and second (Q15) derivative of the targets at the newest knot, by frames."""
    d = 0
    while d < dofs:
        step = knot[d] - knot[_DOFS + d]
        bend = step - (knot[_DOFS + d] - knot[2 * _DOFS + d])
        slope_q16[d] = (2 * step + bend) >> 9
        bend_q15[d] = bend >> 9
        d += 1


@micropython.viper
def _store(value_q15: ptr16, ring_q15: ptr16, dofs: int, at: int):
    """Copy the values of all DOFs to their place in a ring."""
    d = 0
    while d < dofs:
        ring_q15[at + d] = value_q15[d]
        d += 1


class Ring:
    """Values of all DOFs in the last 16 frames, frame `n` at `(n % 16) * 16`."""

    def __init__(self):
        self.value_q15 = halves(FRAMES_KEPT * DOFS_MAX)

    def put(self, frame, dofs, value_q15):
        """Store a frame's values."""
        _store(value_q15, self.value_q15, dofs, (frame & 15) * _DOFS)

    def rearrange(self, gather_halves, keep, scratch, dofs, newest, rest_q15):
        """Let the last few frames have other DOFs; those that were not there before were at rest."""
        for frame in range(newest - 3, newest + 1):
            at = (frame & 15) * _DOFS
            gather_halves(self.value_q15, keep, scratch, dofs, 0, at)
            for d in range(dofs):
                if keep[d] == NEW:
                    self.value_q15[at + d] = rest_q15[d]


class Trajectory:
    """The course of all DOFs between frames.

    Synthesis writes a frame's targets with `put`; the motor tick calls `advance` and reads `reference_q24` (with `ZERO_Q24`
    added). `newest` is the last frame that was put, `late` counts the frames that were not there when they should have
    taken effect. `ring` keeps the targets.
    """

    def __init__(self):
        self.reference_q24 = words(DOFS_MAX)
        self.late = 0
        self.newest = 0
        self.ring = Ring()
        self._knot = words(KNOTS * DOFS_MAX)
        self._glide = words(2 * DOFS_MAX)
        self._changed = halves(DOFS_MAX)
        self._effect = 0  # the last frame that has taken effect
        self._part = 0  # of the frame under way, in millionths
        self._step = 0  # millionths of a frame in a tick
        self._delay = 0
        self._source = -1
        self._fade_q15 = self._keep_q15 = self._share_q15 = self._most_q24 = 0

    def load(self, tables):
        """Take over frame rate and motor rate; allocates."""
        rate_hz = tables.frame_rate_hz
        self._step = rate_hz * tables.motor_period_us
        self._delay = min(10000 * rate_hz, _MICRO // 2)
        self._fade_q15 = exp_q15(1000, _FADE_MS * rate_hz)
        self._keep_q15 = exp_q15(1000, _GLIDE_MS * rate_hz)
        self._most_q24 = _GLIDE_PER_S * POSITION_ONE // rate_hz
        self._share_q15 = (1000 * 32768 + _GLIDE_MS * rate_hz // 2) // (_GLIDE_MS * rate_hz)

    def hold(self, dofs, position_q24):
        """Let every DOF stand at its position until the first frame comes."""
        at = (self.newest & 15) * _DOFS
        for d in range(dofs):
            self.ring.value_q15[at + d] = (position_q24[d] + 256) >> 9
        _stand(self._knot, self._glide, self._changed, dofs, position_q24)

    def stand_one(self, dof, position_q24):
        """Let one DOF stand at a position, from which it goes to its targets."""
        for place in range(dof, KNOTS * _DOFS, _DOFS):
            self._knot[place] = position_q24
        self._glide[dof] = self._glide[_DOFS + dof] = ZERO_Q24
        self._changed[dof] = 1

    def prepare(self):
        """Expect frame 0; frames may be put from now on."""
        values = self.ring.value_q15
        before = (self.newest & 15) * _DOFS
        for d in range(_DOFS):
            values[15 * _DOFS + d] = values[before + d]
        self.newest = -1
        self.late = 0

    def start(self, dofs, position_q24):
        """Begin with frame 0 in the tick under way, from where every DOF is."""
        self._effect = -1
        self._part = _MICRO - self._delay - self._step
        _stand(self._knot, self._glide, self._changed, dofs, position_q24)

    def put(self, frame, dofs, target_q15):
        """Store a frame's targets; they count from this call on."""
        self.ring.put(frame, dofs, target_q15)
        self.newest = frame

    def rearrange(self, gather_words, gather_halves, keep, scratch, dofs, rest_q15):
        """Let other tables have other DOFs; new ones come from their rest."""
        for place in range(0, KNOTS * _DOFS, _DOFS):
            gather_words(self._knot, keep, scratch, dofs, ZERO_Q24, place)
        for place in range(0, 2 * _DOFS, _DOFS):
            gather_words(self._glide, keep, scratch, dofs, ZERO_Q24, place)
        gather_halves(self._changed, keep, scratch, dofs, 0, 0)
        self.ring.rearrange(gather_halves, keep, scratch, dofs, self.newest, rest_q15)

    def advance(self, dofs, playing, rest_q15):
        """Take the step of one motor tick.

        `playing` tells whether frames come; with `rest_q15` not None all DOFs go there instead.
        """
        part = self._part + self._step
        while part >= _MICRO:
            part -= _MICRO
            self._next(dofs, playing, rest_q15)
        self._part = part
        _evaluate(self._knot, self.reference_q24, dofs, (part << 10) // 31250)

    def derive(self, dofs, slope_q16, bend_q15):
        """Write the targets' first and second derivatives, by frames, in Q16 and Q15."""
        _derive(self._knot, slope_q16, bend_q15, dofs)

    def _next(self, dofs, playing, rest_q15):
        late = 0
        target_q15 = self.ring.value_q15
        at = before = (self.newest & 15) * _DOFS
        source = 0
        if playing:
            self._effect += 1
            at = (self._effect & 15) * _DOFS
            before = ((self._effect - 1) & 15) * _DOFS if self._effect else at
            source = 1
            if self._effect > self.newest:
                self.late += 1
                late = 1
        if rest_q15 is not None:
            target_q15 = rest_q15
            at = before = 0
            source = 2
            late = 0
        if source != self._source:
            self._source = source
            changed = self._changed
            for d in range(dofs):
                changed[d] = 1
        # fmt: off
        _next_knots(
            self._knot, self._glide, self._changed, dofs, target_q15, at, target_q15, before, late,
            self._fade_q15, self._keep_q15, self._share_q15, self._most_q24,
        )
        # fmt: on
