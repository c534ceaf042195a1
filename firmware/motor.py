"""Motor control: the last layer before the board. Clamps, calibrates, and decides whether pulses flow.

Absolute DOFs take positions, relative DOFs velocities with 16384 (Q15) standing still. Nothing is driven until `arm`;
`kill` takes all pulses away at once. When the link falls silent, relative DOFs ease to a stand within 300 ms.
"""

import micropython
from micropython import const

from firmware.tables import halves
from shared.formats import DOFS_MAX, NO_PIN, VALUE_ONE

_STOP_MS = const(300)
_ONE_Q15 = const(32768)


@micropython.viper
def _move(
    dofs: int,
    signal_q15: ptr16,
    relative: ptr8,
    ease_q15: int,
    low_q15: ptr16,
    high_q15: ptr16,
    motor_q15: ptr16,
    pulse0_q4us: ptr16,
    pulse1_q4us: ptr16,
    pulse_q4us: ptr16,
):
    """Write the clamped value and the calibrated pulse width of every DOF.

    `ease_q15` scales the speed of relative DOFs, 32768 being full. Bits: values are Q15 in 0..32768, pulse widths below
    2^16, so products stay within 2^31.
    """
    d = 0
    while d < dofs:
        value = int(signal_q15[d])
        if relative[d]:
            value = 16384 + (((value - 16384) * ease_q15 + 0x4000) >> 15)
        if value > high_q15[d]:
            value = int(high_q15[d])
        if value < low_q15[d]:
            value = int(low_q15[d])
        motor_q15[d] = value
        at_0 = int(pulse0_q4us[d])
        pulse_q4us[d] = at_0 + (((int(pulse1_q4us[d]) - at_0) * value + 0x4000) >> 15)
        d += 1


class Motor:
    """The outputs of one puppet.

    `motor_q15` is what each DOF was last told, `pulse_q4us` its pulse width in 1/16 us.
    """

    def __init__(self, board, tables):
        self.armed = False
        self.motor_q15 = halves(DOFS_MAX)
        self.pulse_q4us = halves(DOFS_MAX)
        self._board = board
        self._ease_q15 = VALUE_ONE
        self._tables = tables

    def load(self, tables):
        """Take over a puppet's limits and calibration; all outputs fall silent, every DOF is at rest."""
        self.kill()
        self._tables = tables
        self._ease_q15 = VALUE_ONE
        self._write(tables.rest_q15)

    def exchange(self, tables):
        """Take over other tables while the motion goes on. Pins that are no longer used fall silent; new ones wait for `arm`."""
        before = self._tables
        for d in range(before.dofs):
            pin = before.pin[d]
            if pin != NO_PIN and not self._drives(tables, pin):
                self._board.release(pin)
        self._tables = tables

    def _drives(self, tables, pin):
        for d in range(tables.dofs):
            if tables.pin[d] == pin:
                return True
        return False

    def begin(self):
        """Let relative DOFs have their full speed from the first frame on, however the motion ended before."""
        self._ease_q15 = VALUE_ONE

    def move(self, signal_q15, silent):
        """Bring one frame's values to the outputs; `silent` tells that the link has been quiet too long."""
        if silent or self._ease_q15 != _ONE_Q15:
            self._ease(silent)
        self._write(signal_q15)

    def stand(self):
        """Stop relative DOFs where no frames follow; absolute DOFs keep their position."""
        self._ease_q15 = 0
        self._write(self.motor_q15)

    def arm(self):
        """Let pulses flow, from the present values. Returns whether there is an output to arm."""
        tables = self._tables
        for d in range(tables.dofs):
            if tables.pin[d] != NO_PIN:
                self._board.attach(tables.pin[d])
                self.armed = True
        if self.armed:
            self._board.pulses(tables.dofs, tables.pin, self.pulse_q4us)
        return self.armed

    def kill(self):
        """Take away all pulses, now."""
        self.armed = False
        self._board.quiet()

    def _ease(self, silent):
        step_q15 = 1 + _ONE_Q15 * 1000 // (_STOP_MS * self._tables.frame_rate_hz)
        if silent:
            self._ease_q15 = max(0, self._ease_q15 - step_q15)
        else:
            self._ease_q15 = min(_ONE_Q15, self._ease_q15 + step_q15)

    def _write(self, signal_q15):
        tables = self._tables
        # fmt: off
        _move(
            tables.dofs, signal_q15, tables.relative, self._ease_q15, tables.limit_low_q15, tables.limit_high_q15,
            self.motor_q15, tables.pulse0_q4us, tables.pulse1_q4us, self.pulse_q4us,
        )
        # fmt: on
        if self.armed:
            self._board.pulses(tables.dofs, tables.pin, self.pulse_q4us)
