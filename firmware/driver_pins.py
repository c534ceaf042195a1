"""Servos on the board's own PWM pins.

Setting: the pin. The period is that of the DOF's turn among the motor ticks (`turns * motor_period_us`), and each period
begins 2.2 ms after such a tick: the tick has written the new pulse width by then, and the hardware takes it over as the period
begins. So no pulse is ever cut or doubled, and all pulses are one constant time behind their tick.
"""

from micropython import const

from firmware.driver import Driver
from firmware.tables import halves
from shared.formats import DOFS_MAX, DRIVER_PINS, NO_PIN, SETTINGS_MAX

_AFTER_TICK_US = const(2200)  # a tick takes up to 1.6 ms, and one of 333 Hz ends after 3


class PinsDriver(Driver):
    """All servos that hang on the board's pins."""

    pins = (0,)

    def __init__(self, board):
        self._board = board
        self._attached = 0  # bits of DOFs
        self._pin = bytearray([NO_PIN] * DOFS_MAX)
        self._period_us = halves(DOFS_MAX)
        self._pin_before = bytearray(DOFS_MAX)
        self._period_before_us = halves(DOFS_MAX)

    def pwm(self, settings, place):
        """Return the numbers of the settings that are PWM pins."""
        return self.pins

    def check_output(self, tables, dof, settings, count):
        """Return None: `Drivers` looks at the pin. A missing or surplus setting is a bad one."""
        return None if count == 1 else min(count, 1)

    def load(self, tables):
        """Keep the pulses of pins that have the same period in the new tables; all others fall silent."""
        pins = self._pin
        before = self._pin_before
        period_before_us = self._period_before_us
        pulsing = self._attached
        for dof in range(DOFS_MAX):
            before[dof] = pins[dof]
            period_before_us[dof] = self._period_us[dof]
            pins[dof] = NO_PIN
        kept = 0
        for dof in range(tables.dofs):
            if tables.driver[dof] != DRIVER_PINS:
                continue
            pin = pins[dof] = tables.settings[dof * SETTINGS_MAX]
            period_us = self._period_us[dof] = self.period_us(tables, dof)
            for was in range(DOFS_MAX):
                if pulsing >> was & 1 and before[was] == pin and period_before_us[was] == period_us:
                    pulsing &= ~(1 << was)
                    kept |= 1 << dof
        for was in range(DOFS_MAX):
            if pulsing >> was & 1:
                self._board.pin_low(before[was])
        self._attached = kept
        return kept

    def attach(self, dof, until_us):
        """Give the DOF's pin to its PWM slice, which begins a period 2.2 ms after the DOF's next turn."""
        if self._attached >> dof & 1:
            return
        self._board.servo_attach(self._pin[dof], self._period_us[dof], until_us + _AFTER_TICK_US)
        self._attached |= 1 << dof

    def release(self, dof):
        """Let the DOF's pin have no pulse any more; one that is under way is given whole."""
        if self._attached >> dof & 1:
            self._attached &= ~(1 << dof)
            self._board.servo_end(self._pin[dof])

    def write(self, level_q24, pulse_q18us, due):
        """Set the pulse widths of the attached DOFs in `due`."""
        self._board.servo_write(DOFS_MAX, self._pin, due & self._attached, pulse_q18us)

    def quiet(self):
        """Drive all pins low, now."""
        self._board.quiet()
        self._attached = 0
