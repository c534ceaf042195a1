"""The inbox: packets in their order whatever the pieces they come in, kills at once, and where a call for the REPL begins."""

from hypothesis import given
from hypothesis import strategies as st

from marotte.link import wire_packet
from shared import codec, messages
from tests.checked import load_checked
from tests.kernels.values import halves

MODULE = load_checked("firmware/inbox.py")
STALE_US = MODULE._STALE_US
KILL_LENGTH = 7
"""Of a kill on the wire, without its zero: a code, an id, a number, a checksum of four bytes."""


class Board:
    """Gives what a test has put there, some bytes at a time."""

    def __init__(self):
        self.now_us = 0
        self.bytes = bytearray()
        self.most = 255

    def ticks_us(self):
        return self.now_us

    def receive(self, buffer):
        count = min(len(buffer), len(self.bytes), self.most)
        buffer[:count] = self.bytes[:count]
        del self.bytes[:count]
        return count


def inbox_of(board):
    killed = []
    return MODULE.Inbox(board, killed.append), killed


WIRE = bytearray(codec.WIRE_MAX)
"""Where packets are moved, one after the other; of one that is not complete its beginning is there."""


def packets(inbox):
    """Take all packets that are complete."""
    while length := inbox.next(WIRE):
        yield bytes(WIRE[:length])


def kill(seq):
    return wire_packet(messages.KILL, seq, b"")


def is_call(piece):
    return piece[:2] == b"\r\x03"


octets = st.lists(st.sampled_from([0, 1, 255]) | st.integers(0, 255), max_size=64).map(bytes)
streams = st.lists(octets | st.integers(0, 255).map(kill), max_size=12)


@given(streams, st.integers(1, 40), st.integers(1, 6))
def test_packets_come_out_whole_and_in_their_order_and_every_kill_as_soon_as_it_is_seen(stream, most, looks):
    everything = b"".join(stream) + b"\0"
    if any(is_call(piece) for piece in everything.split(b"\0")):
        return
    board = Board()
    board.most = most
    board.bytes += everything
    inbox, killed = inbox_of(board)
    found = []
    while board.bytes or inbox.waiting():
        seen = len(everything) - len(board.bytes)
        for _ in range(looks):
            inbox.look()
            seen = len(everything) - len(board.bytes)
            assert killed == [seq_of(piece) for piece in everything[:seen].split(b"\0")[:-1] if is_kill(piece)]
        found += packets(inbox)
    assert found == [piece for piece in everything.split(b"\0") if piece]


def is_kill(piece):
    return any(piece + b"\0" == kill(seq) for seq in range(256))


def seq_of(piece):
    return next(seq for seq in range(256) if piece + b"\0" == kill(seq))


def test_kill_behind_all_that_fits_acts_before_any_of_it_is_taken():
    board = Board()
    inbox, killed = inbox_of(board)
    before = b"\1" * 200 + b"\0"
    board.bytes += before + kill(9)
    while board.bytes:
        inbox.look()
    assert killed == [9] and next(packets(inbox)) == before[:-1]


def test_kill_of_which_one_bit_is_wrong_does_nothing():
    for place in range(KILL_LENGTH):
        for bit in range(8):
            board = Board()
            inbox, killed = inbox_of(board)
            wire = bytearray(kill(9))
            wire[place] ^= 1 << bit
            board.bytes += wire
            inbox.look()
            assert killed == []


def test_what_finds_no_room_waits_on_the_board():
    board = Board()
    inbox, _ = inbox_of(board)
    board.bytes += (b"\1" * 50 + b"\0") * 20
    while inbox.look() < 224:
        pass
    left = len(board.bytes)
    assert inbox.look() == 20 * 51 - left <= 256 and len(board.bytes) == left
    assert len(list(packets(inbox))) == (20 * 51 - left) // 51


@given(st.integers(253, 3000), st.integers(1, 255))
def test_of_a_packet_that_is_too_long_only_the_length_is_known(length, byte):
    board = Board()
    inbox, _ = inbox_of(board)
    board.bytes += bytes([byte]) * length + b"\0\5\0"
    wire = bytearray(codec.WIRE_MAX)
    found = []
    while board.bytes or inbox.waiting():
        inbox.look()
        found.append(inbox.next(wire))
    assert [length for length in found if length] == [min(length, 1000), 1]


def test_pause_ends_a_packet_only_where_the_line_was_seen_to_be_still():
    for is_seen in (True, False):
        board = Board()
        inbox, _ = inbox_of(board)
        board.bytes += b"\5\5"
        inbox.look()
        if is_seen:
            inbox.look()
        board.now_us += STALE_US + 1
        board.bytes += b"\6\0"
        inbox.look()
        assert list(packets(inbox)) == ([b"\5\5", b"\6"] if is_seen else [b"\5\5\6"])


def test_what_follows_a_call_for_the_repl_is_left_on_the_board():
    board = Board()
    inbox, _ = inbox_of(board)
    board.bytes += b"\1\0\r\3"
    inbox.look()
    board.bytes += b"\r\3print"
    inbox.look()
    assert not inbox.is_calling(), "a packet waits"
    assert list(packets(inbox)) == [b"\1"]
    assert inbox.is_calling() and board.bytes == b"\3print"


def test_call_is_one_after_a_pause_and_none_if_another_byte_follows():
    board = Board()
    inbox, _ = inbox_of(board)
    board.bytes += b"\r\3"
    inbox.look()
    assert list(packets(inbox)) == []
    board.now_us += STALE_US
    assert not inbox.is_calling()
    board.now_us += 1
    assert inbox.is_calling()
    board.bytes += b"\7\0"
    assert not inbox.is_calling()
    inbox.look()
    assert list(packets(inbox)) == [b"\r\3", b"\7"], "the pause has ended what was before it"


@given(octets, st.integers(0, 255), st.integers(0, 255), st.integers(0, 1000))
def test_kernels_stay_inside_their_arrays(chunk, first, waiting, length):
    """Whatever the state: places are taken modulo the ring's size, lengths stay at 1000."""
    waiting = min(waiting, 256 - len(chunk))
    state = halves([length, first, waiting, length, messages.KILL])
    ring, packet = bytearray(range(256)), bytearray(KILL_LENGTH)
    expected = bytearray(ring)
    for n, byte in enumerate(chunk):
        expected[(first + waiting + n) % 256] = byte
    start = 0
    while start >= 0:
        start = MODULE._store(ring, chunk, start, len(chunk), packet, KILL_LENGTH, state)
    assert (ring, state[2]) == (expected, waiting + len(chunk)) and state[0] <= 1000
    wire = bytearray(codec.WIRE_MAX)
    while state[2]:
        assert 0 <= MODULE._next(ring, wire, len(wire), state) <= 1000
    assert state[1] == (first + waiting + len(chunk)) % 256
