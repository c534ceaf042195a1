"""The board on a PC: MicroPython's unix port in virtual time, for tests, renderings and trying things out.

It has the pins, the PWM, the analogue inputs and the I2C buses of a Pico: it tells the host what is written to them, and is
told what they read. `unix_time.py` has the rest.
"""

import gc
from array import array
from struct import pack_into

from micropython import const

from firmware.unix_time import VirtualTime

_PINS = const(30)
_KEPT = const(17)  # words: a tag, then a pose, each value beside its complement
_BRIDGE_US = const(50)
_NO_PIN = const(255)
_UNDRIVEN = const(2)
_EIO = const(5)
_PULLED_UP = const(1)  # uses of a pin; 0: it floats
_LOW = const(2)
_HIGH = const(3)
_PWM = const(4)


class Board(VirtualTime):
    """A PC that stands in for a Pico, with the same pins. `commands` and `records` are binary files.

    `kept` names a file that stands in for the RAM that a reset leaves as it is, `resets` is how often the watchdog has
    reset the MCU since power on. It is made when the host has given the first stretch, and knows what has arrived by then.
    """

    def __init__(self, commands, records, kept=None, resets=0):
        super().__init__(commands, records, resets)
        self._use = bytearray(_PINS)
        self._outside = bytearray(_UNDRIVEN for _ in range(_PINS))
        self._analog_q12 = array("H", bytes(2 * _PINS))
        self._adc_q15 = 0
        self._present = set()
        self._kept_file = kept
        self._kept = array("H", bytes(4 * _KEPT))
        self._kept_changed = False
        self._tag = 0
        self._read_kept()
        self._begin()

    # --- pins

    def is_output(self, pin):
        """Return whether a servo may hang on this pin; the pins are those of a Pico."""
        return 2 <= pin <= 22 or 26 <= pin <= 28

    def clash(self, pin, other):
        """Return whether two pins are outputs of the same PWM channel."""
        return pin & 15 == other & 15

    def same_slice(self, pin, other):
        """Return whether two pins belong to the same PWM slice and so have one period."""
        return (pin >> 1) & 7 == (other >> 1) & 7

    def input_pullup(self, pin):
        """Make a pin an input that is high if nobody drives it."""
        self._use[pin] = _PULLED_UP
        self._out[self._record(b"Z", 1)] = pin

    def level(self, pin):
        """Return the level at a pin, 0 or 1."""
        use = self._use[pin]
        if use == _LOW or use == _HIGH:
            return use & 1
        outside = self._outside[pin]
        return outside if outside != _UNDRIVEN else use & 1

    def drive(self, pin, level):
        """Make a pin an output of this level, whatever it was before."""
        self._use[pin] = _HIGH if level else _LOW
        at = self._record(b"L", 2)
        self._out[at] = pin
        self._out[at + 1] = 1 if level else 0

    def servo_attach(self, pin, period_us, until_wrap_us):
        """Give a pin to its PWM slice: periods of `period_us`, one of which ends in `until_wrap_us`. No pulse yet."""
        self._use[pin] = _PWM
        pack_into("<BII", self._out, self._record(b"A", 9), pin, period_us, until_wrap_us)

    def servo_write(self, count, pin, due, pulse_q18us):
        """Set `pulse_q18us[d]` at `pin[d]`, from its next period on, for each `d` below `count` whose bit is set in `due`."""
        length = 0
        for d in range(count):
            if due >> d & 1 and pin[d] != _NO_PIN:
                length += 5
        if length == 0:
            return
        at = self._record(b"P", length)
        out = self._out
        for d in range(count):
            if due >> d & 1 and pin[d] != _NO_PIN:
                out[at] = pin[d]
                pack_into("<I", out, at + 1, pulse_q18us[d])
                at += 5

    def servo_end(self, pin):
        """Give a pin no more pulses, from its next period on."""
        self._out[self._record(b"E", 1)] = pin

    def bridge_attach(self, pin):
        """Give a pin to its PWM slice at 20 kHz, low."""
        self.servo_attach(pin, _BRIDGE_US, _BRIDGE_US)

    def bridge_write(self, pin, duty_q16):
        """Let a pin be high for a part of each 50 us, 65536 being all of it."""
        pack_into("<BI", self._out, self._record(b"P", 5), pin, duty_q16 * (_BRIDGE_US << 2))

    def pin_low(self, pin):
        """Drive a pin low at once and take it from its PWM slice."""
        self.drive(pin, 0)

    def quiet(self):
        """Drive all PWM pins low at once."""
        for pin in range(_PINS):
            if self._use[pin] == _PWM:
                self._use[pin] = _LOW
        self._record(b"Q", 0)

    # --- analogue inputs and I2C

    def adc_start(self, pin):
        """Measure the voltage at a pin."""
        level_q12 = self._analog_q12[pin]
        self._adc_q15 = (level_q12 << 3) + ((level_q12 + 256) >> 9)

    def adc_read(self):
        """Return what was measured last, 32768 being the supply; the converter's 4095 is that."""
        return self._adc_q15

    def i2c(self, sda, scl, baud_hz):
        """Return the I2C bus at two pins."""
        return _Bus(self, (sda >> 1) & 1)

    # --- what a reset leaves

    def keep_pose(self, dofs, position_q24):
        """Keep a pose where a reset leaves it, to Q15, under the tag that `kept_pose` was last called with."""
        if self._tag == 0:  # no robot yet: what a reset has left stays
            return
        kept = self._kept
        kept[0] = self._tag & 0xFFFF
        kept[1] = self._tag >> 16
        for d in range(dofs):
            value_q15 = (position_q24[d] + 256) >> 9
            kept[2 * d + 2] = value_q15
            kept[2 * d + 3] = value_q15 ^ 0xFFFF
        self._kept_changed = True

    def kept_pose(self, dofs, position_q24, tag):
        """Read the pose that was kept under a tag; return whether there was one. From now on poses are kept under it."""
        self._tag = tag
        kept = self._kept
        if kept[0] | kept[1] << 16 != tag:
            return False
        for d in range(dofs):
            if kept[2 * d + 2] ^ kept[2 * d + 3] != 0xFFFF:
                return False
        for d in range(dofs):
            position_q24[d] = kept[2 * d + 2] << 9
        return True

    def heap_free(self):
        """Return the free bytes of the heap."""
        return gc.mem_free()

    def close(self):
        """Leave no pulses behind, no ticks and no watchdog."""
        self.stop_ticks()
        self.watchdog_off()
        self.quiet()

    def _set_input(self, kind, data):
        """Take the level at a pin, at an analogue input, or whether an I2C device is there."""
        if kind == 1:
            self._outside[data[0]] = data[1]
        elif kind == 2:
            self._analog_q12[data[0]] = data[1] | data[2] << 8
        else:
            device = data[0] << 7 | data[1]
            if data[2]:
                self._present.add(device)
            else:
                self._present.discard(device)

    def _read_kept(self):
        if self._kept_file:
            try:
                with open(self._kept_file, "rb") as file:
                    file.readinto(self._kept)
            except OSError:
                pass  # nothing was kept

    def _save(self):
        """Put the kept pose into its file."""
        if self._kept_file and self._kept_changed:
            with open(self._kept_file, "wb") as file:
                file.write(self._kept)
            self._kept_changed = False


class _Bus:
    """An I2C bus."""

    def __init__(self, board, number):
        self._board = board
        self._number = number

    def writeto(self, address, data):
        """Send bytes to a device; return their number. Raises OSError if it is not there."""
        board = self._board
        if self._number << 7 | address not in board._present:
            raise OSError(_EIO)
        length = len(data)
        at = board._record(b"I", 2 + length)
        out = board._out
        out[at] = self._number
        out[at + 1] = address
        for i in range(length):
            out[at + 2 + i] = data[i]
        return length
