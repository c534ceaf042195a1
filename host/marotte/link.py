"""The host's end of the link: reliable commands over a byte stream that may lose or damage bytes.

`Link` does the protocol and nothing else: it is handed a carrier for its bytes and its clock, so the same code works in
real time over a serial port and in virtual time with an emulated MCU.

Commands are numbered and carried out by the MCU in their order, each once; up to WINDOW of them, and of WINDOW_BYTES
unless a single one has more, are under way. What is not acknowledged within RETRY_US is sent again, one at a time; what is known
to be lost, since a later one has been answered, at once. Telemetry is not acknowledged: what is lost of it is lost.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from marotte.errors import MarotteError
from marotte.mcu.base import VirtualMcu
from shared import codec, messages

WINDOW = 3
URGENT_WINDOW = 8
"""The same for urgent ones; the MCU remembers its last 16 answers."""

WINDOW_BYTES = 128
"""The MCU takes some 50 us for a byte, a UART at 115200 baud 87, and 2 to 5 ms to carry out a part of an upload, at a motor
rate of 333 Hz half as much again. With no more on the way, a `kill` that overtakes what waits acts within 20 ms.
"""

PAYLOAD_SENT_MAX = 80
"""Longest payload that is sent, so that a packet alone does not take longer than that."""

RETRY_US = 40_000
"""When a line works again the first answer comes within this and the time it takes, and the MCU counts as found within 100 ms. It
is more than what an MCU that plays is busy with otherwise.
"""
HURRY_US = 5_000
"""A gap that the MCU reports is filled at once, but not twice within this: all that follow it report it too."""

CTRL_C = 3
CTRL_D = 4
_ERASERS = b"\x03\x08\x0b\r\x0e\x15\x17\x7f"
"""What ends or empties a line in MicroPython's REPL; Ctrl-D on an empty one restarts the MCU."""

SILENT_US = 1_000_000
"""With commands under way and no packet, or no answer to any of them, for so long, the MCU counts as gone."""

STALE_US = 20_000
"""The beginning of a packet is dropped if the line is still for so long behind it: its end was lost."""

ASLEEP_US = 500_000
"""A host that has not looked for so long, as it was suspended, knows nothing of what was to be heard meanwhile."""

WIRE_OVERHEAD = codec.OVERHEAD + 2
"""What a packet has on the wire beside its payload."""

_BY_NAME = {message[0]: message for message in messages.MESSAGES}
_BY_ID = {message[1]: message for message in messages.MESSAGES}


_HINTS = {
    ("arm", messages.STATE): "; has the robot outputs, and is its kill switch where it should be?",
    ("save_begin", messages.STATE): "; the MCU writes its flash only while the puppet stands and its outputs are off",
    ("save_erase", messages.STATE): "; the MCU writes its flash only while the puppet stands and its outputs are off",
}


class LinkError(MarotteError):
    """The link does not work, or the MCU refused a command."""


class LinkSilent(LinkError):
    """Nothing, or nothing that is a packet, has come for too long."""


class LinkTaken(LinkSilent):
    """The MCU can be heard, but it does not answer this session."""


class LinkRefused(LinkError):
    """The MCU refused a command. `status` and `detail` are those of its acknowledgement."""

    def __init__(self, name: str, status: int, detail: int):
        text = messages.STATUS_TEXT[status] if status < len(messages.STATUS_TEXT) else f"status {status}"
        super().__init__(f"the MCU refused {name!r}: {text} (detail {detail}){_HINTS.get((name, status), '')}")
        self.status = status
        self.detail = detail


class Carrier(Protocol):
    """What takes the link's bytes to an MCU and back."""

    def now_us(self) -> int:
        """Return the time in microseconds, from any beginning."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def read(self, wait_us: int) -> bytes:
        """Let at most `wait_us` pass; return what has arrived, empty if nothing has."""

    def close(self) -> None:
        """Let go of the MCU."""


class VirtualCarrier:
    """An emulated MCU in virtual time as a carrier: time passes in `read`, all of `wait_us`."""

    def __init__(self, mcu: VirtualMcu):
        self.mcu = mcu

    def now_us(self) -> int:
        return self.mcu.now_us

    def write(self, data: bytes) -> None:
        self.mcu.send(data)

    def read(self, wait_us: int) -> bytes:
        self.mcu.run_for(wait_us)
        return b"".join(data for _, data in self.mcu.receive())

    def close(self) -> None:
        self.mcu.close()


@dataclass(frozen=True)
class Message:
    """A message that has come from the MCU: its fields by name, and the fields of each of its items."""

    name: str
    fields: dict[str, int]
    items: list[dict[str, int]]


@dataclass
class Counters:
    """What a link has seen since it was made."""

    sent: int = 0
    repeated: int = 0
    received: int = 0
    damaged: int = 0
    bytes: int = 0


@dataclass
class _Command:
    name: str
    payload: bytes
    on_refused: Callable[[int, int], None] | None
    seq: int = 0
    packet: bytes = b""  # made when it is sent, and numbered then
    urgent: bool = False
    sent_us: int = 0
    repeated: bool = False
    answer: tuple[int, int] | None = None  # status and detail, while one before it has none


def pack(name: str, fields: dict[str, int], items: list[dict[str, int]] | None = None) -> bytes:
    """Return a message's payload. Raises ValueError for a field that is missing or out of its type's range."""
    _, _, field_pairs, item_pairs = _BY_NAME[name]
    parts = [_pack_pairs(name, field_pairs, fields)]
    parts += [_pack_pairs(name, item_pairs, item) for item in items or []]
    return b"".join(parts)


def unpack(message_id: int, payload: bytes) -> Message | None:
    """Return the message that a payload holds; None if there is none of that id or its length does not fit."""
    message = _BY_ID.get(message_id)
    if message is None or not messages.length_fits(message, len(payload)):
        return None
    name, _, field_pairs, item_pairs = message
    fields = _unpack_pairs(field_pairs, payload, 0)
    start = messages.size(field_pairs)
    step = messages.size(item_pairs) or 1
    items = [_unpack_pairs(item_pairs, payload, place) for place in range(start, len(payload), step)]
    return Message(name, fields, items)


def wire_packet(message_id: int, seq: int, payload: bytes) -> bytes:
    """Return a packet as it goes over the wire, with the zero that ends it."""
    body = bytearray(codec.BODY_MAX)
    length = codec.OVERHEAD - 4 + len(payload)
    body[:length] = bytes((message_id, seq)) + payload
    length = codec.seal(body, length)
    wire = bytearray(codec.WIRE_MAX)
    return bytes(wire[: codec.encode(body, length, wire)])


def _is_harmless(greeting: bytes) -> bool:
    """Return whether a greeting neither interrupts MicroPython's start, nor restarts it from its REPL.

    The first byte of most is Ctrl-D, as the fourth of their bodies is a zero: each has to leave text on the REPL's line for the
    next.
    """
    rest = greeting[1:]
    text = rest[max(map(rest.rfind, _ERASERS)) + 1 :]
    return CTRL_C not in greeting and CTRL_D not in rest and any(32 <= byte < 127 for byte in text)


class Link:
    """Commands out, messages in. `on_message` is called with every message but acknowledgements."""

    def __init__(self, carrier: Carrier, on_message: Callable[[Message], None]):
        self.counters = Counters()
        self.heard_us = carrier.now_us()
        self._answered_us = self._pumped_us = self.heard_us
        self._carrier = carrier
        self._on_message = on_message
        self._seq = 0
        self._backlog: deque[_Command] = deque()
        self._under_way: deque[_Command] = deque()
        self._partial = b""
        self._is_stale = False  # whether the line has been still behind that
        self._byte_us = self.heard_us
        self._tail = b""
        self._refusals: deque[LinkRefused] = deque()

    @property
    def pending(self) -> int:
        """How many commands are not acknowledged yet."""
        return len(self._backlog) + len(self._under_way)

    @property
    def tail(self) -> bytes:
        """The last bytes that have come, at most 1 KB of them."""
        return self._tail

    def post(
        self,
        name: str,
        fields: dict[str, int] | None = None,
        items: list[dict[str, int]] | None = None,
        on_refused: Callable[[int, int], None] | None = None,
        *,
        urgent: bool = False,
    ) -> None:
        """Send a command, at once if the window allows; an urgent one at once anyway, before those that wait.

        `on_refused(status, detail)` is called if the MCU refuses it; without, `pump` raises LinkRefused.
        """
        command = _Command(name, pack(name, fields or {}, items), on_refused, urgent=urgent)
        if urgent and len(self._under_way) < URGENT_WINDOW:
            self._carrier.write(b"\0")  # the end of whatever has lost its own
            self._send(command)
        else:
            self._backlog.append(command)
            self._send_what_fits()

    def withdraw(self, name: str, is_meant: Callable[[Message], bool] = lambda message: True) -> None:
        """Drop the commands of this name that have not been sent yet, or those of them that are meant."""
        message_id = _BY_NAME[name][1]
        self._backlog = deque(
            command
            for command in self._backlog
            if command.name != name or not (message := unpack(message_id, command.payload)) or not is_meant(message)
        )

    def pump(self, wait_us: int) -> None:
        """Let at most `wait_us` pass; take what has come, repeat what was lost. Raises LinkSilent and LinkRefused."""
        begun_us = self._carrier.now_us()
        slept = begun_us - self._pumped_us > ASLEEP_US
        data = self._carrier.read(wait_us)
        now_us = self._pumped_us = self._carrier.now_us()
        if data:
            self._take_bytes(data)
            self._byte_us = now_us
        self._is_stale = not data and now_us - self._byte_us > STALE_US
        if slept:
            self.heard_us = self._answered_us = begun_us
        if self._under_way:
            self._check_answers(now_us)
            self._repeat_late(now_us)
        self._send_what_fits()
        if self._refusals:  # raised when all else is done, so that nothing that has come is lost
            raise self._refusals.popleft()

    def forget(self) -> None:
        """Drop all commands that are not acknowledged: for a new session."""
        self._backlog.clear()
        self._under_way.clear()
        self._refusals.clear()

    def _send_what_fits(self) -> None:
        room = WINDOW_BYTES - sum(len(command.packet) for command in self._under_way)
        while self._backlog and len(self._under_way) < WINDOW:
            command = self._backlog[0]
            room -= len(command.payload) + WIRE_OVERHEAD
            if room < 0 and self._under_way:
                break
            self._send(self._backlog.popleft())

    def _check_answers(self, now_us: int) -> None:
        if now_us - self.heard_us > SILENT_US:
            raise LinkSilent(f"the MCU has not answered for {SILENT_US / 1e6:g} s (unplugged, or reset?)")
        if now_us - self._answered_us > SILENT_US:
            raise LinkTaken(
                f"the MCU can be heard, but has answered no command for {SILENT_US / 1e6:g} s: "
                "does another program use this port, or is the line to the MCU broken?"
            )

    def _send(self, command: _Command) -> None:
        if not self._under_way:  # silence begins with the first command that waits for an answer
            self.heard_us = self._answered_us = self._carrier.now_us()
        message_id = _BY_NAME[command.name][1]
        command.packet = wire_packet(message_id, self._seq, command.payload)
        if command.name == "hello":
            for seq in range(self._seq, self._seq + 256):
                packet = wire_packet(message_id, seq & 255, command.payload)
                if _is_harmless(packet):
                    self._seq, command.packet = seq & 255, packet
                    break
        command.seq = self._seq
        command.sent_us = self._carrier.now_us()
        self._seq = (self._seq + 1) & 255
        self._under_way.append(command)
        self._carrier.write(command.packet)
        self.counters.sent += 1

    def _repeat_late(self, now_us: int) -> None:
        """Repeat the first command if it has no answer for too long, as that tells of the rest, and those that are urgent."""
        first = self._under_way[0]
        for command in list(self._under_way):
            if (command is first or command.urgent) and now_us - command.sent_us > RETRY_US:
                self._repeat(command, now_us)

    def _repeat_lost(self, last: _Command | None) -> None:
        """Repeat what has no answer, up to `last`, but not twice within a moment."""
        now_us = self._carrier.now_us()
        first = self._under_way[0]
        if first.repeated and now_us - first.sent_us <= HURRY_US:
            return
        for command in list(self._under_way):
            if command is last:
                break
            if command.answer is None:
                self._repeat(command, now_us)

    def _repeat(self, command: _Command, now_us: int) -> None:
        command.sent_us = now_us
        command.repeated = True
        self._carrier.write(command.packet)
        self.counters.repeated += 1

    def _take_bytes(self, data: bytes) -> None:
        self.counters.bytes += len(data)
        self._tail = (self._tail + data)[-4 * codec.WIRE_MAX :]
        if self._is_stale and self._partial:
            self.counters.damaged += 1
            self._partial = b""
        *packets, self._partial = (self._partial + data).split(b"\0")
        self._partial = self._partial[-4 * codec.WIRE_MAX :]
        for packet in packets:
            self._take(packet)

    def _take(self, packet: bytes) -> None:
        if not packet:
            return
        body = bytearray(packet)
        length = codec.decode(body, len(body))
        if length < 0 or not codec.is_sealed(body, length):
            self.counters.damaged += 1
            return
        message = unpack(body[0], bytes(body[2 : length - 4]))
        if message is None:
            self.counters.damaged += 1
            return
        self.heard_us = self._carrier.now_us()
        self.counters.received += 1
        if message.name == "ack":
            self._acknowledged(message.fields["seq"], message.fields["status"], message.fields["detail"])
        else:
            self._on_message(message)

    def _acknowledged(self, seq: int, status: int, detail: int) -> None:
        if status == messages.RESEND:
            if self._found(detail & 255):
                self._repeat_lost(None)
            return
        command = self._found(seq)
        if command is None or command.answer:
            return  # answered before
        command.answer = (status, detail)
        self._answered_us = self._carrier.now_us()
        while self._under_way and (answer := self._under_way[0].answer):
            self._settle(self._under_way.popleft(), *answer)
        if self._found(seq):
            self._repeat_lost(command)  # the MCU has carried out all before it, so it is their answers that were lost

    def _found(self, seq: int) -> _Command | None:
        """Return the command under way that has this number."""
        return next((command for command in self._under_way if command.seq == seq), None)

    def _settle(self, command: _Command, status: int, detail: int) -> None:
        if status == messages.OK:
            return
        if command.on_refused is None:
            self._refusals.append(LinkRefused(command.name, status, detail))
            return
        command.on_refused(status, detail)


def _pack_pairs(name: str, pairs: tuple[tuple[str, str], ...], values: dict[str, int]) -> bytes:
    if set(values) != {field for field, _ in pairs}:
        raise ValueError(f"message {name!r} has the fields {[field for field, _ in pairs]}, not {list(values)}")
    try:
        return struct.pack(messages.struct_format(pairs), *(values[field] for field, _ in pairs))
    except struct.error as error:
        raise ValueError(f"message {name!r}: {error}: {values}") from None


def _unpack_pairs(pairs: tuple[tuple[str, str], ...], payload: bytes, start: int) -> dict[str, int]:
    values = struct.unpack_from(messages.struct_format(pairs), payload, start)
    return {field: value for (field, _), value in zip(pairs, values, strict=True)}
