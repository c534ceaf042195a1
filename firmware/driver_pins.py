"""Servos on the board's own PWM pins.

Setting: the pin. The period is that of the DOF's turn among the motor ticks (`turns * motor_period_us`), and each period
begins 1 ms after such a tick: the tick has written the new pulse width by then, and the hardware takes it over as the period
begins. So no pulse is ever cut or doubled, and all pulses are one constant time behind their tick.
"""

from micropython import const

from shared.formats import DOFS_MAX, DRIVER_PINS, NO_PIN, SETTINGS_MAX

_AFTER_TICK_US = const(1000)


class PinsDriver:
    """All servos that hang on the board's pins."""

    in_tick = True
    pins = (0,)
    device_pins = ()

    def __init__(self, board):
        self._board = board
        self._tables = None
        self._pin = bytearray([NO_PIN] * DOFS_MAX)  # of the attached DOFs
        self._other = bytearray([NO_PIN] * DOFS_MAX)  # the same while tables change

    def pwm(self, settings, place):
        """Return the numbers of the settings that are PWM pins."""
        return self.pins

    def check_device(self, settings, count):
        """Pins need no device."""
        return 0

    def check_output(self, tables, dof, settings, count):
        """Return None: `Drivers` looks at the pin. A missing or surplus setting is a bad one."""
        return None if count == 1 else min(count, 1)

    def period_us(self, tables, dof):
        """Return the time from pulse to pulse."""
        return tables.turns[dof] * tables.motor_period_us

    def load(self, tables):
        """Keep the pulses of pins that have the same period in the new tables; all others fall silent."""
        kept = 0
        before = self._pin
        after = self._other
        for dof in range(DOFS_MAX):
            after[dof] = NO_PIN
            if dof < tables.dofs and tables.driver[dof] == DRIVER_PINS:
                pin = tables.settings[dof * SETTINGS_MAX]
                old = self._dof_of(pin)
                if old is not None and self.period_us(tables, dof) == self.period_us(self._tables, old):
                    before[old] = NO_PIN
                    after[dof] = pin
                    kept |= 1 << dof
        for dof in range(DOFS_MAX):
            if before[dof] != NO_PIN:
                self._board.pin_low(before[dof])
        self._pin = after
        self._other = before
        self._tables = tables
        return kept

    def _dof_of(self, pin):
        """Return the attached DOF that has a pin, or None."""
        for dof in range(DOFS_MAX):
            if self._pin[dof] == pin:
                return dof
        return None

    def attach(self, dof, until_us):
        """Give the DOF's pin to its PWM slice, which begins a period 1 ms after the DOF's next turn."""
        tables = self._tables
        pin = tables.settings[dof * SETTINGS_MAX]
        self._board.servo_attach(pin, self.period_us(tables, dof), until_us + _AFTER_TICK_US)
        self._pin[dof] = pin

    def release(self, dof):
        """Drive the DOF's pin low."""
        pin = self._pin[dof]
        if pin != NO_PIN:
            self._pin[dof] = NO_PIN
            self._board.pin_low(pin)

    def write(self, level_q24, pulse_q18us, due):
        """Set the pulse widths of the attached DOFs in `due`."""
        self._board.servo_write(DOFS_MAX, self._pin, due, pulse_q18us)

    def quiet(self):
        """Drive all pins low, now."""
        self._board.quiet()
        for dof in range(DOFS_MAX):
            self._pin[dof] = NO_PIN
