"""The exchange of tables in the firmware with every integer checked: the motion stays, nonsense about the old ones is refused."""

from functools import cache
from pathlib import Path

import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from shared import formats, messages
from tests.motion.checked_mcu import CheckedMcu

PET = Path(__file__).parents[2] / "puppets" / "pet.toml"
FRAME_US = 1_000_000 // 30
FRAMES = 60


@cache
def pet_tables():
    """Return the tables of the pet; it drives nothing."""
    return marotte.build_tables(marotte.load_puppet(PET))


def begin_performance(mcu):
    """Start the pet with all actions; return the session."""
    session = marotte.Session(VirtualCarrier(mcu))
    session.carrier.read(400_000)
    session.open()
    session.upload(pet_tables())
    session.telemetry(formats.TAP_BASE, 1, 0)
    count = len(pet_tables().puppet.actions)
    session.weight_targets(0, dict.fromkeys(range(count), formats.WEIGHT_ONE))
    session.tempo(20, formats.MASTER, formats.TEMPO_ONE * 2)
    session.tempo(25, 3, formats.TEMPO_ONE)
    session.start()
    session.flush()
    return session


def performed(mcu, exchanges):
    """Return the taps of a performance in which the pet is exchanged for itself so many times."""
    session = begin_performance(mcu)
    for n in range(exchanges):
        while len(session.taps) < 5 + 15 * n:
            session.pump(FRAME_US)
        session.exchange(pet_tables(), pet_tables().puppet)
    while len(session.taps) < FRAMES:
        session.pump(FRAME_US)
    assert session.status()["late_frames"] == 0
    return list(session.taps)[:FRAMES]


def test_checked_exchange_moves_as_on_micropython_and_as_without():
    with CheckedMcu() as checked, CheckedMcu() as calm, UnixMcu() as unix:
        found = performed(checked, 3)
        assert found == performed(calm, 0)
        assert found == performed(unix, 3)


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "in motion"])
@pytest.mark.parametrize("kind", [formats.KEEP_ACTIONS, formats.KEEP_DOFS, formats.KEEP_LIVES])
@pytest.mark.parametrize("old", [60, 64, 200, 254])
def test_tables_that_keep_what_was_not_are_refused(moving, kind, old):
    with CheckedMcu() as mcu:
        session = begin_performance(mcu)
        if not moving:
            session.stop()
        *parts, commit = pet_tables().messages()
        count = (len(pet_tables().puppet.actions), len(pet_tables().puppet.dofs), 1)[kind]
        keep = "keep", {"kind": kind, "first": 0}, [{"old": old}] * count
        assert session._post_all([*parts, keep]) == []
        assert [refused.status for refused in session._post_all([commit])] == [messages.RANGE]
        session.start()
        session.taps.clear()
        while len(session.taps) < 5:
            session.pump(FRAME_US)
