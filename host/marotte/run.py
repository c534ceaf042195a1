"""Running: a score played live, on a robot or on an emulated MCU in real time, and shown while it plays."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction

from marotte.errors import MarotteError
from marotte.link import Carrier
from marotte.prompter import Prompter
from marotte.puppet import Puppet
from marotte.score import Score
from marotte.session import Session
from marotte.tables import build_tables, value_of
from marotte.view import REFRESH_HZ, Scene, View
from marotte.wiring import Robot
from shared import formats

AFTERGLOW_S = 2.0
"""How long a run goes on after the last cue if its length is not given: its weights need a moment to get there."""
PUMP_US = 20_000
WEIGHTS_HZ = 5
SILENT_S = 0.5
"""A view without a new frame for so long says so."""
FAREWELL_S = 1.0
WEIGHT_Q12_ONE = 1 << 12


@dataclass
class Performance:
    """How a run went."""

    frames: int = 0
    is_interrupted: bool = False
    status: dict[str, int] = field(default_factory=dict)
    """The firmware's own counters at the end; empty if it could not be asked any more."""


def default_seconds(score: Score) -> Fraction:
    """Return how long a score is played if nobody says."""
    return Fraction(score.length_s) + Fraction(AFTERGLOW_S)


def perform(
    puppet: Puppet,
    score: Score,
    carrier: Carrier,
    view: View,
    *,
    robot: Robot | None = None,
    arm: bool = False,
    seconds: Fraction | None = None,
) -> Performance:
    """Upload a puppet, play a score for `seconds` (default: to its end and a little longer), and stop.

    With `arm` the robot's outputs give pulses. Whatever ends the run, Ctrl-C and SIGTERM included, the outputs are killed and the
    motion is stopped before this returns or raises. Raises MarotteError.
    """
    length_s = default_seconds(score) if seconds is None else seconds
    last_frame = round(length_s * puppet.frame_rate_hz) - 1
    session = Session(carrier)
    session.open()
    begin_us = carrier.now_us()
    session.upload(build_tables(puppet, robot))
    view.note(f"{puppet.name} uploaded in {(carrier.now_us() - begin_us) / 1000:.0f} ms, on {view.where}")
    session.telemetry(formats.TAP_MOTOR, _every(puppet, REFRESH_HZ), _every(puppet, WEIGHTS_HZ))
    play = _Play(puppet, score, session, view)
    performance = Performance()
    with _interruptible(), _safe_end(session, performance):
        play.begin(arm)
        try:
            while play.scene.frame < last_frame:
                play.go_on()
        except KeyboardInterrupt:
            performance.is_interrupted = True
        performance.frames = play.scene.frame + 1
    return performance


class _Play:
    """One score under way."""

    def __init__(self, puppet: Puppet, score: Score, session: Session, view: View) -> None:
        self.puppet = puppet
        self.session = session
        self.view = view
        self.scene = Scene()
        self._dofs = list(puppet.dofs.values())
        self._actions = list(puppet.actions)
        self._cues = [(cue.frame(puppet.frame_rate_hz), cue) for cue in sorted(score.cues, key=lambda cue: cue.at_s)]
        self._prompter = Prompter(session, score.steps(puppet), session.welcome["queue_max"])
        self._quiet_us = 0

    def begin(self, arm: bool) -> None:
        """Send the first steps and start the motion, so that the cues of frame 0 act in frame 0."""
        self._prompter.reached(-1)
        if arm:
            self.session.arm()
        self.session.start()

    def go_on(self) -> None:
        """Let a moment pass, and show what came of it."""
        self.session.pump(PUMP_US)
        self._quiet_us += PUMP_US
        while self.session.taps:
            frame, _, values_q15 = self.session.taps.popleft()
            pairs = zip(self._dofs, values_q15, strict=True)
            self.scene.values = {dof.name: value_of(value_q15, dof) for dof, value_q15 in pairs}
            self.scene.frame = frame
            self._quiet_us = 0
        _, weights_q12 = self.session.weights
        self.scene.weights = {self._actions[index]: weight / WEIGHT_Q12_ONE for index, weight in weights_q12.items()}
        self.scene.is_silent = self._quiet_us > SILENT_S * 1e6
        self._prompter.reached(self.scene.frame)
        self._tell_cues()
        self.view.show(self.scene)

    def _tell_cues(self) -> None:
        while self._cues and self._cues[0][0] <= self.scene.frame:
            _, cue = self._cues.pop(0)
            self.scene.cue = cue.summary()
            self.view.cue(float(cue.at_s), self.scene.cue)


def _every(puppet: Puppet, rate_hz: int) -> int:
    """Return every how many frames something is reported that wants to be reported at about this rate."""
    return max(1, puppet.frame_rate_hz // rate_hz)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let SIGTERM end the block as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _safe_end(session: Session, performance: Performance) -> Iterator[None]:
    """Kill the outputs and stop the motion when the block ends, however it does, and not to be interrupted in it."""
    try:
        yield
    finally:
        with _uninterruptible(), contextlib.suppress(MarotteError):
            session.kill()
            session.flush(FAREWELL_S)
            performance.status = session.status()
            session.stop()
            session.flush(FAREWELL_S)


@contextlib.contextmanager
def _uninterruptible() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, signal.SIG_IGN) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
