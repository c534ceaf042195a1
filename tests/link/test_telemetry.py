"""Telemetry: what comes how often, when none comes, and that a host which does not take it does not hold the motion up."""

import itertools

import pytest

from marotte.link import wire_packet
from marotte.mcu.unix import UnixMcu
from shared import formats, messages
from tests.link.stage import FRAME_US, begin_performance, pet_tables

DOFS = len(pet_tables().puppet.dofs)
LINK_TIMEOUT_US = 500_000
BLOCKED_US = 1_100_000
"""A write over USB gives up after half a second without progress, and Python tries the rest of it once more."""


@pytest.fixture
def session():
    """A session with the pet playing on the PC."""
    with UnixMcu() as mcu:
        yield begin_performance(mcu)


def frames_of(session, frames):
    """Let so many frames pass; return those that taps tell of."""
    session.flush()
    session.taps.clear()
    end_us = session.carrier.now_us() + frames * FRAME_US
    while session.carrier.now_us() < end_us:
        session.pump(10_000)
    return [frame for frame, _, _ in session.taps]


@pytest.mark.parametrize("every", [1, 2, 3, 7])
def test_telemetry_comes_every_so_many_frames(session, every):
    session.telemetry(formats.TAP_BASE, every, 0)
    frames = frames_of(session, 60)
    assert all(frame % every == 0 for frame in frames)
    assert {b - a for a, b in itertools.pairwise(frames)} == {every}
    assert len(frames) == pytest.approx(60 / every, abs=1)


@pytest.mark.parametrize("taps", range(8))
def test_telemetry_has_the_values_of_its_taps(session, taps):
    session.telemetry(taps, 1, 0)
    frames_of(session, 3)
    assert all(len(values) == DOFS * taps.bit_count() for _, _, values in session.taps)
    assert all(told == taps for _, told, _ in session.taps)
    assert bool(session.taps) == bool(taps)


def test_telemetry_tells_the_weights_of_what_plays(session):
    session.telemetry(0, 0, 1)
    frames_of(session, 60)
    frame, before = session.weights
    assert frame > 40 and set(before) == {0, 1, 2, 3}
    frames_of(session, 10)
    frame, after = session.weights
    assert frame > 50 and 0 < after[0] < before[0] and before[3] < after[3] <= 4096


def test_telemetry_ends_with_a_new_greeting(session):
    assert frames_of(session, 5)
    session.open()
    assert session.welcome["frame"] > 0
    assert frames_of(session, 10) == []


def test_telemetry_pauses_while_the_link_is_silent(session):
    mcu = session.carrier.mcu
    session.telemetry(formats.TAP_BASE, 1, 0)
    frames_of(session, 3)
    heard_us = mcu.now_us
    mcu.run_for(2 * LINK_TIMEOUT_US)
    sent_us = [t_us for t_us, _ in mcu.receive()]
    assert len(sent_us) > 10
    assert sent_us[-1] <= heard_us + LINK_TIMEOUT_US + FRAME_US
    assert len(frames_of(session, 10)) >= 9


def test_partial_packet_is_dropped_after_a_pause(session):
    mcu = session.carrier.mcu
    before = session.status()
    mcu.send(wire_packet(messages.PING, session.link._seq, b"")[:5])
    session.pump(30_000)
    session.stop()  # not spoilt by what was left behind
    session.flush()
    assert session.link.counters.repeated == 0
    assert session.status()["damaged"] == before["damaged"] + 1


@pytest.mark.images
def test_host_that_does_not_read_holds_the_motion_up_once(rp2040_mcu):
    with rp2040_mcu() as mcu:
        session = begin_performance(mcu)
        session.pump(300_000)
        begun = session.status()
        begun_us = mcu.now_us
        mcu.set_host_reading(False)
        for _ in range(40):
            mcu.send(wire_packet(messages.PING, session.link._seq, b""))  # alive, but deaf
            mcu.run_for(100_000)
        mcu.set_host_reading(True)
        mcu.run_for(100_000)
        mcu.receive()
        session.link._seq = (session.link._seq + 1) & 255
        status = session.status()
        assert status["frame"] - begun["frame"] == pytest.approx((mcu.now_us - begun_us) / FRAME_US, abs=1)
        assert status["late_max_us"] < BLOCKED_US
        assert status["late_frames"] <= BLOCKED_US / FRAME_US
