"""Puppets that play on an emulated MCU while their tables are exchanged."""

import tempfile
from pathlib import Path

import marotte
from marotte.link import VirtualCarrier
from marotte.prompter import Prompter
from marotte.puppet_file import load_puppet
from shared.formats import TAP_BASE, TAP_MOTOR, TAP_SIGNAL
from tests.generate import to_toml

PUMP_US = 5_000
TAPS = TAP_BASE | TAP_SIGNAL | TAP_MOTOR
QUEUE_SHARE = 128
"""How much of the MCU's queue the score may fill: what it has sent before an exchange takes up the rest."""


def puppet_of(document):
    """Return the puppet of a document as `tomllib` gives it, read by the host."""
    with tempfile.TemporaryDirectory(prefix="marotte-test-") as folder:
        path = Path(folder) / "puppet.toml"
        path.write_text(to_toml(document), "utf-8")
        return load_puppet(path)


def score_of(document, puppet):
    """Return the score of a document, read by the host."""
    with tempfile.TemporaryDirectory(prefix="marotte-test-") as folder:
        path = Path(folder) / "score.toml"
        path.write_text(to_toml(document), "utf-8")
        return marotte.load_score(path, puppet)


class Stage:
    """A puppet that plays a score on an emulated MCU.

    `puppet` is the one whose tables are in force. `seen` has for every frame, by DOF, the values of base, signal and motor.
    Puppets that are exchanged for each other have to be told apart by the number of their DOFs, or have the same ones in order.
    """

    def __init__(self, mcu, puppet, score=None, robot=None):
        self.puppet = puppet
        self.seen = []
        self._robot = robot
        self._score = score
        self._steps_sent = 0
        self.session = marotte.Session(VirtualCarrier(mcu))
        self.session.open()
        self.session.upload(marotte.build_tables(puppet, robot))
        self.session.telemetry(TAPS, 1, 0)
        if robot:
            self.session.arm()
            self.session.wait_attached()
        self.begin()

    def begin(self):
        """Play the score from its beginning, by the tables that are there."""
        self.seen.clear()
        self.session.taps.clear()
        self._steps_sent = 0
        self._find_prompter()
        self.session.start()
        self.session.flush()

    def play_until(self, frame):
        """Play until the taps of a frame have come."""
        while len(self.seen) <= frame:
            self.session.pump(PUMP_US)
            self._look(self.puppet)
            self._prompt()

    def play_for(self, duration_us):
        """Play for some virtual time."""
        end_us = self.session.carrier.now_us() + duration_us
        while (left_us := end_us - self.session.carrier.now_us()) > 0:
            self.session.pump(min(PUMP_US, left_us))
            self._look(self.puppet)
            self._prompt()

    def exchange(self, puppet, tables=None):
        """Exchange the tables, by default those of `puppet`, and return the virtual time that it took, in microseconds."""
        begun_us = self.session.carrier.now_us()
        before = self.puppet
        self.session.exchange(tables or marotte.build_tables(puppet, self._robot), before)
        took_us = self.session.carrier.now_us() - begun_us
        self.puppet = puppet
        self._look(before, puppet)
        self._find_prompter()
        return took_us

    def status(self):
        """Return the firmware's counters."""
        status = self.session.status()
        self._look(self.puppet)
        return status

    def forget_score(self):
        """Send no more of the score: for puppets that it was not written for."""
        self._score = None

    def weights(self):
        """Return the weights of the actions that play, by index."""
        self.session.telemetry(TAPS, 1, 1)
        self.play_for(100_000)
        return self.session.weights[1]

    def _find_prompter(self):
        steps = self._score.steps(self.puppet) if self._score else []
        self._prompter = Prompter(self.session, steps[self._steps_sent :], QUEUE_SHARE)
        self._prompt()

    def _prompt(self):
        self._steps_sent += len(self._prompter.reached(len(self.seen) - 1))

    def _look(self, *puppets):
        """Take the taps that have come, of one of these puppets."""
        while self.session.taps:
            frame, _, values_q15 = self.session.taps.popleft()
            assert frame == len(self.seen), "the taps of a frame were lost"
            count = len(values_q15) // 3
            dofs = next(list(puppet.dofs) for puppet in puppets if len(puppet.dofs) == count)
            self.seen.append({dof: tuple(values_q15[place::count]) for place, dof in enumerate(dofs)})
