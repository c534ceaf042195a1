"""Servos on PCA9685 chips: 16 channels of PWM with 12 bits, on an I2C bus.

Settings of a device: `sda, scl, address, oe, baud_khz, clock_khz`; of an output: `device, channel`. The period is that
of the DOF's turn among the motor ticks, to what the chip's divider can do; a pulse is a multiple of its 4096th part (4.9 us at
50 Hz), which is all that the chip resolves.

I2C takes its time and may fail, so a chip is set up and written from the main loop (`flush`), soon after the tick: all
channels in use in one burst, which takes effect at its STOP, for each channel at the end of its period (data sheet, 7.3.3).
A transfer that fails is repeated at once, twice; then the device counts as gone. It is asked for again every 500 ms, and set up
anew when it answers: its channels start with the present values. A stuck bus holds the main loop up for as long as the
longest burst takes, and again with every question.

The pin OE takes the pulses away without the bus: it is high (off) from the start and in `quiet`, and becomes low only when a
channel is attached and the chip has been written since. Boards that stand in a row may share the pin: then all of them have to
have been written.
"""

import micropython
from micropython import const

from firmware.clock import ticks_diff
from firmware.driver import Driver
from shared.formats import (
    DEVICE_SETTINGS_MAX,
    DEVICES_MAX,
    DRIVER_PCA9685,
    NO_PIN,
    SETTINGS_MAX,
)

_CHANNELS = const(16)
_ADDRESS_FIRST = const(0x40)
_ADDRESS_LAST = const(0x7F)
_ALL_CALL = const(0x70)
_BAUD_MIN_KHZ = const(100)
_BAUD_MAX_KHZ = const(1000)
_CLOCK_MIN_KHZ = const(20000)
_CLOCK_MAX_KHZ = const(30000)
_PRESCALE_MIN = const(3)
_PRESCALE_MAX = const(255)
_RETRIES = const(2)
_PROBE_US = const(500000)
_WAKE_US = const(1000)  # the oscillator needs 500
_NO_DOF = const(255)
_FIRST_REGISTER = const(6)  # LED0_ON_L
_FULL_OFF = const(0x10)  # in LEDn_OFF_H

_SLEEP = b"\x00\x30"  # MODE1: asleep, registers count up, no answer to All Call
_TOTEM_POLE = b"\x01\x04"  # MODE2: outputs change at STOP, are driven both ways, and are low while OE is high
_PRESCALE = const(0xFE)  # can be set while asleep
_ALL_OFF = b"\xfa\x00\x00\x00\x10"
_WAKE = b"\x00\x20"
_RESTART = b"\x00\xa0"

# States of a chip. From _RESET to _WAKING a state is the number of the transfer that comes next in setting it up.
_UNUSED = const(0)
_RESET = const(1)
_WAKING = const(6)
_RUNNING = const(7)
_GONE = const(8)

@micropython.viper
def _fill(count: int, dof: ptr8, attached: int, due: int, pulse_q18us: ptr32, scale_q21: int, registers: ptr8):
    """Write the registers of the channels that have a DOF: off after its pulse if it is due, for good if it is not attached.

    `dof[c]` is a channel's DOF, above 15 for none; its registers follow each other from byte `1 + 4 * c` on. `scale_q21`
    is the chip's counts in a microsecond. Bits: a pulse of 3000 us has 17 bits as Q5, of which the upper 9 and a scale
    below 1.42 give less than 2^31, the lower 8 less than 2^30.
    """
    c = 0
    while c < count:
        d = int(dof[c])
        off = 3 + (c << 2)
        if d < 16:
            if ((attached >> d) & 1) == 0:
                registers[off] = 0
                registers[off + 1] = 0x10
            elif (due >> d) & 1:
                pulse_q5us = int(pulse_q18us[d]) >> 13
                counts_q18 = (pulse_q5us >> 8) * scale_q21 + (((pulse_q5us & 255) * scale_q21) >> 8)
                counts = (counts_q18 + 0x20000) >> 18
                if counts > 4095:
                    counts = 4095
                registers[off] = counts & 255
                registers[off + 1] = counts >> 8
        c += 1


def prescale(clock_khz, period_us):
    """Return the divider's register value for a period; the chip takes 3 to 255."""
    return (clock_khz * period_us + 2048000) // 4096000 - 1


def _scale_q21(clock_khz, divider):
    """Return how many counts a microsecond has. In two steps, as what has more than 30 bits would need memory."""
    clock_q14 = clock_khz << 14
    steps = 1000 * (divider + 1)
    return (clock_q14 // steps << 7) + (clock_q14 % steps << 7) // steps


class _Chip:
    """One PCA9685."""

    def __init__(self, board):
        self.state = _UNUSED
        self.oe = NO_PIN
        self.mask = 0  # the DOFs on this chip, as bits
        self.attached = 0  # those of them that have pulses
        self.written = 0  # those of them that the chip has been told about
        self.fresh = False  # whether it has been written since all were switched off
        self.errors = 0
        self._board = board
        self._settings = [0] * DEVICE_SETTINGS_MAX
        self._bus = None
        self._attempts = 1 + _RETRIES
        self._since_us = 0
        self._waits = False  # a channel has to be switched off
        self._quiets = 0
        self._scale_q21 = 0
        self._divider = bytearray((_PRESCALE, 0))
        self._steps = (_SLEEP, _TOTEM_POLE, self._divider, _ALL_OFF, _WAKE, _RESTART)
        self._dof = bytearray([_NO_DOF] * _CHANNELS)
        self._dof_before = bytearray([_NO_DOF] * _CHANNELS)
        self._registers = bytearray(1 + 4 * _CHANNELS)
        self._burst = self._next_burst = memoryview(self._registers)
        self._next_first = 0

    def prepare(self, tables, device):
        """Note which of the registers are to be sent for a device's channels in these tables."""
        first = _CHANNELS
        last = -1
        for dof in range(tables.dofs):
            at = dof * SETTINGS_MAX
            if tables.driver[dof] == DRIVER_PCA9685 and tables.settings[at] == device:
                channel = tables.settings[at + 1]
                first = min(first, channel)
                last = max(last, channel)
        self._next_first = first
        self._next_burst = memoryview(self._registers)[4 * first : 5 + 4 * last]

    def load(self, tables, device):
        """Take over a device and its channels; return the DOFs whose channel goes on, as bits."""
        used = tables.device_driver[device] == DRIVER_PCA9685
        if self.state == _UNUSED and not used:
            self.oe = NO_PIN
            return 0
        settings = self._settings
        same = used and self.state != _UNUSED
        for number in range(DEVICE_SETTINGS_MAX):
            value = tables.device_settings[device * DEVICE_SETTINGS_MAX + number]
            same = same and settings[number] == value
            settings[number] = value
        self.oe = settings[3] if used else NO_PIN
        period_us = self._take_channels(tables, device)
        if used and period_us:
            wanted = prescale(settings[5], period_us)
            same = same and wanted == self._divider[1]
            self._divider[1] = wanted
            self._scale_q21 = _scale_q21(settings[5], wanted)
        self.written = self.attached
        if not same or not period_us:
            self.attached = self.written = 0
            self.fresh = False
            self._attempts = 1 + _RETRIES
            self.state = _RESET if used and period_us else _UNUSED
        self._waits = True
        return self.attached

    def _take_channels(self, tables, device):
        """Look up which DOF has which channel; return the period, 0 if no channel is in use."""
        before = self._dof_before
        for channel in range(_CHANNELS):
            before[channel] = self._dof[channel]
            self._dof[channel] = _NO_DOF
        attached_before = self.attached
        self.attached = self.mask = period_us = 0
        for dof in range(tables.dofs):
            at = dof * SETTINGS_MAX
            if tables.driver[dof] == DRIVER_PCA9685 and tables.settings[at] == device:
                self._dof[tables.settings[at + 1]] = dof
                self.mask |= 1 << dof
                period_us = tables.turns[dof] * tables.motor_period_us
        registers = self._registers
        for channel in range(_CHANNELS):
            old = before[channel]
            if old != _NO_DOF and attached_before >> old & 1 and self._dof[channel] != _NO_DOF:
                self.attached |= 1 << self._dof[channel]
            else:
                at = 1 + 4 * channel
                registers[at] = registers[at + 1] = registers[at + 2] = 0
                registers[at + 3] = _FULL_OFF
        if period_us:
            # Nothing is sent of the channels before the first; the last byte of theirs takes the burst's register address.
            registers[4 * self._next_first] = _FIRST_REGISTER + 4 * self._next_first
            self._burst = self._next_burst
        return period_us

    def attach(self, dof):
        """Let a DOF's channel have pulses from the next write in which it is due."""
        self.attached |= 1 << dof

    def release(self, dof):
        """Take them away with the next transfer."""
        self.attached &= ~(1 << dof)
        self.written &= ~(1 << dof)
        if self.attached == 0:
            self.fresh = False
        self._waits = True

    def quiet(self):
        """Take all pulses away; OE has done so already."""
        self.attached = self.written = 0
        self.fresh = False
        self._waits = True
        self._quiets = (self._quiets + 1) & 0xFFFF

    def flush(self, pulse_q18us, due):
        """Note new pulse widths, and send them if there are any and the chip is ready."""
        due &= self.attached
        if due or self._waits:
            quiets = self._quiets
            waits = self._waits
            self._waits = False
            attached = self.attached
            _fill(_CHANNELS, self._dof, attached, due, pulse_q18us, self._scale_q21, self._registers)
            if self.state != _RUNNING:
                self._waits = self._waits or waits
            elif self._transfer(self._burst):
                lock = self._board.lock()
                if quiets == self._quiets:
                    self.written = attached & self.attached
                    self.fresh = True
                self._board.unlock(lock)

    def attend(self, now_us):
        """Set the chip up, ask for it again if it is gone, or send what waits."""
        if self.state == _GONE and ticks_diff(now_us, self._since_us) >= _PROBE_US:
            self._attempts = 1
            self.state = _RESET
        if self.state == _RESET:
            settings = self._settings
            self._address = settings[2]
            self._bus = self._board.i2c(settings[0], settings[1], 1000 * settings[4])
            self._set_up(_WAKING)
        elif self.state == _WAKING and ticks_diff(now_us, self._since_us) >= _WAKE_US:
            self._set_up(_RUNNING)
        if self.state == _RUNNING and self._waits:
            self.flush(self._registers, 0)

    def _set_up(self, until):
        """Make the transfers of setting up that come before a state; stop at the first that fails."""
        while self.state < until:
            if not self._transfer(self._steps[self.state - 1]):
                return
            self._attempts = 1 + _RETRIES
            self.state += 1
        self._since_us = self._board.ticks_us()
        self._waits = True

    def gone(self):
        """Return whether the chip does not answer."""
        return self.state == _GONE or self._attempts == 1

    def _transfer(self, data):
        """Send bytes; return whether they have arrived. If they have not, the chip is gone."""
        for _ in range(self._attempts):
            try:
                if self._bus is not None and self._bus.writeto(self._address, data) == len(data):
                    return True
            except OSError:
                pass
            self.errors += 1
        self._since_us = self._board.ticks_us()
        self.state = _GONE
        self._waits = True
        return False


class Pca9685Driver(Driver):
    """All servos on PCA9685 chips."""

    in_tick = False
    device_pins = (0, 1, 3)

    def __init__(self, board):
        self._board = board
        self._chips = [_Chip(board) for _ in range(DEVICES_MAX)]
        self._enabled = bytearray(DEVICES_MAX)  # whether OE is low
        self._used = False  # whether there is a chip

    def check_device(self, settings, count):
        """Return None, or the number of the setting that is missing, surplus or out of range."""
        if count != 6:
            return min(count, 6)
        sda, scl, address, oe, baud_khz, clock_khz = [settings[number] for number in range(6)]
        board = self._board
        if not board.is_output(sda) or sda & 1:
            return 0
        if not board.is_output(scl) or not scl & 1 or (sda >> 1) & 1 != (scl >> 1) & 1:
            return 1
        if not _ADDRESS_FIRST <= address <= _ADDRESS_LAST or address == _ALL_CALL:
            return 2
        if not board.is_output(oe) or oe == sda or oe == scl:
            return 3
        if not _BAUD_MIN_KHZ <= baud_khz <= _BAUD_MAX_KHZ:
            return 4
        if not _CLOCK_MIN_KHZ <= clock_khz <= _CLOCK_MAX_KHZ:
            return 5
        return None

    def check_output(self, tables, dof, settings, count):
        """Return None, or the number of the bad setting: `device` also if its pins are not its own, or its period another."""
        if count != 2:
            return min(count, 2)
        device = settings[0]
        if device >= DEVICES_MAX or tables.device_driver[device] != DRIVER_PCA9685:
            return 0
        if settings[1] >= _CHANNELS:
            return 1
        clock_khz = tables.device_settings[device * DEVICE_SETTINGS_MAX + 5]
        if not _PRESCALE_MIN <= prescale(clock_khz, self.period_us(tables, dof)) <= _PRESCALE_MAX:
            return 0
        for other in range(tables.dofs):
            at = other * SETTINGS_MAX
            if other != dof and tables.driver[other] == DRIVER_PCA9685 and tables.settings[at] == device:
                if tables.settings[at + 1] == settings[1]:
                    return 1
                if tables.turns[other] != tables.turns[dof]:
                    return 0
        for other in range(DEVICES_MAX):
            if other != device and tables.device_driver[other] == DRIVER_PCA9685:
                if not self._can_share(tables, device, other):
                    return 0
        return None

    def _can_share(self, tables, device, other):
        """Return whether two chips may be there at once: on one bus with two addresses, or on two buses."""
        sda, scl, address, oe, baud_khz = [tables.device_settings[device * DEVICE_SETTINGS_MAX + i] for i in range(5)]
        at = other * DEVICE_SETTINGS_MAX
        its_sda, its_scl, its_address, its_oe, its_baud_khz = [tables.device_settings[at + i] for i in range(5)]
        if oe in (its_sda, its_scl) or its_oe in (sda, scl):
            return False
        if sda >> 1 & 1 != its_sda >> 1 & 1:  # the I2C controller
            return True
        return sda == its_sda and scl == its_scl and baud_khz == its_baud_khz and address != its_address

    def prepare(self, tables):
        """Note what is to be sent to each chip."""
        for device in range(DEVICES_MAX):
            if tables.device_driver[device] == DRIVER_PCA9685:
                self._chips[device].prepare(tables, device)

    def load(self, tables):
        """Keep the pulses of channels that stay, on chips that stay as they are."""
        kept = 0
        used = False
        for device in range(DEVICES_MAX):
            used = used or tables.device_driver[device] == DRIVER_PCA9685
        if not used and not self._used:
            return 0
        self._used = used
        for device in range(DEVICES_MAX):
            chip = self._chips[device]
            old_oe = chip.oe
            kept |= chip.load(tables, device)
            if chip.oe != old_oe:
                self._enabled[device] = 0
                if old_oe != NO_PIN:
                    self._board.drive(old_oe, 1)
                if chip.oe != NO_PIN:
                    self._board.drive(chip.oe, 1)
        self._switch()
        return kept

    def attach(self, dof, until_us):
        """Let a channel have pulses from the next write on."""
        for chip in self._chips:
            if chip.mask >> dof & 1:
                chip.attach(dof)

    def release(self, dof):
        """Take the pulses of a channel away: at once if it is the last, else from the main loop."""
        for chip in self._chips:
            if chip.attached >> dof & 1:
                chip.release(dof)
                if chip.attached == 0:
                    self._switch()

    def flush(self, level_q24, pulse_q18us, due):
        """Send the pulse widths of the attached DOFs in `due`, chip by chip."""
        if not self._used:
            return
        for chip in self._chips:
            if chip.mask:
                chip.flush(pulse_q18us, due)
        self._enable()

    def attend(self, now_us):
        """Set chips up, find those that have come back, and switch off what has been released."""
        if not self._used:
            return
        for chip in self._chips:
            if chip.mask:
                chip.attend(now_us)
        self._enable()

    def quiet(self):
        """Take all pulses away, now: by OE, and from the chips' registers with the next `attend`."""
        if not self._used:
            return
        for device in range(DEVICES_MAX):
            chip = self._chips[device]
            if chip.oe != NO_PIN:
                self._board.drive(chip.oe, 1)
                self._enabled[device] = 0
                chip.quiet()

    def bus_errors(self):
        """Return how many transfers have failed."""
        errors = 0
        for chip in self._chips:
            errors += chip.errors
        return errors

    def bus_gone(self):
        """Return which devices do not answer, as bits."""
        gone = 0
        for device in range(DEVICES_MAX):
            if self._chips[device].gone():
                gone |= 1 << device
        return gone

    def _enable(self):
        """Switch on the outputs of chips that have been written since they were off."""
        for device in range(DEVICES_MAX):
            if self._chips[device].written and not self._enabled[device]:
                self._switch()

    def _switch(self):
        """Drive every OE to what it should be: low if one of its chips has pulses and all of them have been written."""
        lock = self._board.lock()  # a kill in the midst of it would be undone
        for device in range(DEVICES_MAX):
            oe = self._chips[device].oe
            if oe != NO_PIN:
                wanted = self._wanted(oe)
                if wanted != self._enabled[device]:
                    self._enabled[device] = wanted
                    self._board.drive(oe, 1 - wanted)
        self._board.unlock(lock)

    def _wanted(self, oe):
        written = 0
        for chip in self._chips:
            if chip.oe == oe and chip.mask:
                if not chip.fresh:
                    return 0
                written |= chip.written
        return 1 if written else 0
