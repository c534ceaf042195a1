"""What has come and waits for its turn, and the kill in it, which does not wait.

Bytes are carried out in their order, some of them in each pass of the main loop. Between two passes a frame is computed, or
other tables are put into force, for a dozen milliseconds, and a kill may be behind other packets. So whatever takes long looks
here in between: what has come is taken from the board, and a kill in it acts at once. In its turn it acts once more.

A pause ends a packet that has begun: what is left of it will not come.
"""

import micropython
from micropython import const

from firmware.clock import ticks_diff
from firmware.tables import halves
from shared import codec, messages

_CHUNK = const(32)  # bytes taken at once; one costs up to 50 us on USB
_ROOM = const(256)  # a power of two, and more than a host has under way
_STALE_US = const(20000)  # a partial packet older than this is ended
_KILL_WIRE = 1 + codec.OVERHEAD  # a kill has no fields


@micropython.viper
def _find(chunk: ptr8, start: int, end: int, packet: ptr8, most: int, state: ptr16) -> int:
    """Pass by packets; return the place behind one that is as long as a kill and has its id, or -1.

    `packet` has the first `most` bytes of the packet under way, `state[0]` is its length, at most 1000; `state[1]` is the kill's id.
    """
    length = int(state[0])
    while start < end:
        byte = int(chunk[start])
        start += 1
        if byte:
            if length < most:
                packet[length] = byte
            if length < 1000:
                length += 1
        else:
            is_kill = 0
            if length == most:
                if int(packet[1]) == int(state[1]):
                    is_kill = 1
            length = 0
            if is_kill:
                state[0] = 0
                return start
    state[0] = length
    return -1


@micropython.viper
def _append(ring: ptr8, at: int, chunk: ptr8, count: int):
    """Write bytes to a ring of 256 from a place on."""
    i = 0
    while i < count:
        ring[(at + i) & 255] = chunk[i]
        i += 1


@micropython.viper
def _take(ring: ptr8, at: int, buffer: ptr8, count: int):
    """Read them."""
    i = 0
    while i < count:
        buffer[i] = ring[(at + i) & 255]
        i += 1


class Inbox:
    """Bytes from a board. `count` of them wait; `byte_us` is when the last one was taken from the board.

    `kill(seq)` is called for every sound kill as soon as it has come.
    """

    def __init__(self, board, kill):
        self.count = 0
        self.byte_us = board.ticks_us()
        self._board = board
        self._kill = kill
        self._chunk = bytearray(_CHUNK)
        self._ring = bytearray(_ROOM)
        self._first = 0
        self._packet = bytearray(_KILL_WIRE)
        self._state = halves(2)
        self._state[1] = messages.KILL
        self._was_still = False

    def is_call(self):
        """Return whether the packet under way begins as a call for the REPL does; what follows may be meant for that."""
        packet = self._packet
        return self._state[0] == 2 and packet[0] == codec.HANDOVER_FIRST and packet[1] == codec.HANDOVER_SECOND

    def look(self):
        """Take what has come, as far as there is room; act on a kill; return how many bytes wait. Allocates nothing."""
        chunk = self._chunk
        while self.count <= _ROOM - _CHUNK - 1 and not self.is_call():
            count = self._board.receive(chunk)
            if count == 0:
                self._was_still = True
                break
            self._put(chunk, count)
            if count < _CHUNK:
                break
        return self.count

    def receive(self, buffer):
        """Look, and move what has waited longest to `buffer`, at most its length; return the number of bytes."""
        self.look()
        count = min(self.count, len(buffer))
        if count:
            _take(self._ring, self._first, buffer, count)
            self._first = (self._first + count) & 255
            self.count -= count
        return count

    def receive_next(self, buffer):
        """Move one byte to `buffer` if there is one, and leave those behind it to the board."""
        if self.count == 0:
            count = self._board.receive(buffer)
            if count:
                self._put(buffer, count)
            else:
                self._was_still = True
                return 0
        _take(self._ring, self._first, buffer, 1)
        self._first = (self._first + 1) & 255
        self.count -= 1
        return 1

    def _put(self, chunk, count):
        now_us = self._board.ticks_us()
        state = self._state
        # Only where the line was seen to be still: the main loop itself may have been away for longer.
        if self._was_still and state[0] and ticks_diff(now_us, self.byte_us) > _STALE_US:
            self._ring[(self._first + self.count) & 255] = 0
            self.count += 1
            state[0] = 0
        self._was_still = False
        self.byte_us = now_us
        _append(self._ring, self._first + self.count, chunk, count)
        self.count += count
        start = _find(chunk, 0, count, self._packet, _KILL_WIRE, state)
        while start >= 0:
            packet = self._packet
            length = codec.decode(packet, _KILL_WIRE)
            if length >= 0 and codec.is_sealed(packet, length):
                self._kill(packet[1])
            start = _find(chunk, start, count, packet, _KILL_WIRE, state)
