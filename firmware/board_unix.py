"""The board on a PC: MicroPython's unix port in virtual time, for tests, renderings and trying things out.

Virtual time advances only when the host says so. Each of the host's commands is a stretch of time together with what
arrives in it; the board runs through it, skipping all waiting, tells what it sent and did, and stops at its end.
Computing takes no time, unless the host says that it does. All offsets count from the beginning of the stretch.

What falls on one microsecond happens in this order: the motor tick, what arrives from outside, the main loop.

Commands (file 1, little-endian):  length_us u32 (at most 2^29), size u32, then `size` bytes of arrivals: offset_us u32,
kind u8, count u16, bytes, repeated:

    0  bytes of the link
    1  a pin's level from outside: pin u8, level u8 (2: nobody drives it)
    2  the level at an analogue input, of 4096 steps: pin u8, level_q12 u16
    3  an I2C device comes or goes: bus u8, address u8, present u8
    4  the main loop's next piece of work takes time: us u32

Records (file 2): kind u8, offset_us u32, count u16, bytes:

    S  bytes sent
    A  a pin is given to its PWM slice: pin u8, period_us u32, until_wrap_us u32
    P  on-times of PWM, from the next period on: pin u8, pulse_q18us u32, repeated
    L  a pin is driven, PWM or not: pin u8, level u8
    Z  a pin is let go of: pin u8
    Q  all PWM pins are driven low
    I  bytes sent to an I2C device: bus u8, address u8, bytes
    W  the watchdog resets the MCU: nothing follows
    D  the stretch is done
"""

import gc
from array import array
from struct import pack_into, unpack_from

from micropython import const

from firmware.clock import TICKS_MASK

_RECORD = const(7)
_ROOM = const(4096)
_RETURN = const(13)
_CTRL_C = const(3)
_PINS = const(30)
_KEPT = const(17)  # words: a tag, then a pose
_BRIDGE_US = const(50)
_NO_PIN = const(255)
_NEVER = const(-1)
_UNDRIVEN = const(2)
_EIO = const(5)
_FLOATING = const(0)
_PULLED_UP = const(1)
_LOW = const(2)
_HIGH = const(3)
_PWM = const(4)


class Board:
    """A PC that stands in for a Pico, with the same pins. `commands` and `records` are binary files.

    `kept` names a file that stands in for the RAM that a reset leaves as it is, `resets` is how often the watchdog has
    reset the MCU since power on. It is made when the host has given the first stretch, and knows what has arrived by then.
    """

    def __init__(self, commands, records, kept=None, resets=0):
        self._commands = commands
        self._records = records
        self._header = bytearray(8)
        self._arrivals = b""
        self._next = 0  # place of the next arrival
        self._arrival_at = _NEVER  # its offset
        self._inbox = b""  # bytes of the link that have arrived, and the place of the first that is not yet read
        self._unread = 0
        self._start_us = 0  # ticks at the beginning of the stretch
        self._offset_us = 0
        self._length_us = 0
        self._out = bytearray(_ROOM)
        self._used = 0
        self._handler = None
        self._period_us = 0
        self._tick_at = _NEVER
        self._ticked = False
        self._block_us = 0
        self._timeout_us = 0
        self._bite_at = _NEVER
        self._resets = resets
        self._use = bytearray(_PINS)
        self._outside = bytearray(_UNDRIVEN for _ in range(_PINS))
        self._analog_q12 = array("H", bytes(2 * _PINS))
        self._adc_q15 = 0
        self._present = set()
        self._kept_file = kept
        self._kept = array("I", bytes(4 * _KEPT))
        self._kept_changed = False
        self._tag = 0
        self._read_kept()
        self._next_stretch()
        while self._arrival_at == 0:
            self._arrive()

    # --- time

    def ticks_us(self):
        """Return virtual time in microseconds, modulo 2^30."""
        return (self._start_us + self._offset_us) & TICKS_MASK

    def wait(self, longest_us):
        """Let virtual time pass until a byte has arrived or a motor tick has run, at most `longest_us`.

        If the host has asked for it, the work that the main loop does then has taken its time when this returns.
        """
        if self._unread < len(self._inbox):
            return
        left_us = longest_us
        self._ticked = False
        while True:
            left_us -= self._advance(left_us)
            if left_us <= 0 or self._ticked or self._inbox:
                break
        if left_us <= 0 and self._block_us:
            left_us = self._block_us
            self._block_us = 0
            while left_us:
                left_us -= self._advance(left_us)

    def start_ticks(self, period_us, handler):
        """Call `handler` each `period_us` from now on, the first time in one period.

        If ticks are under way, the new period counts from the last one, and a tick that it would have had is left out.
        """
        if self._tick_at < 0:
            last_us = self._offset_us
        else:
            last_us = self._tick_at - self._period_us
        self._tick_at = last_us + ((self._offset_us - last_us) // period_us + 1) * period_us
        self._period_us = period_us
        self._handler = handler

    def stop_ticks(self):
        """Call the handler no more."""
        self._tick_at = _NEVER
        self._handler = None

    def tick_due_us(self):
        """Return the instant of the next tick, as `ticks_us` counts."""
        return (self._start_us + self._tick_at) & TICKS_MASK

    def lock(self):
        """Keep ticks away: here they run only in `wait`."""
        return 0

    def unlock(self, state):
        """Let ticks run again; `state` is what `lock` returned."""

    # --- the link

    def receive(self, buffer):
        """Read what has arrived into `buffer`, at most its length; return the number of bytes. Never waits.

        `0D 03` ends a read: if it calls for the REPL, what follows is meant for that.
        """
        count = 0
        room = len(buffer)
        inbox = self._inbox
        at = self._unread
        while count < room and at < len(inbox):
            byte = inbox[at]
            buffer[count] = byte
            count += 1
            at += 1
            if byte == _CTRL_C and (count == 1 or buffer[count - 2] == _RETURN):
                break
        if at == len(inbox):
            self._inbox = b""
            at = 0
        self._unread = at
        return count

    def send(self, buffer, length):
        """Send the first `length` bytes of `buffer`."""
        at = self._record(b"S", length)
        out = self._out
        for i in range(length):
            out[at + i] = buffer[i]

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
        self._adc_q15 = self._analog_q12[pin] << 3

    def adc_read(self):
        """Return what was measured, 32768 being the supply."""
        return self._adc_q15

    def i2c(self, sda, scl, baud_hz):
        """Return the I2C bus at two pins."""
        return _Bus(self, (sda >> 1) & 1)

    # --- the watchdog, and what a reset leaves

    def watchdog(self, timeout_ms):
        """Reset the MCU if `feed` is not called for so long."""
        self._timeout_us = timeout_ms * 1000
        self.feed()

    def feed(self):
        """Tell the watchdog that all is well."""
        if self._timeout_us:
            self._bite_at = self._offset_us + self._timeout_us

    def watchdog_off(self):
        """Let the watchdog sleep."""
        self._timeout_us = 0
        self._bite_at = _NEVER

    def watchdog_resets(self):
        """Return how often the watchdog has reset the MCU since power on."""
        return self._resets

    def keep_pose(self, dofs, position_q24):
        """Keep a pose where a reset leaves it, to Q15, under the tag that `kept_pose` was last called with."""
        kept = self._kept
        kept[0] = self._tag
        for d in range(dofs):
            value_q15 = (position_q24[d] + 256) >> 9
            kept[d + 1] = value_q15 | (value_q15 ^ 0xFFFF) << 16
        self._kept_changed = True

    def kept_pose(self, dofs, position_q24, tag):
        """Read the pose that was kept under a tag; return whether there was one. From now on poses are kept under it."""
        self._tag = tag
        kept = self._kept
        if kept[0] != tag:
            return False
        for d in range(dofs):
            if (kept[d + 1] ^ kept[d + 1] >> 16) & 0xFFFF != 0xFFFF:
                return False
        for d in range(dofs):
            position_q24[d] = (kept[d + 1] & 0xFFFF) << 9
        return True

    def heap_free(self):
        """Return the free bytes of the heap."""
        return gc.mem_free()

    def close(self):
        """Leave no pulses behind, no ticks and no watchdog."""
        self.stop_ticks()
        self.watchdog_off()
        self.quiet()

    # --- virtual time

    def _advance(self, longest_us):
        """Let time pass until something happens, at most `longest_us`; return how long it was."""
        to_us = self._offset_us + max(longest_us, 0)
        if 0 <= self._tick_at < to_us:
            to_us = self._tick_at
        if 0 <= self._arrival_at < to_us:
            to_us = self._arrival_at
        if 0 <= self._bite_at < to_us:
            to_us = self._bite_at
        if to_us > self._length_us:
            passed_us = self._length_us - self._offset_us
            self._next_stretch()
            return passed_us
        passed_us = to_us - self._offset_us
        self._offset_us = to_us
        if self._bite_at == to_us:
            self._bite()
        if self._tick_at == to_us:
            self._tick_at += self._period_us
            self._ticked = True
            self._handler()
        while self._arrival_at == to_us:
            self._arrive()
        return passed_us

    def _arrive(self):
        """Take the next arrival."""
        kind, count = unpack_from("<BH", self._arrivals, self._next + 4)
        start = self._next + _RECORD
        self._next = start + count
        data = self._arrivals[start : self._next]
        self._find_arrival()
        if kind == 0:
            self._inbox = self._inbox[self._unread :] + data
            self._unread = 0
        elif kind == 1:
            self._outside[data[0]] = data[1]
        elif kind == 2:
            self._analog_q12[data[0]] = data[1] | data[2] << 8
        elif kind == 3:
            device = data[0] << 7 | data[1]
            if data[2]:
                self._present.add(device)
            else:
                self._present.discard(device)
        else:
            self._block_us += unpack_from("<I", data)[0]

    def _find_arrival(self):
        more = self._next < len(self._arrivals)
        self._arrival_at = unpack_from("<I", self._arrivals, self._next)[0] if more else _NEVER

    def _next_stretch(self):
        """Tell that this stretch is done, and wait for the host to give the next one."""
        length_us = self._length_us
        self._offset_us = length_us
        self._record(b"D", 0)
        self._write_kept()
        self._flush()
        if self._commands.readinto(self._header) != 8:
            raise SystemExit  # the host has gone
        self._start_us = (self._start_us + length_us) & TICKS_MASK
        self._offset_us = 0
        if self._tick_at >= 0:
            self._tick_at -= length_us
        if self._bite_at >= 0:
            self._bite_at -= length_us
        self._length_us, size = unpack_from("<II", self._header)
        self._arrivals = self._commands.read(size)
        self._next = 0
        self._find_arrival()

    def _bite(self):
        """Be reset: tell the host, which puts an end to this process and starts another."""
        self._record(b"W", 0)
        self._write_kept()
        self._flush()
        self._commands.read()
        raise SystemExit

    def _record(self, kind, length):
        """Begin a record; return the place of its bytes."""
        if self._used + _RECORD + length > _ROOM:
            self._flush()
        at = self._used
        self._out[at] = kind[0]
        pack_into("<IH", self._out, at + 1, self._offset_us, length)
        self._used = at + _RECORD + length
        return at + _RECORD

    def _flush(self):
        self._records.write(self._out, self._used)
        self._used = 0

    def _read_kept(self):
        if self._kept_file:
            try:
                with open(self._kept_file, "rb") as file:
                    file.readinto(self._kept)
            except OSError:
                pass  # nothing was kept

    def _write_kept(self):
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
