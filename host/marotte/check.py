"""Checking files of any kind together: what each is, and every mistake in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marotte.bands import centres_hz, hertz
from marotte.limits import LimitsInUse
from marotte.puppet import NEUTRAL_GAINS, Dof, Puppet
from marotte.puppet_file import read_puppet
from marotte.score import read_score
from marotte.tables import build_tables
from marotte.tomlfile import Document, Mistake
from marotte.wiring import Robot, read_robot

PUPPET = "puppet"
SCORE = "score"
ROBOT = "robot"

_ROBOT_KEYS = {
    "output",
    "chip",
    "kill",
    "mcu",
    "link_timeout",
    "rate",
    "attach_interval",
    "autostart",
}


@dataclass
class CheckReport:
    """What came of a check."""

    fine: list[str] = field(default_factory=list)
    """A line for each file without a mistake, and what follows from it, indented."""
    mistakes: list[Mistake] = field(default_factory=list)


def kind_of(document: Document) -> str | None:
    """Return which kind of file this is, by its keys; None if it could not be parsed."""
    if not document.is_parsed:
        return None
    keys = document.keys()
    return SCORE if "cue" in keys else ROBOT if keys & _ROBOT_KEYS else PUPPET


def check_files(paths: Sequence[str | Path]) -> CheckReport:
    """Return what is fine and what is wrong with files, which may be named in any order.

    Scores and robots are checked against the one puppet among the files; a score cannot be checked without.
    """
    report = CheckReport()
    kinds: dict[str, list[Path]] = {PUPPET: [], SCORE: [], ROBOT: []}
    for path in map(Path, paths):
        document = Document(path)
        kind = kind_of(document)
        if kind:
            kinds[kind].append(path)
        report.mistakes += document.mistakes
    puppets = [_check_puppet(path, report) for path in kinds[PUPPET]]
    puppet_is_fine = not report.mistakes
    puppet = puppets[0] if len(puppets) == 1 else None
    for path in kinds[SCORE]:
        _check_score(path, puppet, len(puppets), report)
    for path in kinds[ROBOT]:
        robot, mistakes = read_robot(path, puppet)
        _note(report, path, mistakes, f"a robot with {_count(robot.outputs, 'output')}")
        if not mistakes and (puppet is None or puppet_is_fine):
            report.fine += describe(robot, puppet)
    return report


def describe(robot: Robot, puppet: Puppet | None) -> list[str]:
    """Return what the motor layer makes of a robot, and of the puppet on it: its rates, and each DOF's limits in use."""
    period_us = robot.motor_period_us
    lines = [f"  motor layer: a tick every {period_us} us, {1e6 / period_us:.4g} Hz"]
    tables = build_tables(puppet, robot) if puppet else None
    rows = []
    for output in robot.outputs.values():
        pulses = f"every {robot.period_us(output):.0f} us" if output.drive.has_pulses else "PWM of 20 kHz"
        rate = f"written at {1e6 / robot.written_us(output):.4g} Hz"
        limits = ""
        if puppet and tables:
            dof = puppet.dofs[output.dof]
            limits = _limits(tables.limits(dof), dof)
        rows.append((output.dof, output.drive.place, f"{pulses}, {rate}", limits))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        lines.append("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    return lines


def describe_bands(puppet: Puppet) -> list[str]:
    """Return the bands of signal processing at a puppet's frame rate, and what its moods do with them."""
    rows = [("bands, in Hz", *map(hertz, centres_hz(puppet.frame_rate_hz)), "")]
    for mood in puppet.moods.values():
        tempo = f"tempo {mood.tempo:g}" if mood.tempo is not None else ""
        rows.append((f"gains of {mood.name}", *(f"{gain:g}" for gain in mood.gains or NEUTRAL_GAINS), tempo))
    first, *columns = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines = []
    for name, *cells, tempo in rows:
        gains = "  ".join(cell.rjust(width) for cell, width in zip(cells, columns[:-1], strict=True))
        lines.append(f"  {name.ljust(first)}  {gains}  {tempo}".rstrip())
    return lines


def _limits(limits: LimitsInUse, dof: Dof) -> str:
    low, high = limits.range
    speed = "" if dof.is_relative else f", speed {limits.speed:g}"
    return f"range {low:g}..{high:g}{speed}, accel {limits.accel:g}"


def _check_puppet(path: Path, report: CheckReport) -> Puppet:
    puppet, mistakes = read_puppet(path)
    mappings = [entry for action in puppet.actions.values() for entry in action.mappings]
    parts = [_count(puppet.dofs, "DOF"), _count(puppet.actions, "action"), _count(mappings, "mapping")]
    parts += [
        _count(puppet.lives, "live channel"),
        _count(puppet.behaviours, "behaviour"),
        _count(puppet.moods, "mood"),
    ]
    _note(report, path, mistakes, "a puppet with " + ", ".join(parts))
    if not mistakes:
        report.fine += describe_bands(puppet)
    return puppet


def _check_score(path: Path, puppet: Puppet | None, puppets: int, report: CheckReport) -> None:
    if puppet:
        score, mistakes = read_score(path, puppet)
        _note(report, path, mistakes, f"a score of {_count(score.cues, 'cue')}, {score.length_s:g} s")
        return
    found = "found no puppet file" if puppets == 0 else f"found {puppets} puppet files"
    report.mistakes.append(
        Mistake(str(path), None, "", f"a score is checked against its puppet: {found}, expected one")
    )


def _note(report: CheckReport, path: Path, mistakes: list[Mistake], what: str) -> None:
    report.mistakes += mistakes
    if not mistakes:
        report.fine.append(f"{path}: {what}: fine")


def _count(things: object, what: str) -> str:
    count = len(things)  # type: ignore[arg-type]
    return f"{count} {what}{'' if count == 1 else 's'}"
