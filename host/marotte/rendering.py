"""Rendering: a score played by the real firmware on an emulated MCU, every frame of it collected.

    puppet = load_puppet("puppets/pet.toml")
    score = load_score("puppets/pet-score.toml", puppet)
    rendering = render(puppet, score, seconds=20, mcu="unix")
    print(rendering.time_s[-1], rendering.motor["NECK"][-1])

All of it happens in virtual time and through the real link; no clock, filter or noise of the host enters, so that the same files
give the same numbers on every run.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from marotte.emulated import connected, open_mcu
from marotte.errors import MarotteError
from marotte.link import VirtualCarrier
from marotte.mcu.base import VirtualMcu
from marotte.prompter import Prompter
from marotte.puppet import Puppet
from marotte.score import Score
from marotte.session import Session
from marotte.tables import build_tables, value_of
from marotte.wiring import Robot
from shared import formats

TAPS = formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR
PUMP_US = 20_000
PATIENCE_US = 2_000_000
"""Virtual time without a new frame after which the MCU counts as stuck."""
DIGITS = 9
WEIGHT_Q12_ONE = 1 << 12

Progress = Callable[[int, int], None]
"""Called with the number of frames done and of all frames."""


class RenderError(MarotteError):
    """A rendering cannot be what the score says: a frame is missing, or a cue came too late for its frame."""


@dataclass
class Rendering:
    """What a puppet did, frame by frame. Values are 0..1 (absolute DOFs) or -1..1 (relative ones)."""

    puppet: Puppet
    base: dict[str, list[float]] = field(default_factory=dict)
    """Per DOF, in the file's order: the compositor's output."""
    signal: dict[str, list[float]] = field(default_factory=dict)
    """Per DOF: the same after signal processing."""
    motor: dict[str, list[float]] = field(default_factory=dict)
    """Per DOF: the motor layer's trajectory at the frame's instant."""
    weights: dict[str, list[float]] = field(default_factory=dict)
    """Per action, in the file's order: its weight 0..4; empty if they were not asked for."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the emulated MCU tells of the run: `kind`, `image`, `image_sha256`, `instructions` and more, by kind."""
    status: dict[str, int] = field(default_factory=dict)
    """The firmware's own counters at the end."""

    @property
    def frames(self) -> range:
        """The frames, from 0."""
        return range(len(next(iter(self.base.values()), [])))

    @property
    def time_s(self) -> list[float]:
        """The instant of each frame."""
        return [frame / self.puppet.frame_rate_hz for frame in self.frames]

    def write_csv(self, path: str | Path) -> None:
        """Write `frame,time` and, per DOF, `NAME.base,NAME.signal,NAME.motor`, a line a frame. Raises MarotteError."""
        names = list(self.puppet.dofs)
        taps = (("base", self.base), ("signal", self.signal), ("motor", self.motor))
        try:
            with Path(path).open("w", newline="", encoding="utf-8") as file:
                lines = csv.writer(file, lineterminator="\n")
                lines.writerow(["frame", "time", *(f"{name}.{tap}" for name in names for tap, _ in taps)])
                for frame, time_s in zip(self.frames, self.time_s, strict=True):
                    values = (column[name][frame] for name in names for _, column in taps)
                    lines.writerow([frame, *(f"{value:.{DIGITS}f}" for value in (time_s, *values))])
        except OSError as error:
            raise MarotteError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from error


def frame_count(seconds: float | Fraction, frame_rate_hz: int) -> int:
    """Return how many frames a rendering of so many seconds has."""
    return round(Fraction(seconds) * frame_rate_hz)


def render(
    puppet: Puppet,
    score: Score,
    seconds: float | Fraction,
    mcu: str | VirtualMcu = "unix",
    robot: Robot | None = None,
    progress: Progress | None = None,
    weights: bool = False,
) -> Rendering:
    """Return what the puppet does in the first `seconds` of a score.

    `mcu` is `"unix"` (MicroPython on this machine, 64 bits), `"unix32"`, `"rp2040"` (the emulated chip), or an emulated MCU just
    switched on, which stays open, so that its pins can be looked at; what is connected to it is the caller's business then. With
    a robot its outputs are armed and attached before frame 0. With `weights` those of all actions are collected too. Raises
    MarotteError: RenderError, or what the link or the emulated MCU has to say.
    """
    count = frame_count(seconds, puppet.frame_rate_hz)
    if count < 1:
        raise RenderError(f"{float(seconds):g} s hold no frame at {puppet.frame_rate_hz} frames a second")
    with _open_mcu(mcu) as virtual:
        if robot and isinstance(mcu, str):
            robot = connected(virtual, robot)
        session = Session(VirtualCarrier(virtual))
        session.open()
        session.upload(build_tables(puppet, robot))
        session.telemetry(TAPS, 1, int(weights))
        prompter = Prompter(session, score.steps(puppet), session.welcome["queue_max"])
        prompter.reached(-1)
        if robot and robot.outputs:
            session.arm()
            session.wait_attached()  # an output that is not attached stands still
        session.start()
        rendering = Rendering(puppet)
        if weights:
            rendering.weights.update((name, []) for name in puppet.actions)
        _collect(session, prompter, rendering, count, progress)
        rendering.status = session.status()
        _check_punctual(rendering.status)
        rendering.report = virtual.report()
    return rendering


@contextmanager
def _open_mcu(mcu: str | VirtualMcu) -> Iterator[VirtualMcu]:
    if isinstance(mcu, str):
        with open_mcu(mcu) as virtual:
            yield virtual
    else:
        yield mcu


def _collect(session: Session, prompter: Prompter, rendering: Rendering, count: int, progress: Progress | None) -> None:
    """Let the MCU compute `count` frames and what it takes until the motor tap of the last is known, and keep the taps.

    What it needs is sent ahead.
    """
    dofs = list(rendering.puppet.dofs.values())
    for taps in (rendering.base, rendering.signal, rendering.motor):
        taps.update((dof.name, []) for dof in dofs)
    columns = [(taps[dof.name], dof) for taps in (rendering.base, rendering.signal, rendering.motor) for dof in dofs]
    done = 0
    waited_us = 0
    while done < count:
        session.pump(PUMP_US)
        waited_us += PUMP_US
        while session.taps and done < count:
            frame, _, values_q15 = session.taps.popleft()
            if frame != done:
                raise RenderError(f"the MCU reported frame {frame} where frame {done} was expected")
            for (column, dof), value_q15 in zip(columns, values_q15, strict=True):
                column.append(value_of(value_q15, dof))
            done += 1
            waited_us = 0
        _collect_weights(session, rendering, count)
        prompter.reached(done - 1)
        if progress:
            progress(done, count)
        if waited_us > PATIENCE_US:
            raise RenderError(f"the MCU has reported no frame after frame {done - 1} for {PATIENCE_US / 1e6:g} s")


def _collect_weights(session: Session, rendering: Rendering, count: int) -> None:
    """Keep the weights that have come, of the first `count` frames, if they are wanted."""
    columns = list(rendering.weights.values())
    while session.weights_seen:
        frame, weights_q12 = session.weights_seen.popleft()
        if columns and frame < count:
            if frame != len(columns[0]):
                raise RenderError(
                    f"the MCU reported weights of frame {frame}, expected those of frame {len(columns[0])}"
                )
            for action, column in enumerate(columns):
                column.append(weights_q12.get(action, 0) / WEIGHT_Q12_ONE)


def _check_punctual(status: dict[str, int]) -> None:
    late = status.get("late_targets", 0)
    if late:
        raise RenderError(f"{late} targets came too late for their frames, so the rendering is not what the score says")
