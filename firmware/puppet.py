"""The puppet: its tables, its state, and one frame through all layers.

Data runs one way: targets, weights, actions, functions, compositor, motor, board. Each layer is a kernel over arrays
that are made here once; a frame allocates nothing.
"""

import gc

import micropython
from micropython import const

from firmware import clock, compositor, functions, weights
from firmware.actions import Actions
from firmware.blinks import Blinks
from firmware.cues import Cues
from firmware.drivers import Drivers
from firmware.exchange import Exchange
from firmware.future import Future
from firmware.kalman import Kalman
from firmware.motor import Motor
from firmware.programs import Programs
from firmware.signal_processing import SignalProcessing
from firmware.tables import Tables, halves, words
from firmware.trajectory import Ring
from shared.formats import (
    DOFS_MAX,
    GRADIENTS,
    LIVES_MAX,
    MAPPINGS_MAX,
    NOISE_TABLES,
    TEMPO_ONE,
    WEIGHT_ONE,
)

_COLLECT_US = const(15000)  # what the heap's collection takes on an RP2040
_PORTION_US = const(4000)  # of work, behind which drivers that do not write in the tick have their turn
_OVERRUN_US = const(1500)  # by which a step may hold a frame up
_PATIENCE = const(3)  # frames that an exchange may take before other work is left out
_STEPS_US = const(2000)  # of preparations for an exchange
_CARRY_US = const(12000)  # what putting other tables into force takes
_MARGIN_US = const(3000)  # between the end of a frame and what is done then
_LESS_US = const(500)  # that will do when it has been waited a frame longer


def _nothing():
    """Look for nothing, as there is no link; nothing waits."""
    return 0


class Puppet:
    """One puppet on one board.

    `frame` is the number of the next frame, -1 while the motion does not run. `base_q15` and `signal_q15` hold the last
    frame's values per DOF, after the compositor and after signal processing; `motor.motor_q15` what the motors were
    told. `entered` is how many actions have entered in the last frame. `clipped` counts the values that signal processing has
    clipped at the ends of their range since `start`. `look` is what whatever takes long calls now and then, for a kill may come;
    it returns how much waits.
    """

    def __init__(self, board):
        self._sine = functions.sine_table()
        self.future = Future(self._sine)  # first, while the heap has room for its rings
        self.look = _nothing
        self.frame = -1
        self.frame_max_us = 0
        self.clipped = 0
        self.entered = 0
        self.clock = clock.FrameClock()
        self.cues = Cues()
        self.drivers = Drivers(board)
        self.tables = Tables(self.drivers)  # those that play
        self.staged = Tables(self.drivers)  # those that the host fills
        gc.collect()
        self.motor = Motor(board, self.drivers, self.tables)
        self.tempo_q16 = words(1)
        self.actions = Actions()
        self.live_target_q28 = words(LIVES_MAX)
        self.kalman = Kalman()
        self.processing = SignalProcessing()
        self.base_q15 = halves(DOFS_MAX)
        self.signal_q15 = halves(DOFS_MAX)
        self.base_ring = Ring()
        self.base_ring_q15 = self.base_ring.value_q15
        self.signal_ring_q15 = self.motor.trajectory.ring.value_q15
        self._board = board
        self.gradients = halves(NOISE_TABLES * GRADIENTS)
        self.master = words(clock.PHASE_WORDS)
        self.blinks = Blinks()
        self.programs = Programs()
        self._live_x_q28 = words(LIVES_MAX)
        self._live_w_q28 = words(LIVES_MAX)
        self._hold_target_q28 = words(DOFS_MAX)
        self._hold_x_q28 = words(DOFS_MAX)
        self._hold_w_q28 = words(DOFS_MAX)
        self.hold_q15 = halves(DOFS_MAX)
        self._value_q15 = halves(MAPPINGS_MAX)
        self._wanted = bytearray(DOFS_MAX)
        self._weight_sum = words(DOFS_MAX)
        self._shift = bytearray(DOFS_MAX)
        self._upper = words(DOFS_MAX)
        self._lower = words(DOFS_MAX)
        self.live_state = (self.live_target_q28, self._live_x_q28, self._live_w_q28)
        self.hold_state = (self._hold_target_q28, self._hold_x_q28, self._hold_w_q28)
        self.exchange = Exchange(self)
        self._exchange_due = False
        self._exchange_due_in = -1  # the frame before which it is, once that has been prepared for
        self._committed = -1  # the frame in which tables have been committed last
        self._waiting_since = -1  # the frame since which time is wanted for an exchange
        self._tempos_changed = 0
        self._is_starting = False
        self._rehearsed = 0
        self._arrivals = 0  # of cues, as far as they have been looked at

    def commit(self):
        """Let the staged tables, which are complete, replace those that play: now, or when the motion runs, soon."""
        self.exchange.begin()
        self._committed = self.frame
        if self.frame < 0:
            while not self.exchange.prepare():
                pass
            self.exchange.replace()
            self._rest()
            gc.collect()  # what fills the heap slows down all that allocates

    def start(self):
        """Begin the motion anew: frame 0 is due at a motor tick soon. Targets that wait keep their stamps.

        First the future of frame 0 is computed, in `prepare`: signal processing wants to know it then.
        """
        if self.frame >= 0:
            self.motor.stand()
        self._rest()
        self.frame = 0
        self.clock.hold(self.tables.frame_rate_hz)
        self._synthesise(True)
        self._turn()
        self.future.start(self.tables, self, self.base_q15)
        self._rest()
        self.frame = 0
        self.frame_max_us = self.clipped = 0
        self.cues.counts[0] = self.cues.refused = 0
        self._rehearsed = self.cues.arrivals
        self._is_starting = True

    def stop(self):
        """Stand still: no more frames, relative DOFs at 0, absolute DOFs where they are."""
        if self.frame >= 0:
            self.motor.stand()
        self.frame = -1
        self._is_starting = False
        self.future.stop()
        self.cues.clear()
        if self.exchange.step >= 0:
            self._exchange_due = False
            self._waiting_since = -1
            self.commit()

    def prepare(self):
        """Take a step of what is to be done between frames; return whether there was one to take.

        That is the future that signal processing wants to know, and then an exchange of tables; if that finds no time for some
        frames, blocks of that future are left out. The last steps collect what tables leave on the heap, so that it does not fill
        up in the middle of a frame, note what is to be expected, and put the new tables into force. They wait until there is time
        for that.
        """
        if self.future.pending or self._has_heard():
            micropython.heap_lock()  # as in a frame
            try:
                return self._work()
            finally:
                micropython.heap_unlock()
        if self._is_starting:
            self._is_starting = False
            self.clock.start(self.motor.start(), self.tables.frame_rate_hz)
            return True
        if self.exchange.step < 0:
            return False
        if self._exchange_due:
            if self._exchange_due_in == self.frame:
                self._exchange_due = False
                self._exchange_due_in = self._waiting_since = -1
                self.exchange.carry_over()
                self._tempos_changed = 1
            elif self._has_time(_CARRY_US):
                self._expect()
                self._exchange_due_in = self.frame
            else:
                return False
        elif self._prepare_exchange():
            if self._waiting_since < 0:
                self._waiting_since = self.frame
            if not self._has_time(_COLLECT_US):
                return False
            gc.collect()
            self._exchange_due = True
            self._waiting_since = self.frame
        return True

    def _prepare_exchange(self):
        """Take some steps; return whether all is prepared."""
        begun_us = now_us = self._board.ticks_us()
        while clock.ticks_diff(now_us, begun_us) < _STEPS_US and self.clock.until_us(now_us) > 0:
            if self.exchange.prepare():
                return True
            if self.look():
                break
            now_us = self._board.ticks_us()
        return False

    def _expect(self):
        """Note what is to be expected from the next frame on, as it is without other tables."""
        if not self.future.is_sketched:
            micropython.heap_lock()
            try:
                self.future.sketch_before(self.tables, self)
            finally:
                micropython.heap_unlock()

    def _has_heard(self):
        """Return whether news for the next frame have come behind all work for it: what is to be expected is noted then."""
        if self.cues.arrivals == self._arrivals or self.frame < 0:
            return False
        self._arrivals = self.cues.arrivals
        return self.expects_news() and self.future.expect_news()

    def _work(self):
        """Work for a while; return whether there was time for that: a step that would make the next frame late is left to it."""
        future = self.future
        flushes = self.drivers.flushes
        if self.exchange.step >= 0 and self.frame >= self._committed + _PATIENCE:
            future.relent()
        begun_us = now_us = self._board.ticks_us()
        while True:
            need_us = future.need_us()
            if self.clock.until_us(now_us) < need_us - _OVERRUN_US:
                return now_us != begun_us
            if flushes and now_us != begun_us and clock.ticks_diff(now_us, begun_us) + need_us > _PORTION_US:
                return True
            if not future.work(self.tables, self):
                return True
            now_us = self._board.ticks_us()
            if self.clock.until_us(now_us) <= 0 or self.look():
                return True

    def _has_time(self, need_us):
        """Return whether so much time is left until the next frame, or as much as there is behind any.

        That is not known, as the line wants some of it, too: the longer it is waited for, the less will do.
        """
        most_us = 1000000 // self.clock.rate_hz - self.frame_max_us - _MARGIN_US
        most_us -= _LESS_US * (self.frame - self._waiting_since)
        return self.clock.until_us(self._board.ticks_us()) >= min(need_us, most_us)

    def step(self):
        """Compute the frame that is due and hand it to the motors."""
        begun_us = self._board.ticks_us()
        self.clock.begin(begun_us)
        if self.future.pending:
            self.future.finish(self.tables, self)
        self._synthesise(False)
        self.base_ring.put(self.frame, self.tables.dofs, self.base_q15)
        self.motor.put(self.frame, self.signal_q15)
        self._turn()
        self.future.advance(self.tables, self, self.base_q15)
        self.frame += 1
        took_us = clock.ticks_diff(self._board.ticks_us(), begun_us)
        if took_us > self.frame_max_us:
            self.frame_max_us = took_us

    def _turn(self):
        """Turn to the next frame: offsets shrink, the master phase advances."""
        self.actions.warp(self.tables, self.tempo_q16[0], self.clock.rate_hz)
        clock.advance(self.master, self.tempo_q16[0], self.clock.rate_hz)

    def _has_news(self):
        """Return whether the frame under way is another than the one before has foreseen."""
        if self.frame == 0:
            if self.cues.arrivals == self._rehearsed:
                return False
            self.future.correct_start(self.tables)
            return True
        return self.future.has_news() or self.expects_news()

    def expects_news(self):
        """Return whether something is at hand that changes in the next frame, or the one under way, what is to come."""
        return self.cues.has_news(self.frame) or self.kalman.is_moving(self.tables.lives)

    # fmt: off
    def _synthesise(self, is_rehearsal):
        """Compute the frame that is due; a rehearsal leaves the targets that act in the queue, and stops before the signal."""
        t = self.tables
        a = self.actions
        rate_hz = self.clock.rate_hz
        counts = self.cues.counts
        counts[1] = self._tempos_changed
        self._tempos_changed = 0
        has_news = not is_rehearsal and self._has_news()
        if has_news:
            self.future.before_news(t, self)
        self.cues.apply(
            self.frame, a.target_q28, self.live_target_q28, self.tempo_q16, a.wanted_tempo_q16,
            self.processing.target4_q16, not is_rehearsal,
        )
        if t.lives:
            self.kalman.step(t, counts[3], self.live_target_q28)
        a.compute_phases(t, self.master, rate_hz)
        if counts[1]:
            a.follow_tempos(t, self.master, rate_hz)
        a.end_gestures(t)
        compositor.hold_targets(
            t.actions, a.target_q28, t.first_mapping, t.mapping_count, t.mapped_dof,
            t.dofs, t.relative, self.base_q15, self._hold_target_q28, self._hold_w_q28, self.hold_q15, self._wanted,
        )
        self.entered = a.enter(t, self.master, rate_hz)
        for n in range(self.entered):
            if a.risen[n] >= 128:
                self.blinks.enter(t, a.risen[n] & 127)
        weights.integrate(t.actions, a.target_q28, a.x_q28, a.w_q28, t.rise_q26, t.fall_q26)
        weights.integrate(
            t.lives, self.live_target_q28, self._live_x_q28, self._live_w_q28, t.live_rise_q26, t.live_fall_q26
        )
        weights.integrate(
            t.dofs, self._hold_target_q28, self._hold_x_q28, self._hold_w_q28, t.hold_q26, t.hold_q26
        )
        functions.evaluate(
            a.playing, a.found, a.cycle, a.fraction_q24, t.first_mapping, t.mapping_count, t.function,
            t.argument, t.same, self._sine, self.gradients, self._live_w_q28, t.curve_start, t.curve_samples,
            t.samples_q15, self._value_q15,
        )
        if t.programs:
            self.programs.evaluate(t, a, self._sine, self.gradients, self._live_w_q28, self._value_q15)
        if t.blinks:
            self.blinks.evaluate(t, a, self._sine, self._value_q15)
        functions.repeat(a.playing, a.found, t.first_mapping, t.mapping_count, t.same, self._value_q15)
        compositor.blend(
            a.playing, a.found, a.w_q28, t.first_mapping, t.mapping_count, t.mapped_dof, t.low_q15, t.high_q15,
            self._value_q15, t.dofs, self._hold_w_q28, self.hold_q15, self.base_q15,
            self._weight_sum, self._shift, self._upper, self._lower,
        )
        if is_rehearsal:
            return
        if self.processing.glide():
            self.clipped += self.processing.process(t, self.base_q15, self.future.level_q16, self.signal_q15)
        else:
            self.processing.bypass(t, self.base_q15, self.signal_q15)
    # fmt: on

    def _rest(self):
        """Set the state before frame 0: no action, HOLD and live channels at rest, tempo 1, phase 0."""
        tables = self.tables
        self.frame = -1
        self._tempos_changed = 0
        self.tempo_q16[0] = TEMPO_ONE
        for place in range(clock.PHASE_WORDS):
            self.master[place] = 0
        self.processing.rest()
        self.kalman.rest(tables)
        self.actions.rest(tables)
        self.blinks.rest(tables)
        for live in range(tables.lives):
            rest_q28 = tables.live_rest_q28[live]
            self.live_target_q28[live] = self._live_x_q28[live] = self._live_w_q28[live] = rest_q28
        for dof in range(tables.dofs):
            self._hold_target_q28[dof] = self._hold_x_q28[dof] = self._hold_w_q28[dof] = WEIGHT_ONE
            self.hold_q15[dof] = self.base_q15[dof] = tables.rest_q15[dof]
