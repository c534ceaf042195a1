"""The board on a PC: MicroPython's unix port in virtual time, for tests, renderings and trying things out.

Virtual time advances only when the host says so. Each of the host's commands is a stretch of time together with the
bytes that arrive in it; the board runs through it, skipping all waiting, tells what it sent and did, and stops at its
end. Computing takes no time. All offsets count from the beginning of the stretch.

Commands (file 1, little-endian):  length_us u32 (at most 2^29), size u32, then `size` bytes: offset_us u32, count u16,
bytes, repeated. Records (file 2): kind u8, offset_us u32, count u16, bytes. `S` bytes sent, `P` pulses (pin u8,
pulse_q4us u16, repeated), `Q` all pins quiet, `D` the stretch is done.
"""

import gc
from struct import pack_into, unpack_from

from micropython import const

from firmware.clock import TICKS_MASK

_RECORD = const(7)
_ROOM = const(4096)
_RETURN = const(13)
_CTRL_C = const(3)


class Board:
    """A PC that stands in for a Pico, with the same pins. `commands` and `records` are binary files."""

    def __init__(self, commands, records):
        self._commands = commands
        self._records = records
        self._header = bytearray(8)
        self._arrivals = b""
        self._next = 0  # place of the next arrival
        self._count = 0  # its bytes that are left, and their place
        self._at = 0
        self._start_us = 0  # ticks at the beginning of the stretch
        self._offset_us = 0
        self._length_us = 0
        self._out = bytearray(_ROOM)
        self._used = 0
        self._attached = bytearray(29)

    def ticks_us(self):
        """Return virtual time in microseconds, modulo 2^30."""
        return (self._start_us + self._offset_us) & TICKS_MASK

    def wait(self, longest_us):
        """Let virtual time pass until a byte arrives, at most `longest_us`."""
        end_us = self._offset_us + longest_us
        while not self._arrived():
            arrival_us = self._arrival_us()
            next_us = end_us if arrival_us < 0 or arrival_us > end_us else arrival_us
            if next_us <= self._length_us:
                self._offset_us = next_us
                if next_us == end_us:
                    return
            else:
                end_us -= self._length_us
                self._next_stretch()

    def receive(self, buffer):
        """Read what has arrived into `buffer`, at most its length; return the number of bytes. Never waits.

        `0D 03` ends a read: if it calls for the REPL, what follows is meant for that.
        """
        count = 0
        room = len(buffer)
        while count < room and self._arrived():
            byte = self._arrivals[self._at]
            buffer[count] = byte
            count += 1
            self._at += 1
            self._count -= 1
            if byte == _CTRL_C and (count == 1 or buffer[count - 2] == _RETURN):
                break
        return count

    def send(self, buffer, length):
        """Send the first `length` bytes of `buffer`."""
        at = self._record(b"S", length)
        out = self._out
        for i in range(length):
            out[at + i] = buffer[i]

    def is_output(self, pin):
        """Return whether a servo may hang on this pin; the pins are those of a Pico."""
        return 2 <= pin <= 22 or 26 <= pin <= 28

    def clash(self, pin, other):
        """Return whether two pins are outputs of the same PWM channel."""
        return pin & 15 == other & 15

    def attach(self, pin):
        """Let a pin have pulses."""
        self._attached[pin] = 1

    def pulses(self, count, pin, pulse_q4us):
        """Record the pulse widths of `count` DOFs: `pulse_q4us[d]` on `pin[d]` where that is attached."""
        length = 0
        for d in range(count):
            if pin[d] < 29 and self._attached[pin[d]]:
                length += 3
        at = self._record(b"P", length)
        for d in range(count):
            if pin[d] < 29 and self._attached[pin[d]]:
                self._out[at] = pin[d]
                self._out[at + 1] = pulse_q4us[d] & 255
                self._out[at + 2] = pulse_q4us[d] >> 8
                at += 3

    def release(self, pin):
        """Take the pulses of one pin away."""
        self._attached[pin] = 0
        self._out[self._record(b"R", 1)] = pin

    def quiet(self):
        """Take all pulses away."""
        for pin in range(29):
            self._attached[pin] = 0
        self._record(b"Q", 0)

    def heap_free(self):
        """Return the free bytes of the heap."""
        return gc.mem_free()

    def close(self):
        """Leave no pulses behind."""
        self.quiet()

    def _arrival_us(self):
        """Return the offset of the next arrival in this stretch, -1 if there is none."""
        if self._count:
            return self._offset_us
        if self._next >= len(self._arrivals):
            return -1
        return unpack_from("<I", self._arrivals, self._next)[0]

    def _arrived(self):
        """Return whether a byte can be read now."""
        while self._count == 0:
            if not 0 <= self._arrival_us() <= self._offset_us:
                return False
            self._count = unpack_from("<H", self._arrivals, self._next + 4)[0]
            self._at = self._next + 6
            self._next = self._at + self._count
        return True

    def _next_stretch(self):
        """Tell that this stretch is done, and wait for the host to give the next one."""
        self._offset_us = self._length_us
        self._record(b"D", 0)
        self._flush()
        if self._commands.readinto(self._header) != 8:
            raise SystemExit  # the host has gone
        self._start_us = (self._start_us + self._length_us) & TICKS_MASK
        self._offset_us = 0
        self._length_us, size = unpack_from("<II", self._header)
        self._arrivals = self._commands.read(size)
        self._next = 0

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
