"""The cues of a score as a figure has them: numbered, and listed in lines that have room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from marotte.puppet import NEUTRAL_GAINS, Puppet
from marotte.score import Cue, Score

Listed: TypeAlias = list[list[tuple[str, str]]]
"""Lines cue by cue: what stands before a line, and the line."""

Measure: TypeAlias = Callable[[str], float]
"""Returns the width of a text."""


@dataclass(frozen=True)
class NumberedCue:
    """A cue of a figure."""

    number: int
    """From 1."""
    at_s: float
    text: str

    def lines(self, room: float, width: Measure) -> list[tuple[str, str]]:
        """Return its lines, none wider than there is room."""
        first, *more = _wrapped(self.text, room, width)
        return [(f"{self.number}", f"{self.at_s:.4g} s  {first}"), *(("", "    " + line) for line in more)]


def numbered(score: Score | None, puppet: Puppet, frames: int) -> list[NumberedCue]:
    """Return the cues that act within so many frames, in order."""
    cues = sorted(score.cues, key=lambda cue: cue.at_s) if score else []
    within = [cue for cue in cues if cue.frame(puppet.frame_rate_hz) < frames]
    return [NumberedCue(place + 1, float(cue.at_s), _text(cue, puppet)) for place, cue in enumerate(within)]


def in_columns(cues: Listed, count: int) -> list[Listed]:
    """Return a list in columns of about equal length, no cue in two of them."""
    most = max(-(-sum(map(len, cues)) // count), 1)
    columns: list[Listed] = [[] for _ in range(count)]
    lines = 0
    for cue in cues:
        columns[min(lines // most, count - 1)].append(cue)
        lines += len(cue)
    return columns


def _text(cue: Cue, puppet: Puppet) -> str:
    """Return what a cue does, and what its mood makes of the gains."""
    gains = puppet.moods[cue.mood].gains if cue.mood is not None and cue.gains is None else None
    if gains is None or gains == NEUTRAL_GAINS:
        return cue.summary()
    return f"{cue.summary()}, gains {' '.join(f'{gain:g}' for gain in gains)}"


def _wrapped(text: str, room: float, width: Measure) -> list[str]:
    """Return a text in lines that are no wider than there is room beside a time, broken at its commas."""
    room -= width("00.00 s  ")
    lines: list[str] = []
    for part in text.split(", "):
        part = _cut(part, room, width)
        if lines and width(f"{lines[-1]}, {part},") <= room:
            lines[-1] += ", " + part
        else:
            lines[-1:] = [lines[-1] + ",", part] if lines else [part]
    return lines


def _cut(part: str, room: float, width: Measure) -> str:
    """Return a name and its number, the name cut so that both have room."""
    name, _, number = part.rpartition(" ")
    while width(part) > room and name:
        name = name[:-1]
        part = f"{name}… {number}"
    return part
