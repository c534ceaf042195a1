"""What `marotte link` does with a capture: shows it, plays it to an MCU again, and counts.

for line in dump(read_capture("run.capture")):
    print(line)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from marotte.capture import Packet, Record, packets
from marotte.link import Carrier, Message
from marotte.ports import BAUD
from shared import formats, messages

SETTLE_US = 200_000
"""How long a replay waits for the last answers."""

STEP_US = 1_000
BITS_PER_BYTE = 10
"""On a UART, with start and stop bit."""

_BYTES_SHOWN = 32
_UNITS = {"us": "us", "ms": "ms", "s": "s", "hz": "Hz", "q4us": "us"}
_DIFFERENCES_TOLD = 10


# --- dump


def dump(records: Iterable[Record]) -> Iterator[str]:
    """Yield a line for each packet: time in seconds, direction, number, message and fields; what is damaged as bytes."""
    for packet in packets(records):
        yield f"{packet.at_us / 1e6:12.6f} {'>' if packet.to_mcu else '<'} {_described(packet)}"


def _described(packet: Packet) -> str:
    if packet.is_damaged:
        shown = packet.wire[:_BYTES_SHOWN].hex(" ") + (" ..." if len(packet.wire) > _BYTES_SHOWN else "")
        return f"--- damaged, {len(packet.wire)} bytes: {shown}"
    if packet.message is None:
        return f"{packet.seq:3d} unknown message: {packet.wire[:_BYTES_SHOWN].hex(' ')}"
    return f"{packet.seq:3d} {described(packet.message)}"


def described(message: Message) -> str:
    """Return a message as text: its name, its fields with their units, its items in brackets."""
    parts = [message.name, *(_field(message.name, *pair) for pair in message.fields.items())]
    parts += ["[" + ", ".join(_field(message.name, *pair) for pair in item.items()) + "]" for item in message.items]
    return " ".join(parts)


def _field(message: str, name: str, number: int) -> str:
    if (message, name) == ("ack", "status") and number < len(messages.STATUS_TEXT):
        return f"status={number} ({messages.STATUS_TEXT[number]})"
    if name == "frame" and number == formats.FRAME_NOW:
        return "frame=next"
    if name in ("dictionary", "crc32"):
        return f"{name}={number:08x}"
    stem, _, ending = name.rpartition("_")
    if ending == "q4us":
        return f"{stem}={number / (1 << formats.PULSE_BITS):g} us"
    if ending in _UNITS:
        return f"{stem}={number} {_UNITS[ending]}"
    if ending[:1] == "q" and ending[1:].isdecimal():
        return f"{stem}={number / (1 << int(ending[1:])):.6g}"
    return f"{name}={number}"


# --- replay


@dataclass
class Replay:
    """What came of playing a capture to an MCU again."""

    packets: int = 0
    """Sent, damaged ones too."""
    answers: int = 0
    """Commands answered as in the capture."""
    frames: int = 0
    """Taps and derivatives that are the same, and that both have."""
    differences: list[str] = field(default_factory=list)

    @property
    def agrees(self) -> bool:
        """Whether the MCU has done what the one of the capture did."""
        return not self.differences


def replay(records: Iterable[Record], carrier: Carrier) -> Replay:
    """Send the host's half of a capture at its times, and compare what the MCU says with what the other half says.

    Commands have to be answered alike; a frame's taps have to be the same where both have them. When an answer comes, what was
    answered by a request to repeat, and telemetry of other kinds may differ. Raises what the carrier raises.
    """
    known = list(records)
    begin_us = carrier.now_us()
    heard: list[Record] = []
    for record in known:
        if record.to_mcu:
            _listen(carrier, begin_us, record.at_us, heard)
            carrier.write(record.data)
    end_us = max((record.at_us for record in known), default=0)
    _listen(carrier, begin_us, max(end_us, carrier.now_us() - begin_us) + SETTLE_US, heard)
    sent = [packet for packet in packets(known) if packet.to_mcu]
    result = Replay(packets=len(sent))
    _compare_answers(sent, _of_mcu(known), _of_mcu(heard), result)
    _compare_frames(_of_mcu(known), _of_mcu(heard), result)
    return result


def _listen(carrier: Carrier, begin_us: int, until_us: int, heard: list[Record]) -> None:
    while (left_us := begin_us + until_us - carrier.now_us()) > 0:
        data = carrier.read(min(left_us, STEP_US))
        if data:
            heard.append(Record(carrier.now_us() - begin_us, False, data))


def _of_mcu(records: Iterable[Record]) -> list[Message]:
    return [packet.message for packet in packets(records) if not packet.to_mcu and packet.message]


def _answers(heard: Iterable[Message]) -> list[tuple[int, int, int]]:
    """Return number, status and detail of the commands' answers in order: of repeated ones the first, no requests to repeat."""
    found: list[tuple[int, int, int]] = []
    recent: dict[int, int] = {}
    for message in heard:
        if message.name != "ack" or message.fields["status"] == messages.RESEND:
            continue
        seq = message.fields["seq"]
        if seq in recent and len(found) - recent[seq] < _HISTORY:
            continue
        recent[seq] = len(found)
        found.append((seq, message.fields["status"], message.fields["detail"]))
    return found


_HISTORY = 16
"""The MCU remembers its last answers; the same number comes again only after 255 others."""


def _compare_answers(sent: list[Packet], before: list[Message], now: list[Message], result: Replay) -> None:
    names = {packet.seq: packet.message.name for packet in sent if packet.message}  # the last of each number
    recorded, heard = _answers(before), _answers(now)
    for place in range(max(len(recorded), len(heard))):
        old = recorded[place] if place < len(recorded) else None
        new = heard[place] if place < len(heard) else None
        if old == new:
            result.answers += 1
            continue
        told = f"{_answer_text(new, names)}, in the capture {_answer_text(old, names)}"
        result.differences.append(f"answer {place + 1}: {told}")
        if old is None or new is None or old[0] != new[0]:
            result.differences.append("what follows cannot be compared")
            return


def _answer_text(answer: tuple[int, int, int] | None, names: dict[int, str]) -> str:
    if answer is None:
        return "none"
    seq, status, detail = answer
    return f"command {seq} ({names.get(seq, 'unknown')}) has status {status}, detail {detail}"


def _compare_frames(before: list[Message], now: list[Message], result: Replay) -> None:
    recorded, heard = _frames(before), _frames(now)
    for key in recorded.keys() & heard.keys():
        if recorded[key] == heard[key]:
            result.frames += 1
    different = sorted(key for key in recorded.keys() & heard.keys() if recorded[key] != heard[key])
    for name, frame, turn in different[:_DIFFERENCES_TOLD]:
        result.differences.append(f"{name} of frame {frame}, start {turn}, are not those of the capture")
    if len(different) > _DIFFERENCES_TOLD:
        result.differences.append(f"so are {len(different) - _DIFFERENCES_TOLD} more")


def _frames(heard: Iterable[Message]) -> dict[tuple[str, int, int], tuple[object, ...]]:
    """Return the taps and derivatives by name, frame, and how often the motion has begun anew."""
    found: dict[tuple[str, int, int], tuple[object, ...]] = {}
    last: dict[str, int] = {}
    turns: Counter[str] = Counter()
    for message in heard:
        if message.name in ("taps", "derivatives"):
            frame = message.fields["frame"]
            if frame <= last.get(message.name, -1):
                turns[message.name] += 1
            last[message.name] = frame
            key = (message.name, frame, turns[message.name] + 1)
            found[key] = (message.fields.get("taps"), [tuple(item.values()) for item in message.items])
    return found


# --- stats


@dataclass
class Flow:
    """What went in one direction."""

    packets: Counter[str] = field(default_factory=Counter)
    """Sound ones, by message."""
    bytes: Counter[str] = field(default_factory=Counter)
    """On the wire with their zeros, by message."""
    damaged: int = 0
    damaged_bytes: int = 0

    @property
    def all_packets(self) -> int:
        """Sound packets of all messages."""
        return self.packets.total()

    @property
    def all_bytes(self) -> int:
        """All bytes of packets, sound or damaged."""
        return self.bytes.total() + self.damaged_bytes

    @property
    def error_rate(self) -> float:
        """The share of damaged packets."""
        return self.damaged / max(self.damaged + self.all_packets, 1)


@dataclass
class Stats:
    """Figures of a capture."""

    length_us: int = 0
    to_mcu: Flow = field(default_factory=Flow)
    from_mcu: Flow = field(default_factory=Flow)
    repeated: int = 0
    """Commands sent again."""
    resends: int = 0
    """Answers that a packet before was missing."""
    refused: int = 0
    """Commands that were answered with another status than `done`."""
    unanswered: int = 0
    """Commands without an answer until the end, or until their number was used again."""
    lost: int = 0
    """Packets of the MCU that their numbers miss."""
    round_trips_us: list[int] = field(default_factory=list)
    """From each command's first sending to its answer, sorted."""

    def round_trip_us(self, percent: float) -> int | None:
        """Return the least round trip that so many percent of the commands do not exceed; None without any."""
        if not self.round_trips_us:
            return None
        place = math.ceil(percent / 100 * len(self.round_trips_us)) - 1
        return self.round_trips_us[max(place, 0)]


def stats(records: Iterable[Record]) -> Stats:
    """Return the figures of a capture."""
    result = Stats()
    asked: dict[int, Packet] = {}
    last_seq: int | None = None  # of the MCU in this session
    for packet in packets(_measured(records, result)):
        flow = result.to_mcu if packet.to_mcu else result.from_mcu
        size = len(packet.wire) + 1
        if packet.is_damaged:
            flow.damaged += 1
            flow.damaged_bytes += size
            continue
        name = packet.message.name if packet.message else "unknown"
        flow.packets[name] += 1
        flow.bytes[name] += size
        if packet.to_mcu:
            _count_command(packet, asked, result)
            if name == "hello":
                last_seq = None
            continue
        if last_seq is not None:
            result.lost += (packet.seq - last_seq - 1) & 255
        last_seq = packet.seq
        if packet.message and name == "ack":
            _count_answer(packet.at_us, packet.message, asked, result)
    result.unanswered += len(asked)
    result.round_trips_us.sort()
    return result


def _measured(records: Iterable[Record], result: Stats) -> Iterator[Record]:
    for record in records:
        result.length_us = record.at_us
        yield record


def _count_command(packet: Packet, asked: dict[int, Packet], result: Stats) -> None:
    before = asked.get(packet.seq)
    if before and before.wire == packet.wire:
        result.repeated += 1
        return
    if before:
        result.unanswered += 1
    asked[packet.seq] = packet


def _count_answer(at_us: int, message: Message, asked: dict[int, Packet], result: Stats) -> None:
    if message.fields["status"] == messages.RESEND:
        result.resends += 1
        return
    command = asked.pop(message.fields["seq"], None)
    if command:
        result.round_trips_us.append(at_us - command.at_us)
        result.refused += message.fields["status"] != messages.OK


def stats_text(figures: Stats, baud: int = BAUD) -> str:
    """Return figures as a table; `baud` is the line's rate, of which shares are told."""
    length_s = figures.length_us / 1e6
    lines = [f"{length_s:.3f} s"]
    for title, flow in (("to the MCU", figures.to_mcu), ("from the MCU", figures.from_mcu)):
        lines += ["", f"{title:24}{'packets':>9}{'bytes':>10}{'bytes/s':>10}{'of ' + str(baud) + ' baud':>18}"]
        rows = [(name, count, flow.bytes[name]) for name, count in sorted(flow.packets.items())]
        if flow.damaged:
            rows.append(("damaged", flow.damaged, flow.damaged_bytes))
        rows.append(("all", flow.all_packets + flow.damaged, flow.all_bytes))
        for name, count, size in rows:
            rate = f"{size / length_s:.0f}" if length_s else "-"
            share = f"{size * BITS_PER_BYTE / length_s / baud:.2%}" if length_s else "-"
            lines.append(f"  {name:22}{count:9d}{size:10d}{rate:>10}{share:>18}")
    lines += [
        "",
        f"damaged        {figures.to_mcu.error_rate:.3%} to the MCU, {figures.from_mcu.error_rate:.3%} from it",
        f"commands       {figures.repeated} repeated, {figures.resends} gaps told, {figures.refused} refused, "
        f"{figures.unanswered} unanswered",
        f"telemetry      {figures.lost} packets of the MCU lost",
    ]
    trips = [(name, figures.round_trip_us(percent)) for name, percent in (("p50", 50), ("p99", 99), ("max", 100))]
    text = ", ".join(f"{name} {trip_us / 1000:.3f} ms" for name, trip_us in trips if trip_us is not None)
    lines.append(f"round trips    {text or 'none'}")
    return "\n".join(lines)
