"""Servos on the board's own PWM pins.

Setting: the pin. The period is that of the DOF's turn among the motor ticks (`turns * motor_period_us`), and each period
begins 1 ms after such a tick: the tick has written the new pulse width by then, and the hardware takes it over as the period
begins. So no pulse is ever cut or doubled, and all pulses are one constant time behind their tick.
"""

from micropython import const

from firmware.driver import Driver
from firmware.tables import halves
from shared.formats import DOFS_MAX, DRIVER_PINS, NO_PIN, SETTINGS_MAX

_AFTER_TICK_US = const(1000)


class PinsDriver(Driver):
    """All servos that hang on the board's pins."""

    pins = (0,)

    def __init__(self, board):
        self._board = board
        self._pin = bytearray([NO_PIN] * DOFS_MAX)  # of the outputs that there are
        self._period_us = halves(DOFS_MAX)
        self._pulsing = bytearray([NO_PIN] * DOFS_MAX)  # the pins of those that are attached
        self._spare = bytearray(DOFS_MAX)

    def pwm(self, settings, place):
        """Return the numbers of the settings that are PWM pins."""
        return self.pins

    def check_output(self, tables, dof, settings, count):
        """Return None: `Drivers` looks at the pin. A missing or surplus setting is a bad one."""
        return None if count == 1 else min(count, 1)

    def load(self, tables):
        """Keep the pulses of pins that have the same period in the new tables; all others fall silent."""
        kept = 0
        before = self._pulsing
        after = self._spare
        for dof in range(DOFS_MAX):
            after[dof] = NO_PIN
            if dof < tables.dofs and tables.driver[dof] == DRIVER_PINS:
                pin = tables.settings[dof * SETTINGS_MAX]
                period_us = self.period_us(tables, dof)
                for old in range(DOFS_MAX):
                    if before[old] == pin and self._period_us[old] == period_us:
                        before[old] = NO_PIN
                        after[dof] = pin
                        kept |= 1 << dof
        for dof in range(DOFS_MAX):
            if before[dof] != NO_PIN:
                self._board.pin_low(before[dof])
            mine = dof < tables.dofs and tables.driver[dof] == DRIVER_PINS
            self._pin[dof] = tables.settings[dof * SETTINGS_MAX] if mine else NO_PIN
            self._period_us[dof] = self.period_us(tables, dof) if mine else 0
        self._pulsing = after
        self._spare = before
        return kept

    def attach(self, dof, until_us):
        """Give the DOF's pin to its PWM slice, which begins a period 1 ms after the DOF's next turn."""
        self._board.servo_attach(self._pin[dof], self._period_us[dof], until_us + _AFTER_TICK_US)
        self._pulsing[dof] = self._pin[dof]

    def release(self, dof):
        """Drive the DOF's pin low."""
        pin = self._pulsing[dof]
        if pin != NO_PIN:
            self._pulsing[dof] = NO_PIN
            self._board.pin_low(pin)

    def write(self, level_q24, pulse_q18us, due):
        """Set the pulse widths of the attached DOFs in `due`."""
        self._board.servo_write(DOFS_MAX, self._pulsing, due, pulse_q18us)

    def quiet(self):
        """Drive all pins low, now."""
        self._board.quiet()
        for dof in range(DOFS_MAX):
            self._pulsing[dof] = NO_PIN
