"""The link's kernels: telemetry packed, and the packet codec."""

import struct
import zlib
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, weights_q28, words

TELEMETRY = load_checked("firmware/telemetry.py")
CODEC = load_checked("shared/codec.py")
BODY_MAX, WIRE_MAX = CODEC.BODY_MAX, CODEC.WIRE_MAX


@given(st.integers(0, 8), st.integers(0, 3), st.lists(integers(0, 65535, 32768), max_size=48), st.integers(0, 2))
def test_values_are_packed_little_endian_from_their_place_on(at, first, values, others):
    body = bytearray(b"\xa5" * (at + 2 * len(values) + 3))
    ring = halves([0xA5A5] * first + values + [0x5A5A] * others)
    end = TELEMETRY._pack_values(body, at, len(values), ring, first)
    assert end == at + 2 * len(values)
    assert body == b"\xa5" * at + b"".join(value.to_bytes(2, "little") for value in values) + b"\xa5" * 3


words_of_32_bits = integers(-(1 << 31), (1 << 31) - 1, -1, 0, 1, -(1 << 15), 1 << 16)


@given(st.integers(0, 8), st.lists(st.tuples(words_of_32_bits, words_of_32_bits), max_size=16))
def test_pairs_of_words_are_packed_little_endian_with_their_sign(at, pairs):
    body = bytearray(b"\xa5" * (at + 8 * len(pairs) + 3))
    first, second = (words([pair[n] for pair in pairs]) for n in range(2))
    end = TELEMETRY._pack_pairs(body, at, len(pairs), first, second)
    assert end == at + 8 * len(pairs)
    assert body == b"\xa5" * at + b"".join(struct.pack("<ii", *pair) for pair in pairs) + b"\xa5" * 3


@given(st.integers(0, 8), st.lists(st.integers(0, 63), max_size=64), st.lists(weights_q28, min_size=64, max_size=64))
def test_weights_are_packed_in_q12_rounded(at, playing, weights):
    body = bytearray(at + 3 * len(playing))
    end = TELEMETRY._pack_weights(body, at, len(playing), bytes(playing), words(weights))
    assert end == len(body)
    expected = [bytes([i]) + ((weights[i] + (1 << 15)) // (1 << 16)).to_bytes(2, "little") for i in playing]
    assert body[at:] == b"".join(expected)


bodies = st.binary(max_size=BODY_MAX) | st.lists(st.sampled_from([0, 0, 1, 255]), max_size=BODY_MAX).map(bytes)


@given(bodies)
def test_checksum_is_that_of_zlib(body):
    crc = halves([7, 7])
    CODEC._checksum(body, len(body), CODEC._CRC_LOW, CODEC._CRC_HIGH, crc)
    assert crc[0] | crc[1] << 16 == zlib.crc32(body)


@given(bodies)
def test_encoding_is_cobs_and_decoding_gives_the_body_back(body):
    wire = bytearray(WIRE_MAX)
    length = CODEC.encode(body, len(body), wire)
    # Cheshire and Baker: every run up to a zero has its length plus one in front; no run here is longer than 253.
    assert wire[:length] == b"".join(bytes([len(run) + 1]) + run for run in body.split(b"\0")) + b"\0"
    decoded = CODEC.decode(wire, length - 1)
    assert wire[:decoded] == body


@given(st.binary(max_size=WIRE_MAX) | st.lists(st.integers(0, 4), max_size=WIRE_MAX).map(bytes))
def test_decoding_of_any_bytes_stays_inside_them(data):
    wire = bytearray(data)
    assert -1 <= CODEC.decode(wire, len(wire)) <= len(data)


@pytest.mark.parametrize("size", [0, 1, 253, 254])
@pytest.mark.parametrize("fill", [0, 1, 255])
def test_coding_of_the_longest_bodies_fits_its_buffers(size, fill):
    body = bytes([fill]) * size
    wire = bytearray(size + 2)
    assert CODEC.encode(body, size, wire) == size + 2
    assert CODEC.decode(wire, size + 1) == size and wire[:size] == body


def test_telemetry_of_the_largest_puppet_fits_a_packet():
    taps = 3
    body = bytearray(BODY_MAX)
    values = halves([65535] * formats.FRAMES_KEPT * formats.DOFS_MAX)
    end = TELEMETRY._pack_values(body, 7, taps * formats.DOFS_MAX, values, 0)
    assert end + 4 <= BODY_MAX
    end = TELEMETRY._pack_weights(body, 6, formats.ACTIONS_MAX, bytes(range(64)), array("i", [formats.WEIGHT_MAX] * 64))
    assert end + 4 <= BODY_MAX
    derivatives = words([-1] * formats.DOFS_MAX)
    assert TELEMETRY._pack_pairs(body, 6, formats.DOFS_MAX, derivatives, derivatives) + 4 <= BODY_MAX
