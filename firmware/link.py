"""The link's end on the MCU: bytes to packets, sequence numbers, answers.

Commands carry sequence numbers and are carried out in their order, each exactly once. A packet that is damaged is as
good as lost; one that comes after a gap is answered with the number that is expected, a repeated one with its first
answer. `hello` begins a session with whatever number it has; one that was repeated or overtaken on its way begins nothing.
What commands mean is in `commands`, what the MCU tells by itself in `telemetry`.

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

_HISTORY = const(16)  # answers kept for repeated commands; the host has fewer under way
_GREETINGS = const(8)  # a greeting with one of the last so many numbers ..
_GREETING_US = const(150000)  # .. within this time is one that was repeated or overtaken
_PAYLOAD = const(2)  # place of the payload in a body
_COUNT_MAX = const(0x3FFFFFFF)  # where counts stay, as a larger one would need memory

_WELCOME_FIELDS = messages.find(messages.WELCOME)[2]
_WELCOME_FORMAT = messages.struct_format(_WELCOME_FIELDS)
_WELCOME_END = _PAYLOAD + messages.size(_WELCOME_FIELDS)


class Link:
    """Receives and answers for one puppet.

    `packets` and `damaged` count what came. `inbox`, `commands`, `telemetry` and `store` are its parts. A packet to send is put
    into `out`, two bytes of head first, and sent by `send`.
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
        self._wire = bytearray(codec.WIRE_MAX)
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
        """Take what has come, carry out one packet at most; return how many bytes wait, -1 if the REPL is called for."""
        inbox = self.inbox
        if inbox.is_calling():
            return -1
        inbox.look()
        length = inbox.next(self._wire)
        if length:
            self._packet(length)
        return inbox.waiting()

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
        """Carry a kill out now, whatever is missing before it, or waits before it; in its turn that is done again."""
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
