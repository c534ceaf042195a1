"""A puppet: its DOFs, actions, live channels, behaviours and moods, as they are in its file.

    puppet = load_puppet("puppets/pet.toml")
    print(puppet.actions["HAPPY_FACE"].tempo)

Everything is plain, frozen data in the units of the file: values 0..1 (absolute) or -1..1 (relative), weights 0..4, times in
seconds, tempos as factors. The dictionaries keep the file's order, which is the order of the indices on the wire.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from marotte.functions import Function
from marotte.kalman import Kalman
from marotte.limits import Limits, LimitsInUse, tightest
from shared.formats import BANDS

ABSOLUTE = "absolute"
RELATIVE = "relative"
NEUTRAL_GAINS = (1.0,) * BANDS
"""Gains that leave the motion as it is."""


@dataclass(frozen=True)
class Character:
    """Second-order dynamics of a DOF."""

    f_hz: float
    """How quickly it follows."""
    zeta: float
    """Damping: below 1 it follows through."""
    r: float
    """Initial response: below 0 it anticipates, above 0 it sets off at once, above 1 too far."""


@dataclass(frozen=True)
class Dof:
    """A mechanical degree of freedom."""

    name: str
    kind: str = ABSOLUTE
    """`absolute` (a position) or `relative` (a fraction of top speed)."""
    rest: float = 0.5
    """Where an absolute DOF stands before anything moves it; 0 for a relative one."""
    limits: tuple[float, float] = (0.0, 1.0)
    """Least and greatest value that reaches the motor."""
    signal: bool = True
    """Whether the DOF passes through signal processing."""
    character: Character | None = None
    speed: float | None = None
    """Most that an absolute DOF's value changes in a second; None if the puppet does not say."""
    accel: float | None = None
    """Most that its speed (relative: its value) changes in a second; None if the puppet does not say."""

    @property
    def is_relative(self) -> bool:
        """Whether values are velocities in -1..1 instead of positions in 0..1."""
        return self.kind == RELATIVE

    def limits_with(self, *others: Limits) -> LimitsInUse:
        """Return what holds when others, a robot's, have limits too."""
        return tightest(self.is_relative, Limits(self.limits, self.speed, self.accel), *others)


@dataclass(frozen=True)
class MappingEntry:
    """One mapping of an action: `low + (high - low) * function(phase)` drives the DOF."""

    dof: str
    low: float
    high: float
    function: Function


@dataclass(frozen=True)
class Action:
    """A named list of mappings with a tempo of its own."""

    name: str
    mappings: tuple[MappingEntry, ...]
    tempo: float = 1.0
    tau_s: tuple[float, float] = (0.25, 0.25)
    """Time constants of a rising and of a falling weight."""
    entry: str = "sync"
    """`sync`: in step with the master phase; `start`: its own time begins as it enters."""
    warp_s: float = 0.5
    """Time constant with which it falls in with the master phase."""
    cycles: int | None = None
    """The periods of a gesture, after which it ends by itself; None if it is none."""


@dataclass(frozen=True)
class Curve:
    """A `[function.NAME]`: an expression, or the samples of one period."""

    name: str
    function: Function
    """What its bare name means as the FUNCTION of a mapping."""
    expression: str | None = None
    samples: tuple[float, ...] = ()


@dataclass(frozen=True)
class Live:
    """A channel that the host streams, 0..1."""

    name: str
    rest: float = 0.5
    tau_s: tuple[float, float] = (0.1, 0.1)
    kalman: Kalman | None = None
    """How its movement is predicted; None if its target is expected to stay as it is."""


@dataclass(frozen=True)
class Mood:
    """Band gains, highest band first (None: all 1), and a master tempo (None: as it is)."""

    name: str
    gains: tuple[float, ...] | None = None
    tempo: float | None = None


@dataclass(frozen=True)
class Puppet:
    """One character, independent of any robot."""

    name: str
    frame_rate_hz: int = 30
    seed: int = 1
    """Chooses the noise tables; 0 to 2^32 - 1."""
    noise_spread: float = 0.0
    when_silent: str = "idle"
    """What it does when the host is gone: `idle`, `rest` or `relax`."""
    dofs: Mapping[str, Dof] = field(default_factory=dict)
    actions: Mapping[str, Action] = field(default_factory=dict)
    lives: Mapping[str, Live] = field(default_factory=dict)
    """The channels declared, then those that functions and mappings use without declaring them."""
    functions: Mapping[str, Curve] = field(default_factory=dict)
    behaviours: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Weight targets by action."""
    moods: Mapping[str, Mood] = field(default_factory=dict)

    def action_index(self, name: str) -> int:
        """Return an action's index on the wire. Raises KeyError."""
        return _index(self.actions, name)

    def live_index(self, name: str) -> int:
        """Return a live channel's index on the wire. Raises KeyError."""
        return _index(self.lives, name)


def _index(names: Mapping[str, object], name: str) -> int:
    if name not in names:
        raise KeyError(name)
    return list(names).index(name)
