"""The link's end on the MCU: packets in, acknowledgements and telemetry out.

Commands carry sequence numbers and are carried out in their order, each exactly once. A packet that is damaged is as
good as lost; one that comes after a gap is answered with the number that is expected, a repeated one with its first
answer. `hello` begins a session with whatever number it has. Nothing here allocates while a puppet plays: tables are
what `begin` .. `commit` bring, and those come first.

The REPL is called for by `0D 03` where a packet would begin and then a pause, another `0D`, or another `03`, as
mpremote and others do it. `0D 03` alone would not do: a single flipped bit can make a packet begin with it, and would
end the performance.

A reader of the wire must not trust it: kernels get only indices and lengths that were checked here, in `tables` or in
`cues`.
"""

from struct import pack, pack_into, unpack_from

import micropython
from micropython import const

from firmware import cues
from firmware.clock import ticks_diff
from firmware.exchange import check_kept
from shared import codec, messages
from shared.formats import (
    ACTIONS_MAX,
    DOFS_MAX,
    LIVES_MAX,
    MAPPINGS_MAX,
    QUEUE_MAX,
    TAP_BASE,
    TAP_MOTOR,
    TAP_SIGNAL,
)

_CHUNK = const(32)  # bytes taken between two looks at the frame clock; one costs up to 50 us on USB
_STALE_US = const(20000)  # a partial packet older than this is dropped
_HISTORY = const(16)  # answers kept for repeated commands; the host has fewer under way
_PAYLOAD = const(2)  # place of the payload in a body

_HELLO_FORMAT = messages.struct_format(messages.find(messages.HELLO)[2])
_WELCOME_FIELDS = messages.find(messages.WELCOME)[2]
_WELCOME_FORMAT = messages.struct_format(_WELCOME_FIELDS)
_WELCOME_END = _PAYLOAD + messages.size(_WELCOME_FIELDS)
_STATUS_FIELDS = messages.find(messages.STATUS)[2]
_STATUS_FORMAT = messages.struct_format(_STATUS_FIELDS)
_STATUS_END = _PAYLOAD + messages.size(_STATUS_FIELDS)
_MAPPING_FORMAT = messages.struct_format(messages.find(messages.MAPPINGS)[3])


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


@micropython.viper
def _pack_values(body: ptr8, at: int, count: int, values: ptr16) -> int:
    """Append `count` 16-bit values, little-endian; return the place behind them."""
    i = 0
    while i < count:
        value = int(values[i])
        body[at] = value & 255
        body[at + 1] = value >> 8
        at += 2
        i += 1
    return at


@micropython.viper
def _pack_weights(body: ptr8, at: int, count: int, playing: ptr8, w_q28: ptr32) -> int:
    """Append index and weight (Q12, 16 bits) of `count` playing actions; return the place behind them."""
    i = 0
    while i < count:
        action = int(playing[i])
        weight_q12 = (w_q28[action] + 0x8000) >> 16
        body[at] = action
        body[at + 1] = weight_q12 & 255
        body[at + 2] = weight_q12 >> 8
        at += 3
        i += 1
    return at


class Link:
    """Receives, answers and reports for one puppet.

    `silent` tells that no packet has come for the puppet's `link_timeout`; `packets` and `damaged` count what came.
    """

    def __init__(self, board, puppet):
        self.silent = True
        self.packets = 0
        self.damaged = 0
        self._board = board
        self._puppet = puppet
        self._dictionary = codec.crc32(messages.canonical_text().encode())
        self._hello = pack(_HELLO_FORMAT, messages.PROTOCOL, self._dictionary)
        self._chunk = bytearray(_CHUNK)
        self._single = bytearray(1)
        self._heap_free = 0
        self._wire = bytearray(codec.WIRE_MAX)
        self._length = 0
        self._out = bytearray(codec.BODY_MAX)
        self._out_wire = bytearray(codec.WIRE_MAX)
        self._out_seq = 0
        self._detail = 0  # of the answer under way
        self._expected = -1  # no session yet
        self._statuses = bytearray(_HISTORY)
        self._details = [0] * _HISTORY
        self._heard_us = self._byte_us = board.ticks_us()
        self._taps = self._taps_every = self._weights_every = 0
        # By message id: length of the fields (-1: no such message), of an item, and what carries it out.
        self._fixed = [-1] * 128
        self._item = bytearray(128)
        self._formats = [None] * 128
        self._handlers = [None] * 128
        for name, message_id, fields, items in messages.MESSAGES:
            if message_id < 128:
                self._fixed[message_id] = messages.size(fields)
                self._item[message_id] = messages.size(items)
                self._formats[message_id] = messages.struct_format(fields)
                self._handlers[message_id] = getattr(self, "_on_" + name)

    # --- bytes to packets

    def poll(self):
        """Take what has arrived, at most `_CHUNK` bytes. Returns whether the REPL is called for."""
        board = self._board
        now_us = board.ticks_us()
        if ticks_diff(now_us, self._heard_us) > self._puppet.tables.link_timeout_ms * 1000:
            self.silent = True
        wire = self._wire
        chunk = self._chunk
        if self._length == 2 and wire[0] == codec.HANDOVER_FIRST and wire[1] == codec.HANDOVER_SECOND:
            # One byte at a time now, so that what follows is left for the REPL.
            end = board.receive(self._single)
            if end == 0:
                return ticks_diff(now_us, self._byte_us) > _STALE_US
            chunk[0] = self._single[0]
            if chunk[0] == codec.HANDOVER_FIRST or chunk[0] == codec.HANDOVER_SECOND:
                return True
        else:
            end = board.receive(chunk)
        if end == 0:
            return False
        if self._length and ticks_diff(now_us, self._byte_us) > _STALE_US:
            self._length = 0
            self.damaged += 1
        start = 0
        while start < end:
            stop = _collect(chunk, start, end, wire, self._length, codec.WIRE_MAX)
            self._length += stop - start
            start = stop + 1
            if stop < end:
                length = self._length
                self._length = 0
                if length:  # a second zero ends nothing
                    self._packet(length)
        self._byte_us = board.ticks_us()  # after the packets, of which a `commit` may take long
        return False

    def _packet(self, length):
        body = self._wire
        if length > codec.WIRE_MAX:
            self.damaged += 1
            return
        length = codec.decode(body, length)
        if length < 0 or not codec.is_sealed(body, length) or body[0] >= 128:
            self.damaged += 1
            return
        self.packets += 1
        self.silent = False
        self._heard_us = self._board.ticks_us()
        message_id = body[0]
        seq = body[1]
        if message_id == messages.HELLO:
            self._expected = seq
        elif self._expected < 0:
            return  # no session: the host has to say hello
        ahead = (seq - self._expected) & 255
        if ahead == 0:
            status = self._carry_out(message_id, body, length - codec.OVERHEAD)
            self._statuses[seq % _HISTORY] = status
            self._details[seq % _HISTORY] = self._detail
            self._expected = (seq + 1) & 255
            self._answer(seq, status, self._detail)
            if message_id == messages.HELLO:
                self._welcome()
            elif message_id == messages.STATUS_REQUEST:
                self._status()
        elif ahead >= 256 - _HISTORY:  # repeated: its answer was lost
            self._answer(seq, self._statuses[seq % _HISTORY], self._details[seq % _HISTORY])
        else:
            self._answer(seq, messages.RESEND, self._expected)

    def _carry_out(self, message_id, body, length):
        """Check the length of a command's payload and carry it out; return its status."""
        self._detail = message_id
        fixed = self._fixed[message_id]
        if fixed < 0:
            return messages.UNKNOWN
        item = self._item[message_id]
        if length < fixed or (length != fixed if item == 0 else (length - fixed) % item != 0):
            self._detail = length
            return messages.LENGTH
        self._detail = 0
        return self._handlers[message_id](body, length)

    # --- commands; each returns a status

    def _fields(self, message_id, body):
        return unpack_from(self._formats[message_id], body, _PAYLOAD)

    def _on_hello(self, body, length):
        self._puppet.cues.clear()
        self._taps = self._taps_every = self._weights_every = 0
        for place in range(length):  # byte by byte, because a host may come back during a performance
            if body[_PAYLOAD + place] != self._hello[place]:
                return messages.MISMATCH
        return messages.OK

    def _on_ping(self, body, length):
        return messages.OK

    def _on_begin(self, body, length):
        if self._puppet.exchange.step >= 0:
            return messages.STATE
        return self._judge(self._puppet.staged.begin(*self._fields(messages.BEGIN, body)))

    def _on_dof(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.dof(*self._fields(messages.DOF, body)))

    def _on_output(self, body, length):
        fields = self._fields(messages.OUTPUT, body)
        return self._staged() or self._judge(self._puppet.staged.output(*fields, self._board))

    def _on_action(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.action(*self._fields(messages.ACTION, body)))

    def _on_mappings(self, body, length):
        status = self._staged()
        if status:
            return status
        (first,) = self._fields(messages.MAPPINGS, body)
        item = self._item[messages.MAPPINGS]
        staged = self._puppet.staged
        for n in range((length - 2) // item):
            bad = staged.mapping(first + n, *unpack_from(_MAPPING_FORMAT, body, _PAYLOAD + 2 + n * item))
            if bad is not None:
                return self._judge(1 + 5 * n + bad)
        return messages.OK

    def _on_live(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.live(*self._fields(messages.LIVE, body)))

    def _on_curve(self, body, length):
        staged = self._puppet.staged
        return self._staged() or self._stream(messages.CURVE, body, length, staged.curve, staged.sample)

    def _on_program(self, body, length):
        staged = self._puppet.staged
        return self._staged() or self._stream(messages.PROGRAM, body, length, staged.program, staged.word)

    def _on_blink(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.blink(*self._fields(messages.BLINK, body)))

    def _on_keep(self, body, length):
        status = self._staged()
        if status:
            return status
        kind, first = self._fields(messages.KEEP, body)
        for place in range(length - 2):
            bad = self._puppet.staged.keep(kind, first, place, body[_PAYLOAD + 2 + place])
            if bad is not None:
                return self._judge(bad)
        return messages.OK

    def _stream(self, message_id, body, length, begin, store):
        """Store what comes in several packets: the fields to `begin`, then each item to `store`."""
        bad = begin(*self._fields(message_id, body))
        if bad is not None:
            return self._judge(bad)
        item = self._item[message_id]
        for place in range(_PAYLOAD + 3, _PAYLOAD + length, item):
            (value,) = unpack_from("<i" if item == 4 else "<H", body, place)
            if store(value) is not None:
                return self._judge(2 + (place - _PAYLOAD - 3) // item)
        return messages.OK

    def _on_commit(self, body, length):
        puppet = self._puppet
        playing = puppet.frame >= 0
        if playing and puppet.staged.frame_rate_hz != puppet.tables.frame_rate_hz:
            return messages.STATE
        status = self._staged()
        if status:
            return status
        self._detail = puppet.staged.missing()
        if self._detail:
            return messages.INCOMPLETE
        bad = self._judge(puppet.staged.doubled())
        if bad == messages.OK and not check_kept(puppet.staged, puppet.tables):
            bad = self._judge(0)
        if bad == messages.OK:
            puppet.commit()
        return bad

    def _on_start(self, body, length):
        if not self._puppet.tables.ready:
            return messages.STATE
        self._heap_free = self._board.heap_free()
        self._puppet.start()
        return messages.OK

    def _on_stop(self, body, length):
        self._puppet.stop()
        return messages.OK

    def _on_weight_targets(self, body, length):
        return self._queue(cues.WEIGHT, length, self._puppet.tables.actions)

    def _on_live_targets(self, body, length):
        return self._queue(cues.LIVE, length, self._puppet.tables.lives)

    def _on_tempo(self, body, length):
        return self._queue(cues.TEMPO, length, self._puppet.tables.actions)

    def _on_arm(self, body, length):
        puppet = self._puppet
        return messages.OK if puppet.tables.ready and puppet.motor.arm() else messages.STATE

    def _on_kill(self, body, length):
        self._puppet.motor.kill()
        return messages.OK

    def _on_telemetry(self, body, length):
        taps = body[_PAYLOAD]
        if taps > TAP_BASE | TAP_SIGNAL | TAP_MOTOR:
            return messages.RANGE
        self._taps = taps
        self._taps_every = body[_PAYLOAD + 1] | body[_PAYLOAD + 2] << 8
        self._weights_every = body[_PAYLOAD + 3] | body[_PAYLOAD + 4] << 8
        return messages.OK

    def _on_status_request(self, body, length):
        return messages.OK

    def _staged(self):
        """Return whether tables may come: after `begin`, and not while others wait to be put into force."""
        puppet = self._puppet
        return messages.OK if puppet.staged.ready and puppet.exchange.step < 0 else messages.STATE

    def _judge(self, bad_field):
        if bad_field is None:
            return messages.OK
        self._puppet.staged.ready = False  # a set of which a part was refused is never played
        self._detail = bad_field
        return messages.RANGE

    def _queue(self, kind, length, indices):
        queue = self._puppet.cues
        status = queue.put(kind, self._wire, _PAYLOAD, length, indices)
        if status:
            self._detail = queue.detail
        return status

    # --- to the host

    def report(self):
        """Send the telemetry that is due after a frame."""
        if self.silent:
            return
        puppet = self._puppet
        frame = puppet.frame - 1
        out = self._out
        if self._taps and self._taps_every and frame % self._taps_every == 0:
            dofs = puppet.tables.dofs
            self._pack_frame(frame)
            out[6] = self._taps
            length = 7
            if self._taps & TAP_BASE:
                length = _pack_values(out, length, dofs, puppet.base_q15)
            if self._taps & TAP_SIGNAL:
                length = _pack_values(out, length, dofs, puppet.signal_q15)
            if self._taps & TAP_MOTOR:
                length = _pack_values(out, length, dofs, puppet.motor.motor_q15)
            self._send(messages.TAPS, length)
        if self._weights_every and frame % self._weights_every == 0:
            self._pack_frame(frame)
            actions = puppet.actions
            self._send(messages.WEIGHTS, _pack_weights(out, 6, actions.found, actions.playing, actions.w_q28))

    def _pack_frame(self, frame):
        pack_into("<i", self._out, _PAYLOAD, frame)

    def _answer(self, seq, status, detail):
        out = self._out
        out[2] = seq
        out[3] = status
        out[4] = detail & 255
        out[5] = detail >> 8
        self._send(messages.ACK, 6)

    def _welcome(self):
        puppet = self._puppet
        # fmt: off
        pack_into(
            _WELCOME_FORMAT, self._out, _PAYLOAD, messages.PROTOCOL, self._dictionary,
            DOFS_MAX, ACTIONS_MAX, MAPPINGS_MAX, LIVES_MAX, QUEUE_MAX, puppet.frame, puppet.motor.armed,
        )
        # fmt: on
        self._send(messages.WELCOME, _WELCOME_END)

    def _status(self):
        puppet = self._puppet
        if puppet.frame < 0:  # looking through the heap takes 10 ms, and while frames run it does not change
            self._heap_free = self._board.heap_free()
        # fmt: off
        pack_into(
            _STATUS_FORMAT, self._out, _PAYLOAD, puppet.frame, puppet.motor.armed, self.silent,
            puppet.clock.late_max_us, puppet.clock.late_frames, puppet.frame_max_us, self.packets, self.damaged,
            puppet.cues.counts[0], self._heap_free,
        )
        # fmt: on
        self._send(messages.STATUS, _STATUS_END)

    def _send(self, message_id, length):
        out = self._out
        out[0] = message_id
        out[1] = self._out_seq
        self._out_seq = (self._out_seq + 1) & 255
        length = codec.seal(out, length)
        self._board.send(self._out_wire, codec.encode(out, length, self._out_wire))
