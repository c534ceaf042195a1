"""A small performance for the tests of the link: the pet, on an emulated MCU in virtual time, with a few stamped targets."""

from functools import cache
from pathlib import Path

import marotte
from marotte.link import VirtualCarrier
from marotte.session import Session
from marotte.tables import Tables, build_tables
from shared import formats

PUPPETS = Path(__file__).parents[2] / "puppets"
ALL_TAPS = formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR
FRAME_US = 1_000_000 // 30
"""The pet's frame period, rounded down."""

WARM_UP_US = 400_000
"""After so long every kind of emulated MCU has booted and performs."""


@cache
def pet_tables() -> Tables:
    """The tables of the pet and its robot."""
    puppet = marotte.load_puppet(PUPPETS / "pet.toml")
    return build_tables(puppet, marotte.load_robot(PUPPETS / "pet-robot.toml", puppet))


class Parts:
    """Tables as a mere list of messages, to be uploaded with faults in them."""

    def __init__(self, parts):
        self._parts = [(name, dict(fields), [dict(item) for item in items]) for name, fields, items in parts]

    def messages(self):
        return iter(self._parts)


def open_session(carrier) -> Session:
    """Open a session with an MCU that has just been switched on."""
    carrier.read(WARM_UP_US)
    session = Session(carrier)
    session.open()
    return session


def begin_performance(mcu, taps=ALL_TAPS) -> Session:
    """Upload the pet, ask for all taps, and start it with some actions; return the session."""
    return begin_performance_over(VirtualCarrier(mcu), taps)


def begin_performance_over(carrier, taps=ALL_TAPS) -> Session:
    """Do that over a carrier."""
    session = open_session(carrier)
    begin_performance_on(session, taps)
    return session


def begin_performance_on(session, taps=ALL_TAPS) -> None:
    """Do that in a session that is open."""
    session.upload(pet_tables())
    session.telemetry(taps, 1, 0)
    session.weight_targets(0, {0: formats.WEIGHT_ONE, 1: formats.WEIGHT_ONE // 2, 2: 3 * formats.WEIGHT_ONE})
    session.weight_targets(25, {0: 0, 3: formats.WEIGHT_ONE})
    session.tempo(40, formats.MASTER, formats.TEMPO_ONE * 3 // 2)
    session.start()
    session.flush()
