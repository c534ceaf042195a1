"""Wheels: motors on H-bridges, driven by PWM at 20 kHz.

Settings: `wiring, pin_a, pin_b, invert`. Wiring 0: PWM on a, direction on b, high for backward. Wiring 1: PWM on a to go
forward, on b to go backward. `invert` exchanges forward and backward.

The hardware takes a new duty over as a period of 50 us begins, and a new direction at once. So a motor that is to turn
round stands for one write: the duty becomes 0 in one, the direction changes in the next, a motor tick later, when the PWM has
long been low. At no instant does the old duty meet the new direction, or do both inputs of a bridge see pulses.
"""

import micropython
from micropython import const

from firmware.driver import Driver
from firmware.tables import words
from shared.formats import DOFS_MAX, DRIVER_BRIDGE, SETTINGS_MAX

_PERIOD_US = const(50)
_WIRINGS = const(2)
_STOP_Q24 = const(0x800000)


@micropython.viper
def _steer(count: int, level_q24: ptr32, invert: ptr8, due: int, duty_q16: ptr32, backward: ptr8):
    """Write duty and direction of the DOFs in `due`: 0..65536 and 0 or 1.

    A direction changes only where the duty was 0 before; otherwise the duty becomes 0. Bits: a level lies in 0..2^24, its
    distance from the stop within 2^23.
    """
    d = 0
    while d < count:
        if (due >> d) & 1:
            speed = int(level_q24[d]) - _STOP_Q24
            if invert[d]:
                speed = -speed
            back = 0
            if speed < 0:
                back = 1
                speed = -speed
            duty = (speed + 64) >> 7
            if duty:
                if back != int(backward[d]):
                    if duty_q16[d]:
                        duty = 0
                    else:
                        backward[d] = back
            duty_q16[d] = duty
        d += 1


class BridgeDriver(Driver):
    """All motors on H-bridges."""

    pins = (1, 2)

    def __init__(self, board):
        self._board = board
        self._attached = 0  # bits of DOFs
        self._wiring = bytearray(DOFS_MAX)
        self._pin_a = bytearray(DOFS_MAX)
        self._pin_b = bytearray(DOFS_MAX)
        self._invert = bytearray(DOFS_MAX)
        self._duty_q16 = words(DOFS_MAX)
        self._backward = bytearray(DOFS_MAX)
        self._driven = bytearray(DOFS_MAX)  # direction as the pin has it

    def pwm(self, settings, place):
        """Return the numbers of the settings that are PWM pins."""
        return (1, 2) if settings[place] else (1,)

    def check_output(self, tables, dof, settings, count):
        """Return None, or the number of the setting that is missing, surplus or out of range; `Drivers` looks at the pins."""
        if count != 4:
            return min(count, 4)
        if settings[0] >= _WIRINGS:
            return 0
        if settings[3] > 1:
            return 3
        return None

    def period_us(self, tables, dof):
        """Return the period of the PWM."""
        return _PERIOD_US

    def load(self, tables):
        """Keep the motors whose settings are the same for the same DOF; all others stand."""
        settings = tables.settings
        kept = 0
        for dof in range(DOFS_MAX):
            mine = dof < tables.dofs and tables.driver[dof] == DRIVER_BRIDGE
            at = dof * SETTINGS_MAX
            if self._attached >> dof & 1:
                if mine and self._is(dof, settings, at):
                    kept |= 1 << dof
                else:
                    self.release(dof)
            if mine:
                self._wiring[dof] = settings[at]
                self._pin_a[dof] = settings[at + 1]
                self._pin_b[dof] = settings[at + 2]
                self._invert[dof] = settings[at + 3]
        return kept

    def _is(self, dof, settings, at):
        """Return whether a DOF has these settings already."""
        return (
            settings[at] == self._wiring[dof]
            and settings[at + 1] == self._pin_a[dof]
            and settings[at + 2] == self._pin_b[dof]
            and settings[at + 3] == self._invert[dof]
        )

    def attach(self, dof, until_us):
        """Let a motor have PWM, at duty 0 until the next write."""
        if self._attached >> dof & 1:
            return
        board = self._board
        board.bridge_attach(self._pin_a[dof])
        if self._wiring[dof]:
            board.bridge_attach(self._pin_b[dof])
        else:
            board.drive(self._pin_b[dof], 0)
        self._duty_q16[dof] = 0
        self._backward[dof] = 0
        self._driven[dof] = 0
        self._attached |= 1 << dof

    def release(self, dof):
        """Drive a motor's pins low."""
        if self._attached >> dof & 1:
            self._attached &= ~(1 << dof)
            self._board.pin_low(self._pin_a[dof])
            self._board.pin_low(self._pin_b[dof])

    def write(self, level_q24, pulse_q18us, due):
        """Set duty and direction of the attached DOFs in `due`."""
        due &= self._attached
        if not due:
            return
        _steer(DOFS_MAX, level_q24, self._invert, due, self._duty_q16, self._backward)
        dof = 0
        while due:
            if due & 1:
                self._write(dof)
            due >>= 1
            dof += 1

    def _write(self, dof):
        board = self._board
        pin = self._pin_a[dof]
        other = self._pin_b[dof]
        backward = self._backward[dof]
        if self._wiring[dof]:
            # The pin of the other direction has duty 0: it was the last that it got.
            board.bridge_write(other if backward else pin, self._duty_q16[dof])
        else:
            if backward != self._driven[dof]:
                self._driven[dof] = backward
                board.drive(other, backward)
            board.bridge_write(pin, self._duty_q16[dof])

    def quiet(self):
        """Drive all PWM pins low, now; the direction does not matter then."""
        self._board.quiet()
        self._attached = 0
