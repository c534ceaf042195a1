"""The future of the base motion, 254 frames and more of it, and the frequency bands that follow from it.

Two rings hold the base of every processed DOF from the past to the future (see `bands`). What is to come is computed in blocks, near
frames first, from an outlook that is taken anew whenever something arrives; a front of exact frames moves on through the future and
then keeps a little more than what the bands need ahead of the motion. All that is done between frames, in portions whose size
follows from the tables and from who plays, never from the time that is left, so that every MCU computes the same.

In the frame in which something arrives, the motion is sketched twice at 16 knots, as it would have been and as it will be. The
difference, straight from knot to knot, is what the bands of this frame, and the part of the future behind the front, are
corrected by until the front has come by.

Source: SPEC of motion signal processing. It wants the whole future at once; the difference is what the bound of 1/50 is for.
"""

import gc

import micropython
from micropython import const

from firmware import bands
from firmware.exchange import gather_words
from firmware.foresight import Foresight
from firmware.outlook import BLOCK, Outlook
from firmware.tables import halves, words
from shared.formats import DOFS_MAX, NEW

KNOTS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 162, 254)
"""Frames of a sketch, from the present one on: the taps of the bands reach as far."""

_AHEAD = const(256)  # frames that are kept ahead at least, one more than the next frame's bands need
_PAST = const(255)
_FAR = const(271)
_BEND_DOFS = const(6)  # that one portion bends

# What work costs on an RP2040 at 125 MHz, in microseconds, a little more than was measured (`make bench`).
_FRAME_US = const(12)
_FRAME_DOF_US = const(6)
_FRAME_ACTION_US = const(6)
_FRAME_MAPPING_US = const(3)
_FRAME_PROGRAM_US = const(60)
_START_US = const(100000)  # for the future of frame 0


@micropython.viper
def _load(playing: ptr8, found: int, mappings: ptr8) -> int:
    """Return how many mappings the playing actions have."""
    total = 0
    n = 0
    while n < found:
        i = int(playing[n])
        total += int(mappings[i])
        n += 1
    return total


@micropython.viper
def _spread(dofs: int, value_q15: ptr16, block_q15: ptr16):
    """Write one value per DOF to all 16 places that a block has for it."""
    at = 0
    end = dofs << 4
    while at < end:
        block_q15[at] = value_q15[at >> 4]
        at += 1


@micropython.viper
def _put_knot(dofs: int, value_q15: ptr16, block_q15: ptr16, knot: int):
    """Write one value per DOF to one of the 16 places that a block has for it."""
    d = 0
    while d < dofs:
        block_q15[(d << 4) + knot] = value_q15[d]
        d += 1


@micropython.viper
def _copy_halves(source: ptr16, target: ptr16, count: int):
    """Copy 16-bit words."""
    i = 0
    while i < count:
        target[i] = source[i]
        i += 1


@micropython.viper
def _copy_words(source: ptr32, target: ptr32, count: int):
    """Copy words."""
    i = 0
    while i < count:
        target[i] = source[i]
        i += 1


class Future:
    """What the bands of the next frame are, and what it takes to know that.

    `level_q16` has `G_0 .. G_7` of the frame under way, 8 x 16 words with `bands.ZERO_Q16` added, `foreseen_q16` the same as the
    frame before has foreseen them, where `changed`. `pending` tells that `work` is left, `is_sketched` that the next frame has
    news because of an exchange of tables.
    """

    def __init__(self, sine):
        self._taps = bands.tap_table()
        self._changes_q15 = bands.change_table(KNOTS, 0)
        self._changes_late_q15 = bands.change_table(KNOTS, 1)
        gc.collect()  # what that took would leave holes behind
        self._base_q15 = halves(DOFS_MAX * bands.RING)
        self._third_q15 = halves(DOFS_MAX * bands.RING)
        self.pending = False
        self.changed = False
        self.level_q16 = words(bands.LEVELS * DOFS_MAX)
        self.foreseen_q16 = words(bands.LEVELS * DOFS_MAX)
        self._outlook = Outlook(KNOTS)
        self._foresight = Foresight(sine, KNOTS)
        self._row = bytearray(range(DOFS_MAX))
        self._before_q15 = halves(DOFS_MAX * BLOCK)
        self._delta_q15 = words(DOFS_MAX * BLOCK)
        self._column_q15 = halves(DOFS_MAX)
        self._rows = bytearray(DOFS_MAX)
        self._scratch = words(BLOCK + 1 + 24)
        self._frame = 0  # the one that comes next
        self._front = 0  # the first one that is not exact
        self._filled = 0  # the first one of which nothing is known
        self._bent_from = 0
        self._bent_until = 0
        self._stage = 0
        self._quota = 0
        self._dof = 0
        self._has_news = False
        self.is_sketched = False

    # --- in a frame

    def before_news(self, tables, puppet):
        """Note what is to be expected before anything that arrives in this frame has acted; `Actions.compute_phases` has listed who plays."""
        if not self.is_sketched:
            self._sketch(tables, puppet, True)
            _copy_halves(self._foresight.future_q15, self._before_q15, tables.dofs * BLOCK)
        self.is_sketched = False
        self._has_news = True

    def after_news(self, tables, puppet, base_q15):
        """Follow what has arrived: the bands of this frame are those of the new future; `base_q15` is this frame's base."""
        self._sketch(tables, puppet, False)
        self._recall(tables, 1)
        self._follow(tables, base_q15)

    def correct_start(self, tables):
        """Note, in frame 0, that something has arrived that was not there for `rehearse`: what it has foreseen counts as before."""
        self._recall(tables, BLOCK)
        self.is_sketched = True

    def _recall(self, tables, knots):
        """Take what is to be expected at the first knots from the ring."""
        for b in range(knots):
            bands.column(self._base_q15, self._row, tables.dofs, self._frame + KNOTS[b], self._column_q15)
            _put_knot(tables.dofs, self._column_q15, self._before_q15, b)

    def _follow(self, tables, base_q15):
        # fmt: off
        _put_knot(tables.dofs, base_q15, self._foresight.future_q15, 0)
        bands.differ(
            tables.dofs, tables.signal, BLOCK, self._foresight.future_q15, self._before_q15, self._delta_q15
        )
        bands.shift_levels(
            tables.dofs, tables.signal, self._delta_q15, self._changes_q15, 0, self.level_q16, self.level_q16
        )
        # fmt: on
        self.changed = True

    def _sketch(self, tables, puppet, before):
        self._outlook.sketch(tables, puppet, before, BLOCK)
        self._foresight.evaluate(tables, self._outlook, BLOCK, 1, puppet)

    def advance(self, tables, puppet, base_q15):
        """Turn to the next frame, the one under way having been computed: `work` is to be done until then."""
        frame = self._frame
        if self._has_news:
            self._has_news = False
            self._outlook.take(frame + 1, tables, puppet)
            self._bent_from = frame
            self._bent_until = self._filled
            self._front = frame + 1
        else:
            bands.put_column(self._base_q15, self._row, tables.dofs, frame, base_q15)
            self._bent_from = -1
        self._frame = frame + 1
        self._quota = self._portion(tables, 1000000 // tables.frame_rate_hz)
        self._begin_work()

    def _begin_work(self):
        self._stage = 0
        self._dof = 0
        self.changed = False
        self.pending = True

    def _portion(self, tables, period_us):
        """Return how many frames to come are computed within one period, 1 to 128."""
        o = self._outlook
        mappings = _load(o.playing, o.found, tables.mapping_count)
        frame_us = _FRAME_US + _FRAME_DOF_US * tables.dofs + _FRAME_ACTION_US * o.found + _FRAME_MAPPING_US * mappings
        if tables.programs:
            frame_us += _FRAME_PROGRAM_US
        return min(128, max(1, (period_us // 2 - 6 * frame_us) // frame_us))

    # --- between frames

    def work(self, tables, puppet):
        """Do a portion of what is to be done before the next frame; return whether there is more."""
        stage = self._stage
        if stage == 0:
            self._foresee(tables)
            self._stage = 1 if self._bent_from >= 0 else 2
        elif stage == 1:
            dofs = min(tables.dofs, self._dof + _BEND_DOFS)
            # fmt: off
            bands.bend(
                self._base_q15, self._third_q15, self._row, dofs, tables.signal, self._dof, self._bent_from,
                self._bent_until, self._outlook.knots, self._delta_q15,
            )
            # fmt: on
            self._dof = dofs
            if dofs == tables.dofs:
                self.changed = True
                self._stage = 2
        elif stage == 2:
            if self._quota > 0 and self._front < self._frame + _AHEAD:
                self._compute(tables, puppet)
            else:
                self._stage = 3
        else:
            if self.changed:
                self._split(tables, self.level_q16)
            else:
                _copy_words(self.foreseen_q16, self.level_q16, bands.LEVELS * DOFS_MAX)
            self.pending = False
        return self.pending

    def _split(self, tables, level_q16):
        # fmt: off
        bands.split(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, self._frame, self._taps, level_q16
        )
        # fmt: on

    def _foresee(self, tables):
        """Write down the next frame's levels as they are to be expected now."""
        if self._filled < self._frame + _AHEAD - 1:
            frames = self._frame + _FAR - self._filled
            if self._bent_from >= 0:  # the last knot of the sketch is as far away
                self._fill(tables, self._filled, frames, self._foresight.future_q15, BLOCK, BLOCK - 1)
            else:
                bands.column(self._base_q15, self._row, tables.dofs, self._filled - 1, self._column_q15)
                self._fill(tables, self._filled, frames, self._column_q15, 1, 0)
            self._filled += frames
        self._split(tables, self.foreseen_q16)
        if self._bent_from >= 0:
            # fmt: off
            bands.shift_levels(
                tables.dofs, tables.signal, self._delta_q15, self._changes_late_q15, 1, self.foreseen_q16,
                self.foreseen_q16,
            )
            # fmt: on

    def _fill(self, tables, first, frames, value_q15, stride, at):
        # fmt: off
        bands.fill(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, first, frames, value_q15, stride, at
        )
        # fmt: on

    def _compute(self, tables, puppet):
        """Compute the next block of frames to come."""
        front = self._front
        bands.column(self._base_q15, self._row, tables.dofs, front - 1, self._column_q15)
        frames = self._outlook.write(tables, min(BLOCK, self._quota), self._column_q15)
        self._foresight.evaluate(tables, self._outlook, frames, 0, puppet)
        # fmt: off
        bands.put_block(
            self._base_q15, self._row, tables.dofs, tables.signal, front, frames, self._foresight.future_q15
        )
        bands.smooth(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, front - bands.THIRD_REACH - 1,
            frames + 1, self._scratch,
        )
        # fmt: on
        if front < self._frame + _AHEAD - 1:
            self.changed = True
        self._quota -= frames
        self._front = front + frames
        if self._filled < self._front:
            self._filled = self._front

    # --- beginnings

    def rehearse(self, tables, puppet, base_q15):
        """Begin with frame 0, whose base is known and was the base in all the past: sketch the future; `start` is to follow."""
        dofs = tables.dofs
        self._frame = 0
        self._front = 1
        self._filled = _FAR
        self._fill(tables, -_PAST, _PAST + _FAR, base_q15, 1, 0)
        _spread(dofs, base_q15, self._before_q15)
        self._sketch(tables, puppet, False)
        self._follow(tables, base_q15)

    def start(self, tables, puppet):
        """Compute the future of frame 0, as far as there is time for before it: the puppet's state is that behind frame 0."""
        self._outlook.take(1, tables, puppet)
        self._bent_from = 0
        self._bent_until = _FAR
        self._quota = 2 * self._portion(tables, _START_US)
        self._has_news = self.is_sketched = False
        self._begin_work()

    def stop(self):
        """Forget what was to be done."""
        self.pending = self._has_news = self.is_sketched = False

    def exchange(self, before, tables, puppet, scratch):
        """Prepare for other tables, between frames and with no work pending, while all state is still that of the tables `before`.

        What is to be expected is sketched now; the rows of DOFs that stay are kept. The next frame has news.
        """
        self._sketch(before, puppet, True)
        _copy_halves(self._foresight.future_q15, self._before_q15, before.dofs * BLOCK)
        keep = tables.keep_dof
        taken = 0
        for d in range(tables.dofs):
            was = keep[d]
            if was != NEW and before.signal[was]:
                taken |= 1 << self._row[was]
        rows = self._rows
        old_q15 = self._foresight.future_q15
        free = 0
        for d in range(tables.dofs):
            was = keep[d]
            if was != NEW and before.signal[was]:
                rows[d] = self._row[was]
                for b in range(BLOCK):
                    old_q15[d * BLOCK + b] = self._before_q15[was * BLOCK + b]
            else:
                while taken >> free & 1:
                    free += 1
                rows[d] = free
                taken |= 1 << free
        _copy_halves(old_q15, self._before_q15, tables.dofs * BLOCK)
        for at in range(0, bands.LEVELS * DOFS_MAX, DOFS_MAX):
            gather_words(self.level_q16, keep, scratch, tables.dofs, 0, at)
            gather_words(self.foreseen_q16, keep, scratch, tables.dofs, 0, at)
        for d in range(DOFS_MAX):
            self._row[d] = rows[d]
        for d in range(tables.dofs):
            was = keep[d]
            if was == NEW or not before.signal[was]:
                value_q15 = tables.rest_q15[d] if was == NEW else puppet.base_q15[was]
                self._begin_row(d, value_q15)
        self.is_sketched = True

    def _begin_row(self, dof, value_q15):
        """Let a DOF have been at one value, and stay there."""
        first = self._row[dof] * bands.RING
        for place in range(first, first + bands.RING):
            self._base_q15[place] = self._third_q15[place] = value_q15
        for at in range(dof, bands.LEVELS * DOFS_MAX, DOFS_MAX):
            self.level_q16[at] = self.foreseen_q16[at] = (value_q15 << 1) + bands.ZERO_Q16
        for b in range(BLOCK):
            self._before_q15[dof * BLOCK + b] = value_q15
