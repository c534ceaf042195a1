"""Virtual time on a PC: what goes to and fro between the board and the host, motor ticks, and the watchdog.

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
    E  a pin gets no more pulses: pin u8
    P  on-times of PWM, from the next period on: pin u8, pulse_q18us u32, repeated
    L  a pin is driven, PWM or not: pin u8, level u8
    Z  a pin is let go of: pin u8
    Q  all PWM pins are driven low
    I  bytes sent to an I2C device: bus u8, address u8, bytes
    W  the watchdog resets the MCU: nothing follows
    D  the stretch is done
"""

from struct import pack_into, unpack_from

from micropython import const

from firmware.clock import TICKS_MASK

_RECORD = const(7)
_ROOM = const(4096)
_RETURN = const(13)
_CTRL_C = const(3)
_NEVER = const(-1)


def _nothing():
    """Be the handler of ticks that nobody wants."""


class VirtualTime:
    """The part of the virtual board that knows what time it is. `commands` and `records` are binary files.

    `resets` is how often the watchdog has reset the MCU since power on.
    """

    def __init__(self, commands, records, resets):
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
        self._handler = _nothing
        self._period_us = 0
        self._tick_at = _NEVER
        self._ticked = False
        self._block_us = 0
        self._timeout_us = 0
        self._bite_at = _NEVER
        self._resets = resets

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
        """Call `handler` each `period_us` from now on, the first time in one period."""
        self._tick_at = self._offset_us + period_us
        self._period_us = period_us
        self._handler = handler

    def stop_ticks(self):
        """Call the handler no more."""
        self._tick_at = _NEVER
        self._handler = _nothing

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

    def send(self, buffer, length, is_telemetry=False):
        """Send the first `length` bytes of `buffer`; there is always room."""
        at = self._record(b"S", length)
        out = self._out
        for i in range(length):
            out[at + i] = buffer[i]

    # --- the watchdog

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

    # --- what the board adds

    def _set_input(self, kind, data):
        """Take the state of an input that the host sets."""

    def _save(self):
        """Put what a reset leaves where it stays."""

    # --- stretches

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
        elif kind == 4:
            self._block_us += unpack_from("<I", data)[0]
        else:
            self._set_input(kind, data)

    def _find_arrival(self):
        more = self._next < len(self._arrivals)
        self._arrival_at = unpack_from("<I", self._arrivals, self._next)[0] if more else _NEVER

    def _begin(self):
        """Wait for the first stretch, and take what is there from its beginning."""
        self._next_stretch()
        while self._arrival_at == 0:
            self._arrive()

    def _next_stretch(self):
        """Tell that this stretch is done, and wait for the host to give the next one."""
        length_us = self._length_us
        self._offset_us = length_us
        self._record(b"D", 0)
        self._save()
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
        self._save()
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
