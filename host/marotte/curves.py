"""Curves of animation tools as table functions: read from CSV, resampled to one period, normalised.

    curve = import_curve("wave.csv", "rotation_x", period_s=2.0)
    print(curve.text("WAVE"))

Neither Blender nor Bottango has a CSV format of its own, scripts write it, so this is what is assumed: the first line names the
columns; cells are parted by commas, semicolons (numbers may then have decimal commas) or tabs. A column `time`, `seconds` or `t`
holds seconds, a column `frame` frames, which become seconds by their rate; without either the rows are spread evenly over the
period. Rows may be samples of every frame or keyframes alone: between them the curve is straight. The period begins with the
first row; rows after its end are left out, and the last one before it leads back to the first.
"""

from __future__ import annotations

import csv
import math
import re
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

from marotte.functions import PRIMITIVES
from marotte.textfile import UnreadableError, read_text
from marotte.tomlfile import FileMistakes, Mistake, did_you_mean, is_identifier
from shared import formats

FRAME_RATE_HZ = 24.0
"""Of the tool, if nobody says: Blender's."""
FRAME_RATE_MAX_HZ = 1000
BYTES_MAX = 4 << 20
"""Of a file: some hours of every frame."""
DIGITS = 5

_TIMES = ("time", "seconds", "t", "time_s", "time (s)")
_FRAMES = ("frame", "frames", "frame_number")
_GRID = 4096
_PER_LINE = 12
_MISTAKES_MAX = 20
_NAMES_SHOWN = 20
_NAME_SHOWN = 40


@dataclass(frozen=True)
class ImportedCurve:
    """One period of a curve."""

    source: str
    """The column and the file."""
    rows: int
    """How many rows of the file lie in the period."""
    period_s: float
    low: float
    high: float
    """The values that have become 0 and 1."""
    samples: tuple[float, ...]
    """0..1, at equal distances over the period."""
    error_max: float
    error_rms: float
    """How far the straight lines between the samples are from those between the rows, over the period; in 0..1."""
    uncovered: float
    """Which share of the period is behind the last row."""

    def text(self, name: str) -> str:
        """Return the `[function.NAME]` for a puppet file, with remarks on what has been done."""
        cells = [f"{sample:.{DIGITS}f}" for sample in self.samples]
        lines = [", ".join(cells[start : start + _PER_LINE]) for start in range(0, len(cells), _PER_LINE)]
        remarks = [
            f"{self.source}: {self.rows} rows in a period of {self.period_s:g} s, for a tempo of {1 / self.period_s:.6g}",
            f"{self.low:g} to {self.high:g} have become 0 to 1: a mapping's LOW and HIGH set the range",
            f"{len(self.samples)} samples, off by {self.error_max:.5f} at most, {self.error_rms:.5f} rms",
        ]
        if self.uncovered > 1.5 * (1 - self.uncovered) / (self.rows - 1):
            remarks.append(f"the last {self.uncovered * self.period_s:g} s have no row: a straight line leads back")
        return "\n".join(
            [
                *(f"# {remark}" for remark in remarks),
                f"[function.{name}]",
                "table = [",
                *(f"    {line}," for line in lines),
                "]",
            ]
        )


def import_curve(
    path: str | Path,
    column: str,
    period_s: float,
    samples: int | None = None,
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> ImportedCurve:
    """Return one period of a column of a CSV file.

    `samples` is how many to take, 2..256 (default: as many as there are rows in the period, at most 256). Raises FileMistakes.
    """
    times_s, values = _read(Path(path), column, period_s, frame_rate_hz)
    phases = [(time_s - times_s[0]) / period_s for time_s in times_s]
    count = sum(phase < 1 - 1e-9 for phase in phases)
    phases, values = phases[:count], values[:count]
    low, high = min(values), max(values)
    if count < 2 or low == high:
        what = f"has {count} row in a period of {period_s:g} s" if count < 2 else f"is {low:g} throughout"
        raise _mistake(path, None, column, f"{what}, expected a curve")
    if not math.isfinite(high - low):
        raise _mistake(path, None, column, f"is {low:g} to {high:g}, expected values that are nearer together")
    shares = [(value - low) / (high - low) for value in values]
    size = samples or min(count, formats.SAMPLES_MAX)
    table = tuple(round(_straight(phases, shares, index / size), DIGITS) for index in range(size))
    grid = [index / size for index in range(size)]
    errors = [_straight(grid, table, phase) - share for phase, share in zip(phases, shares, strict=True)]
    spread = [_straight(grid, table, k / _GRID) - _straight(phases, shares, k / _GRID) for k in range(_GRID)]
    rms = math.sqrt(sum(error * error for error in spread) / _GRID)
    source = f"{column} of {Path(path).name}"
    worst = max(abs(error) for error in errors)
    return ImportedCurve(source, count, period_s, low, high, table, worst, rms, 1 - phases[-1])


def function_name(text: str) -> str:
    """Return a name for a function that is near to a text: letters, digits and _, in capitals."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_").upper() or "CURVE"
    return name if is_function_name(name) else f"CURVE_{name}"


def is_function_name(name: str) -> bool:
    """Return whether a `[function.NAME]` can have this name."""
    return is_identifier(name) and name not in PRIMITIVES and name != "t"


def _straight(phases: list[float], values: list[float] | tuple[float, ...], phase: float) -> float:
    """Return the closed curve through points of increasing phase, straight between them, at `phase` in 0..1."""
    after = bisect_right(phases, phase)
    start, end = phases[after - 1], phases[after] if after < len(phases) else phases[0] + 1
    here, there = values[after - 1], values[after % len(values)]
    return here + (there - here) * (phase - start) / (end - start)


def _read(path: Path, column: str, period_s: float, frame_rate_hz: float) -> tuple[list[float], list[float]]:
    """Return the times in seconds, increasing, and the values of a column."""
    try:
        return _columns(path, _lines(path), column, period_s, frame_rate_hz)
    except csv.Error as error:
        raise _mistake(path, None, "", f"is no table of cells: {error}") from None


def _columns(
    path: Path, lines: list[str], column: str, period_s: float, frame_rate_hz: float
) -> tuple[list[float], list[float]]:
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    header = [cell.strip() for cell in next(csv.reader(lines[:1], delimiter=delimiter), [])]
    if column not in header:
        hint = (
            did_you_mean(column, header)
            or f"; expected one of {', '.join(name[:_NAME_SHOWN] for name in header[:_NAMES_SHOWN])}"
        )
        raise _mistake(path, 1 if header else None, column, f"there is no such column{hint}")
    clock = [index for index, name in enumerate(header) if name.lower() in (*_TIMES, *_FRAMES)]
    per_s = frame_rate_hz if clock and header[clock[0]].lower() in _FRAMES else 1.0
    mistakes: list[Mistake] = []
    times_s: list[float] = []
    values: list[float] = []
    rows = csv.reader(lines[1:], delimiter=delimiter)
    for row in rows:
        if len(mistakes) >= _MISTAKES_MAX:
            break
        if not any(cell.strip() for cell in row):
            continue
        line = rows.line_num + 1
        numbers = {}
        for index in {header.index(column), *clock[:1]}:
            cell = row[index].strip() if index < len(row) else ""
            try:
                numbers[index] = _number(cell, delimiter)
            except ValueError:
                mistakes.append(Mistake(str(path), line, header[index], f'found "{cell[:40]}", expected a number'))
        if len(numbers) == len({header.index(column), *clock[:1]}):
            time_s = numbers[clock[0]] / per_s if clock else float(len(values))
            if times_s and time_s <= times_s[-1]:
                what = f"{header[clock[0]]} does not increase, expected one row after the other in time"
                mistakes.append(Mistake(str(path), line, header[clock[0]], what))
            times_s.append(time_s)
            values.append(numbers[header.index(column)])
    if mistakes:
        raise FileMistakes(mistakes)
    if not values:
        raise _mistake(path, None, column, "has no row, expected at least two")
    if not clock:
        times_s = [index * period_s / len(values) for index in range(len(values))]
    return times_s, values


def _lines(path: Path) -> list[str]:
    try:
        return read_text(path, "utf-8-sig", BYTES_MAX).splitlines()
    except UnreadableError as error:
        raise _mistake(path, None, "", str(error)) from None


def _number(cell: str, delimiter: str) -> float:
    """Return the finite number of a cell. Raises ValueError."""
    value = float(cell.replace(",", ".") if delimiter == ";" else cell)
    if not math.isfinite(value):
        raise ValueError
    return value


def _mistake(path: str | Path, line: int | None, key: str, text: str) -> FileMistakes:
    return FileMistakes([Mistake(str(path), line, key, text)])
