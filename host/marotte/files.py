"""The files of a performance, loaded together, and watched for changes while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from marotte import wiring
from marotte.puppet import Puppet
from marotte.puppet_file import read_puppet
from marotte.score import Score, read_score
from marotte.tomlfile import FileMistakes
from marotte.wiring import Robot

LOOK_US = 300_000
"""How often a watch looks at its files."""


@dataclass(frozen=True)
class Files:
    """A puppet, what it plays, and on which robot."""

    puppet: Puppet
    score: Score
    robot: Robot | None


def load(puppet_path: str | Path, score_path: str | Path, robot_path: str | Path | None = None) -> Files:
    """Return what the files hold. Raises FileMistakes, with the mistakes of all of them."""
    puppet, mistakes = read_puppet(puppet_path)
    if not puppet.dofs:
        raise FileMistakes(mistakes)  # nothing that the others could be checked against
    score, score_mistakes = read_score(score_path, puppet)
    robot, robot_mistakes = wiring.read_robot(robot_path, puppet) if robot_path else (None, [])
    mistakes = [*mistakes, *score_mistakes, *robot_mistakes]
    if mistakes:
        raise FileMistakes(mistakes)
    return Files(puppet, score, robot)


def load_pair(puppet_path: str | Path, robot_path: str | Path) -> tuple[Puppet, Robot]:
    """Return a puppet and its robot. Raises FileMistakes, with the mistakes of both files."""
    puppet, mistakes = read_puppet(puppet_path)
    if not puppet.dofs:
        raise FileMistakes(mistakes)
    robot, robot_mistakes = wiring.read_robot(robot_path, puppet)
    if mistakes or robot_mistakes:
        raise FileMistakes([*mistakes, *robot_mistakes])
    return puppet, robot


class Watch:
    """Loads the files of a performance again when one of them has changed, and been left alone since the last look."""

    def __init__(self, puppet: str | Path, score: str | Path, robot: str | Path | None = None) -> None:
        self.adapt: Callable[[Robot], Robot] | None = None
        """What to make of the robot that has been loaded, if anything."""
        self._paths = (puppet, score, robot)
        self._loaded = self._seen = self._look()
        self._looked_us: int | None = None

    def changed(self, now_us: int) -> Files | None:
        """Return the files if they have changed, None if not or if it is too soon to look. Raises FileMistakes."""
        if self._looked_us is not None and now_us - self._looked_us < LOOK_US:
            return None
        self._looked_us = now_us
        before, self._seen = self._seen, self._look()
        if self._seen in (None, self._loaded) or self._seen != before:
            return None
        self._loaded = self._seen
        files = load(*self._paths)
        return replace(files, robot=self.adapt(files.robot)) if self.adapt and files.robot else files

    def _look(self) -> tuple[tuple[int, int], ...] | None:
        """Return time and size of each file; None while one is missing, as it is for a moment when an editor replaces it."""
        try:
            stats = [Path(path).stat() for path in self._paths if path]
        except OSError:
            return None
        return tuple((stat.st_mtime_ns, stat.st_size) for stat in stats)
