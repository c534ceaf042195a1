"""Damaged packets: none is taken for a good one, every one is counted, and the motion does not notice.

What is damaged and what is not is decided by a decoder written here from the definitions, with zlib's checksum.
"""

import random
import zlib
from dataclasses import dataclass

import pytest

from marotte.link import pack, wire_packet
from marotte.mcu.unix import UnixMcu
from shared import codec, messages
from tests.link.stage import FRAME_US, begin_performance

COMMANDS = [message for message in messages.MESSAGES if message[1] < 128]
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


def is_call(wire: bytes) -> bool:
    """Whether bytes between two zeros begin as mpremote does when it wants the REPL."""
    return wire[:3] in (b"\r\x03\r", b"\r\x03\x03")


def any_packet(rng: random.Random, seq: int) -> bytes:
    """A sound packet with any command, any values, and the number that the MCU expects: accepted, it would be carried out."""
    name, message_id, fields, items = rng.choice(COMMANDS)
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
    """Damaged packets from a seed, and what came of making them."""

    rng: random.Random
    seq: int
    packets: int = 0  # handed out
    pieces: int = 0  # what they are between zeros: what the MCU has to count
    sound: int = 0  # damages after which a packet was still sound, or had become another sound one; not handed out
    calls: int = 0  # damages that made a call for the REPL; not handed out

    def next(self) -> bytes:
        """A packet, or two that follow each other, damaged in one to three ways; ends with a zero."""
        while True:
            count = self.rng.choice((1, 1, 1, 2))
            wire = bytearray(b"".join(any_packet(self.rng, self.seq) for _ in range(count)))
            for _ in range(self.rng.choice((1, 1, 2, 3))):
                if wire:
                    self.rng.choice(DAMAGES)(self.rng, wire)
            pieces = [piece for piece in bytes(wire).split(b"\0") if piece]
            if any(is_call(piece) for piece in pieces):
                self.calls += 1
            elif any(is_command(piece) for piece in pieces):
                self.sound += 1
            else:
                self.packets += count
                self.pieces += len(pieces)
                return bytes(wire) + b"\0"


def perform(mcu, packets: int, a_frame: int, frames: int):
    """Play so many frames, with `packets` damaged packets, `a_frame` at a time; return taps, status and noise."""
    session = begin_performance(mcu)
    before = session.status()
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
    assert session.link.counters.repeated == 0, "a good command was lost"
    assert session.link.counters.sent == sent + 1
    return taps[:frames], before, after, noise, session


def check_undisturbed(make_mcu, packets: int, a_frame: int) -> Noise:
    """Play with and without damaged packets; nothing but the counter of damaged ones may differ."""
    frames = 2 * packets // a_frame + SETTLE_FRAMES
    with make_mcu() as mcu:
        taps, before, after, noise, session = perform(mcu, packets, a_frame, frames)
        assert after["damaged"] - before["damaged"] == noise.pieces
        assert after["packets"] == session.link.counters.sent
        assert after["late_frames"] == 0
    with make_mcu() as mcu:
        quiet, _, after, _, _ = perform(mcu, 0, a_frame, frames)
        assert after["damaged"] == before["damaged"]
    assert [frame for frame, _, _ in taps] == list(range(frames))
    assert taps == quiet
    assert len({tuple(values) for _, _, values in taps}) > frames // 2, "the puppet hardly moved"
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


@pytest.mark.images
def test_damaged_packets_leave_the_motion_of_an_rp2040_alone(rp2040_mcu):
    check_undisturbed(rp2040_mcu, packets=1000, a_frame=4)


@pytest.mark.soak
def test_a_million_damaged_packets_leave_the_motion_alone():
    noise = check_undisturbed(UnixMcu, packets=1_000_000, a_frame=1000)
    print(
        f"\n{noise.packets} damaged packets, {noise.pieces} pieces; {noise.sound} sound, {noise.calls} calls left out"
    )
