"""What `marotte run` shows in the terminal: the DOFs and the weights as bars, calmly, in place.

Where there is no terminal (a log, a pipe) it prints a line a cue instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rich.console import Console, Group, RenderableType
from rich.constrain import Constrain
from rich.live import Live
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from marotte.puppet import NEUTRAL_GAINS, Dof, Puppet
from marotte.wiring import Robot

BAR_WIDTH = 30
WEIGHT_WIDTH = 16
FEW_ACTIONS = 18
"""More than these share three columns instead of two, so that the picture stays within a small terminal."""
WEIGHT_FULL = 1.0
"""The weight that fills its bar; a heavier one shows its number only."""
REFRESH_HZ = 12
ECHO_WIDTH = 3
"""Columns left free at the right, where the terminal echoes ^C: a line that it breaks would move the picture."""

_EIGHTHS = " ▏▎▍▌▋▊▉█"
_FULL = "█"
_TRACK = "·"


@dataclass
class Scene:
    """What is to be seen at one moment."""

    frame: int = -1
    values: Mapping[str, float] = field(default_factory=dict)
    """Per DOF, 0..1 or -1..1: the motor layer's."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """Per action, 0..4."""
    cue: str = ""
    """The last cue, as its line says it."""
    mood: str = ""
    """The last mood that a cue has set."""
    gains: tuple[float, ...] = NEUTRAL_GAINS
    """What becomes of the bands, highest first."""
    late_frames: int = 0
    clipped: int = 0
    """Values that signal processing has clipped at the ends of their range."""
    stalled: frozenset[str] = frozenset()
    """DOFs that do not move although they should, and have lost their pulses for it."""
    released: frozenset[str] = frozenset()
    """DOFs without pulses that get them back when they have to move."""
    alert: str = ""
    """What is wrong with the robot, if anything is."""
    is_silent: bool = False
    """Whether the MCU has not been heard for a while."""


class View:
    """Shows scenes while it is entered as a context; a `quiet` one, or one without a terminal, prints lines of cues only."""

    def __init__(
        self, puppet: Puppet, robot: Robot | None, where: str, length_s: float, console: Console, quiet: bool = False
    ) -> None:
        """`where` names the port or MCU, `length_s` is how long the performance takes."""
        self.puppet = puppet
        self.robot = robot
        self.where = where
        self.length_s = length_s
        self.console = console
        self._live = None if quiet or not console.is_terminal else Live(console=console, refresh_per_second=REFRESH_HZ)

    def __enter__(self) -> View:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._live:
            self._live.stop()

    def exchange(self, puppet: Puppet, robot: Robot | None, length_s: float) -> None:
        """Show another puppet from now on."""
        self.puppet = puppet
        self.robot = robot
        self.length_s = length_s

    def show(self, scene: Scene) -> None:
        """Show a scene, in place."""
        if self._live:
            self._live.update(self.picture(scene))

    def note(self, text: str) -> None:
        """Say something that happens once."""
        self.console.print(Text(text), soft_wrap=True)

    def cue(self, at_s: float, text: str) -> None:
        """Say that a cue acts now."""
        if not self._live:
            self.console.print(Text(f"{at_s:7.2f} s  {text}"), soft_wrap=True)

    def picture(self, scene: Scene) -> RenderableType:
        """Return the whole picture of a scene."""
        parts: list[RenderableType] = [self._headline(scene), Rule(style="dim"), self._dofs(scene)]
        parts += [_mood(scene), self._weights(scene), Rule(style="dim"), self._footer(scene)]
        return Constrain(Group(*parts), self.console.width - ECHO_WIDTH)

    def _headline(self, scene: Scene) -> RenderableType:
        time_s = max(scene.frame, 0) / self.puppet.frame_rate_hz
        line = Table.grid(expand=True)
        line.add_column()
        line.add_column(justify="right")
        title = Text.assemble((self.puppet.name, "bold"), ("  on  ", "dim"), self.where)
        clock = Text.assemble(f"{time_s:6.1f}", (f" of {self.length_s:.1f} s", "dim"))
        line.add_row(title, clock)
        return line

    def _dofs(self, scene: Scene) -> RenderableType:
        grid = Table.grid(padding=(0, 2))
        grid.add_column()
        grid.add_column()
        grid.add_column(justify="right")
        grid.add_column(justify="right", style="dim")
        for name, dof in self.puppet.dofs.items():
            value = scene.values.get(name)
            if value is None:
                grid.add_row(name, Text(_TRACK * BAR_WIDTH, style="dim"), "", "")
            else:
                grid.add_row(name, _dof_bar(value, dof), f"{value:.3f}", self._output(name, value, dof, scene))
        return grid

    def _output(self, name: str, value: float, dof: Dof, scene: Scene) -> RenderableType:
        """Return where a DOF's output is and what it gets."""
        output = self.robot.outputs.get(name) if self.robot else None
        if output is None:
            return ""
        if name in scene.stalled:
            return Text(f"{output.drive.place} stalled", style="yellow")
        if name in scene.released:
            return f"{output.drive.place} released"
        level = output.drive_of(value) if dof.is_relative else value
        if not output.drive.has_pulses:
            return f"{output.drive.place} {level:+7.1%}"
        low_us, high_us = output.ends_us
        share = (level + 1) / 2 if dof.is_relative else level
        return f"{output.drive.place} {low_us + (high_us - low_us) * share:6.1f} us"

    def _weights(self, scene: Scene) -> RenderableType:
        columns, bar_width, gap = (2, WEIGHT_WIDTH, 2) if len(self.puppet.actions) <= FEW_ACTIONS else (3, 4, 1)
        grid = Table.grid(padding=(0, gap))
        for _ in range(columns):
            grid.add_column(min_width=14)
            grid.add_column(min_width=bar_width)
            grid.add_column(min_width=4, justify="right")
        cells: list[tuple[RenderableType, ...]] = []
        for name in self.puppet.actions:
            weight = scene.weights.get(name, 0.0)
            bar = Text(bar_text(min(weight / WEIGHT_FULL, 1), bar_width), style="cyan")
            cells.append((Text(name, style="" if weight else "dim"), bar, f"{weight:.2f}" if weight else ""))
        rows = -(-len(cells) // columns)
        cells += [("", "", "")] * (rows * columns - len(cells))
        for row in range(rows):
            grid.add_row(*(cell for triple in cells[row::rows] for cell in triple))
        return grid

    def _footer(self, scene: Scene) -> RenderableType:
        line = Table.grid(expand=True)
        line.add_column()
        line.add_column(justify="right")
        alert = "no word from the MCU" if scene.is_silent else scene.alert
        left = Text(alert, style="yellow") if alert else Text(scene.cue, style="italic")
        late = f"{scene.late_frames} late frames  " if scene.late_frames else ""
        clipped = f"{scene.clipped} values clipped  " if scene.clipped else ""
        line.add_row(left, Text.assemble((late + clipped, "yellow"), ("Ctrl-C stops", "dim")))
        return line


def bar_text(share: float, width: int) -> str:
    """Return a bar that fills `share` (0..1) of `width` characters, to an eighth of a character."""
    eighths = round(min(max(share, 0.0), 1.0) * width * 8)
    full, part = divmod(eighths, 8)
    return (_FULL * full + (_EIGHTHS[part] if part else "")).ljust(width)


def centred_text(value: float, width: int) -> str:
    """Return a bar that grows from the middle of `width` characters (even) to the right or left with `value`, -1..1."""
    half = width // 2
    length = round(min(abs(value), 1.0) * half)
    bar = _FULL * length
    left, right = (bar.rjust(half), " " * half) if value < 0 else (" " * half, bar.ljust(half))
    return left.replace(" ", _TRACK) + right.replace(" ", _TRACK)


def _mood(scene: Scene) -> RenderableType:
    """Return a rule with the mood and the gains, as far as there is something to say."""
    gains = " ".join(f"{gain:g}" for gain in scene.gains) if scene.gains != NEUTRAL_GAINS else ""
    parts = [f"mood {scene.mood}" if scene.mood else "", f"gains {gains}" if gains else ""]
    return Rule(Text(", ".join(part for part in parts if part)), style="dim", align="left")


def _dof_bar(value: float, dof: Dof) -> Text:
    if dof.is_relative:
        return Text(centred_text(value, BAR_WIDTH), style="magenta")
    return Text(bar_text(value, BAR_WIDTH).replace(" ", _TRACK), style="green")
