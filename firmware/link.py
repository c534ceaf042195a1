"""The link's end on the MCU: bytes to packets, sequence numbers, answers.

Commands carry sequence numbers and are carried out in their order, each exactly once. A packet that is damaged is as
good as lost; one that comes after a gap is answered with the number that is expected, a repeated one with its first
answer. `hello` begins a session with whatever number it has; one that was repeated or overtaken on its way begins nothing.
What commands mean is in `commands`, what the MCU tells by itself in `telemetry`.

The REPL is called for by `0D 03` where a packet would begin and then a pause, another `0D`, or another `03`, as
mpremote and others do it. `0D 03` alone would not do: a single flipped bit can make a packet begin with it, and would
end the performance.

Nothing here allocates while a puppet plays.
"""

from struct import pack_into

import micropython
from micropython import const

from firmware.clock import ticks_diff
from firmware.commands import Commands
from firmware.inbox import Inbox
from firmware.store import Store
from firmware.telemetry import Telemetry
from shared import codec, messages
from shared.formats import ACTIONS_MAX, DOFS_MAX, KILLED_BY_HOST, LIVES_MAX, MAPPINGS_MAX, QUEUE_MAX

_CHUNK = const(32)  # bytes taken between two looks at the frame clock
_TOO_LONG = const(1000)  # more than any packet has, where the length of what never ends stays
_CALL_US = const(20000)  # a pause behind `0D 03` that calls for the REPL
_HISTORY = const(16)  # answers kept for repeated commands; the host has fewer under way
_GREETINGS = const(8)  # a greeting with one of the last so many numbers ..
_GREETING_US = const(150000)  # .. within this time is one that was repeated or overtaken
_PAYLOAD = const(2)  # place of the payload in a body
_COUNT_MAX = const(0x3FFFFFFF)  # where counts stay, as a larger one would need memory

_WELCOME_FIELDS = messages.find(messages.WELCOME)[2]
_WELCOME_FORMAT = messages.struct_format(_WELCOME_FIELDS)
_WELCOME_END = _PAYLOAD + messages.size(_WELCOME_FIELDS)


@micropython.viper
def _collect(chunk: ptr8, start: int, end: int, wire: ptr8, length: int, room: int) -> int:
    """Append `chunk[start:end]` to `wire` up to a zero byte; return the place of that zero, or `end`.

    What does not fit in `room` is left out; the caller counts by places, so it knows that the packet was too long.
    """
    while start < end:
        byte = int(chunk[start])
        if byte == 0:
            return start
        if length < room:
            wire[length] = byte
        length += 1
        start += 1
    return end


class Link:
    """Receives and answers for one puppet.

    `packets` and `damaged` count what came. `inbox`, `commands`, `telemetry` and `store` are its parts. A packet to send is put into `out`, two bytes of head first, and sent by `send`.
    """

    def __init__(self, board, puppet):
        self.packets = 0
        self.damaged = 0
        self.inbox = Inbox(board, self._kill)
        self.out = bytearray(codec.BODY_MAX)
        self.telemetry = Telemetry(board, puppet, self)
        self.store = Store()
        self.commands = Commands(puppet, self.telemetry, self.store)
        self._board = board
        self._puppet = puppet
        self._chunk = bytearray(_CHUNK)
        self._single = bytearray(1)
        self._wire = bytearray(codec.WIRE_MAX)
        self._length = 0
        self._out_wire = bytearray(codec.WIRE_MAX)
        self._out_seq = 0
        self._expected = -1  # no session yet
        self._greeting = 0  # the number with which the session has begun
        self._greeted_us = 0
        self._kills = False  # whether a kill has been carried out before its turn
        self._statuses = bytearray(_HISTORY)
        self._details = [0] * _HISTORY
        self._seals = bytearray(2 * _HISTORY)  # half of the checksum of each

    def poll(self):
        """Take what has arrived, at most `_CHUNK` bytes. Returns whether the REPL is called for."""
        inbox = self.inbox
        wire = self._wire
        chunk = self._chunk
        if self._length == 2 and wire[0] == codec.HANDOVER_FIRST and wire[1] == codec.HANDOVER_SECOND:
            # One byte at a time now, so that what follows is left for the REPL.
            end = inbox.receive_next(self._single)
            if end == 0:
                return ticks_diff(self._board.ticks_us(), inbox.byte_us) > _CALL_US
            chunk[0] = self._single[0]
            if chunk[0] == codec.HANDOVER_FIRST or chunk[0] == codec.HANDOVER_SECOND:
                return True
        else:
            end = inbox.receive(chunk)
        start = 0
        while start < end:
            stop = _collect(chunk, start, end, wire, self._length, codec.WIRE_MAX)
            self._length += stop - start
            if self._length > _TOO_LONG:
                self._length = _TOO_LONG
            start = stop + 1
            if stop < end:
                length = self._length
                self._length = 0
                if length:  # a second zero ends nothing
                    self._packet(length)
        return False

    def report(self):
        """Send the telemetry that is due after a frame."""
        self.telemetry.report()

    def send(self, message_id, length, is_telemetry=False):
        """Send `out[:length]` as a packet; its head is written here. What the line has no room for is lost."""
        out = self.out
        out[0] = message_id
        out[1] = self._out_seq
        self._out_seq = (self._out_seq + 1) & 255
        length = codec.seal(out, length)
        self._board.send(self._out_wire, codec.encode(out, length, self._out_wire), is_telemetry)

    def _kill(self, seq):
        """Carry a kill out now, whatever is missing before it, or has come but not had its turn; in its turn that is done again."""
        self._puppet.motor.kill(KILLED_BY_HOST)
        self._kills = 0 < (seq - self._expected) & 255 < 128

    def _packet(self, length):
        body = self._wire
        if length > codec.WIRE_MAX:
            self._drop()
            return
        length = codec.decode(body, length)
        if length < 0 or not codec.is_sealed(body, length) or body[0] >= 128:
            self._drop()
            return
        if self.packets < _COUNT_MAX:
            self.packets += 1
        self._puppet.motor.heard()
        message_id = body[0]
        seq = body[1]
        if message_id == messages.KILL:
            self._kill(seq)
        if message_id == messages.HELLO and not self._is_old_greeting(seq):
            self._expected = self._greeting = seq
            self._greeted_us = self._board.ticks_us()
            self._kills = False
        elif self._expected < 0:
            return  # no session: the host has to say hello
        ahead = (seq - self._expected) & 255
        if ahead == 0:
            if self.commands.allocates[message_id]:  # the main loop keeps the heap locked
                micropython.heap_unlock()
                try:
                    status = self.commands.carry_out(message_id, body, length - codec.OVERHEAD)
                finally:
                    micropython.heap_lock()
            elif message_id == messages.ARM and self._kills:  # a kill that is to follow it has overtaken it
                status = messages.OK
            else:
                status = self.commands.carry_out(message_id, body, length - codec.OVERHEAD)
            detail = self.commands.detail
            place = seq % _HISTORY
            self._statuses[place] = status
            self._details[place] = detail
            self._seals[2 * place] = body[length - 4]
            self._seals[2 * place + 1] = body[length - 3]
            self._expected = (seq + 1) & 255
            self._answer(seq, status, detail)
            if message_id == messages.HELLO:
                self._welcome()
            elif message_id == messages.STATUS_REQUEST:
                self.telemetry.status()
        elif ahead >= 256 - _HISTORY and self._is_repeated(seq, body, length):  # its answer was lost
            self._answer(seq, self._statuses[seq % _HISTORY], self._details[seq % _HISTORY])
            if message_id == messages.HELLO and seq == self._greeting:
                self._welcome()
        else:
            self._answer(seq, messages.RESEND, self._expected)

    def _is_repeated(self, seq, body, length):
        """Return whether a command is the one that had its number, and not another host's."""
        place = 2 * (seq % _HISTORY)
        return body[length - 4] == self._seals[place] and body[length - 3] == self._seals[place + 1]

    def _is_old_greeting(self, seq):
        since_us = ticks_diff(self._board.ticks_us(), self._greeted_us)
        return self._expected >= 0 and (self._greeting - seq) & 255 < _GREETINGS and 0 <= since_us < _GREETING_US

    def _drop(self):
        if self.damaged < _COUNT_MAX:
            self.damaged += 1

    def _answer(self, seq, status, detail):
        out = self.out
        out[2] = seq
        out[3] = status
        out[4] = detail & 255
        out[5] = detail >> 8
        self.send(messages.ACK, 6)

    def _welcome(self):
        puppet = self._puppet
        # fmt: off
        pack_into(
            _WELCOME_FORMAT, self.out, _PAYLOAD, messages.PROTOCOL, self.commands.dictionary,
            DOFS_MAX, ACTIONS_MAX, MAPPINGS_MAX, LIVES_MAX, QUEUE_MAX, puppet.frame, puppet.motor.armed,
        )
        # fmt: on
        self.send(messages.WELCOME, _WELCOME_END)
