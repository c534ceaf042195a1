"""A score: cues in time, read from its file and expanded into the targets of each frame.

    puppet = load_puppet("puppets/pet.toml")
    score = load_score("puppets/pet-score.toml", puppet)
    for step in score.steps(puppet):
        print(step.frame, step.weights)

Source: docs/puppet-file.md. A cue acts in the first frame whose instant is not before its time; cues of one frame act in the
order of their times, then of the file; within a cue: behaviour, weights, mood, gains, live, tempo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path

from marotte.puppet import NEUTRAL_GAINS, Puppet
from marotte.puppet_file import MASTER_NAME, MASTER_TEMPO_RANGE, TEMPO_RANGE, read_gains, weights
from marotte.tomlfile import Document, FileMistakes, Mistake, Table, did_you_mean
from shared.formats import FRAME_NOW

AT_MAX_S = 10_000_000
"""The latest time of a cue: some 115 days, whose frame still fits the wire at 60 frames a second."""


@dataclass(frozen=True)
class Cue:
    """What happens at one time; parts that are None leave everything as it is."""

    at_s: Fraction
    """Exactly the decimal of the file."""
    behaviour: str | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    mood: str | None = None
    gains: tuple[float, ...] | None = None
    lives: Mapping[str, float] = field(default_factory=dict)
    tempos: Mapping[str, float] = field(default_factory=dict)
    """Tempo by action."""
    master_tempo: float | None = None

    def frame(self, frame_rate_hz: int) -> int:
        """Return the frame in which the cue acts."""
        return math.ceil(self.at_s * frame_rate_hz)

    def summary(self) -> str:
        """Return what the cue does in one line, for people."""
        parts = [self.behaviour or "", f"mood {self.mood}" if self.mood else ""]
        parts += [f"{name} {value:g}" for name, value in (*self.weights.items(), *self.lives.items())]
        parts += [f"tempo of {name} {tempo:g}" for name, tempo in self.tempos.items()]
        parts += [f"tempo {self.master_tempo:g}"] if self.master_tempo is not None else []
        parts += ["gains " + " ".join(f"{gain:g}" for gain in self.gains)] if self.gains else []
        return ", ".join(part for part in parts if part)


@dataclass(frozen=True)
class Step:
    """All that the cues of one frame set; what two of them set is as the later one has it."""

    frame: int
    weights: Mapping[int, float]
    """Weight targets 0..4 by the action's index."""
    lives: Mapping[int, float]
    """Live targets 0..1 by the channel's index."""
    master_tempo: float | None
    tempos: Mapping[int, float] = field(default_factory=dict)
    """Tempos 0.05..8 by the action's index."""
    gains: tuple[float, ...] | None = None
    """Gains -4..4 of the bands, highest first."""


@dataclass(frozen=True)
class Score:
    """A canned sequence of cues, in the file's order."""

    cues: tuple[Cue, ...] = ()

    @property
    def length_s(self) -> float:
        """The time of the last cue, in seconds."""
        return float(max((cue.at_s for cue in self.cues), default=Fraction(0)))

    def steps(self, puppet: Puppet) -> list[Step]:
        """Return what to send for each frame that has a cue, in order of frames.

        A behaviour sets the actions that it does not name to 0; those of them that no cue has raised since are left out, as they
        are at 0 already.
        """
        frames: dict[int, list[Cue]] = {}
        for cue in sorted(self.cues, key=lambda cue: cue.at_s):
            frames.setdefault(cue.frame(puppet.frame_rate_hz), []).append(cue)
        targets: dict[str, float] = {}
        return [_step(puppet, frame, cues, targets) for frame, cues in frames.items()]


def state(steps: Sequence[Step], puppet: Puppet, frame: int) -> Step:
    """Return all that holds in a frame: what the steps have set until then, and what nobody has set as it is at the beginning.

    The tempos are only those that a cue has set. A gesture is left out, since it ends by itself: whether it is under way, only
    the MCU knows.
    """
    weights = dict.fromkeys(range(len(puppet.actions)), 0.0)
    lives = {index: live.rest for index, live in enumerate(puppet.lives.values())}
    tempos: dict[int, float] = {}
    master_tempo = 1.0
    gains = NEUTRAL_GAINS
    for step in steps:
        if step.frame <= frame:
            weights.update(step.weights)
            lives.update(step.lives)
            tempos.update(step.tempos)
            master_tempo = step.master_tempo if step.master_tempo is not None else master_tempo
            gains = step.gains if step.gains is not None else gains
    for index, action in enumerate(puppet.actions.values()):
        if action.cycles is not None:
            del weights[index]
    return Step(frame, weights, lives, master_tempo, tempos, gains)


def resumed(steps: Sequence[Step], puppet: Puppet, frame: int) -> list[Step]:
    """Return what brings an MCU that has played something else to where the steps are in `frame`, and what is to follow."""
    now = replace(state(steps, puppet, frame), frame=FRAME_NOW)
    return [now, *(step for step in steps if step.frame > frame)]


def load_score(path: str | Path, puppet: Puppet) -> Score:
    """Return the score of a file, checked against the puppet that plays it. Raises FileMistakes, with every mistake."""
    score, mistakes = read_score(path, puppet)
    if mistakes:
        raise FileMistakes(mistakes)
    return score


def read_score(path: str | Path, puppet: Puppet) -> tuple[Score, list[Mistake]]:
    """Return what could be read of a score, and every mistake in its file."""
    document = Document(path)
    score = document.read_until_full(lambda: _score(document, puppet), Score())
    return score, document.in_order()


def _score(document: Document, puppet: Puppet) -> Score:
    root = document.root()
    cues = [_cue(table, puppet) for table in root.list_of_tables("cue")]
    if not cues and document.is_parsed:
        root.mistake("has no cue, expected at least one [[cue]]")
    root.finish()
    return Score(tuple(cues))


def _cue(table: Table, puppet: Puppet) -> Cue:
    at_s = Fraction(0)
    if table.require("at", "at = SECONDS") and table.is_number_in("at", 0, AT_MAX_S):
        at_s = Fraction(table.value("at"))
    behaviour = _name(table, "behaviour", puppet.behaviours)
    targets = weights(table.table("weights"), puppet.actions)
    mood = _name(table, "mood", puppet.moods)
    gains = read_gains(table)
    lives = _lives(table.table("live"), puppet)
    tempos, master_tempo = _tempos(table.table("tempo"), puppet)
    table.finish()
    return Cue(at_s, behaviour, targets, mood, gains, lives, tempos, master_tempo)


def _name(table: Table, key: str, known: Mapping[str, object]) -> str | None:
    if not table.has(key):
        return None
    name = table.text(key, "")
    if name in known:
        return name
    if isinstance(table.value(key), str):
        table.mistake(f'unknown {key} "{name}"{did_you_mean(name, known)}', key)
    return None


def _lives(table: Table, puppet: Puppet) -> dict[str, float]:
    targets = {}
    for name in table.names():
        if name in puppet.lives:
            targets[name] = table.number(name, 0, 1, default=0)
        else:
            table.mistake(f"unknown live channel{did_you_mean(name, puppet.lives)}", name)
    return targets


def _tempos(table: Table, puppet: Puppet) -> tuple[dict[str, float], float | None]:
    tempos = {}
    master_tempo = None
    for name in table.names():
        if name == MASTER_NAME:
            master_tempo = table.number(name, *MASTER_TEMPO_RANGE, default=1)
        elif name in puppet.actions:
            tempos[name] = table.number(name, *TEMPO_RANGE, default=1)
        else:
            table.mistake(f"unknown action{did_you_mean(name, [MASTER_NAME, *puppet.actions])}", name)
    return tempos, master_tempo


def _step(puppet: Puppet, frame: int, cues: list[Cue], targets: dict[str, float]) -> Step:
    """Return the step of one frame; `targets` holds the weight targets as the score has set them so far, and is kept up."""
    changed: dict[str, float] = {}
    lives: dict[str, float] = {}
    tempos: dict[str, float] = {}
    master_tempo = gains = None
    for cue in cues:
        if cue.behaviour is not None:
            changed.update((name, 0.0) for name, target in (targets | changed).items() if target > 0)
            changed.update(puppet.behaviours[cue.behaviour])
        changed.update(cue.weights)
        if cue.mood is not None:
            mood = puppet.moods[cue.mood]
            gains = mood.gains or NEUTRAL_GAINS
            master_tempo = mood.tempo if mood.tempo is not None else master_tempo
        gains = cue.gains if cue.gains is not None else gains
        lives.update(cue.lives)
        tempos.update(cue.tempos)
        master_tempo = cue.master_tempo if cue.master_tempo is not None else master_tempo
    targets.update(changed)
    return Step(
        frame,
        {puppet.action_index(name): target for name, target in changed.items()},
        {puppet.live_index(name): target for name, target in lives.items()},
        master_tempo,
        {puppet.action_index(name): tempo for name, tempo in tempos.items()},
        gains,
    )
