"""Damaged packets, in either direction: none is taken for a good one, every one is counted, and the motion does not notice.

What is damaged and what is not is decided by a decoder written here from the definitions, with zlib's checksum.
"""

import random
import zlib
from dataclasses import dataclass

import pytest

from marotte.link import Link, pack, wire_packet
from marotte.mcu.unix import UnixMcu
from shared import codec, messages
from tests.link.carriers import ScriptedCarrier
from tests.link.stage import FRAME_US, begin_performance

COMMANDS = [message for message in messages.MESSAGES if message[1] < 128]
ANSWERS = [message for message in messages.MESSAGES if message[1] >= 128]
LARGEST = {"B": 0xFF, "H": 0xFFFF, "I": 0xFFFFFFFF, "i": 0x7FFFFFFF}
SETTLE_FRAMES = 5


def uncobs(wire: bytes) -> bytes | None:
    """Undo COBS by its definition; None for what is not COBS."""
    runs = []
    while wire:
        length = wire[0]
        if len(wire) < length:
            return None
        runs.append(wire[1:length])
        wire = wire[length:]
    return b"\0".join(runs)


def is_command(wire: bytes) -> bool:
    """Whether bytes between two zeros are a packet for the MCU."""
    body = uncobs(wire)
    if body is None or len(body) < 6 or len(wire) > codec.WIRE_MAX:
        return False
    return body[0] < 128 and zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")


def is_message(wire: bytes) -> bool:
    """Whether bytes between two zeros are a packet that the host understands."""
    body = uncobs(wire)
    if body is None or len(body) < 6 or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        return False
    message = messages.find(body[0])
    return message is not None and messages.length_fits(message, len(body) - 6)


def is_call(wire: bytes) -> bool:
    """Whether bytes between two zeros begin as mpremote does when it wants the REPL."""
    return wire[:3] in (b"\r\x03\r", b"\r\x03\x03")


def any_packet(rng: random.Random, seq: int, among=COMMANDS) -> bytes:
    """A sound packet with any command, any values, and the number that the MCU expects: accepted, it would be carried out."""
    name, message_id, fields, items = rng.choice(among)
    values = {field: rng.choice((0, 1, rng.randrange(LARGEST[kind] + 1))) for field, kind in fields}
    if "frame" in values:
        values["frame"] = -1
    entries = [{field: rng.randrange(LARGEST[kind] + 1) for field, kind in items} for _ in range(rng.randrange(6))]
    return wire_packet(message_id, seq, pack(name, values, entries if items else []))


def flip(rng: random.Random, wire: bytearray) -> None:
    wire[rng.randrange(len(wire))] ^= 1 << rng.randrange(8)


def replace(rng: random.Random, wire: bytearray) -> None:
    wire[rng.randrange(len(wire))] = rng.randrange(256)


def drop(rng: random.Random, wire: bytearray) -> None:
    place = rng.randrange(len(wire))
    del wire[place : place + rng.choice((1, 1, 2, 5))]


def insert(rng: random.Random, wire: bytearray) -> None:
    place = rng.randrange(len(wire))
    wire[place:place] = rng.randbytes(rng.choice((1, 1, 2, 40))) if rng.random() < 0.7 else bytes(1)


def swap(rng: random.Random, wire: bytearray) -> None:
    one, other = rng.randrange(len(wire)), rng.randrange(len(wire))
    wire[one], wire[other] = wire[other], wire[one]


def truncate(rng: random.Random, wire: bytearray) -> None:
    del wire[rng.randrange(len(wire)) :]


def run_together(rng: random.Random, wire: bytearray) -> None:
    """Lose the zero between two packets, or write one over the end of the other."""
    place = wire.find(0)
    del wire[place - rng.randrange(3) : place + 1]


DAMAGES = (flip, flip, replace, drop, insert, swap, truncate, run_together)


@dataclass
class Noise:
    """Damaged packets from a seed, and what came of making them. They are commands, or what the MCU sends."""

    rng: random.Random
    seq: int
    to_mcu: bool = True
    packets: int = 0  # handed out
    pieces: int = 0  # what they are between zeros: what the MCU has to count
    sound: int = 0  # damages after which a packet was still sound, or had become another sound one; not handed out
    calls: int = 0  # damages that made a call for the REPL; not handed out

    def next(self) -> bytes:
        """A packet, or two that follow each other, damaged in one to three ways; ends with a zero."""
        while True:
            count = self.rng.choice((1, 1, 1, 2))
            among = COMMANDS if self.to_mcu else ANSWERS
            wire = bytearray(b"".join(any_packet(self.rng, self.seq, among) for _ in range(count)))
            for _ in range(self.rng.choice((1, 1, 2, 3))):
                if wire:
                    self.rng.choice(DAMAGES)(self.rng, wire)
            pieces = [piece for piece in bytes(wire).split(b"\0") if piece]
            is_sound = is_command if self.to_mcu else is_message
            if self.to_mcu and any(is_call(piece) for piece in pieces):
                self.calls += 1
            elif any(is_sound(piece) for piece in pieces):
                self.sound += 1
            else:
                self.packets += count
                self.pieces += len(pieces)
                return bytes(wire) + b"\0"


def perform(mcu, packets: int, a_frame: int, frames: int):
    """Play so many frames, with `packets` damaged packets, `a_frame` at a time; return taps, status and noise."""
    session = begin_performance(mcu)
    before = session.status()
    repeated = session.link.counters.repeated  # while tables were put into force
    noise = Noise(random.Random(packets + a_frame), session.link._seq)
    taps = []
    while len(taps) < frames:
        sent = noise.packets
        while noise.packets < packets and noise.packets < sent + a_frame:
            noise.seq = session.link._seq
            mcu.send(noise.next())
        session.pump(FRAME_US // 2)
        while session.taps:
            taps.append(session.taps.popleft())
    assert noise.packets >= packets
    session.flush()
    sent = session.link.counters.sent
    after = session.status()
    assert session.link.counters.repeated == repeated, "a good command was lost"
    assert session.link.counters.sent == sent + 1
    return taps[:frames], before, after, noise, session


def check_undisturbed(make_mcu, packets: int, a_frame: int) -> Noise:
    """Play with and without damaged packets; nothing but the counter of damaged ones may differ."""
    frames = 2 * packets // a_frame + SETTLE_FRAMES
    with make_mcu() as mcu:
        taps, before, after, noise, session = perform(mcu, packets, a_frame, frames)
        assert after["damaged"] - before["damaged"] == noise.pieces
        assert after["packets"] == session.link.counters.sent + session.link.counters.repeated
        assert after["late_frames"] == 0
    with make_mcu() as mcu:
        quiet, _, after, _, _ = perform(mcu, 0, a_frame, frames)
        assert after["damaged"] == before["damaged"]
    assert [frame for frame, _, _ in taps] == list(range(frames))
    assert taps == quiet
    assert len({tuple(values) for _, _, values in taps}) > frames // 2, "the puppet hardly moved"
    return noise


def check_host(packets: int) -> Noise:
    """Let damaged packets come to the host's link, which has a command under way; it must take none of them."""
    noise = Noise(random.Random(packets), 0, to_mcu=False)
    carrier = ScriptedCarrier(lambda *_: (b"", 0))
    received = []
    link = Link(carrier, received.append)
    link.post("ping", on_refused=lambda *refusal: received.append(refusal))
    while noise.packets < packets:
        wire = noise.next()
        carrier.read = lambda wait_us, wire=wire: wire
        link.pump(0)
    assert (received, link.counters.received, link.pending) == ([], 0, 1)
    assert link.counters.damaged == noise.pieces
    return noise


@pytest.mark.parametrize(
    ("wire", "sound"),
    [
        (wire_packet(messages.PING, 0, b"")[:-1], True),
        (wire_packet(messages.PING, 0, b"\0\0")[:-1], True),
        (wire_packet(messages.ACK, 0, b"")[:-1], False),
        (wire_packet(messages.PING, 0, b"")[:-2], False),
        (b"\x01\x01\x01\x01\x01", False),
        (b"\x07\x11\x01\x01\x01\x01\x01", False),
    ],
)
def test_independent_decoder_knows_packets(wire, sound):
    assert is_command(wire) == sound


def test_damaged_packets_are_counted_and_leave_the_motion_alone():
    noise = check_undisturbed(UnixMcu, packets=20_000, a_frame=100)
    assert noise.sound < noise.packets // 4, "most of the noise is none"


def test_host_counts_damaged_packets_and_takes_none():
    noise = check_host(5_000)
    assert noise.sound < noise.packets // 4, "most of the noise is none"


@pytest.mark.soak
def test_host_takes_none_of_a_million_damaged_packets():
    noise = check_host(1_000_000)
    print(f"\n{noise.packets} damaged packets, {noise.pieces} pieces; {noise.sound} sound left out")


@pytest.mark.images
def test_damaged_packets_leave_the_motion_of_an_rp2040_alone(rp2040_mcu):
    check_undisturbed(rp2040_mcu, packets=1000, a_frame=4)


@pytest.mark.soak
def test_a_million_damaged_packets_leave_the_motion_alone():
    noise = check_undisturbed(UnixMcu, packets=1_000_000, a_frame=1000)
    print(
        f"\n{noise.packets} damaged packets, {noise.pieces} pieces; {noise.sound} sound, {noise.calls} calls left out"
    )
