"""Running: a score played live, on a robot or on an emulated MCU in real time, and shown while it plays."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction

from marotte.drivers import Drive
from marotte.errors import MarotteError
from marotte.files import Files, Watch
from marotte.link import Carrier, LinkRefused
from marotte.prompter import Prompter
from marotte.puppet import NEUTRAL_GAINS, Puppet
from marotte.score import Cue, Score, resumed, state
from marotte.session import Session, killer
from marotte.signals import interruptible, uninterruptible
from marotte.tables import build_tables, value_of
from marotte.tomlfile import FileMistakes
from marotte.view import REFRESH_HZ, Scene, View
from marotte.wiring import Robot
from shared import formats

AFTERGLOW_S = 2.0
"""How long a run goes on after the last cue if its length is not given: its weights need a moment to get there."""
PUMP_US = 20_000
WEIGHTS_HZ = 5
STATUS_US = 500_000
"""How often the MCU is asked for its counters."""
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
    watch: Watch | None = None,
) -> Performance:
    """Upload a puppet, play a score for `seconds` (default: to its end and a little longer), and stop.

    With `arm` the robot's outputs give pulses. With `watch` what changes in the files is played as soon as it is there; mistakes
    in them are told, and what played plays on. Whatever ends the run, Ctrl-C and SIGTERM included, the outputs are killed and the
    motion is stopped before this returns or raises. Raises MarotteError.
    """
    session = Session(carrier)
    session.open()
    begin_us = carrier.now_us()
    session.upload(build_tables(puppet, robot))
    view.note(f"{puppet.name} uploaded in {(carrier.now_us() - begin_us) / 1000:.0f} ms, on {view.where}")
    play = _Play(Files(puppet, score, robot), session, view, arm, seconds)
    performance = Performance()
    with interruptible(), _safe_end(session, performance):
        play.begin()
        try:
            while not play.is_done:
                play.go_on()
                if watch:
                    play.look(watch)
        except KeyboardInterrupt:
            performance.is_interrupted = True
        performance.frames = play.scene.frame + 1
    return performance


class _Play:
    """A performance under way."""

    def __init__(self, files: Files, session: Session, view: View, arm: bool, seconds: Fraction | None) -> None:
        self.session = session
        self.view = view
        self.scene = Scene()
        self._arm = arm
        self._seconds = seconds
        self._quiet_us = 0
        self._asked_us = 0
        self._status: dict[str, int] = {}
        self._take(files)
        self._prompter = Prompter(session, self._steps, session.welcome["queue_max"])

    @property
    def is_done(self) -> bool:
        """Whether its time is over."""
        length_s = default_seconds(self.files.score) if self._seconds is None else self._seconds
        return self.scene.frame >= round(length_s * self.files.puppet.frame_rate_hz) - 1

    def begin(self, again: bool = False) -> None:
        """Send the first steps and start the motion, so that the cues of frame 0 act in frame 0."""
        self._ask_for_telemetry(self.files.puppet)
        self._prompter.reached(-1)
        if again:
            self._arm_again()
        elif self._arm:
            self.session.arm()
        self.session.start()

    def go_on(self) -> None:
        """Let a moment pass, and show what came of it."""
        self.session.pump(PUMP_US)
        self._quiet_us += PUMP_US
        self._take_telemetry()
        self._look_at_status()
        self.scene.is_silent = self._quiet_us > SILENT_S * 1e6
        self._prompter.reached(self.scene.frame)
        self._tell_cues()
        self.view.show(self.scene)

    def look(self, watch: Watch) -> None:
        """Play on with the files of a watch if they have changed; if they have mistakes, tell them."""
        try:
            files = watch.changed(self.session.carrier.now_us())
            if files:
                self._exchange(files)
        except (FileMistakes, LinkRefused) as error:
            self.view.note(f"{error}\n{self.files.puppet.name} plays on as it was")

    def _exchange(self, files: Files) -> None:
        """Replace puppet and score. Raises LinkRefused if the MCU does not take them; nothing has changed then."""
        before = self.files.puppet
        tables = build_tables(files.puppet, files.robot)
        tick_before_s = build_tables(before, self.files.robot).tick_s
        begin_us = self.session.carrier.now_us()
        if files.puppet.frame_rate_hz != before.frame_rate_hz or tables.tick_s != tick_before_s:
            try:
                self.session.upload(tables)
            except LinkRefused:
                self.session.upload(build_tables(before, self.files.robot))
                self._restart(self.files)
                raise
            self._restart(files)
            how = (
                f"with a new frame rate: its motion begins anew at {files.puppet.frame_rate_hz} frames a second"
                if files.puppet.frame_rate_hz != before.frame_rate_hz
                else f"with a new motor rate: its motion begins anew at {float(1 / tables.tick_s):.4g} ticks a second"
            )
        else:
            self.session.exchange(tables, before)
            took_ms = (self.session.carrier.now_us() - begin_us) / 1000
            self._go_on_with(files)
            how = f"in {took_ms:.0f} ms"
        length_s = float(default_seconds(files.score) if self._seconds is None else self._seconds)
        self.view.exchange(files.puppet, files.robot if self._arm else None, length_s)
        self.view.note(f"{files.puppet.name} exchanged {how}")

    def _restart(self, files: Files) -> None:
        self.scene = Scene()
        self._status = {}
        self.session.taps.clear()
        self._take(files)
        self._prompter = Prompter(self.session, self._steps, self.session.welcome["queue_max"])
        self.begin(again=True)

    def _go_on_with(self, files: Files) -> None:
        """Bring what has been exchanged to where the new score stands."""
        self.session.open()  # once more: that empties the queue of what the old score had in it
        self._ask_for_telemetry(files.puppet)
        self._take_telemetry()
        before = self.files.puppet
        arms = bool(_driven(files) - _driven(self.files))
        was = state(self._steps, before, self.scene.frame)
        self._take(files)
        now, *later = resumed(self._steps, files.puppet, self.scene.frame)
        actions = list(before.actions)
        cued = [actions[index] for index in was.tempos if actions[index] in files.puppet.actions]
        tempos = {files.puppet.action_index(name): files.puppet.actions[name].tempo for name in cued}
        steps = [replace(now, tempos={**tempos, **now.tempos}), *later]
        self._prompter = Prompter(self.session, steps, self.session.welcome["queue_max"])
        if arms:  # only for outputs that are new, as it gives pulses to what has stalled
            self._arm_again()

    def _arm_again(self) -> None:
        """Arm after an exchange; yet what somebody has killed stays so, whatever is saved in a file."""
        if self._arm and self.session.status()["killed_by"] == formats.KILLED_BY_NOBODY:
            self.session.arm()

    def _ask_for_telemetry(self, puppet: Puppet) -> None:
        self.session.telemetry(formats.TAP_MOTOR, _every(puppet, REFRESH_HZ), _every(puppet, WEIGHTS_HZ))

    def _take(self, files: Files) -> None:
        """Take what is to be played from now on, from the frame that has been reached."""
        puppet = files.puppet
        self.files = files
        self._dofs = list(puppet.dofs.values())
        self._actions = list(puppet.actions)
        self._steps = files.score.steps(puppet)
        cues = [(cue.frame(puppet.frame_rate_hz), cue) for cue in sorted(files.score.cues, key=lambda cue: cue.at_s)]
        self._cues = [(frame, cue) for frame, cue in cues if frame > self.scene.frame]
        self.scene.mood, self.scene.gains = "", NEUTRAL_GAINS
        for frame, cue in cues:
            if frame <= self.scene.frame:
                self._show_mood(cue)
        self.scene.values = {}
        self.scene.weights = {}
        self.session.weights = (-1, {})

    def _take_telemetry(self) -> None:
        while self.session.taps:
            self.scene.frame, _, values_q15 = self.session.taps.popleft()
            self._quiet_us = 0
            if len(values_q15) == len(self._dofs):  # not those of a puppet before, which come a moment longer
                pairs = zip(self._dofs, values_q15, strict=True)
                self.scene.values = {dof.name: value_of(value_q15, dof) for dof, value_q15 in pairs}
        _, weights_q12 = self.session.weights
        known = {index: weight for index, weight in weights_q12.items() if index < len(self._actions)}
        self.scene.weights = {self._actions[index]: weight / WEIGHT_Q12_ONE for index, weight in known.items()}

    def _look_at_status(self) -> None:
        """Ask for the MCU's counters now and then, show and tell what they say."""
        status = self.session.take_status()
        if status:
            self._tell_status(status)
        now_us = self.session.carrier.now_us()
        if now_us - self._asked_us >= STATUS_US:
            self._asked_us = now_us
            self.session.request_status()

    def _tell_status(self, status: dict[str, int]) -> None:
        before, self._status = self._status, status
        scene = self.scene
        scene.late_frames = status["late_frames"]
        scene.clipped = status["clipped"]
        stalled = self._names(status["stalled"])
        for name in stalled - scene.stalled:
            self.view.note(f"{name} has stalled: it is without pulses until it is armed again")
        scene.stalled = stalled
        scene.released = self._names(status["released"]) - stalled if status["armed"] else frozenset()
        chips = list(self.files.robot.chips) if self.files.robot else []
        gone_before = before.get("bus_gone", 0)
        for index, chip in enumerate(chips):
            if (status["bus_gone"] ^ gone_before) >> index & 1:
                gone = status["bus_gone"] >> index & 1
                self.view.note(f"the chip {chip} {'does not answer' if gone else 'answers again'}")
        if before.get("armed") and not status["armed"]:
            self.view.note(f"all pulses are off: killed by {killer(status)}")
        alerts = [f"killed by {killer(status)}"] if self._arm and not status["armed"] and before else []
        alerts += [f"{chip} does not answer" for index, chip in enumerate(chips) if status["bus_gone"] >> index & 1]
        scene.alert = ", ".join(alerts)

    def _names(self, bits: int) -> frozenset[str]:
        """Return the DOFs of a status' bits."""
        return frozenset(dof.name for index, dof in enumerate(self._dofs) if bits >> index & 1)

    def _tell_cues(self) -> None:
        while self._cues and self._cues[0][0] <= self.scene.frame:
            _, cue = self._cues.pop(0)
            self.scene.cue = cue.summary()
            self._show_mood(cue)
            self.view.cue(float(cue.at_s), self.scene.cue)

    def _show_mood(self, cue: Cue) -> None:
        if cue.mood is not None:
            self.scene.mood = cue.mood
            self.scene.gains = self.files.puppet.moods[cue.mood].gains or NEUTRAL_GAINS
        self.scene.gains = cue.gains if cue.gains is not None else self.scene.gains


def _driven(files: Files) -> set[tuple[str, str, Drive]]:
    """Return which DOFs have outputs, of which kind they are, and what drives them."""
    outputs = files.robot.outputs if files.robot else {}
    return {(name, dof.kind, outputs[name].drive) for name, dof in files.puppet.dofs.items() if name in outputs}


def _every(puppet: Puppet, rate_hz: int) -> int:
    """Return every how many frames something is reported that wants to be reported at about this rate."""
    return max(1, puppet.frame_rate_hz // rate_hz)


@contextlib.contextmanager
def _safe_end(session: Session, performance: Performance) -> Iterator[None]:
    """Kill the outputs and stop the motion when the block ends, however it does, and not to be interrupted in it."""
    try:
        yield
    finally:
        with uninterruptible(), contextlib.suppress(MarotteError):
            session.kill()
            session.flush(FAREWELL_S)
            performance.status = session.status()
            session.stop()
            session.flush(FAREWELL_S)
