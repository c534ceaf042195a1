"""The drivers of outputs, and what concerns them all: which pins are taken, and which DOF has which driver.

A new driver is a file of its own (see `firmware/driver.py`), a code in `shared/formats.py` and an entry in `_KINDS`.
"""

from firmware.driver_bridge import BridgeDriver
from firmware.driver_pca9685 import Pca9685Driver
from firmware.driver_pins import PinsDriver
from shared.formats import (
    DEVICE_SETTINGS_MAX,
    DEVICES_MAX,
    DOFS_MAX,
    NO_DRIVER,
    SETTINGS_MAX,
)

_KINDS = (PinsDriver, Pca9685Driver, BridgeDriver)  # in the order of their codes


class Drivers:
    """All drivers of a board, and which of them serves which DOF. `flushes` tells that there are outputs that `flush` writes."""

    def __init__(self, board):
        self._board = board
        self._drivers = [kind(board) for kind in _KINDS]
        self._writing = self._next_writing = tuple(self._drivers)  # those that write in the tick and have outputs
        self.flushes = self._next_flushes = False
        self._later = [driver for driver in self._drivers if not driver.in_tick]
        self._driver = bytearray([NO_DRIVER] * DOFS_MAX)

    def check_device(self, code, settings, count):
        """Return None if `count` settings suit a device of this driver, else the number of the bad one.

        Whether its pins are free turns out when an output uses it.
        """
        if code >= len(_KINDS):
            return 0
        return self._drivers[code].check_device(settings, count)

    def device_uses(self, code, settings, pin):
        """Return the number of the setting of a device that is this pin, or None."""
        for number in self._drivers[code].device_pins:
            if settings[number] == pin:
                return number
        return None

    def check_output(self, code, tables, dof, settings, count):
        """Return None if `count` settings suit an output of a DOF, else the number of the bad one.

        `tables` holds the robot, all devices, this DOF's `turns` and the outputs that are already accepted: pins may be
        used once, outputs of one PWM slice must have one period.
        """
        if code >= len(_KINDS):
            return 0
        driver = self._drivers[code]
        bad = driver.check_output(tables, dof, settings, count)
        if bad is not None:
            return bad
        for number in driver.pins:
            if not self._board.is_output(settings[number]) or self._taken(tables, dof, settings[number]):
                return number
            for before in driver.pins:
                if before < number and settings[before] == settings[number]:
                    return number
        mine = driver.pwm(settings, 0)
        for place, number in enumerate(mine):
            if self._clashes(tables, dof, settings[number], driver.period_us(tables, dof)):
                return number
            for before in mine[:place]:
                if self._board.clash(settings[before], settings[number]):
                    return number
        return None

    def uses(self, tables, pin):
        """Return whether an output or a device of `tables` uses a pin: it can be no input then."""
        for dof in range(tables.dofs):
            if self._output_uses(tables, dof, pin):
                return True
        return self._device_uses(tables, pin)

    def _taken(self, tables, dof, pin):
        """Return whether a pin has another use than in the output of this DOF."""
        if pin == tables.kill_pin or self._device_uses(tables, pin):
            return True
        for other in range(tables.dofs):
            if tables.feedback_pin[other] == pin or (other != dof and self._output_uses(tables, other, pin)):
                return True
        return False

    def _output_uses(self, tables, dof, pin):
        code = tables.driver[dof]
        if code == NO_DRIVER:
            return False
        for number in self._drivers[code].pins:
            if tables.settings[dof * SETTINGS_MAX + number] == pin:
                return True
        return False

    def _device_uses(self, tables, pin):
        for device in range(DEVICES_MAX):
            code = tables.device_driver[device]
            if code != NO_DRIVER:
                for number in self._drivers[code].device_pins:
                    if tables.device_settings[device * DEVICE_SETTINGS_MAX + number] == pin:
                        return True
        return False

    def _clashes(self, tables, dof, pin, period_us):
        """Return whether the PWM channel of a pin is taken by another DOF, or its slice has another period."""
        for other in range(tables.dofs):
            code = tables.driver[other]
            if other == dof or code == NO_DRIVER:
                continue
            driver = self._drivers[code]
            for number in driver.pwm(tables.settings, other * SETTINGS_MAX):
                used = tables.settings[other * SETTINGS_MAX + number]
                if self._board.clash(pin, used):
                    return True
                if self._board.same_slice(pin, used) and driver.period_us(tables, other) != period_us:
                    return True
        return False

    def prepare(self, tables):
        """Allocate what `load` needs for these tables."""
        used = {tables.driver[dof] for dof in range(tables.dofs)}
        self._next_writing = tuple(driver for code, driver in enumerate(self._drivers) if driver.in_tick and code in used)
        self._next_flushes = any(driver in self._later for code, driver in enumerate(self._drivers) if code in used)
        for driver in self._drivers:
            driver.prepare(tables)

    def load(self, tables):
        """Play the prepared tables: outputs that are gone fall silent. Returns the DOFs whose output goes on as it was, as bits.

        To be called with the tick kept away; allocates nothing.
        """
        kept = 0
        for driver in self._drivers:
            kept |= driver.load(tables)
        for dof in range(DOFS_MAX):
            self._driver[dof] = tables.driver[dof] if dof < tables.dofs else NO_DRIVER
        self._writing = self._next_writing
        self.flushes = self._next_flushes
        return kept

    def attach(self, dof, until_us):
        """Let a DOF's output have pulses. `until_us`: time until the next tick in which this DOF is due."""
        code = self._driver[dof]
        if code != NO_DRIVER:
            self._drivers[code].attach(dof, until_us)

    def release(self, dof):
        """Take the pulses of a DOF's output away."""
        code = self._driver[dof]
        if code != NO_DRIVER:
            self._drivers[code].release(dof)

    def write(self, level_q24, pulse_q18us, due):
        """In the tick: hand the DOFs whose bit is set in `due` to the drivers that write at once.

        `level_q24` is the calibrated level, 0x800000 standing still, `pulse_q18us` the pulse width, both by DOF.
        """
        for driver in self._writing:
            driver.write(level_q24, pulse_q18us, due)

    def flush(self, level_q24, pulse_q18us, due):
        """In the main loop, as soon as possible after a tick: the same for the other drivers."""
        for driver in self._later:
            driver.flush(level_q24, pulse_q18us, due)

    def quiet(self):
        """Take all pulses away, now."""
        for driver in self._drivers:
            driver.quiet()

    def attend(self, now_us):
        """In the main loop, all the time: start devices, find those that have come back, send what waits."""
        for driver in self._drivers:
            driver.attend(now_us)

    def bus_errors(self):
        """Return how many transfers have failed since the start."""
        errors = 0
        for driver in self._drivers:
            errors += driver.bus_errors()
        return errors

    def bus_gone(self):
        """Return which devices do not answer, one bit for each."""
        gone = 0
        for driver in self._drivers:
            gone |= driver.bus_gone()
        return gone
