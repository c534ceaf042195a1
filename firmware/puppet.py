"""The puppet: its tables, its state, and one frame through all layers.

Data runs one way: targets, weights, actions, functions, compositor, motor, board. Each layer is a kernel over arrays
that are made here once; a frame allocates nothing.
"""

import gc

from micropython import const

from firmware import clock, compositor, functions, weights
from firmware.actions import Actions
from firmware.blinks import Blinks
from firmware.cues import Cues
from firmware.drivers import Drivers
from firmware.exchange import Exchange
from firmware.motor import Motor
from firmware.programs import Programs
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
_CARRY_US = const(16000)  # what putting other tables into force takes
_MARGIN_US = const(3000)  # between the end of a frame and what is done then


class Puppet:
    """One puppet on one board.

    `frame` is the number of the next frame, -1 while the motion does not run. `base_q15` and `signal_q15` hold the last
    frame's values per DOF, after the compositor and after signal processing; `motor.motor_q15` what the motors were
    told.
    """

    def __init__(self, board):
        self.frame = -1
        self.frame_max_us = 0
        self.clock = clock.FrameClock()
        self.cues = Cues()
        self.drivers = Drivers(board)
        self.tables = Tables(self.drivers)  # those that play
        self.staged = Tables(self.drivers)  # those that the host fills
        self.motor = Motor(board, self.drivers, self.tables)
        self.tempo_q16 = words(1)
        self.actions = Actions()
        self.live_target_q28 = words(LIVES_MAX)
        self.base_q15 = halves(DOFS_MAX)
        self.signal_q15 = self.base_q15  # until a signal processing layer stands between them
        self.base_ring = Ring()
        self.base_ring_q15 = self.base_ring.value_q15
        self.signal_ring_q15 = self.motor.trajectory.ring.value_q15
        self._board = board
        self._sine = functions.sine_table()
        self.gradients = halves(NOISE_TABLES * GRADIENTS)
        self._master = words(clock.PHASE_WORDS)
        self.blinks = Blinks()
        self._programs = Programs()
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
        self._tempos_changed = 0

    def commit(self):
        """Let the staged tables, which are complete, replace those that play: now, or when the motion runs, soon."""
        self.exchange.begin()
        if self.frame < 0:
            while not self.exchange.prepare():
                pass
            self.exchange.replace()
            self._rest()

    def start(self):
        """Begin the motion anew: frame 0 is due at a motor tick soon. Targets that wait keep their stamps."""
        self._rest()
        self.frame = 0
        self.frame_max_us = 0
        self.cues.counts[0] = 0
        self.clock.start(self.motor.start(), self.tables.frame_rate_hz)

    def stop(self):
        """Stand still: no more frames, relative DOFs at 0, absolute DOFs where they are."""
        if self.frame >= 0:
            self.motor.stand()
        self.frame = -1
        self.cues.clear()
        if self.exchange.step >= 0:
            self._exchange_due = False
            self.commit()

    def prepare(self):
        """Take a step of what an exchange of tables needs between frames; return whether there was one to take.

        The last two collect what tables leave on the heap, so that it does not fill up in the middle of a frame, and put the
        new tables into force. They wait until there is time for that.
        """
        if self.exchange.step < 0:
            return False
        if self._exchange_due:
            if not self._has_time(_CARRY_US):
                return False
            self._exchange_due = False
            self.exchange.carry_over()
            self._tempos_changed = 1
        elif self.exchange.prepare():
            if not self._has_time(_COLLECT_US):
                return False
            gc.collect()
            self._exchange_due = True
        return True

    def _has_time(self, need_us):
        """Return whether so much time is left until the next frame, or as much as there is behind any."""
        most_us = 1000000 // self.clock.rate_hz - self.frame_max_us - _MARGIN_US
        return self.clock.until_us(self._board.ticks_us()) >= min(need_us, most_us)

    def step(self):
        """Compute the frame that is due and hand it to the motors."""
        begun_us = self._board.ticks_us()
        self.clock.begin(begun_us)
        self._synthesise()
        self.base_ring.put(self.frame, self.tables.dofs, self.base_q15)
        self.motor.put(self.frame, self.signal_q15)
        self.actions.warp(self.tables, self.tempo_q16[0], self.clock.rate_hz)
        clock.advance(self._master, self.tempo_q16[0], self.clock.rate_hz)
        self.frame += 1
        took_us = clock.ticks_diff(self._board.ticks_us(), begun_us)
        if took_us > self.frame_max_us:
            self.frame_max_us = took_us

    # fmt: off
    def _synthesise(self):
        t = self.tables
        a = self.actions
        rate_hz = self.clock.rate_hz
        counts = self.cues.counts
        counts[1] = self._tempos_changed
        self._tempos_changed = 0
        self.cues.apply(self.frame, a.target_q28, self.live_target_q28, self.tempo_q16, a.wanted_tempo_q16)
        a.compute_phases(t, self._master, rate_hz)
        if counts[1]:
            a.follow_tempos(t, self._master, rate_hz)
        a.end_gestures(t)
        compositor.hold_targets(
            t.actions, a.target_q28, t.first_mapping, t.mapping_count, t.mapped_dof,
            t.dofs, t.relative, self.base_q15, self._hold_target_q28, self._hold_w_q28, self.hold_q15, self._wanted,
        )
        for n in range(a.enter(t, self._master, rate_hz)):
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
            self._programs.evaluate(t, a, self._sine, self.gradients, self._live_w_q28, self._value_q15)
        if t.blinks:
            self.blinks.evaluate(t, a, self._sine, self._value_q15)
        functions.repeat(a.playing, a.found, t.first_mapping, t.mapping_count, t.same, self._value_q15)
        compositor.blend(
            a.playing, a.found, a.w_q28, t.first_mapping, t.mapping_count, t.mapped_dof, t.low_q15, t.high_q15,
            self._value_q15, t.dofs, self._hold_w_q28, self.hold_q15, self.base_q15,
            self._weight_sum, self._shift, self._upper, self._lower,
        )
    # fmt: on

    def _rest(self):
        """Set the state before frame 0: no action, HOLD and live channels at rest, tempo 1, phase 0."""
        tables = self.tables
        self.frame = -1
        self._tempos_changed = 0
        self.tempo_q16[0] = TEMPO_ONE
        for place in range(clock.PHASE_WORDS):
            self._master[place] = 0
        self.actions.rest(tables)
        self.blinks.rest(tables)
        for live in range(tables.lives):
            rest_q28 = tables.live_rest_q28[live]
            self.live_target_q28[live] = self._live_x_q28[live] = self._live_w_q28[live] = rest_q28
        for dof in range(tables.dofs):
            self._hold_target_q28[dof] = self._hold_x_q28[dof] = self._hold_w_q28[dof] = WEIGHT_ONE
            self.hold_q15[dof] = self.base_q15[dof] = tables.rest_q15[dof]
