"""Drawing a rendering: the taps of some DOFs over time, their spectra before and after signal processing, and the weights.

    rendering = render(puppet, score, seconds=20, weights=True)
    save_figure(plot(rendering, score, ["NECK", "HEAD_YAW"]), "pet.png")

Everything is laid out in inches, and no text is smaller than 9 points at the size in which it is saved. Needs matplotlib, which
is imported here only, and only when something is drawn.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from marotte.bands import centres_hz, hertz
from marotte.cue_list import Listed, NumberedCue, in_columns, numbered
from marotte.errors import MarotteError
from marotte.spectrum import spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from marotte.rendering import Rendering
    from marotte.score import Score

SUFFIXES = (".png", ".svg")
DOFS = 4
"""How many DOFs are drawn if nobody names any."""
MISSING = "plotting needs matplotlib, which is not installed; please run: pip install 'matplotlib>=3.8'"
DOTS_PER_INCH = 150

BASE, SIGNAL, MOTOR = "#a6a6a6", "#0072b2", "#d55e00"
"""Colours of Okabe and Ito, which people who see colours differently tell apart; the lines differ in width too."""
WEIGHT = "#009e73"
INK, FAINT, CUE = "#333333", "#e3e3e3", "#cbbd7f"

SMALL_PT = 9.0
MEDIUM_PT = 10.0
LARGE_PT = 14.0

# All lengths are in inches.
WIDTH = 13.0
MARGIN = 0.3
TIME_WIDTH = 7.6
GAP = 0.85
HEADER = 0.62
STRIP_ROW = 0.17
ROW = 1.25
TITLE = 0.3
AXIS = 0.55
WEIGHT_ROW = 0.23
LINE = 0.175
LIST_INDENT = 0.35
LIST_WIDTH = 3.55
CUES_MOST = 60
"""More cues than that are only counted, and their lines are thinner."""
LEVELS_MOST = 4
"""Rows of cues' numbers above the time; a number that would need one more is in the list only."""
COLUMNS = 3
"""Of a list of cues that is too long to stand beside the weights."""
NAME_MOST = 24
SPECTRUM_DECADES = 3.5
SPAN_LEAST = 0.02
AMPLITUDE_LEAST = 0.03
AMPLITUDE_NONE = 1e-9
"""What the axes of a DOF that hardly moves show at least; a logarithmic axis has no 0."""


class PlotError(MarotteError):
    """A rendering cannot be drawn."""


def is_possible() -> bool:
    """Return whether matplotlib is there."""
    return importlib.util.find_spec("matplotlib") is not None


def plot(rendering: Rendering, score: Score | None = None, dofs: Sequence[str] | None = None) -> Figure:
    """Return a rendering as a figure: base, signal and motor of DOFs, spectra of base and signal, weights, and a score's cues.

    By default the DOFs are the four that move most. The weights are there if the rendering has them. Raises PlotError without
    matplotlib, KeyError for an unknown DOF.
    """
    if not is_possible():
        raise PlotError(MISSING)
    names = list(dict.fromkeys(dofs)) if dofs else moving(rendering)
    for name in names:
        if name not in rendering.base:
            raise KeyError(name)
    return _Drawing(rendering, numbered(score, rendering.puppet, len(rendering.frames)), names).figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure to a PNG or SVG file. The same rendering gives the same bytes. Raises MarotteError."""
    import matplotlib

    kind = Path(path).suffix.lower()
    metadata = {"Date": None} if kind == ".svg" else {}
    try:
        with matplotlib.rc_context({"svg.hashsalt": "marotte"}):
            figure.savefig(path, dpi=DOTS_PER_INCH, format=kind.removeprefix("."), metadata=metadata)
    except OSError as error:
        raise MarotteError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from error


def moving(rendering: Rendering) -> list[str]:
    """Return the DOFs that move most, in the file's order."""
    dofs = rendering.puppet.dofs
    spans = {
        name: (max(values) - min(values)) / (2 if dofs[name].is_relative else 1)
        for name, values in rendering.signal.items()
    }
    most = sorted(spans, key=lambda name: -spans[name])[:DOFS]
    return [name for name in spans if name in most]


class _Drawing:
    """A figure in the making, from its top downwards."""

    def __init__(self, rendering: Rendering, cues: list[NumberedCue], dofs: list[str]) -> None:
        from matplotlib.figure import Figure

        self.rendering = rendering
        self.rate_hz = rendering.puppet.frame_rate_hz
        self.end_s = len(rendering.frames) / self.rate_hz
        self.cues = cues
        self.cue_width = 0.8 if len(cues) <= CUES_MOST else 0.3
        weights = {name: values for name, values in rendering.weights.items() if any(values)}
        self.left = max([0.75, *(MARGIN + 0.12 + text_width(_short(name)) for name in weights)])
        self.time_width = TIME_WIDTH - (self.left - 0.75)
        self.right = self.left + self.time_width + GAP
        self.spectrum_width = WIDTH - MARGIN - self.right
        levels = self.cue_levels()
        strip = STRIP_ROW * (max((level for level in levels if level is not None), default=0) + 1)
        listed = self.cue_lines()
        weights_height = TITLE + WEIGHT_ROW * len(weights) if weights else 0.0
        rows = MARGIN + HEADER + strip + len(dofs) * (ROW + TITLE)
        lines = sum(map(len, listed))
        is_beside = AXIS + TITLE + LINE * lines <= weights_height + AXIS
        columns = [listed] if is_beside else in_columns(listed, COLUMNS)
        list_height = TITLE + LINE * max(sum(map(len, column)) for column in columns) if listed else 0.0
        list_top = rows + AXIS if is_beside else rows + weights_height + AXIS
        self.height = max(rows + weights_height + AXIS, list_top + list_height) + MARGIN
        self.figure = Figure(figsize=(WIDTH, self.height))
        self.header()
        top = MARGIN + HEADER
        self.strip(top, strip, levels)
        top += strip
        for place, name in enumerate(dofs):
            is_last = place == len(dofs) - 1
            self.dof(name, top + TITLE, is_first=place == 0, has_time=is_last and not weights)
            self.spectrum(name, top + TITLE, is_first=place == 0, is_last=is_last)
            top += ROW + TITLE
        if weights:
            self.weights(weights, top + TITLE)
        for place, column in enumerate(columns):
            left = self.right - GAP + 0.3 if is_beside else MARGIN + place * (WIDTH - 2 * MARGIN) / COLUMNS
            self.cue_list(column, left, list_top + 0.1, has_title=place == 0)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Return axes at a place, in inches from the left and from the top."""
        bottom = self.height - top - height
        box = (left / WIDTH, bottom / self.height, width / WIDTH, height / self.height)
        axes = self.figure.add_axes(box)
        axes.tick_params(labelsize=SMALL_PT, colors=INK, length=3)
        for side, spine in axes.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(INK)
        return axes

    def text(self, left: float, top: float, text: str, size_pt: float, **style: Any) -> None:
        """Write a text whose upper left corner is at a place, in inches from the left and from the top."""
        place = (left / WIDTH, 1 - top / self.height)
        self.figure.text(*place, text, fontsize=size_pt, **{"color": INK, "va": "top", **style})

    def header(self) -> None:
        """Write what this is, and what the lines are, outside of the data."""
        from matplotlib.lines import Line2D

        rendering = self.rendering
        frames = len(rendering.frames)
        self.text(MARGIN, MARGIN, rendering.puppet.name, LARGE_PT, weight="bold")
        kind = rendering.report.get("kind", "")
        where = f", on the emulated {kind}" if kind else ""
        self.text(
            MARGIN, MARGIN + 0.27, f"{self.end_s:g} s, {frames} frames at {self.rate_hz} a second{where}", SMALL_PT
        )
        handles = [Line2D([], [], label=label, **style) for label, style in _LINES.items()]
        self.figure.legend(
            handles=handles,
            loc="upper right",
            bbox_to_anchor=(1 - MARGIN / WIDTH, 1 - (MARGIN - 0.06) / self.height),
            borderaxespad=0,
            ncols=3,
            frameon=False,
            fontsize=MEDIUM_PT,
            labelcolor=INK,
        )

    def cue_levels(self) -> list[int | None]:
        """Return for each cue the row in which its number stands, so that no two touch; None where there is no room."""
        ends: list[float] = []
        levels: list[int | None] = []
        for cue in self.cues if len(self.cues) <= CUES_MOST else ():
            at = cue.at_s / self.end_s * self.time_width
            half = text_width(str(cue.number)) / 2 + 0.03
            level = next((level for level, end in enumerate(ends) if at - half >= end), len(ends))
            if level < LEVELS_MOST:
                ends[level : level + 1] = [at + half]
            levels.append(level if level < LEVELS_MOST else None)
        return levels

    def strip(self, top: float, height: float, levels: list[int | None]) -> None:
        """Write the numbers of the cues above the time."""
        for cue, level in zip(self.cues, levels, strict=False):
            if level is None:
                continue
            left = self.left + cue.at_s / self.end_s * self.time_width
            self.text(left, top + height - STRIP_ROW * (level + 1), str(cue.number), SMALL_PT, ha="center")

    def time_axes(self, top: float, height: float, has_time: bool) -> Axes:
        """Return axes over time with the cues in them."""
        axes = self.axes(self.left, top, self.time_width, height)
        axes.set_xlim(0, self.end_s)
        axes.tick_params(labelbottom=has_time)
        if has_time:
            axes.set_xlabel("time (s)", fontsize=SMALL_PT, color=INK)
        for cue in self.cues:
            axes.axvline(cue.at_s, color=CUE, linewidth=self.cue_width, zorder=0)
        return axes

    def dof(self, name: str, top: float, is_first: bool, has_time: bool) -> None:
        """Draw the taps of a DOF."""
        rendering = self.rendering
        axes = self.time_axes(top, ROW, has_time)
        if is_first:  # the lines of the cues go up to their numbers
            for cue in self.cues:
                axes.axvline(
                    cue.at_s, 1, 1 + (TITLE - 0.02) / ROW, color=CUE, linewidth=self.cue_width, zorder=0, clip_on=False
                )
        title = axes.set_title(_short(name), loc="left", fontsize=MEDIUM_PT, fontweight="bold", color=INK, pad=4)
        title.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 1})
        taps = {"base": rendering.base[name], "signal": rendering.signal[name], "motor": rendering.motor[name]}
        for label, values in taps.items():
            axes.plot(rendering.time_s, values, **_LINES[label])
        low, high = _limits([value for values in taps.values() for value in values])
        axes.set_ylim(low, high)
        axes.locator_params(axis="y", nbins=4)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        axes.set_axisbelow(True)

    def spectrum(self, name: str, top: float, is_first: bool, is_last: bool) -> None:
        """Draw the spectra of a DOF's base and signal, and mark the bands."""
        from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

        axes = self.axes(self.right, top, self.spectrum_width, ROW)
        axes.set_xscale("log")
        axes.set_yscale("log")
        centres = centres_hz(self.rate_hz)
        for centre_hz in centres:
            axes.axvline(centre_hz, color=FAINT, linewidth=1.0, zorder=0)
        most = 0.0
        for label, values in (("base", self.rendering.base[name]), ("signal", self.rendering.signal[name])):
            frequencies, amplitudes = spectrum(values, self.rate_hz)
            axes.plot(frequencies, [max(amplitude, AMPLITUDE_NONE) for amplitude in amplitudes], **_LINES[label])
            most = max([most, *amplitudes])
        top_decade = math.log10(max(most, AMPLITUDE_LEAST)) + 0.25
        axes.set_ylim(10 ** (top_decade - SPECTRUM_DECADES), 10**top_decade)
        axes.set_xlim(centres[-1] / 1.7, centres[0] * 1.12)
        decades = [10.0**n for n in range(-6, 3)]
        for axis in (axes.xaxis, axes.yaxis):
            low, high = axis.get_view_interval()
            axis.set_major_locator(FixedLocator([decade for decade in decades if low <= decade <= high]))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.tick_params(labelbottom=is_last)
        if is_last:
            axes.set_xlabel("frequency (Hz)", fontsize=SMALL_PT, color=INK)
        if is_first:
            bands = axes.secondary_xaxis("top")
            bands.xaxis.set_major_locator(FixedLocator(centres))
            bands.xaxis.set_major_formatter(FuncFormatter(lambda value, _: hertz(value)))
            bands.xaxis.set_minor_locator(NullLocator())
            bands.tick_params(labelsize=SMALL_PT, colors=INK, length=0, pad=2)
            bands.spines["top"].set_visible(False)
            bands.set_xlabel("amplitude, and the bands (Hz)", fontsize=SMALL_PT, color=INK, labelpad=4)

    def weights(self, weights: dict[str, list[float]], top: float) -> None:
        """Draw the weights of all actions that play, a row each."""
        full = max(1.0, max(max(values) for values in weights.values()))
        axes = self.time_axes(top, WEIGHT_ROW * len(weights), has_time=True)
        axes.set_title(f"weights (a full row is {full:.3g})", loc="left", fontsize=MEDIUM_PT, color=INK, pad=4)
        for row, values in enumerate(weights.values()):
            foot = len(weights) - 1 - row
            heights = [foot + 0.92 * value / full for value in values]
            axes.fill_between(self.rendering.time_s, foot, heights, color=WEIGHT, linewidth=0)
            axes.axhline(foot, color=FAINT, linewidth=0.6, zorder=0)
        axes.set_ylim(0, len(weights))
        places = [len(weights) - 0.5 - row for row in range(len(weights))]
        axes.set_yticks(places, [_short(name) for name in weights])
        axes.tick_params(axis="y", length=0)

    def cue_lines(self) -> Listed:
        """Return the list of cues."""
        if len(self.cues) > CUES_MOST:
            return [[("", f"{len(self.cues)}, too many to be listed")]]
        return [cue.lines(LIST_WIDTH, text_width) for cue in self.cues]

    def cue_list(self, cues: Listed, left: float, top: float, has_title: bool) -> None:
        """Write the list of cues, or a column of it."""
        if cues and has_title:
            self.text(left, top, "cues", MEDIUM_PT)
        for place, (number, line) in enumerate(line for cue in cues for line in cue):
            line_top = top + TITLE + LINE * place
            self.text(left + LIST_INDENT - 0.12, line_top, number, SMALL_PT, ha="right")
            self.text(left + LIST_INDENT, line_top, line, SMALL_PT)


_LINES: dict[str, dict[str, Any]] = {
    "base": {"color": BASE, "linewidth": 3.2, "solid_capstyle": "round"},
    "signal": {"color": SIGNAL, "linewidth": 1.5},
    "motor": {"color": MOTOR, "linewidth": 1.0},
}


def text_width(text: str, size_pt: float = SMALL_PT) -> float:
    """Return the width of a text in inches."""
    from matplotlib.textpath import TextPath

    return TextPath((0, 0), text, size=size_pt).get_extents().width / 72 if text.strip() else 0.0


def _short(name: str) -> str:
    """Return a name that is not too long for its place."""
    return name if len(name) <= NAME_MOST else name[: NAME_MOST - 1] + "…"


def _limits(values: Iterable[float]) -> tuple[float, float]:
    """Return what an axis shows: all values, and a little more."""
    found = list(values)
    low, high = min(found), max(found)
    middle = (low + high) / 2
    half = max(high - low, SPAN_LEAST) * 0.54
    return middle - half, middle + half
