"""Motor control: from the frames' targets to what the outputs get, at the motor layer's own rate.

`tick` runs in interrupt context, from a hardware timer, whatever the main loop does: it looks at the kill pin, counts
the silence of the link, and takes every DOF one step further (trajectory, character, error correction, limits,
calibration), then lets the drivers write. It is safe there because it allocates nothing, waits for nothing, and shares with the
main loop only words that one side writes: the main loop stores a frame in a ring and then its number (`put`), the tick
stores positions. Where the main loop changes what the tick uses (attaching, letting go, other tables) it holds interrupts
off for a few hundred microseconds (`board.lock`). A late synthesis makes the tick go on with guesses, never wait.

Nothing is driven until `arm`; then the guards attach one DOF after the other, each from its last known pose. `kill` takes all
pulses away at once.
"""

import micropython
from micropython import const

from firmware import calibration, limiter
from firmware.character import Character
from firmware.clock import TICKS_MASK, ticks_diff
from firmware.feedback import Feedback
from firmware.guards import Guards
from firmware.tables import halves, words
from firmware.trajectory import ZERO_Q24, Ring, Trajectory
from shared.formats import (
    DOFS_MAX,
    KILLED_BY_NOBODY,
    KILLED_BY_PIN,
    KILLED_BY_STOPPED_TICKS,
    MOTOR_PERIOD_MAX_US,
    NO_DRIVER,
    NO_PIN,
    POSITION_ONE,
    SILENT_IDLE,
    SILENT_RELAX,
)

_DOFS = const(16)
_MICRO = const(1000000)
_COUNT_MASK = const(0x1FFFFFFF)  # of ticks: counting further would allocate
_STILL_Q24 = const(0x800000)
_CALM_PER_S = const(4)  # change of a wheel's speed when it has to stand: from full speed in 250 ms
_GLIDE_US_PER_S = const(200)  # of pulse ends that are set anew
_AHEAD_US = const(2000)  # a start that is nearer to the next tick takes the one after it
_STOPPED_US = const(100000)  # without a tick for so long, the main loop takes the pulses away
_UNKNOWN_US = const(-1)
_KEEP_US = const(16000)  # between two notes of the pose


@micropython.viper
def _remember(position_q24: ptr32, before_q24: ptr32, dofs: int):
    """Shift the positions of the last two ticks."""
    d = 0
    while d < dofs:
        before_q24[_DOFS + d] = before_q24[d]
        before_q24[d] = position_q24[d]
        d += 1


@micropython.viper
def _measure(times_us: ptr32, period_us: int, begun_us: int, ended_us: int):
    """Keep the longest tick (word 0) and the largest lateness of one against the first (1); word 2 is when it was expected.

    Microseconds count modulo 2^30; a word 2 outside of that means that this tick is the first.
    """
    expected = times_us[2]
    if expected < 0 or expected > 0x3FFFFFFF:
        expected = begun_us
    late = (begun_us - expected) & 0x3FFFFFFF
    if late < 0x20000000 and late > times_us[1]:
        times_us[1] = late
    took = (ended_us - begun_us) & 0x3FFFFFFF
    if took > times_us[0]:
        times_us[0] = took
    times_us[2] = (expected + period_us) & 0x3FFFFFFF


class Motor:
    """The motor layer of one puppet on one board.

    `tick` is the handler of the board's motor ticks. Per DOF: `position_q24` is where the layer has led it, `velocity_q24`
    what it moved in the last tick, `reference_q24` where it would like to be (both with `ZERO_Q24` added). `attached` has
    the bit of every DOF that has pulses. `tap_ring` holds the course at the instants of the last 16 frames, `tapped[0]` is
    the last of them. `silent` tells that no packet has come for the puppet's `link_timeout`, once
    there has been one.
    """

    def __init__(self, board, drivers, tables):
        self.armed = False
        self.attached = 0
        self.killed_by = KILLED_BY_NOBODY
        self.silent = False
        self.playing = False
        self.ticks = 0
        self.tables = tables
        self.position_q24 = words(DOFS_MAX)
        self.velocity_q24 = words(DOFS_MAX)
        self.reference_q24 = words(DOFS_MAX)
        self.tap_ring = Ring()
        self.tap_q15 = self.tap_ring.value_q15
        self.tapped = words(1)
        self.slope_q16 = words(DOFS_MAX)
        self.bend_q15 = words(DOFS_MAX)
        self.feedback = Feedback(board)
        self.trajectory = Trajectory()
        self.guards = Guards(self, board)
        self._board = board
        self._drivers = drivers
        self._character = Character(tables)
        self._correction_q24 = words(DOFS_MAX)
        self._before_q24 = words(2 * DOFS_MAX)
        self._force_q24 = words(DOFS_MAX)
        self._level_q24 = words(DOFS_MAX)
        self._pulse_q18us = words(DOFS_MAX)
        self._end_q4us = halves(2 * DOFS_MAX)
        self._held = bytearray(DOFS_MAX)
        self._turn = bytearray(DOFS_MAX)
        self._rest_q15 = None
        self._period_us = 0
        self._part = 0  # of a frame in a tick, in millionths
        self._paused = False
        self._missed = 0
        self._kill_pin = NO_PIN
        self._kill_level = 0
        self._maintained = 0
        self._unsettled = False
        self._calm_q24 = 0
        self._glide_q4us = 0
        self._timeout_ticks = 1
        self._quiet_ticks = 0
        self._heard = False
        self._keep_ticks = 0
        self._keep_wait = 0
        self._starting = 0
        self._tap_part = 0
        self._later = 0
        self._times_us = words(3)
        self._times_us[2] = _UNKNOWN_US
        self._since = 0  # ticks at which the turns began
        self._seen = 0
        self._seen_us = board.ticks_us()
        self._next_tag = 0  # of the tables that are prepared
        self._has_same_dofs = True
        self.tick = self._tick  # bound once: binding allocates
        self._set_rates(tables)
        self.prepare(tables)
        self._course = self._next_course
        board.start_ticks(MOTOR_PERIOD_MAX_US, self.tick)

    # --- the main loop's side

    @property
    def late_frames(self):
        """Return how many frames were not there when they should have taken effect, since `start`."""
        return self.trajectory.late

    @property
    def tick_max_us(self):
        """Return how long a tick took at most, since `start`."""
        return self._times_us[0]

    @property
    def tick_late_max_us(self):
        """Return how late a tick came at most against the first, since `start`."""
        return self._times_us[1]

    @property
    def released(self):
        """Return a mask of the armed DOFs that a guard has taken the pulses from."""
        return self.guards.released

    @property
    def stalled(self):
        """Return a mask of the DOFs that were let go because they could not move."""
        return self.guards.stalled

    def load(self, tables):
        """Take over a puppet's tables while nothing moves: all outputs fall silent, each DOF is at its last known pose."""
        board = self._board
        self.kill(self.killed_by)
        board.stop_ticks()
        self.playing = False
        self._starting = 0
        self.tables = tables
        for d in range(tables.dofs):
            self.position_q24[d] = tables.rest_q15[d] << 9
        board.kept_pose(tables.dofs, self.position_q24, _tag(tables))
        for d in range(tables.dofs):
            if tables.driver[d] == NO_DRIVER:
                self.position_q24[d] = tables.rest_q15[d] << 9
            elif tables.relative[d]:
                self.position_q24[d] = _STILL_Q24
            self.position_q24[d] = min(max(self.position_q24[d], tables.limit_low_q24[d]), tables.limit_high_q24[d])
            self._turn[d] = 0
            self._correction_q24[d] = ZERO_Q24
            self._take_ends(d)
            self._stand(d)
        self._hold_unattached()
        self._set_rates(tables)
        self.prepare(tables)
        self._drivers.load(tables)
        self.trajectory.load(tables)
        self.trajectory.hold(tables.dofs, self.position_q24)
        self._take_over(tables)
        self._settle()
        self._since = self.ticks
        self._times_us[2] = _UNKNOWN_US
        board.start_ticks(tables.motor_period_us, self.tick)

    def prepare(self, tables):
        """Make what an exchange for other tables needs, which are complete; allocates."""
        micropython.heap_lock()  # what allocates nothing is twice as fast then
        try:
            self._next_tag = _tag(tables)
            self._has_same_dofs = _same_dofs(tables, self.tables)
        finally:
            micropython.heap_unlock()
        self._drivers.prepare(tables)
        course = self._steps(tables)
        next(course)
        self._next_course = course

    def exchange(self, tables, gather_words, gather_halves, scratch):
        """Take over the prepared tables while the motion goes on; `tables.keep_dof` says which DOF was which.

        Outputs that are no longer used fall silent, new ones are attached one after the other. Frame rate and motor period
        are the same. `gather_*(values, old, scratch, count, fresh, at)` rearrange an array. If the DOFs and their outputs
        stay as they were, no tick waits for this; else ticks that come meanwhile are made up for by the next. Allocates nothing.
        """
        before = self.tables
        if self._has_same_dofs:
            self.tables = tables
            self._take_over(tables)
            self._unsettled = True
            return
        self._paused = True
        self.feedback.pause()
        self.tables = tables
        self._rearrange(before, tables, gather_words, gather_halves, scratch)
        self._take_over(tables)
        self._unsettled = True
        self._paused = False
        self._board.kept_pose(0, self.position_q24, self._next_tag)  # from now on it is kept under the new tag

    def _rearrange(self, before, tables, gather_words, gather_halves, scratch):
        going_on = self._drivers.load(tables)
        keep = tables.keep_dof
        dofs = tables.dofs
        attached = 0
        gather_words(self.position_q24, keep, scratch, dofs, 0, 0)
        gather_words(self.velocity_q24, keep, scratch, dofs, ZERO_Q24, 0)
        gather_words(self.reference_q24, keep, scratch, dofs, ZERO_Q24, 0)
        gather_words(self._correction_q24, keep, scratch, dofs, ZERO_Q24, 0)
        gather_words(self._force_q24, keep, scratch, dofs, 0, 0)
        for place in range(2):
            gather_words(self._before_q24, keep, scratch, dofs, 0, place * _DOFS)
            gather_halves(self._end_q4us, keep, scratch, dofs, 0, place * _DOFS)
        self.trajectory.rearrange(gather_words, gather_halves, keep, scratch, dofs, tables.rest_q15)
        self._character.rearrange(gather_words, keep, scratch, dofs)
        self.tap_ring.rearrange(gather_halves, keep, scratch, dofs, self.trajectory.newest, tables.rest_q15)
        for d in range(dofs):
            self._turn[d] = ((self.ticks - self._since) & _COUNT_MASK) % tables.turns[d]
            was = keep[d]
            if was >= before.dofs:
                rest_q24 = tables.rest_q15[d] << 9
                self.position_q24[d] = min(max(rest_q24, tables.limit_low_q24[d]), tables.limit_high_q24[d])
                self._stand(d)
                self.trajectory.stand_one(d, self.position_q24[d])
            if was >= before.dofs or not _same_output(tables, d, before, was):
                self._take_ends(d)
                if going_on >> d & 1:  # it was another DOF's: the new one begins from its own pose
                    self._drivers.release(d)
            elif self.attached >> was & 1:
                attached |= going_on & 1 << d
        state = self._board.lock()
        if not self.armed:  # the kill pin may have come in between, while a driver had not yet all its outputs
            attached = 0
            self._drivers.quiet()
        self.attached = attached
        self._hold_unattached()
        self._board.unlock(state)

    def start(self):
        """Begin the motion: return the instant of frame 0, which is that of a motor tick soon."""
        board = self._board
        state = board.lock()
        due_us = board.tick_due_us()
        self._starting = 1
        if ticks_diff(due_us, board.ticks_us()) < _AHEAD_US:
            due_us = (due_us - (TICKS_MASK - self._period_us) - 1) & TICKS_MASK  # the plain sum may pass 2^30
            self._starting = 2
        self.trajectory.prepare()
        self._times_us[0] = self._times_us[1] = 0
        board.unlock(state)
        return due_us

    def stand(self):
        """Come to a stand: relative DOFs slow down, absolute DOFs settle where the last frame wanted them."""
        self.playing = False
        self._starting = 0

    def put(self, frame, signal_q15):
        """Hand a frame's targets to the ticks."""
        self.trajectory.put(frame, self.tables.dofs, signal_q15)

    def heard(self):
        """Note that a packet has come."""
        self._quiet_ticks = 0
        self._heard = True
        self.silent = False

    def arm(self):
        """Let pulses flow, one DOF after the other. Returns whether there is an output, and no pin that kills."""
        tables = self.tables
        if self._kill_pin != NO_PIN and self._board.level(self._kill_pin) == self._kill_level:
            self.killed_by = KILLED_BY_PIN
            return False
        for d in range(tables.dofs):
            if tables.driver[d] != NO_DRIVER:
                self.killed_by = KILLED_BY_NOBODY
                self.armed = True
                return self.guards.arm(self._board.ticks_us())
        return False

    def kill(self, killed_by):
        """Take away all pulses, now. Called from the tick as well."""
        state = self._board.lock()
        self.armed = False
        self.attached = 0
        self.killed_by = killed_by
        self._drivers.quiet()
        self.guards.disarm()
        self._hold_unattached()
        self._board.unlock(state)

    def calibrate(self, dof, end0_q4us, end1_q4us, dead_q15, top_q15):
        """Set a DOF's calibration, which has been checked; pulses glide there."""
        self.tables.calibrate(dof, end0_q4us, end1_q4us, dead_q15, top_q15)

    def limit(self, dof, low_q15, high_q15, speed_q24, accel_q24):
        """Set a DOF's limits, which have been checked; a DOF that is beyond them brakes and comes back."""
        state = self._board.lock()
        self.tables.limit(dof, low_q15, high_q15, speed_q24, accel_q24)
        self._board.unlock(state)

    def attach(self, dof):
        """Let a DOF have pulses again, from where it was last, or is measured to be."""
        board = self._board
        state = board.lock()
        if self.armed:
            tables = self.tables
            start_q24 = self.feedback.start(dof)
            if start_q24 >= 0:
                self.position_q24[dof] = start_q24
            self._stand(dof)
            # The limiter adds the correction; the course begins without it.
            led_q24 = self.position_q24[dof] - self._correction_q24[dof] + ZERO_Q24
            led_q24 = min(max(led_q24, 0), POSITION_ONE)
            self._character.stand(dof, led_q24)
            self.trajectory.stand_one(dof, led_q24)
            self._held[dof] = 0
            self.attached |= 1 << dof
            ticks = tables.turns[dof] - 1 - self._turn[dof]
            until_us = ticks_diff(board.tick_due_us(), board.ticks_us()) + ticks * self._period_us
            self._drivers.attach(dof, until_us)
        board.unlock(state)

    def detach(self, dof):
        """Take the pulses of one DOF away; it counts as standing where it is."""
        state = self._board.lock()
        self.attached &= ~(1 << dof)
        if self.tables.relative[dof]:
            self.position_q24[dof] = _STILL_Q24
        self._held[dof] = 1
        self._drivers.release(dof)
        self._board.unlock(state)

    def derive(self):
        """Bring `slope_q16` and `bend_q15`, the derivatives of the targets by frames, up to date."""
        state = self._board.lock()
        self.trajectory.derive(self.tables.dofs, self.slope_q16, self.bend_q15)
        self._board.unlock(state)

    def attend(self):
        """Do what the main loop has to do for the motors at each pass: slow drivers, guards, the watchdog. Allocates nothing."""
        board = self._board
        now_us = board.ticks_us()
        if self.ticks == self._seen:
            if self.armed and ticks_diff(now_us, self._seen_us) > _STOPPED_US:
                self.kill(KILLED_BY_STOPPED_TICKS)
            return
        self._seen = self.ticks
        self._seen_us = now_us
        board.feed()
        state = board.lock()
        due = self._later
        self._later = 0
        board.unlock(state)
        self._drivers.flush(self._level_q24, self._pulse_q18us, due)
        if not self._unsettled:
            self.guards.attend(now_us, self.silent and self.tables.when_silent == SILENT_RELAX)

    def maintain(self):
        """Let drivers set up their devices and find those that have come back, once a tick. May allocate."""
        if self._unsettled:
            self._settle()
        if self.ticks != self._maintained:
            self._maintained = self.ticks
            self._drivers.attend(self._board.ticks_us())

    def _settle(self):
        """Let error correction and guards take over the tables; corrections stay as they are until then."""
        self.feedback.load(self.tables)
        self.guards.load()
        self._unsettled = False

    # --- the tick

    def _tick(self):
        board = self._board
        begun_us = board.ticks_us()
        tables = self.tables
        self.ticks = (self.ticks + 1) & _COUNT_MASK
        if self.armed and self._kill_pin != NO_PIN and board.level(self._kill_pin) == self._kill_level:
            self.kill(KILLED_BY_PIN)
        if self._quiet_ticks >= self._timeout_ticks:
            self.silent = self._heard
        else:
            self._quiet_ticks += 1
        if self._paused:
            self._missed += 1
            _measure(self._times_us, self._period_us, begun_us, board.ticks_us())
            return
        if self._missed:  # one at a time: a UART has no room for more than 3 ms without attention
            self._missed -= 1
            next(self._course)
        next(self._course)
        self._keep_wait -= 1
        if self._keep_wait <= 0:
            self._keep_wait = self._keep_ticks
            board.keep_pose(tables.dofs, self.position_q24)
        _measure(self._times_us, self._period_us, begun_us, board.ticks_us())

    # fmt: off
    def _steps(self, tables):
        """Take every DOF one step further and write the outputs whose turn it is, each time this is resumed.

        A generator, because its names are bound once for a set of tables: looking one up costs 2 us on an RP2040, and there
        are some sixty.
        """
        dofs, relative, turns = tables.dofs, tables.relative, tables.turns
        low_q24, high_q24, speed_q24, accel_q24, force_q24 = (
            tables.limit_low_q24, tables.limit_high_q24, tables.speed_q24, tables.accel_q24, self._force_q24
        )
        end0_q4us, end1_q4us, dead_q15, top_q15 = (
            tables.end0_q4us, tables.end1_q4us, tables.dead_q15, tables.top_q15
        )
        position_q24, velocity_q24, reference_q24 = self.position_q24, self.velocity_q24, self.reference_q24
        before_q24, correction_q24, held = self._before_q24, self._correction_q24, self._held
        level_q24, pulse_q18us, end_q4us, turn = self._level_q24, self._pulse_q18us, self._end_q4us, self._turn
        course_q24, wanted_q24 = self.trajectory.reference_q24, self._character.output_q24
        advance, respond, correct = self.trajectory.advance, self._character.respond, self.feedback.tick
        limit, remember, calibrate, write = limiter.limit, _remember, calibration.calibrate, self._drivers.write
        calm_q24, glide_q4us = self._calm_q24, self._glide_q4us
        rest_q15 = tables.rest_q15 if tables.when_silent != SILENT_IDLE else None
        while True:
            yield
            if self._starting:
                self._starting -= 1
                if self._starting == 0:
                    self.trajectory.start(dofs, position_q24)
                    self.playing = True
                    self.tapped[0] = -1
                    self._tap_part = -self._part - self._part // 2
            playing = self.playing
            silent = self.silent
            attached = self.attached
            advance(dofs, playing, rest_q15 if silent else None)
            respond(dofs, course_q24)
            correct(attached, position_q24, correction_q24)
            limit(
                wanted_q24, correction_q24, reference_q24, position_q24, velocity_q24, dofs, held, relative, low_q24,
                high_q24, speed_q24, accel_q24, force_q24, silent or not playing or not self._heard, calm_q24,
            )
            if playing:
                self._tap(dofs)
            remember(position_q24, before_q24, dofs)
            due = attached & calibrate(
                position_q24, level_q24, pulse_q18us, dofs, relative, end_q4us, end0_q4us, end1_q4us, glide_q4us,
                dead_q15, top_q15, turn, turns,
            )
            if due:
                write(level_q24, pulse_q18us, due)
                self._later |= due
    # fmt: on

    def _tap(self, dofs):
        """Note the course at the instants of frames that lie half a tick or more behind."""
        part = self._tap_part + self._part
        while part >= 0:
            frame = self.tapped[0] + 1
            # z = 1 - part / (a tick's part of a frame) in Q15, in two steps that stay small
            scaled = part << 9
            whole = scaled // self._part
            z_q15 = 32768 - (whole << 6) - (((scaled - whole * self._part) << 6) // self._part)
            calibration.tap(
                self.position_q24, self._before_q24, dofs, z_q15, self.tap_ring.value_q15, (frame & 15) * _DOFS
            )
            self.tapped[0] = frame
            part -= _MICRO
        self._tap_part = part

    # --- shared

    def _stand(self, dof):
        """Let a DOF stand where it is; the trajectory is seen to by the caller."""
        position_q24 = self.position_q24[dof]
        self.velocity_q24[dof] = ZERO_Q24
        self.reference_q24[dof] = position_q24 + ZERO_Q24
        self._before_q24[dof] = self._before_q24[_DOFS + dof] = position_q24
        self._character.stand(dof, position_q24)

    def _hold_unattached(self):
        """Hold every DOF with an output that has no pulses; a wheel without pulses stands."""
        tables = self.tables
        for d in range(tables.dofs):
            if tables.driver[d] == NO_DRIVER or self.attached >> d & 1:
                self._held[d] = 0
            else:
                self._held[d] = 1
                if tables.relative[d]:
                    self.position_q24[d] = _STILL_Q24

    def _take_ends(self, dof):
        self._end_q4us[dof] = self.tables.end0_q4us[dof]
        self._end_q4us[_DOFS + dof] = self.tables.end1_q4us[dof]

    def _take_over(self, tables):
        self._character.load(tables)
        if tables.kill_pin != self._kill_pin:
            self._kill_pin = NO_PIN
            if tables.kill_pin != NO_PIN:
                self._board.input_pullup(tables.kill_pin)
        self._kill_level = tables.kill_level
        self._kill_pin = tables.kill_pin
        self._timeout_ticks = tables.link_timeout_ms * 1000 // tables.motor_period_us
        self._course = self._next_course

    def _set_rates(self, tables):
        period_us = tables.motor_period_us
        self._period_us = period_us
        self._part = period_us * tables.frame_rate_hz
        self._calm_q24 = _CALM_PER_S * (POSITION_ONE // 2) * period_us // _MICRO
        self._glide_q4us = max(1, _GLIDE_US_PER_S * 16 * period_us // _MICRO)
        self._keep_ticks = _KEEP_US // period_us


def _same_dofs(tables, other):
    """Return whether DOFs and outputs are those of other tables, in the same order."""
    if tables.dofs != other.dofs:
        return False
    for d in range(tables.dofs):
        if tables.keep_dof[d] != d or not _same_output(tables, d, other, d):
            return False
    return True


def _same_output(tables, dof, other, was):
    """Return whether a DOF has the very output that another had in other tables."""
    if tables.driver[dof] != other.driver[was] or tables.turns[dof] != other.turns[was]:
        return False
    size = len(tables.settings) // DOFS_MAX
    for place in range(size):
        if tables.settings[dof * size + place] != other.settings[was * size + place]:
            return False
    return tables.device_settings == other.device_settings


def _tag(tables):
    """Return a number that stands for a robot's wiring: a pose is known as long as it stays the same."""
    tag = _fold(tables.dofs, tables.driver)
    tag = _fold(tag, tables.settings)
    tag = _fold(tag, tables.end0_q4us)
    tag = _fold(tag, tables.end1_q4us)
    return _fold(tag, tables.relative) + 1


def _fold(tag, values):
    for value in values:
        tag = (tag * 31 + value) & 0xFFFFFF
    return tag
