"""A hostile MCU: whatever it says to a host that plays a score, the run ends in good order or with an error for people."""

import io
from fractions import Fraction
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import marotte
from marotte.errors import MarotteError
from marotte.link import pack, wire_packet
from marotte.run import perform
from marotte.session import DICTIONARY
from marotte.view import View
from shared import messages
from tests.hostile.attack import RANGES
from tests.hostile.test_decoders import FROM_MCU
from tests.link.carriers import ScriptedCarrier, ack
from tests.link.test_messages import values_of

PUPPETS = Path(__file__).parents[2] / "puppets"
PET = marotte.load_puppet(PUPPETS / "pet.toml")
SCORE = marotte.load_score(PUPPETS / "pet-score.toml", PET)
ROBOT = marotte.load_robot(PUPPETS / "pet-robot-pca9685.toml", PET)
PATIENCE_US = 3_000_000
"""After so long the MCU is gone, so that every run ends."""


class Shown(View):
    """A view on which one scene of ten is drawn."""

    def __init__(self):
        self.scenes = 0
        super().__init__(PET, ROBOT, "here", 1.0, Console(file=io.StringIO(), width=100))

    def show(self, scene):
        self.scenes += 1
        if self.scenes % 10 == 0:
            self.console.print(self.picture(scene))


class HostileMcu(ScriptedCarrier):
    """Answers as an MCU has to, mostly, and says what a test wants between its answers."""

    def __init__(self, welcome, sayings, statuses):
        super().__init__(self._answer)
        self._welcome = wire_packet(messages.WELCOME, 0, pack("welcome", welcome))
        self._sayings, self._statuses = list(sayings), list(statuses)

    def _answer(self, number, message_id, seq):
        if message_id == messages.HELLO:
            return ack(seq) + self._welcome, 1000
        # The upload is taken; what comes then is answered as the test says.
        is_table = messages.BEGIN <= message_id <= messages.COMMIT or message_id in range(
            messages.ROBOT, messages.GUARD + 1
        )
        status = (
            self._statuses.pop() if self._statuses and not is_table and message_id != messages.STOP else messages.OK
        )
        saying = self._sayings.pop(0) if self._sayings and not is_table else b""
        return saying + ack(seq, status, number & 0xFFFF), 1000

    def read(self, wait_us):
        data = super().read(wait_us)
        return data if self.now_us() < PATIENCE_US else b""


@st.composite
def sayings(draw):
    """A sound packet of any kind but answers, with any contents."""
    name, message_id, fields, items = draw(st.sampled_from([entry for entry in FROM_MCU if entry[0] != "ack"]))
    values = draw(st.lists(values_of(items), max_size=12)) if items else []
    return wire_packet(message_id, draw(st.integers(0, 255)), pack(name, draw(values_of(fields)), values))


welcomes = values_of(messages.find(messages.WELCOME)[2]).map(
    lambda fields: fields | {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY}
)
statuses = st.lists(
    st.sampled_from([messages.OK] * 6 + [messages.RANGE, messages.STATE, messages.FULL, 99]), max_size=8
)


@settings(max_examples=20)
@given(welcomes, st.lists(sayings(), max_size=25), statuses, st.booleans())
def test_run_takes_whatever_an_mcu_says(welcome, told, answers, arm):
    carrier = HostileMcu(welcome, told, answers)
    try:
        performance = perform(PET, SCORE, carrier, Shown(), robot=ROBOT, arm=arm, seconds=Fraction(1))
    except MarotteError as error:
        assert str(error).strip()
    else:
        assert performance.frames <= RANGES["i"][1] + 1
    assert carrier.now_us() < 3 * PATIENCE_US
    assert messages.KILL in [message_id for message_id, _, _ in carrier.arrived], (
        "whatever it said, the outputs were killed"
    )
