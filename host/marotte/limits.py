"""Limits of a DOF: range, top speed and top acceleration, of the puppet and of the robot that it moves.

Values are those of the DOF: 0..1 for an absolute one, -1..1 for a relative one, whose value is a velocity, so that its range is
its top speed. The puppet's limits are part of its character, the robot's are what its hardware stands: the tighter of both holds.
"""

from __future__ import annotations

from dataclasses import dataclass

from marotte.tomlfile import Table, found

SPEED_RANGE = (0.05, 50)
"""Of an absolute DOF: widths of the whole range, 0 to 1, a second."""
ACCEL_RANGE_ABSOLUTE = (1, 1000)
"""Widths of the whole range a second, a second."""
ACCEL_RANGE_RELATIVE = (4, 1000)
"""Top speeds a second. With less than 4, a wheel would not come to a stand in time when the host is gone."""

DEFAULT_SPEED = 10.0
"""Quicker than any servo: 0.1 s from end to end."""
DEFAULT_ACCEL_ABSOLUTE = 200.0
"""Reaches the default top speed in 50 ms."""
DEFAULT_ACCEL_RELATIVE = 20.0
"""Reaches full speed in 50 ms."""


@dataclass(frozen=True)
class Limits:
    """What a DOF is held to. None: nothing is said about it."""

    range: tuple[float, float] | None = None
    """The least and the greatest value."""
    speed: float | None = None
    """Absolute DOFs: range widths a second."""
    accel: float | None = None
    """Absolute DOFs: range widths a second, a second. Relative ones: top speeds a second."""


@dataclass(frozen=True)
class LimitsInUse:
    """What a DOF is held to when all is said. A relative one has no speed: its range is that."""

    range: tuple[float, float]
    speed: float
    accel: float


def whole_range(relative: bool) -> tuple[float, float]:
    """Return the least and the greatest value that a DOF of this kind can have."""
    return (-1.0, 1.0) if relative else (0.0, 1.0)


def tightest(relative: bool, *limits: Limits) -> LimitsInUse:
    """Return the tightest of some limits; the range is empty (its first end above its last) if they have nothing in common."""
    ranges = [whole_range(relative), *(one.range for one in limits if one.range)]
    speeds = [one.speed for one in limits if one.speed is not None]
    accels = [one.accel for one in limits if one.accel is not None]
    default_accel = DEFAULT_ACCEL_RELATIVE if relative else DEFAULT_ACCEL_ABSOLUTE
    return LimitsInUse(
        (max(low for low, _ in ranges), min(high for _, high in ranges)),
        min(speeds, default=DEFAULT_SPEED),
        min(accels, default=default_accel),
    )


def read_limits(table: Table, relative: bool | None) -> Limits:
    """Return the limits that a table's keys `range`, `speed` and `accel` name.

    `relative` is None where the DOF's kind is not known: then only what is wrong for both kinds is a mistake.
    """
    speed = accel = None
    if table.has("speed"):
        if relative:
            table.mistake("a relative DOF has none, as its range is its top speed; expected no speed", "speed")
        else:
            speed = table.number("speed", *SPEED_RANGE, default=DEFAULT_SPEED)
    if table.has("accel"):
        bounds = ACCEL_RANGE_RELATIVE if relative else ACCEL_RANGE_ABSOLUTE
        accel = table.number("accel", *bounds, default=bounds[1])
    return Limits(read_range(table, "range", relative), speed, accel)


def read_range(table: Table, key: str, relative: bool | None) -> tuple[float, float] | None:
    """Return the least and the greatest value of a DOF as a key names them; None if it does not, or is wrong."""
    least, most = whole_range(relative is not False)
    values = table.numbers(key, 2, least, most, "the least and the greatest value")
    if values is None:
        return None
    low, high = values
    if low >= high:
        table.mistake(f"found {found(table.value(key))}, expected the least value first", key)
        return None
    if relative and not low <= 0 <= high:
        table.mistake(f"found {found(table.value(key))}, expected 0 within: a wheel must be able to stand", key)
        return None
    return low, high
