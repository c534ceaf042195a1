"""The future of the base motion, 254 frames and more of it, and the frequency bands that follow from it.

Two rings hold the base of every processed DOF from the past to the future (see `bands`). What is to come is computed in
blocks, near frames first, from an outlook that is taken anew whenever something arrives; a front of exact frames moves on
through the future and then keeps a little more than what the bands need ahead of the motion. All that is done between
frames, in portions whose size follows from the tables and from who plays, never from the time that is left, so that every MCU
computes the same.

In the frame in which something arrives, the signal is what it would have been: `e` takes up what `corr` changes by. So the
new future need not be known until the frame has been computed. Its near part is, in full, before the next frame. For the
rest, if there is time for it, the motion is sketched twice at 16 knots, as it would have been and as it will be, and what was
known follows the difference, straight from knot to knot, until the front comes by.

Source: SPEC of motion signal processing. It wants the whole future at once; what a sketch lacks is what the bound of 1/50
is for.
"""

import gc
import sys

import micropython
from micropython import const

from firmware import bands
from firmware.exchange import gather_words
from firmware.foresight import Foresight
from firmware.outlook import BLOCK, Outlook
from firmware.tables import halves, words
from shared.formats import DOFS_MAX

KNOTS = (0, 1, 2, 4, 8, 16, 32, 64, 128, 254)
"""Frames of a sketch, from the present one on: the taps of the bands reach as far."""
_KNOTS = const(10)
_NEAR_KNOT = const(6)  # up to it the future follows at once
_NEAR_FRAMES = const(32)  # which are so many

_PROGRAM = const(6)  # as in shared.formats
_AHEAD = const(256)  # frames that are kept ahead at least, one more than the next frame's bands need
_PAST = const(255)
_FAR = const(271)
_DOFS = const(16)
_NEW = const(255)  # as in shared.formats
_ZERO_Q16 = const(0x100000)  # as in bands
_BEND_DOFS = const(6)  # that one portion bends

# What work costs on an RP2040 at 125 MHz, in microseconds, a little more than was measured (`make bench`).
_LINK_PERCENT = const(14)  # of a period
_TICK_US = const(950)  # a motor tick
_TICK_DOF_US = const(30)
_FIXED_US = const(3800)  # the frame under way, its bands
_FIXED_DOF_US = const(60)
_FIXED_ACTION_US = const(10)
_FIXED_MAPPING_US = const(9)
_ENTER_US = const(250)  # an action that has entered
_NEWS_US = const(1900)  # to begin anew
_NEWS_DOF_US = const(50)
_NEAR_US = const(90)  # a DOF whose rings are bent up to the knot `_NEAR`
_BEND_US = const(170)  # and beyond
_SKETCH_US = const(750)  # one sketch
_SKETCH_DOF_US = const(36)
_SKETCH_ACTION_US = const(105)
_KNOT_NS = const(66000)  # a knot of it
_KNOT_ACTION_NS = const(300)
_KNOT_MAPPING_NS = const(1600)
_KNOT_WORD_NS = const(700)
_BLOCK_US = const(1150)  # a block of frames to come
_BLOCK_ACTION_US = const(9)
_BLOCK_MAPPING_US = const(10)
_FRAME_NS = const(3000)  # a frame in it
_FRAME_DOF_NS = const(5500)
_FRAME_ACTION_NS = const(12000)
_FRAME_MAPPING_NS = const(200)
_FRAME_WORD_NS = const(500)
_FRAME_LIVE_NS = const(1000)
_PORTION_US = const(4000)  # that is done at once, between looks at what has come
_START_US = const(160000)  # for the future of frame 0

_BEGIN = const(0)  # stages of work
_NEAR = const(1)
_COMPUTE = const(2)
_SPLIT = const(3)
_SKETCH = const(4)
_DONE = const(5)


@micropython.viper
def _program_words(
    playing: ptr8,
    found: int,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    signal: ptr8,
    function: ptr8,
    argument: ptr16,
    program_words: ptr16,
) -> int:
    """Return how many words the programs of the playing actions have, on DOFs that are processed."""
    total = 0
    n = 0
    while n < found:
        i = int(playing[n])
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            d = int(mapped_dof[m])
            if signal[d] and int(function[m]) == _PROGRAM:
                k = int(argument[m])
                total += int(program_words[k])
            m += 1
        n += 1
    return total


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
def _processed(dofs: int, signal: ptr8) -> int:
    """Return how many DOFs are processed."""
    count = 0
    d = 0
    while d < dofs:
        if signal[d]:
            count += 1
        d += 1
    return count


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
def _match_rows(
    dofs: int,
    keep: ptr8,
    signal: ptr8,
    row: ptr8,
    new_row: ptr8,
    rest_q15: ptr16,
    base_q15: ptr16,
    before_q15: ptr16,
    after_q15: ptr16,
    value_q15: ptr16,
):
    """Give every new DOF the row that it had, or if it had none one that is free, and what it was to be expected to do.

    A DOF that begins to be processed begins with `value`: its rest, or where it is.
    """
    taken = 0
    d = 0
    while d < dofs:
        was = int(keep[d])
        if was != _NEW:
            if signal[was]:
                taken = taken | (1 << int(row[was]))
        d += 1
    free = 0
    d = 0
    while d < dofs:
        was = int(keep[d])
        kept = 0
        a = int(rest_q15[d])
        if was != _NEW:
            kept = int(signal[was])
            a = int(base_q15[was])
        value_q15[d] = a
        if kept:
            new_row[d] = row[was]
        else:
            while (taken >> free) & 1:
                free += 1
            new_row[d] = free
            taken = taken | (1 << free)
        b = 0
        while b < 16:
            if kept:
                a = int(before_q15[(was << 4) + b])
            after_q15[(d << 4) + b] = a
            b += 1
        d += 1


@micropython.viper
def _begin_rows(
    dofs: int,
    keep: ptr8,
    signal: ptr8,
    row: ptr8,
    value_q15: ptr16,
    base: ptr32,
    third: ptr32,
    level_q16: ptr32,
):
    """Let every DOF that was not processed have been at its `value` always, and stay there; rings are written by pairs."""
    d = 0
    while d < dofs:
        was = int(keep[d])
        kept = 0
        if was != _NEW:
            kept = int(signal[was])
        if kept == 0:
            a = int(value_q15[d])
            pair = a | ((a - ((a >> 15) << 16)) << 16)
            at = int(row[d]) << 8
            end = at + 256
            while at < end:
                base[at] = pair
                third[at] = pair
                at += 1
            k = d
            while k < 128:
                level_q16[k] = (a << 1) + _ZERO_Q16
                k += 16
        d += 1


class Future:
    """What the bands of the next frame are, and what it takes to know that.

    `level_q16` has `G_0 .. G_7` of the next frame as they are to be expected, 8 x 16 words with `bands.ZERO_Q16` added.
    `pending` tells that `work` is left, `cut_short` in how many periods since `start` some of it was left out. `is_sketched` tells
    that it has been noted what is to be expected from the next frame on.
    """

    def __init__(self, sine):
        self._taps = bands.tap_table()
        self._smooth, self._split, self._bend = bands.smooth, bands.split, bands.bend
        if sys.platform == "rp2":
            from firmware import bands_thumb

            self._taps.extend(bands_thumb.quartets(self._taps))
            self._smooth, self._split, self._bend = bands_thumb.smooth, bands_thumb.split, bands_thumb.bend
        gc.collect()  # what that took would leave holes behind
        self._base_q15 = halves(DOFS_MAX * bands.RING)
        self._third_q15 = halves(DOFS_MAX * bands.RING)
        self.pending = False
        self.cut_short = 0
        self.is_sketched = False
        self.level_q16 = words(bands.LEVELS * DOFS_MAX)
        self._outlook = Outlook(KNOTS)
        self._foresight = Foresight(sine, KNOTS)
        self._row = bytearray(range(DOFS_MAX))
        self._rows = bytearray(DOFS_MAX)
        self._before_q15 = halves(DOFS_MAX * BLOCK)
        self._delta_q15 = words(DOFS_MAX * BLOCK)
        self._column_q15 = halves(DOFS_MAX)
        self._base_column_q15 = halves(DOFS_MAX)  # the base of a frame with news
        self._scratch = words(BLOCK + 1 + 24)
        self._frame = 0  # the one that comes next
        self._front = 0  # the first one that is not exact
        self._filled = 0  # the first one of which nothing is known
        self._bent_until = 0
        self._stage = _DONE
        self._budget_us = 0
        self._is_bending = False
        self._origin = 0  # the frame whose news are bent to
        self._news = 0  # the last frame that had news
        self._dof = 0
        self._has_news = False
        self._has_changed = False
        self._is_exchanged = False
        self._is_idle = False  # whether there is nobody who wants to know
        self._is_sketchy = True  # whether there is time for sketches
        self._left_us = self._sketch_us = self._block_us = self._frame_us = 1
        self._is_first = False  # whether nothing has been done yet in a period
        self._changed = bytearray(DOFS_MAX)  # whether a sketch differs from the one before, by DOF
        self._changes = 0
        self._block = BLOCK  # frames that are computed at once

    # --- in a frame

    def has_news(self):
        """Return whether the frame under way has news because of an exchange of tables."""
        return self._is_exchanged

    def before_news(self, tables, puppet):
        """Note what is to be expected before anything that arrives in this frame has acted, if that has not been done in time."""
        if self._is_idle:
            return
        if not self.is_sketched:
            self.sketch_before(tables, puppet)
        self._has_news = True
        self._is_exchanged = False

    def sketch_before(self, tables, puppet):
        """Note what is to be expected if nothing arrives, from the frame that comes next on."""
        a = puppet.actions
        a.compute_phases(tables, puppet.master, tables.frame_rate_hz)  # which lists who plays
        self._weigh(tables, a.playing, a.found)
        while self._is_bending:
            self._bend_far(tables)
        self._is_sketchy = self._news_us(tables) + self._sketch_us < self._left_us
        if self._is_sketchy:
            self._sketch(tables, puppet, False)
            _copy_halves(self._foresight.future_q15, self._before_q15, tables.dofs * BLOCK)
        self.is_sketched = True

    def _sketch(self, tables, puppet, is_behind):
        self._outlook.sketch(tables, puppet, is_behind, _KNOTS)
        self._foresight.evaluate(tables, self._outlook, _KNOTS, 1, puppet)

    def correct_start(self, tables):
        """Note, in frame 0, that something has arrived that `start` did not know: what it has foreseen counts as before."""
        if self._is_idle:
            return
        for b in range(_KNOTS):
            self._recall(tables, b)
        self.is_sketched = self._is_sketchy = True

    def _recall(self, tables, knot):
        """Take what was to be expected at a knot from the ring."""
        bands.column(self._base_q15, self._row, tables.dofs, self._frame + KNOTS[knot], self._column_q15)
        _put_knot(tables.dofs, self._column_q15, self._before_q15, knot)

    def advance(self, tables, puppet, base_q15):
        """Turn to the next frame, the one under way having been computed: `work` is to be done until then."""
        if self._is_idle:
            self._frame += 1
            self.is_sketched = False
            return
        if self._has_news:
            self._recall(tables, 0)
            _copy_halves(base_q15, self._base_column_q15, tables.dofs)
        else:
            bands.put_column(self._base_q15, self._row, tables.dofs, self._frame, base_q15)
        self._frame += 1
        self._stage = _BEGIN
        self._has_changed = self.is_sketched = False
        self.pending = True

    # --- between frames

    def work(self, tables, puppet):
        """Do a portion of what is to be done before the next frame; return whether there is more."""
        stage = self._stage
        if stage == _BEGIN:
            self._begin(tables, puppet)
        elif stage == _NEAR:
            self._bend_near(tables)
            self._stage = _COMPUTE
        elif stage == _COMPUTE:
            self._compute_some(tables, puppet)
        elif stage == _SPLIT:
            if self._has_changed:
                self._levels(tables, self._news)
                puppet.processing.follow(tables, self.level_q16, self._frame - 1 - self._news)
            self._levels(tables, self._frame)
            self._stage = _DONE
            if puppet.cues.has_news(self._frame) and self._frame:
                self._stage = _SKETCH
        else:
            self.sketch_before(tables, puppet)
            self._stage = _DONE
        self.pending = self._stage != _DONE
        return self.pending

    def relent(self):
        """Leave out the blocks that are left for this period: something else needs the time."""
        self._budget_us = 0
        self._is_first = False

    def finish(self, tables, puppet):
        """Come to an end, as the next frame is due: what is left for this period is left out, and counted.

        That happens only if the link or the motor layer take more time than is allowed for here. Other MCUs may then compute
        other signals; but the frame is in time.
        """
        is_cut = False
        if self._stage == _BEGIN:
            self._is_sketchy = False
            self._begin(tables, puppet)
            is_cut = True
        if self._stage != _SKETCH:
            is_cut = is_cut or self._stage == _NEAR or (self._stage == _COMPUTE and self._wanted() != 0)
            self._stage = _SPLIT
            self.work(tables, puppet)
        if self._stage == _SKETCH:
            self._is_sketchy = False
            self.is_sketched = is_cut = True
        self._stage = _DONE
        self.pending = False
        if is_cut:
            self.cut_short += 1

    def _levels(self, tables, frame):
        # fmt: off
        self._split(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, frame, self._taps, self.level_q16
        )
        # fmt: on

    def _begin(self, tables, puppet):
        """See how many frames are to be computed; if there was news, sketch what is to be expected now and begin anew."""
        until = self._filled
        frame = self._frame
        us = 0
        is_sketched = self._has_news and self._is_sketchy
        if is_sketched:
            self._sketch(tables, puppet, True)
            self._differ(tables, self._base_column_q15)
            us -= self._sketch_us
            self._origin = frame - 1
            self._bent_until = until
        elif self._has_news:
            bands.put_column(self._base_q15, self._row, tables.dofs, frame - 1, self._base_column_q15)
        if until < frame + _AHEAD - 1:
            frames = frame + _FAR - until
            if is_sketched:  # the last knot of the sketch is as far away
                self._fill(tables, until, frames, self._foresight.future_q15, BLOCK, _KNOTS - 1)
            else:
                bands.column(self._base_q15, self._row, tables.dofs, until - 1, self._column_q15)
                self._fill(tables, until, frames, self._column_q15, 1, 0)
            self._filled += frames
        if self._has_news:
            self._has_news = False
            self._outlook.take(frame, tables, puppet)
            self._weigh(tables, self._outlook.playing, self._outlook.found)
            self._front = frame
            self._news = frame - 1
            puppet.processing.note(tables)
            self._has_changed = True
            us -= self._news_us(tables)
        us += self._left_us - _ENTER_US * puppet.entered
        if puppet.cues.has_news(frame):
            us -= self._sketch_us
        self._budget_us = us
        self._is_first = not self._has_changed
        self._stage = _NEAR if is_sketched else _COMPUTE

    def _differ(self, tables, base_q15):
        """Note what has changed at the knots; the first one is the frame that has been, whose base is known."""
        _put_knot(tables.dofs, base_q15, self._foresight.future_q15, 0)
        # fmt: off
        self._changes = bands.differ(
            tables.dofs, tables.signal, _KNOTS, self._foresight.future_q15, self._before_q15, self._delta_q15, self._changed
        )
        # fmt: on

    def _bend_near(self, tables):
        """Let what is known of the near future follow the change."""
        self._bend_rows(tables, 0, tables.dofs, 0, self._origin + _NEAR_FRAMES)
        # Where the change begins it is not straight, and what is smoothed has to be smoothed anew.
        begin = self._origin - bands.THIRD_REACH
        self._smooth_some(tables, begin, BLOCK + 1)
        self._smooth_some(tables, begin + BLOCK + 1, bands.THIRD_REACH)
        self._budget_us -= _NEAR_US * self._changes
        self._dof = 0
        self._is_bending = True

    def _bend_far(self, tables):
        """Let the far future of some of the DOFs do so."""
        dofs = min(tables.dofs, self._dof + _BEND_DOFS)
        self._bend_rows(tables, self._dof, dofs, _NEAR_KNOT, self._bent_until)
        self._budget_us -= _BEND_US * (dofs - self._dof)
        self._dof = dofs
        self._is_bending = dofs < tables.dofs
        self._has_changed = True

    def _bend_rows(self, tables, first_dof, dofs, first_knot, until):
        # fmt: off
        self._bend(
            self._base_q15, self._third_q15, self._row, dofs, self._changed, first_dof, self._origin, until,
            self._outlook.knots, first_knot, _KNOTS, self._delta_q15,
        )
        # fmt: on

    def _smooth_some(self, tables, first, frames):
        # fmt: off
        self._smooth(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, first, frames, self._scratch
        )
        # fmt: on

    def _weigh(self, tables, playing, found):
        """Note what frames to come and sketches cost for the actions of a list, so many microseconds, whatever MCU this is."""
        t = tables
        # fmt: off
        words = _program_words(
            playing, found, t.first_mapping, t.mapping_count, t.mapped_dof, t.signal, t.function, t.argument,
            t.program_words,
        ) if t.programs else 0
        # fmt: on
        mappings = _load(playing, found, t.mapping_count)
        knot_ns = _KNOT_NS + _KNOT_ACTION_NS * found + _KNOT_MAPPING_NS * mappings + _KNOT_WORD_NS * words
        self._sketch_us = _SKETCH_US + _SKETCH_DOF_US * t.dofs + _SKETCH_ACTION_US * found + _KNOTS * knot_ns // 1000
        block_us = _BLOCK_US + _BLOCK_ACTION_US * found + _BLOCK_MAPPING_US * mappings
        frame_ns = _FRAME_NS + _FRAME_DOF_NS * t.dofs + _FRAME_ACTION_NS * found + _FRAME_MAPPING_NS * mappings
        frame_us = (frame_ns + _FRAME_WORD_NS * words + _FRAME_LIVE_NS * t.lives) // 1000
        self._block = min(BLOCK, max(1 + block_us // frame_us, (_PORTION_US - block_us) // frame_us))
        self._block_us = block_us
        self._frame_us = frame_us
        tick_us = _TICK_US + _TICK_DOF_US * t.dofs
        percent = max(20, 100 - _LINK_PERCENT - 100 * tick_us // t.motor_period_us)
        fixed_us = _FIXED_US + _FIXED_DOF_US * t.dofs + _FIXED_ACTION_US * found + _FIXED_MAPPING_US * mappings
        self._left_us = 10000 * percent // t.frame_rate_hz - fixed_us

    def _news_us(self, tables):
        """Return what it costs to begin anew, without a sketch."""
        return _NEWS_US + _NEWS_DOF_US * tables.dofs

    def _fill(self, tables, first, frames, value_q15, stride, at):
        # fmt: off
        bands.fill(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, first, frames, value_q15, stride, at
        )
        # fmt: on

    def _compute_some(self, tables, puppet):
        """Take a step of what is to be computed and bent, as long as the budget lasts, and one at least."""
        frames = self._wanted()
        self._is_first = False
        if frames > 0:
            self._compute(tables, puppet, frames)
        elif frames < 0:
            self._bend_far(tables)
        else:
            self._stage = _SPLIT

    def _wanted(self):
        """Return how many frames are to be computed at once, -1 if rings are to be bent first, 0 if nothing is left to do."""
        until = self._frame + _FAR
        if self._is_bending:
            until = self._origin + _NEAR_FRAMES
            if self._front >= until:
                return -1 if self._is_first or self._budget_us > _BEND_US * _BEND_DOFS else 0
        elif self._front >= self._frame + _AHEAD:
            return 0
        frames = (self._budget_us - self._block_us) // self._frame_us
        return min(self._block, until - self._front, max(frames, 1 if self._is_first else 0))

    def _compute(self, tables, puppet, frames):
        """Compute the next block of frames to come."""
        front = self._front
        bands.column(self._base_q15, self._row, tables.dofs, front - 1, self._column_q15)
        frames = self._outlook.write(tables, frames, self._column_q15)
        self._foresight.evaluate(tables, self._outlook, frames, 0, puppet)
        # fmt: off
        bands.put_block(
            self._base_q15, self._row, tables.dofs, tables.signal, front, frames, self._foresight.future_q15
        )
        # fmt: on
        self._smooth_some(tables, front - bands.THIRD_REACH - 1, frames + 1)
        if front < self._frame + _AHEAD - 1:
            self._has_changed = True
        self._budget_us -= self._block_us + frames * self._frame_us
        self._front = front + frames
        if self._filled < self._front:
            self._filled = self._front

    # --- beginnings

    def start(self, tables, puppet, base_q15):
        """Begin with frame 0, which has just been rehearsed and had its base in all the past; `work` computes its future."""
        self.stop()
        self.cut_short = 0
        self._frame = 0
        self._is_idle = not _processed(tables.dofs, tables.signal)
        if self._is_idle:
            return
        self._fill(tables, -_PAST, _PAST + _FAR, base_q15, 1, 0)
        _spread(tables.dofs, base_q15, self._before_q15)
        self._sketch(tables, puppet, True)
        self._differ(tables, base_q15)
        self._bent_until = self._filled = _FAR
        self._origin = self._news = 0
        self._bend_near(tables)
        while self._is_bending:
            self._bend_far(tables)
        self._outlook.take(1, tables, puppet)
        self._front = 1
        self._weigh(tables, self._outlook.playing, self._outlook.found)
        self._budget_us = _START_US
        self._has_news = self._has_changed = self._is_exchanged = self.is_sketched = False
        self._stage = _COMPUTE
        self.pending = True

    def stop(self):
        """Forget what was to be done."""
        self.pending = self._has_news = self._is_exchanged = self.is_sketched = self._is_bending = False

    def exchange(self, before, tables, puppet, scratch):
        """Prepare for other tables, between frames and with no work pending, while all state is that of the tables `before`.

        `sketch_before` has noted what is to be expected; the rows of DOFs that stay are kept. The next frame has news.
        """
        was_idle = self._is_idle
        self._is_idle = not _processed(tables.dofs, tables.signal)
        if self._is_idle:
            self.stop()
            return
        if was_idle:
            self._bent_until = self._filled = self._frame + _FAR
        # fmt: off
        _match_rows(
            tables.dofs, tables.keep_dof, before.signal, self._row, self._rows, tables.rest_q15, puppet.base_q15,
            self._before_q15, self._foresight.future_q15, self._column_q15,
        )
        # fmt: on
        _copy_halves(self._foresight.future_q15, self._before_q15, tables.dofs * BLOCK)
        for at in range(0, bands.LEVELS * _DOFS, _DOFS):
            gather_words(self.level_q16, tables.keep_dof, scratch, tables.dofs, 0, at)
        self._row, self._rows = self._rows, self._row
        # fmt: off
        _begin_rows(
            tables.dofs, tables.keep_dof, before.signal, self._row, self._column_q15, self._base_q15, self._third_q15,
            self.level_q16,
        )
        # fmt: on
        self._is_exchanged = True
