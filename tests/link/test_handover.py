"""The call for the REPL: what is one, whatever pieces it comes in, and what is none."""

import itertools

import pytest

from marotte.link import VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.session import DICTIONARY, GREETING_US, OPEN_TIMEOUT_S, LinkForeign, Session
from tests.link.stage import FRAME_US, begin_performance

RAW_BANNER = b"raw REPL; CTRL-B to exit\r\n>"


@pytest.fixture(params=["unix", pytest.param("rp2040", marks=pytest.mark.images)])
def performing(request):
    """An MCU that performs with its outputs armed, and the session with it."""
    make = UnixMcu if request.param == "unix" else request.getfixturevalue("rp2040_mcu")
    with make() as mcu:
        session = begin_performance(mcu)
        session.arm()
        session.flush()
        session.pump(100_000)
        yield mcu, session


def answer(mcu, wait_us=300_000):
    mcu.run_for(wait_us)
    return b"".join(data for _, data in mcu.receive())


@pytest.mark.images
@pytest.mark.parametrize(
    "pieces",
    [
        [b"\r\x03\r\x01"],
        [b"\r\x03", b"\r\x01"],
        [b"\r", b"\x03", b"\r", b"\x01"],
        [b"\r\x03\x03\r\x01"],
        [b"\r\x03", 50_000, b"\r\x01"],
        [b"\r\x03", 50_000, b"\x01"],
        [b"\r\x03\x03", 50_000, b"\r\x01"],
        [b"\x11\x22\x33", 50_000, b"\r\x03\r\x01"],
        [b"\0\r\x03\r\x01"],
    ],
    ids=lambda pieces: " ".join(f"{piece}us" if isinstance(piece, int) else piece.hex() for piece in pieces),
)
def test_call_for_the_repl_stops_the_pulses_and_opens_it(performing, pieces):
    mcu, _ = performing
    mcu.receive()
    called_us = mcu.now_us
    for piece in pieces:
        if isinstance(piece, int):
            mcu.run_for(piece)
        else:
            mcu.send(piece)
            mcu.run_for(200)
    assert RAW_BANNER in answer(mcu)
    edges = mcu.edges(2)
    assert edges[-1][1] == 0 and edges[-1][0] < (called_us + 2 * FRAME_US + 50_000) * 1000
    mcu.send(b"print(6 * 7)\x04")
    assert answer(mcu, 50_000).replace(b"\r\n", b"\n") == b"OK42\n\x04\x04>"


@pytest.mark.parametrize(
    "data",
    [
        b"\r\x03\x10\x22\x33\x44\x55\0",
        b"\r\x03\0",
        b"\x03\x03\0",
        b"\x05\x11\r\x03\r\0",
        b"\x03\r\x03\r\0",
        b"\r\r\x03\r\0",
    ],
    ids=lambda data: data.hex(),
)
def test_other_bytes_call_for_nothing(performing, data):
    mcu, session = performing
    before = session.status()
    for pieces in ([data], [bytes([byte]) for byte in data]):
        for piece in pieces:
            mcu.send(piece)
            session.pump(1000)
    after = session.status()
    assert after["damaged"] == before["damaged"] + 2
    assert after["frame"] >= before["frame"] and after["armed"]


def test_firmware_performs_again_after_the_repl(performing):
    mcu, _ = performing
    repl = RawRepl(mcu)
    assert repl.exec("print('here')").strip() == "here"
    assert mcu.edges(2)[-1][1] == 0
    mcu.clear_edges()
    mcu.send(b"\x02")
    mcu.run_for(10_000)
    mcu.send(b"\x04")
    mcu.run_for(400_000)
    mcu.receive()
    again = begin_performance(mcu)
    assert not again.welcome["armed"] and again.welcome["frame"] == -1
    assert mcu.edges(2) == []
    again.arm()
    again.flush()
    again.pump(200_000)
    rises = [pulse.start_ns for pulse in pulses(mcu.edges(2))]
    assert len(rises) >= 8
    assert {b - a for a, b in itertools.pairwise(rises)} == {20_000_000}


@pytest.mark.parametrize(
    ("dictionary", "timeout_s"),
    [
        (DICTIONARY, 256 * GREETING_US / 1e6),  # so that each number has its turn
        (0xE4B06CE6, OPEN_TIMEOUT_S),  # with these two some of the first numbers are unfit
        (0xAFBD67F9, OPEN_TIMEOUT_S),
    ],
    ids=["all numbers", "e4b06ce6", "afbd67f9"],
)
def test_greetings_neither_restart_nor_leave_a_repl(performing, monkeypatch, dictionary, timeout_s):
    monkeypatch.setattr("marotte.session.DICTIONARY", dictionary)
    mcu, _ = performing
    RawRepl(mcu).exec("kept = 6 * 7")
    mcu.send(b"\x02")
    mcu.run_for(10_000)
    with pytest.raises(LinkForeign, match="MicroPython's REPL answers at this port"):
        Session(VirtualCarrier(mcu)).open(timeout_s)
    assert RawRepl(mcu).exec("print(kept)").strip() == "42"
