"""What has come and waits for its turn, and the kill in it, which does not wait.

Packets are carried out in their order, some of them in each pass of the main loop. Between two passes a frame is computed, or
other tables are put into force, for a dozen milliseconds, and a kill may be behind other packets. So whatever takes long looks
here in between: what has come is taken from the board, and a kill in it acts at once. In its turn it acts once more.

A pause ends a packet that has begun: what is left of it will not come.

The REPL is called for by `0D 03` where a packet would begin and then a pause, another `0D`, or another `03`, as
mpremote and others do it. `0D 03` alone would not do: a single flipped bit can make a packet begin with it, and would
end the performance.
"""

import micropython
from micropython import const

from firmware.clock import ticks_diff
from firmware.tables import halves
from shared import codec, messages

_CHUNK = const(32)  # bytes taken at once; one costs up to 50 us on USB
_RING = const(256)  # more than a host has under way
_FULL = const(223)  # bytes that leave room for a chunk and a zero
_STALE_US = const(20000)  # a packet that has begun is ended by such a pause, a call for the REPL too
_KILL_WIRE = 1 + codec.OVERHEAD  # a kill has no fields

_END = b"\0"  # of a packet

# Places in the state.
_LENGTH = const(0)  # of the packet that comes in, 1000 at most
_FIRST = const(1)  # byte that waits
_COUNT = const(2)  # of those that wait
_TAKEN = const(3)  # bytes of the packet that is being taken, 1000 at most
_KILL = const(4)  # the id of a kill
_STATES = const(5)


@micropython.viper
def _store(ring: ptr8, chunk: ptr8, start: int, end: int, packet: ptr8, most: int, state: ptr16) -> int:
    """Append `chunk[start:end]` to what waits; stop behind a packet as long as a kill and with its id; return the place, or -1.

    `packet` has the first `most` bytes of the packet that comes in.
    """
    length = int(state[0])
    place = int(state[1]) + int(state[2])
    count = int(state[2])
    found = -1
    while start < end:
        byte = int(chunk[start])
        start += 1
        ring[place & 255] = byte
        place += 1
        count += 1
        if byte:
            if length < most:
                packet[length] = byte
            if length < 1000:
                length += 1
        else:
            if length == most:
                if int(packet[1]) == int(state[4]):
                    found = start
                    start = end
            length = 0
    state[0] = length
    state[2] = count
    return found


@micropython.viper
def _next(ring: ptr8, wire: ptr8, room: int, state: ptr16) -> int:
    """Move what waits to `wire` up to the end of a packet; return its length without its zero, 0 if none is complete.

    What does not fit in `room` is left out, but counted to the length.
    """
    first = int(state[1])
    count = int(state[2])
    length = int(state[3])
    ended = 0
    while count and ended == 0:
        byte = int(ring[first])
        first = (first + 1) & 255
        count -= 1
        if byte:
            if length < room:
                wire[length] = byte
            if length < 1000:
                length += 1
        else:
            ended = length  # a second zero ends nothing
            length = 0
    state[1] = first
    state[2] = count
    state[3] = length
    return ended


class Inbox:
    """Bytes from a board, and the packets in them. `kill(seq)` is called for every sound kill as soon as it has come."""

    def __init__(self, board, kill):
        self._board = board
        self._kill = kill
        self._chunk = bytearray(_CHUNK)
        self._single = bytearray(1)
        self._ring = bytearray(_RING)
        self._packet = bytearray(_KILL_WIRE)
        self._state = halves(_STATES)
        self._state[_KILL] = messages.KILL
        self._was_still = False
        self._byte_us = board.ticks_us()  # when the last byte was taken

    def look(self):
        """Take a chunk of what has come, if there is room; act on a kill; return how many bytes wait. Allocates nothing."""
        state = self._state
        # What follows a call for the REPL may be meant for that.
        if state[_COUNT] <= _FULL and not (state[_LENGTH] == 2 and self._is_call()):
            count = self._board.receive(self._chunk)
            if count:
                self._put(self._chunk, count)
            else:
                self._was_still = True
        return state[_COUNT]

    def next(self, wire):
        """Move the packet whose turn it is to `wire`, without its zero; return its length, 0 if none is complete.

        Of a packet longer than WIRE_MAX the length is right, up to 1000, but not all is there.
        """
        return _next(self._ring, wire, codec.WIRE_MAX, self._state)

    def waiting(self):
        """Return how many bytes wait."""
        return self._state[_COUNT]

    def is_calling(self):
        """Return whether the REPL is called for, and all packets before that have been taken. May take a byte."""
        state = self._state
        if state[_LENGTH] != 2 or state[_COUNT] or not self._is_call():
            return False
        byte = self._single
        if self._board.receive(byte) == 0:
            self._was_still = True
            return ticks_diff(self._board.ticks_us(), self._byte_us) > _STALE_US
        if byte[0] == codec.HANDOVER_FIRST or byte[0] == codec.HANDOVER_SECOND:
            return True
        self._put(byte, 1)
        return False

    def _is_call(self):
        packet = self._packet
        return packet[0] == codec.HANDOVER_FIRST and packet[1] == codec.HANDOVER_SECOND

    def _put(self, chunk, count):
        state = self._state
        now_us = self._board.ticks_us()
        # Only where the line was seen to be still: the main loop itself may have been away for longer.
        if self._was_still:
            self._was_still = False
            if state[_LENGTH] and ticks_diff(now_us, self._byte_us) > _STALE_US:
                _store(self._ring, _END, 0, 1, self._packet, 0, state)
        self._byte_us = now_us
        packet = self._packet
        start = _store(self._ring, chunk, 0, count, packet, _KILL_WIRE, state)
        while start >= 0:
            length = codec.decode(packet, _KILL_WIRE)
            if length >= 0 and codec.is_sealed(packet, length):
                self._kill(packet[1])
            start = _store(self._ring, chunk, start, count, packet, _KILL_WIRE, state)
