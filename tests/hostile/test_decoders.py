"""Any bytes in any pieces at both ends of the link: no exception, no growth, and the next sound packet is taken.

What is sound is decided by the decoder of `tests/link/test_damaged.py`, which is written from the definitions.
"""

import contextlib
import types

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from marotte.link import Link, LinkError, pack, wire_packet
from marotte.session import Session
from shared import codec, messages
from tests.checked import load_checked
from tests.link.test_damaged import is_call, is_command, uncobs
from tests.link.test_messages import values_of
from tests.motion.checked_mcu import SMALL_INT_FUNCTIONS

FIRMWARE = load_checked("firmware/link.py", bytecode=SMALL_INT_FUNCTIONS)
COUNT_MAX = (1 << 30) - 1
"""The largest integer that needs no memory on a 32-bit port."""

TO_MCU, FROM_MCU = ([entry for entry in messages.MESSAGES if (entry[1] < 128) == to_mcu] for to_mcu in (True, False))
PARTIAL_MAX = 4 * codec.WIRE_MAX
SOAK_EXAMPLES = 5_000


class Board:
    """What the link asks of a board: bytes, in pieces, at instants that a test chooses."""

    def __init__(self, pieces):
        self.now_us = 0
        self.sent = []
        self._pieces = [bytearray(piece) for piece in pieces if piece]

    def ticks_us(self):
        return self.now_us

    def receive(self, buffer):
        if not self._pieces:
            return 0
        piece = self._pieces[0]
        count = min(len(buffer), len(piece))
        buffer[:count] = piece[:count]
        del piece[:count]
        if not piece:
            self._pieces.pop(0)
        return count

    def send(self, data, length, is_telemetry=False):
        self.sent.append(bytes(data[:length]))

    def heap_free(self):
        return 0

    @property
    def is_empty(self):
        return not self._pieces


class Commands:
    """Carries out nothing, and notes what it was told."""

    def __init__(self):
        self.told = []
        self.detail = 0
        self.dictionary = 0
        self.allocates = bytearray(128)

    def carry_out(self, message_id, body, length):
        self.told.append((message_id, bytes(body[2 : 2 + length])))
        return messages.OK


def firmware_link(board):
    """Return the MCU's end of the link, with an expected sequence number of 0; it is not told what commands mean."""
    motor = types.SimpleNamespace(heard=lambda: None, kill=lambda killed_by: None, armed=False)
    link = FIRMWARE.Link(board, types.SimpleNamespace(frame=-1, motor=motor))
    link.commands = Commands()
    link.telemetry = types.SimpleNamespace(status=lambda: None)
    link._expected = 0
    return link


def drain(board, link):
    """Let the link take all there is."""
    while not board.is_empty or link.inbox.waiting():
        assert link.poll() >= 0


def buffers(thing):
    """Return the lengths of all buffers and lists of an object."""
    return {name: len(value) for name, value in vars(thing).items() if isinstance(value, bytearray | list)}


@st.composite
def packets(draw, to_mcu):
    """A sound packet with any contents."""
    name, message_id, fields, items = draw(st.sampled_from(TO_MCU if to_mcu else FROM_MCU))
    room = (codec.PAYLOAD_MAX - messages.size(fields)) // messages.size(items) if items else 0
    item_values = draw(st.lists(values_of(items), max_size=min(room, 6)))
    return wire_packet(message_id, draw(st.integers(0, 255)), pack(name, draw(values_of(fields)), item_values))


@st.composite
def spoilt(draw, to_mcu):
    """A packet with bytes changed, lost and added."""
    wire = bytearray(draw(packets(to_mcu)))
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, len(wire)))
        wire[place : place + draw(st.integers(0, 3))] = draw(st.binary(max_size=3))
    return bytes(wire)


def streams(to_mcu):
    """Pieces of a byte stream: sound packets, spoilt ones, any bytes, and much of one byte."""
    much = st.tuples(st.integers(0, 255), st.integers(200, 700)).map(
        lambda byte_count: bytes([byte_count[0]]) * byte_count[1]
    )
    return st.lists(packets(to_mcu) | spoilt(to_mcu) | st.binary(max_size=80) | much, max_size=12)


def cut(data, draw):
    """Return a stream in other pieces than it was made of."""
    places = sorted(draw(st.lists(st.integers(0, len(data)), max_size=8)))
    return [data[start:end] for start, end in zip([0, *places], [*places, len(data)], strict=True)]


def check_firmware_decoder(stream, data):
    everything = b"".join(stream)
    sound = wire_packet(messages.PING, 0, b"")
    board = Board([*cut(everything, data.draw), b"\0" + sound])
    link = firmware_link(board)
    sizes = buffers(link)
    pieces = [piece for piece in (everything + b"\0" + sound).split(b"\0") if piece]
    assume(not any(is_call(piece) or piece == b"\r\x03" for piece in pieces))  # those call the REPL
    drain(board, link)
    assert (link.packets, link.damaged) == (
        sum(is_command(piece) for piece in pieces),
        sum(not is_command(piece) for piece in pieces),
    )
    assert buffers(link) == sizes
    link._expected = 0
    before = len(link.commands.told)
    board._pieces = [bytearray(sound)]
    drain(board, link)
    assert link.commands.told[before:] == [(messages.PING, b"")]
    assert board.sent[-1] == wire_packet(messages.ACK, (len(board.sent) - 1) & 255, bytes([0, 0, 0, 0]))


@given(streams(to_mcu=True), st.data())
def test_firmware_takes_any_bytes_in_any_pieces(stream, data):
    check_firmware_decoder(stream, data)


@pytest.mark.soak
@settings(max_examples=SOAK_EXAMPLES)
@given(streams(to_mcu=True), st.data())
def test_firmware_takes_any_bytes_in_any_pieces_for_long(stream, data):
    check_firmware_decoder(stream, data)


@pytest.mark.parametrize("byte", [1, 0x55, 0xFF])
def test_bytes_without_an_end_leave_integers_that_need_no_memory(byte):
    board = Board([bytes([byte]) * 2000])
    link = firmware_link(board)
    drain(board, link)
    assert link.inbox._state[0] == link.inbox._state[3] == 1000
    board._pieces = [bytearray(b"\0" + wire_packet(messages.PING, 0, b""))]
    drain(board, link)
    assert link.damaged == 1 and link.commands.told == [(messages.PING, b"")]


@pytest.mark.parametrize("count", ["packets", "damaged"])
def test_counts_of_packets_stay_at_their_end(count):
    board = Board([wire_packet(messages.PING, 0, b"") + b"\1\0" * 2 + wire_packet(messages.PING, 1, b"")])
    link = firmware_link(board)
    setattr(link, count, COUNT_MAX)
    drain(board, link)
    assert getattr(link, count) == COUNT_MAX
    assert len(link.commands.told) == 2


class Carrier:
    """Brings what a test says, a piece at a time; nothing that is sent arrives anywhere."""

    def __init__(self, pieces):
        self.pieces = list(pieces)
        self._now_us = 0

    def now_us(self):
        return self._now_us

    def write(self, data):
        pass

    def read(self, wait_us):
        self._now_us += wait_us
        return self.pieces.pop(0) if self.pieces else b""

    def close(self):
        pass


def is_message(wire):
    """Whether bytes between two zeros are a packet that the host knows."""
    body = uncobs(wire)
    if body is None or len(body) < 6 or codec.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        return False
    entry = messages.find(body[0])
    return entry is not None and messages.length_fits(entry, len(body) - 6)


def check_host_decoder(stream, data):
    everything = b"".join(stream)
    carrier = Carrier(cut(everything, data.draw))
    received = []
    link = Link(carrier, received.append)
    while carrier.pieces:
        link.pump(1000)
        assert len(link._partial) <= PARTIAL_MAX
    *pieces, rest = everything.split(b"\0")
    pieces = [piece for piece in pieces if 0 < len(piece) <= PARTIAL_MAX]
    assert link.counters.received == sum(map(is_message, pieces))
    before = len(received)
    carrier.pieces = [b"\0" + wire_packet(messages.WEIGHTS, 9, pack("weights", {"frame": 5}, []))]
    link.pump(1000)
    *ended, last = received[before:]  # what was left may be a whole packet but for its zero
    assert (last.name, last.fields) == ("weights", {"frame": 5})
    assert len(ended) == (0 < len(rest) <= PARTIAL_MAX and is_message(rest))


@given(streams(to_mcu=False), st.data())
def test_host_takes_any_bytes_in_any_pieces(stream, data):
    check_host_decoder(stream, data)


@pytest.mark.soak
@settings(max_examples=SOAK_EXAMPLES)
@given(streams(to_mcu=False), st.data())
def test_host_takes_any_bytes_in_any_pieces_for_long(stream, data):
    check_host_decoder(stream, data)


@given(st.lists(packets(to_mcu=False), max_size=20))
def test_session_takes_any_messages(stream):
    session = Session(Carrier(stream))
    session.start()
    session.weight_targets(-1, {0: 1})
    for _ in range(len(stream)):
        with contextlib.suppress(LinkError):  # a refusal may be among them
            session.pump(1000)
    assert not session.carrier.pieces


def test_session_keeps_the_newest_taps_of_those_that_nobody_takes(monkeypatch):
    monkeypatch.setattr("marotte.session.TAPS_KEPT", 5)
    wire = [
        wire_packet(messages.TAPS, 0, pack("taps", {"frame": frame, "taps": 1}, [{"value_q15": 7}]))
        for frame in range(9)
    ]
    session = Session(Carrier(wire))
    for _ in wire:
        session.pump(1000)
    assert [frame for frame, _, _ in session.taps] == [4, 5, 6, 7, 8]
