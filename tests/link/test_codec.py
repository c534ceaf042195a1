"""The packet codec: against zlib, against COBS as its paper has it, on hostile bytes, and on both interpreters."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.images import unix_binary
from shared import codec, messages

CHECKOUT = Path(__file__).parents[2]
LONGEST = codec.BODY_MAX
GUARD = 0xA5

body_bytes = st.one_of(
    st.binary(max_size=LONGEST),
    st.lists(st.sampled_from([0, 0, 1, 255]), max_size=LONGEST).map(bytes),
)


def cobs(body: bytes) -> bytes:
    """COBS by its definition, for bodies of at most 253 bytes: each run up to a zero, its length plus one in front."""
    return b"".join(bytes([len(run) + 1]) + run for run in body.split(b"\0"))


def encoded(body: bytes) -> bytes:
    """What the codec puts on the wire, having checked that it writes nothing behind it."""
    wire = bytearray([GUARD]) * (codec.WIRE_MAX + 8)
    length = codec.encode(body, len(body), wire)
    assert wire[length:] == bytes([GUARD]) * (len(wire) - length)
    return bytes(wire[:length])


@given(st.binary(max_size=LONGEST))
def test_checksum_equals_that_of_zlib(data):
    assert codec.crc32(data) == zlib.crc32(data)


@given(st.binary(min_size=2, max_size=LONGEST - 4))
def test_seal_appends_the_checksum_and_touches_nothing_else(data):
    body = bytearray([GUARD]) * (LONGEST + 4)
    body[: len(data)] = data
    length = codec.seal(body, len(data))
    assert length == len(data) + 4
    assert body[:length] == data + zlib.crc32(data).to_bytes(4, "little")
    assert body[length:] == bytes([GUARD]) * (len(body) - length)
    assert codec.is_sealed(body, length)


@given(st.binary(min_size=2, max_size=LONGEST - 4), st.integers(0), st.integers(1, 255))
def test_seal_does_not_hold_for_a_changed_byte(data, place, change):
    sealed = bytearray(data + zlib.crc32(data).to_bytes(4, "little"))
    sealed[place % len(sealed)] ^= change
    assert not codec.is_sealed(sealed, len(sealed))


@pytest.mark.parametrize("length", range(codec.OVERHEAD))
def test_seal_does_not_hold_below_the_least_length(length):
    data = bytes(max(0, length - 4))
    sealed = (data + zlib.crc32(data).to_bytes(4, "little"))[-length or 8 :]
    assert not codec.is_sealed(sealed, length)


@given(body_bytes)
def test_encoding_is_cobs_and_ends_with_the_only_zero(body):
    wire = encoded(body)
    assert wire == cobs(body) + b"\0"
    assert wire.index(0) == len(wire) - 1
    assert len(wire) == len(body) + 2 <= codec.WIRE_MAX


@given(body_bytes)
def test_decoding_gives_the_body_back(body):
    wire = bytearray(encoded(body)[:-1])
    assert codec.decode(wire, len(wire)) == len(body)
    assert wire[: len(body)] == body


@pytest.mark.parametrize("fill", [0, 1, 255])
def test_decoding_gives_bodies_of_every_length_back(fill):
    for length in range(LONGEST + 1):
        body = bytes([fill]) * length
        wire = bytearray(encoded(body)[:-1])
        assert codec.decode(wire, len(wire)) == length
        assert wire[:length] == body


@given(st.binary(max_size=codec.WIRE_MAX))
def test_decoding_of_any_bytes_stays_inside_them(data):
    exact = bytearray(data)  # one byte further raises IndexError, for reading and for writing
    length = codec.decode(exact, len(exact))
    assert -1 <= length <= max(0, len(data) - 1)
    guarded = bytearray(data) + bytes([GUARD]) * 300
    assert codec.decode(guarded, len(data)) == length
    assert guarded[len(data) :] == bytes([GUARD]) * 300
    if length >= 0 and data:
        assert cobs(bytes(exact[:length])) == data


@pytest.mark.parametrize(
    ("wire", "what"),
    [
        (b"\x00", "a zero as code"),
        (b"\x02", "a code that points behind the end"),
        (b"\x03\x11", "a run that is cut short"),
        (b"\x02\x11\x00", "a zero as second code"),
        (b"\x02\x11\xff", "a second run that is cut short"),
        (b"\xff" + b"\x11" * 253, "a full run without its last byte"),
    ],
)
def test_decoding_refuses_what_is_not_cobs(wire, what):
    assert codec.decode(bytearray(wire), len(wire)) == -1, what


@pytest.mark.parametrize("message", messages.MESSAGES, ids=lambda message: message[0])
def test_no_packet_begins_as_a_call_for_the_repl(message):
    for payload in (b"", bytes(20), b"\x11" * 20, b"\x11" * 9 + bytes(9)):
        for seq in range(256):
            body = bytes([message[1], seq]) + payload
            wire = encoded(body + zlib.crc32(body).to_bytes(4, "little"))
            assert wire[:2] != bytes([codec.HANDOVER_FIRST, codec.HANDOVER_SECOND])


@pytest.mark.parametrize(("kind", "bits"), [("unix", 64), pytest.param("unix32", 32, marks=pytest.mark.images)])
def test_codec_gives_the_same_bytes_on_micropython(kind, bits):
    script = str(Path(__file__).with_name("codec_answers.py"))
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "MICROPYPATH": str(CHECKOUT)}
    told = [
        subprocess.run([binary, script], env=environment, capture_output=True, text=True, timeout=60, check=True).stdout
        for binary in (sys.executable, str(unix_binary(bits)))
    ]
    assert told[0].count("\n") == LONGEST - 5
    assert told[1] == told[0]
