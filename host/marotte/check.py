"""Checking files of any kind together: what each is, and every mistake in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marotte.puppet import Puppet
from marotte.puppet_file import read_puppet
from marotte.score import read_score
from marotte.tomlfile import Document, Mistake
from marotte.wiring import read_robot

PUPPET = "puppet"
SCORE = "score"
ROBOT = "robot"

_ROBOT_KEYS = {"output", "mcu", "link_timeout"}


@dataclass
class CheckReport:
    """What came of a check."""

    fine: list[str] = field(default_factory=list)
    """A line for each file without a mistake."""
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
    puppet = puppets[0] if len(puppets) == 1 else None
    for path in kinds[SCORE]:
        _check_score(path, puppet, len(puppets), report)
    for path in kinds[ROBOT]:
        robot, mistakes = read_robot(path, puppet)
        _note(report, path, mistakes, f"a robot with {_count(robot.outputs, 'output')}")
    return report


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
