"""The future of the base motion, 254 frames and more of it, and the frequency bands that follow from it.

Two rings hold the base of every processed DOF from the past to the future (see `rings`). What is to come is computed in
blocks, near frames first, from an outlook that is taken anew whenever something arrives; a front of exact frames moves on
through the future and then keeps a little more than what the bands need ahead of the motion. All that is done between
frames, in portions, on a budget that follows from the tables and from who plays, never from the time that is left, so that
every MCU computes the same. Only what the next frame finds undone is left out, and counted.

In the frame in which something arrives, the signal is what it would have been: `e` takes up what `corr` changes by. So the
new future need not be known until the frame has been computed. If there is time for it, the motion is sketched twice at a few
knots, as it would have been and as it will be, and what was known follows the difference, straight from knot to knot, until
the front comes by: the near future before the next frame, the far future when the front has reached it.

Source: SPEC of motion signal processing. It wants the whole future at once; what a sketch lacks is what the bound of 1/50
is for.
"""

import micropython
from micropython import const

from firmware import bands, budget
from firmware.foresight import Foresight
from firmware.outlook import BLOCK, Outlook
from firmware.rings import Rings
from firmware.tables import halves, words
from shared.formats import DOFS_MAX

KNOTS = (0, 1, 2, 4, 8, 16, 32, 64, 128, 254)
"""Frames of a sketch, from the present one on: the taps of the bands reach as far."""
_KNOTS = const(10)
_NEAR_KNOT = const(6)  # up to it the future follows at once
_NEAR_FRAMES = const(32)  # which are so many

_AHEAD = const(256)  # frames that are kept ahead at least, one more than the next frame's bands need
_PAST = const(255)
_FAR = const(271)
_BEND_DOFS = const(6)  # that one portion bends

_SKETCH_MOST_US = const(2500)  # that a sketch in a frame may take
_START_US = const(160000)  # that may be spent on the future of frame 0

_BEGIN = const(0)  # stages of work
_NEAR = const(1)
_COMPUTE = const(2)
_SPLIT = const(3)
_SKETCH = const(4)
_DONE = const(5)


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


class Future:
    """What the bands of the next frame are, and what it takes to know that.

    `level_q16` has `G_0 .. G_7` of the next frame as they are to be expected, 8 x 16 words with `bands.ZERO_Q16` added.
    `pending` tells that `work` is left, `cut_short` in how many periods since `start` some of it was left out. `is_sketched`
    tells that it has been noted what is to be expected from the next frame on.
    """

    def __init__(self, sine):
        self._rings = Rings()  # first, while the heap has room for them
        self.level_q16 = self._rings.level_q16
        self._budget = budget.Budget(_KNOTS)
        self.pending = False
        self.cut_short = 0
        self.is_sketched = False
        self._outlook = Outlook(KNOTS)
        self._foresight = Foresight(sine, KNOTS)
        self._before_q15 = halves(DOFS_MAX * BLOCK)
        self._delta_q15 = words(DOFS_MAX * BLOCK)
        self._column_q15 = halves(DOFS_MAX)
        self._base_column_q15 = halves(DOFS_MAX)  # the base of a frame with news
        self._frame = 0  # the one that comes next
        self._front = 0  # the first one that is not exact
        self._filled = 0  # the first one of which nothing is known
        self._bent_until = 0
        self._stage = _DONE
        self._us = 0  # what is left of the budget
        self._is_bending = False
        self._origin = 0  # the frame whose news are bent to
        self._news = 0  # the last frame that had news
        self._dof = 0
        self._has_news = False
        self._has_changed = False
        self._is_exchanged = False
        self._is_idle = False  # whether there is nobody who wants to know
        self._is_sketchy = True  # whether there is time for sketches
        self._is_first = False  # whether nothing has been done yet in a period
        self._changed = bytearray(DOFS_MAX)  # whether a sketch differs from the one before, by DOF
        self._changes = 0

    # --- in a frame

    def has_news(self):
        """Return whether the frame under way has news because of an exchange of tables."""
        return self._is_exchanged

    def before_news(self, tables, puppet):
        """See that it is noted what is to be expected, before anything that arrives in this frame acts.

        Where that has not been done between frames, it is done now if the frame does not come too late by that.
        """
        if self._is_idle:
            return
        if not self.is_sketched:
            if self._budget.sketch_us * self._budget.stretch_percent // 100 < _SKETCH_MOST_US - puppet.clock.late_us:
                self.sketch_before(tables, puppet)
            else:
                self._is_sketchy = False
                self.cut_short += 1
        self._has_news = True
        self._is_exchanged = False

    def sketch_before(self, tables, puppet):
        """Note what is to be expected if nothing arrives, from the frame that comes next on, if a sketch is worth its time."""
        a = puppet.actions
        a.compute_phases(tables, puppet.master, tables.frame_rate_hz)  # which lists who plays
        self._budget.weigh(tables, a.playing, a.found)
        while self._is_bending:
            self._bend_far(tables)
        self._is_sketchy = self._budget.sketch_us + self._budget.news_us(tables) < self._budget.left_us
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
        self._rings.read(tables, self._frame + KNOTS[knot], self._column_q15)
        _put_knot(tables.dofs, self._column_q15, self._before_q15, knot)

    def advance(self, tables, puppet, base_q15):
        """Turn to the next frame, the one under way having been computed: `work` is to be done until then."""
        if self._is_idle:
            self._frame += 1
            self.is_sketched = False
            return
        if self.is_sketched:  # the outlook has been overwritten by that, whatever came of it
            self._has_news = True
        if self._has_news:
            self._recall(tables, 0)
            _copy_halves(base_q15, self._base_column_q15, tables.dofs)
        else:
            self._rings.write(tables, self._frame, base_q15)
        self._frame += 1
        self._stage = _BEGIN
        self.is_sketched = False
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
                self._has_changed = False
                self._rings.split(tables, self._news)
                puppet.processing.follow(tables, self.level_q16, self._frame - 1 - self._news)
            self._rings.split(tables, self._frame)
            self._stage = _DONE
            if self._frame and puppet.expects_news():
                self._stage = _SKETCH
        else:
            self.sketch_before(tables, puppet)
            self._stage = _DONE
        self.pending = self._stage != _DONE
        return self.pending

    def need_us(self):
        """Return about how long the next step of `work` takes, with the motor ticks that come in between."""
        stage = self._stage
        us = 0
        if stage == _SKETCH or (stage == _BEGIN and self._has_news and self._is_sketchy):
            us = self._budget.sketch_us
        elif stage == _NEAR:
            us = budget.NEAR_US * self._changes
        elif stage == _COMPUTE:
            frames = self._wanted()
            if frames > 0:
                us = self._budget.block_us + frames * self._budget.frame_us
            elif frames:
                us = budget.BEND_US * _BEND_DOFS
        return us * self._budget.stretch_percent // 100

    def expect_news(self):
        """Note that the next frame will have news, behind all work; return whether there is more of that now."""
        if self._frame and not (self._is_idle or self.is_sketched or self.pending):
            self._stage = _SKETCH
            self.pending = True
        return self.pending

    def relent(self):
        """Leave out the blocks that are left for this period: something else needs the time."""
        self._us = 0
        self._is_first = False

    def finish(self, tables, puppet):
        """Come to an end, as the next frame is due: what is left for this period is left out, and counted.

        That happens only if the link or the motor layer take more time than is allowed for here. Other MCUs may then compute
        other signals; but the frame is in time.
        """
        if self._stage == _BEGIN:
            self._is_sketchy = False
            self._begin(tables, puppet)
        is_cut = False
        if self._stage != _SKETCH:
            is_cut = self._stage == _NEAR or (self._stage == _COMPUTE and self._wanted() != 0)
            if is_cut:
                self._rings.split(tables, self._frame)
            else:
                self._stage = _SPLIT
                self.work(tables, puppet)
        if self._stage == _SKETCH or (self._frame and puppet.expects_news()):
            self._is_sketchy = False
            self.is_sketched = is_cut = True
        self._stage = _DONE
        self.pending = False
        if is_cut:
            self.cut_short += 1

    def _begin(self, tables, puppet):
        """See how many frames are to be computed; if there was news, sketch what is to be expected now and begin anew."""
        until = self._filled
        frame = self._frame
        us = 0
        is_sketched = self._has_news and self._is_sketchy
        if is_sketched:
            self._sketch(tables, puppet, True)
            self._differ(tables, self._base_column_q15)
            us -= self._budget.sketch_us
            self._origin = frame - 1
            self._bent_until = until
        elif self._has_news:
            self._rings.write(tables, frame - 1, self._base_column_q15)
        if until < frame + _AHEAD - 1:
            frames = frame + _FAR - until
            if is_sketched:  # the last knot of the sketch is as far away
                self._rings.fill(tables, until, frames, self._foresight.future_q15, BLOCK, _KNOTS - 1)
            else:
                self._rings.read(tables, until - 1, self._column_q15)
                self._rings.fill(tables, until, frames, self._column_q15, 1, 0)
            self._filled += frames
        if self._has_news:
            self._has_news = False
            self._outlook.take(frame, tables, puppet)
            self._budget.weigh(tables, self._outlook.playing, self._outlook.found)
            self._front = frame
            self._news = frame - 1
            puppet.processing.note(tables)
            self._has_changed = True
            us -= self._budget.news_us(tables)
        us += self._budget.left_us - budget.ENTER_US * puppet.entered
        if puppet.expects_news():
            us -= self._budget.sketch_us
        self._us = us
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
        self._bend(0, tables.dofs, 0, self._origin + _NEAR_FRAMES)
        # Where the change begins it is not straight, and what is smoothed has to be smoothed anew.
        begin = self._origin - bands.THIRD_REACH
        self._rings.smooth(tables, begin, BLOCK + 1)
        self._rings.smooth(tables, begin + BLOCK + 1, bands.THIRD_REACH)
        self._us -= budget.NEAR_US * self._changes
        self._dof = 0
        self._is_bending = True

    def _bend_far(self, tables):
        """Let the far future of some of the DOFs do so."""
        dofs = min(tables.dofs, self._dof + _BEND_DOFS)
        self._bend(self._dof, dofs, _NEAR_KNOT, self._bent_until)
        self._us -= budget.BEND_US * (dofs - self._dof)
        self._dof = dofs
        self._is_bending = dofs < tables.dofs
        self._has_changed = True

    def _bend(self, first_dof, dofs, first_knot, until):
        # fmt: off
        self._rings.bend(
            self._changed, first_dof, dofs, self._origin, until, self._outlook.knots, first_knot, _KNOTS, self._delta_q15
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
            if self._is_first or self._us > budget.BEND_US * _BEND_DOFS:
                return -1
            until = self._origin + _NEAR_FRAMES
        if self._front >= min(until, self._frame + _AHEAD):
            return 0
        return min(until - self._front, max(self._budget.frames(self._us), 1 if self._is_first else 0))

    def _compute(self, tables, puppet, frames):
        """Compute the next block of frames to come."""
        front = self._front
        self._rings.read(tables, front - 1, self._column_q15)
        frames = self._outlook.write(tables, frames, self._column_q15)
        self._foresight.evaluate(tables, self._outlook, frames, 0, puppet)
        self._rings.write_block(tables, front, frames, self._foresight.future_q15)
        if front < self._frame + _AHEAD - 1:
            self._has_changed = True
        self._us -= self._budget.block_us + frames * self._budget.frame_us
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
        self._rings.fill(tables, -_PAST, _PAST + _FAR, base_q15, 1, 0)
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
        self._budget.weigh(tables, self._outlook.playing, self._outlook.found)
        self._us = _START_US
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
        block_q15 = self._foresight.future_q15
        self._rings.exchange(before, tables, puppet.base_q15, self._before_q15, block_q15, scratch)
        _copy_halves(block_q15, self._before_q15, tables.dofs * BLOCK)
        self._is_exchanged = True
