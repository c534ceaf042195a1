"""Guards: which DOFs have pulses, once the host has armed the puppet.

Servos that all get their pulses in one instant draw more current than most supplies have, so DOFs attach one after
the other. A servo that holds its place hums, draws current and gets warm, so guards may take the pulses away:

- after stillness: where a DOF has stood where it should for `release_ms`; it gets them back at once when it should move
  by more than 1/256;
- by budget: pulses may flow for a share `duty` of the time. A leaky bucket fills while they flow, by `1 - duty`, and
  empties while they do not, by `duty`. It is full after `duty * window` of pulses without a break and empty `(1 - duty)
  * window` later, so in a time T they flow for no more than `duty * (T + (1 - duty) * window)`, and for what a move still
  lasts when the bucket is full. They come back when it is down to three quarters and the DOF has to move;
- to relax: every DOF that stands is let go; afterwards all attach again, one after the other;
- on a stall, at once: the DOF does not move, and its motor burns. It stays without pulses until the next `arm`.

Apart from a stall nothing is ever let go in mid-move, nor where a motion merely turns: a DOF stands if for 100 ms it
has been slower than 1/1024 per second and within 1/512 of where it should be; a relative one, if it has been at 0 besides.

Source: SPEC of motor control.
"""

import micropython
from micropython import const

from firmware.clock import TICKS_MASK, ticks_diff
from firmware.tables import words
from shared.formats import DOFS_MAX, NEW, NO_DRIVER

_ZERO = const(0x10000000)
_HALF = const(0x800000)  # a relative DOF at 0
_SLOT_US = const(10000)
_SLOT_MAX_MS = const(30000)
_EARLY_US = const(1000)  # a turn to attach may come so much early: a main loop that wakes with the motor ticks jitters
_STANDS_MS = const(100)
_NEAR_Q24 = const(0x8000)  # 1/512
_AWAY_Q24 = const(0x10000)  # 1/256
_CHANGE_Q24 = const(0x1000)  # 1/4096
_AT_ZERO_Q24 = const(0x1000)  # 1/2048 of a relative DOF's top speed
_USED_MAX_MS = const(0x10000000)

# Places in `masks`: bits of DOFs.
_ATTACHED = const(0)
_WANTED = const(1)  # get their pulses back when they have to move
_SPENT = const(2)  # have used up their budget
_RELEASE = const(3)
_ATTACH = const(4)


@micropython.viper
def _watch(
    position_q24: ptr32, velocity_q24: ptr32, reference_q24: ptr32, low_q24: ptr32, high_q24: ptr32, relative: ptr8,
    dofs: int, masks: ptr32, elapsed_ms: int, slow_q24: int, relaxing: int, release_ms: ptr16, duty_q15: ptr16,
    budget_ms: ptr32, used_ms: ptr32, used_q15: ptr32, still_ms: ptr32, seen_q24: ptr32,
):  # fmt: skip
    """Go on counting for `elapsed_ms`, 0..30000; set which DOFs are to be released and attached in `masks`.

    `still_ms` is 1 more than the time for which a DOF has stood, 0 while it does not. The bucket holds `used_ms +
    used_q15 / 2^15`, exactly. Velocity and reference have 16 added. `seen_q24` is where the DOFs were the last time: a short move
    in between ends a stand too.
    Bits: what flows into the bucket is below 30000 * 2^15 < 2^30; the bucket ends at 2^28 ms.
    """
    attached = masks[_ATTACHED]
    wanted = masks[_WANTED]
    spent = masks[_SPENT]
    release = 0
    attach = 0
    d = 0
    while d < dofs:
        bit = 1 << d
        duty = int(duty_q15[d])
        if duty < 32768:
            part = used_q15[d] + (elapsed_ms * (32768 - duty) if attached & bit else -elapsed_ms * duty)
            used = used_ms[d] + (part >> 15)
            part = part & 0x7FFF
            if used < 0:
                used = 0
                part = 0
            if used > _USED_MAX_MS:
                used = _USED_MAX_MS
            used_ms[d] = used
            used_q15[d] = part
            if used >= budget_ms[d]:
                spent = spent | bit
            elif used <= budget_ms[d] - (budget_ms[d] >> 2):
                spent = spent & (0xFFFF ^ bit)
        else:
            spent = spent & (0xFFFF ^ bit)
        goal = reference_q24[d] - _ZERO
        if goal > high_q24[d]:
            goal = high_q24[d]
        if goal < low_q24[d]:
            goal = low_q24[d]
        position = position_q24[d]
        velocity = velocity_q24[d] - _ZERO
        away = position - goal
        if away < 0:
            away = -away
        change = position - seen_q24[d]
        seen_q24[d] = position
        still = 0
        if attached & bit and -_CHANGE_Q24 <= change and change <= _CHANGE_Q24:
            if away <= _NEAR_Q24 and -slow_q24 <= velocity and velocity <= slow_q24:
                off = position - _HALF if relative[d] else 0
                if -_AT_ZERO_Q24 <= off and off <= _AT_ZERO_Q24:
                    still = still_ms[d]
                    still = still + elapsed_ms if still else 1
                    if still > 0x10000:
                        still = 0x10000
            if still > _STANDS_MS:
                most = int(release_ms[d])
                if relaxing or spent & bit or (most and still > most):
                    release = release | bit
        if away > _AWAY_Q24 and wanted & bit and ((attached | spent) & bit) == 0:
            attach = attach | bit
        still_ms[d] = still
        d += 1
    masks[_SPENT] = spent
    masks[_RELEASE] = release
    masks[_ATTACH] = attach


class Guards:
    """Gives and takes the pulses of single DOFs. Belongs to the main loop; `disarm` may come from an interrupt.

    `motor` offers `tables`, `attached` (bits of the DOFs that have pulses), `position_q24`, `velocity_q24` (per tick, 16 added),
    `reference_q24` (16 added; where the DOF is led, its correction included, so that a DOF at rest is there), `feedback`,
    `attach(dof)`, which does nothing once the pulses have been taken from all, and `detach(dof)`.

    `armed` and `stalled` have a bit for each DOF: those that get pulses, and those that have stalled since `arm`.
    """

    def __init__(self, motor, board):
        self.armed = 0
        self.stalled = 0
        self._motor = motor
        self._board = board
        self._pending = 0  # wait for their turn to attach
        self._next_us = 0  # when the next of them does
        self._last_us = board.ticks_us()
        self._relaxing = False
        self._slow_q24 = 0
        self._masks = words(5)
        self._budget_ms = words(DOFS_MAX)
        self._used_ms = words(DOFS_MAX)
        self._used_q15 = words(DOFS_MAX)
        self._still_ms = words(DOFS_MAX)
        self._seen_q24 = words(DOFS_MAX)

    @property
    def released(self):
        """The DOFs, as bits, that are armed but have no pulses because a guard took them."""
        return self.armed & ~self._pending & ~self._motor.attached

    def load(self):
        """Take over the motor's tables after an exchange: DOFs that stay keep what they are and have used. Allocates."""
        tables = self._motor.tables
        dofs = tables.dofs
        keep = tables.keep_dof
        used = [self._used_ms[keep[d]] if keep[d] != NEW else 0 for d in range(dofs)]
        part = [self._used_q15[keep[d]] if keep[d] != NEW else 0 for d in range(dofs)]
        outputs = self._outputs()
        armed = self._kept(self.armed) & outputs
        self.stalled = self._kept(self.stalled) & outputs
        self._masks[_SPENT] = self._kept(self._masks[_SPENT])
        for d in range(DOFS_MAX):
            self._still_ms[d] = 0
            self._used_ms[d] = used[d] if d < dofs else 0
            self._used_q15[d] = part[d] if d < dofs else 0
        for d in range(dofs):
            duty_q15 = tables.duty_q15[d]
            if duty_q15 < 32768:
                self._budget_ms[d] = max(1, duty_q15 * (32768 - duty_q15) * tables.window_s[d] * 1000 >> 30)
        self._slow_q24 = tables.motor_period_us * (1 << 14) // 1000000
        state = self._board.lock()
        if self.armed:  # still: an interrupt may have disarmed
            self.armed = armed
        self._board.unlock(state)
        self._queue(self._board.ticks_us())

    def arm(self, now_us):
        """Let all DOFs that have an output attach, the first one now. Returns whether there is one."""
        armed = self._outputs()
        for d in range(self._motor.tables.dofs):
            self._still_ms[d] = 0
            self._motor.feedback.forgive(d)
        self.stalled = 0
        self.armed = armed
        self._queue(now_us)
        self._attach_next(now_us)
        return armed != 0

    def disarm(self):
        """Attach nothing any more; taking the pulses away is up to the motor. May be called from an interrupt."""
        self.armed = 0
        self._pending = 0

    def attend(self, now_us, relaxing):
        """Give and take pulses as it is time to; `relaxing` lets go what stands. Allocates nothing.

        Called as often as there is time for; looks at the DOFs each 10 ms.
        """
        if self._pending:
            self._attach_next(now_us)
        elapsed_us = ticks_diff(now_us, self._last_us)
        if elapsed_us < _SLOT_US:
            return
        elapsed_ms = elapsed_us // 1000
        self._last_us = (now_us - elapsed_us % 1000) & TICKS_MASK
        if elapsed_ms > _SLOT_MAX_MS:
            elapsed_ms = _SLOT_MAX_MS
        if relaxing != self._relaxing:
            self._relaxing = relaxing
            if not relaxing:
                self._queue(now_us)
        motor = self._motor
        masks = self._masks
        tables = motor.tables
        attached = motor.attached
        stalled = motor.feedback.stalled & attached & self.armed
        if stalled:
            self.stalled |= stalled
            self._detach(stalled)
            attached = motor.attached
        masks[_ATTACHED] = attached
        masks[_WANTED] = self.armed & ~self.stalled & ~self._pending
        # fmt: off
        _watch(
            motor.position_q24, motor.velocity_q24, motor.reference_q24, tables.limit_low_q24, tables.limit_high_q24,
            tables.relative, tables.dofs, masks, elapsed_ms, self._slow_q24, 1 if relaxing else 0, tables.release_ms,
            tables.duty_q15, self._budget_ms, self._used_ms, self._used_q15, self._still_ms,
            self._seen_q24,
        )
        # fmt: on
        if masks[_RELEASE]:
            self._detach(masks[_RELEASE] & self.armed)
        if masks[_ATTACH]:
            self._attach(masks[_ATTACH])

    def _outputs(self):
        """Return the bits of the DOFs that have an output."""
        tables = self._motor.tables
        found = 0
        for d in range(tables.dofs):
            if tables.driver[d] != NO_DRIVER:
                found |= 1 << d
        return found

    def _kept(self, mask):
        """Return bits of DOFs of the tables before, as bits of those that have become of them."""
        tables = self._motor.tables
        found = 0
        for d in range(tables.dofs if mask else 0):
            if tables.keep_dof[d] != NEW and mask & (1 << tables.keep_dof[d]):
                found |= 1 << d
        return found

    def _queue(self, now_us):
        """Let all that have no pulses get them in turn, but for those that have stalled or used up their budget."""
        self._pending = self.armed & ~self._motor.attached & ~self.stalled & ~self._masks[_SPENT]
        self._next_us = now_us

    def _attach_next(self, now_us):
        while self._pending and ticks_diff(now_us, self._next_us) >= -_EARLY_US:
            bit = self._pending & -self._pending
            self._pending ^= bit
            self._attach(bit)
            pause_us = self._motor.tables.attach_ms * 1000
            self._next_us = (now_us - (TICKS_MASK - pause_us) - 1) & TICKS_MASK  # the plain sum may pass 2^30
            if pause_us:
                return

    def _attach(self, mask):
        for d in range(self._motor.tables.dofs):
            if mask & self.armed & (1 << d):
                self._still_ms[d] = 0
                self._motor.attach(d)

    def _detach(self, mask):
        for d in range(self._motor.tables.dofs):
            if mask & (1 << d):
                self._motor.detach(d)
