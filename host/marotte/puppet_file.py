"""Reading a puppet file, `[dof.X]` to `[mood.X]`, with every mistake in it reported.

Source: docs/puppet-file.md; each value's range is checked where it is read.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from marotte.function_tables import FunctionReader
from marotte.functions import Function, FunctionError
from marotte.kalman import AGILITY_RANGE, FADE_RANGE_S, NOISE_RANGE, Kalman
from marotte.limits import Limits, read_limits, read_range, whole_range
from marotte.pools import Pools
from marotte.positions import KeyPath
from marotte.puppet import (
    ABSOLUTE,
    RELATIVE,
    Action,
    Character,
    Curve,
    Dof,
    Live,
    MappingEntry,
    Mood,
    Puppet,
)
from marotte.tomlfile import (
    Document,
    FileMistakes,
    Mistake,
    Table,
    check_number,
    did_you_mean,
    found,
    is_identifier,
    key_text,
)
from shared import formats, program

TEMPO_RANGE = (0.05, 8)
MASTER_TEMPO_RANGE = (0.25, 4)
WEIGHT_RANGE = (0, 4)
GAIN_RANGE = (-4, 4)
HOLD = "hold"
KALMAN = "kalman"
"""How the future of a live channel is predicted."""
TAU_RANGE_S = (0.03, 10)
WARP_RANGE_S = (0.05, 10)
CYCLES_RANGE = (1, formats.CYCLES_MAX)
FREQUENCY_RANGE_HZ = (0.2, 10)
DAMPING_RANGE = (0.1, 3)
RESPONSE_RANGE = (-4, 4)
SEED_MAX = 2**32 - 1
MASTER_NAME = "global"
"""What a score's tempo table calls the master tempo; no action can have this name."""

_MAPPING = 'a mapping ["DOF", LOW, HIGH, "FUNCTION"]'


def load_puppet(path: str | Path) -> Puppet:
    """Return the puppet of a file. Raises FileMistakes, with every mistake in it."""
    puppet, mistakes = read_puppet(path)
    if mistakes:
        raise FileMistakes(mistakes)
    return puppet


def read_puppet(path: str | Path) -> tuple[Puppet, list[Mistake]]:
    """Return what could be read of a puppet, and every mistake in its file."""
    document = Document(path)
    puppet = document.read_until_full(lambda: _Reader(document).puppet(), Puppet(Path(path).stem))
    return puppet, document.in_order()


def weights(table: Table, actions: Iterable[str]) -> dict[str, float]:
    """Return the weight targets of a table whose keys are actions."""
    known = dict.fromkeys(actions)
    targets = {}
    for name in table.names():
        if name not in known:
            table.mistake(f"unknown action{did_you_mean(name, known)}", name)
        else:
            targets[name] = table.number(name, *WEIGHT_RANGE, default=0)
    return targets


def read_gains(table: Table) -> tuple[float, ...] | None:
    """Return the seven gains of a table's `gains`, None if it has none."""
    values = table.numbers("gains", formats.BANDS, *GAIN_RANGE, what="the gains of the seven bands, highest first")
    return tuple(values) if values is not None else None


class _Reader:
    def __init__(self, document: Document) -> None:
        self.document = document
        self.root = document.root()
        self.functions = FunctionReader(document)
        self.blinking: dict[str, KeyPath] = {}
        self.dofs: dict[str, Dof] = {}
        self.lives: dict[str, Live] = {}
        self.mapping_count = 0

    def puppet(self) -> Puppet:
        root = self.root
        name = root.text("name", self.document.path.stem)
        frame_rate_hz = root.integer("frame_rate", formats.FRAME_RATE_MIN_HZ, formats.FRAME_RATE_MAX_HZ, 30)
        seed = root.integer("seed", 0, SEED_MAX, Puppet.seed)
        noise_spread = root.number("noise_spread", 0, 1, 0.0)
        when_silent = root.choice("when_silent", ("idle", "rest", "relax"), "idle")
        curves = self.functions.curves(root)
        self.blinking = self.blinking_dofs()
        dofs = {name: self.dof(table, name) for name, table in root.tables("dof")}
        self.dofs = dofs
        self.lives = {name: self.live(table, name) for name, table in root.tables("live")}
        for curve in curves.values():
            self.declare_channels(curve.function)
        actions = {name: self.action(table, name) for name, table in root.tables("action")}
        behaviours = {name: weights(table, actions) for name, table in root.tables("behaviour")}
        moods = {name: self.mood(table, name) for name, table in root.tables("mood")}
        root.finish()
        self.check_counts(dofs, actions, curves)
        return Puppet(
            name,
            frame_rate_hz,
            seed,
            noise_spread,
            when_silent,
            dofs,
            actions,
            self.lives,
            curves,
            behaviours,
            moods,
        )

    def dof(self, table: Table, name: str) -> Dof:
        kind = table.choice("kind", (ABSOLUTE, RELATIVE), ABSOLUTE)
        relative = kind == RELATIVE
        rest = 0.0 if relative else 0.5
        if table.has("rest"):
            if not relative:
                rest = table.number("rest", 0, 1, rest)
            elif table.value("rest") != 0:
                table.mistake(f"found {found(table.value('rest'))}, expected 0: a relative DOF rests at 0", "rest")
        limits = _limits(table, relative)
        signal = table.boolean("signal", default=None)
        blink = self.blinking.get(name)
        if signal and blink:
            table.mistake(
                f"found true, expected false: {key_text(blink)} makes it blink, and nobody knows when it will", "signal"
            )
        character = self.character(table) if table.has("character") else None
        table.finish()
        is_processed = signal if signal is not None else not (relative or blink)
        range_ = limits.range or whole_range(relative)
        return Dof(name, kind, rest, range_, is_processed, character, limits.speed, limits.accel)

    def blinking_dofs(self) -> dict[str, KeyPath]:
        """Return the DOFs that any mapping, in any action, makes blink, and where the first such mapping stands."""
        blinking: dict[str, KeyPath] = {}
        actions = self.root.value("action", {})
        for name, action in actions.items() if isinstance(actions, dict) else ():
            rows = action.get("map") if isinstance(action, dict) else None
            for index, row in enumerate(rows if isinstance(rows, list) else ()):
                if not isinstance(row, list) or len(row) != 4 or not isinstance(row[0], str):
                    continue
                function = self.functions.parse(row[3])
                if isinstance(function, Function) and function.blinks:
                    blinking.setdefault(row[0], ("action", name, "map", index))
        return blinking

    def character(self, table: Table) -> Character:
        inner = table.table("character")
        inner.require("f", f"a frequency in Hz, {FREQUENCY_RANGE_HZ[0]:g}..{FREQUENCY_RANGE_HZ[1]:g}")
        character = Character(
            inner.number("f", *FREQUENCY_RANGE_HZ, default=1),
            inner.number("zeta", *DAMPING_RANGE, default=1),
            inner.number("r", *RESPONSE_RANGE, default=0),
        )
        inner.finish()
        return character

    def live(self, table: Table, name: str) -> Live:
        if not is_identifier(name):
            table.mistake("expected a name of letters, digits and _, as it stands in live(NAME)")
        rest = table.number("rest", 0, 1, Live.rest)
        tau_s = _tau(table, Live.tau_s)
        predict = table.choice("predict", (HOLD, KALMAN), HOLD)
        kalman = Kalman(
            table.number("noise", *NOISE_RANGE, default=Kalman.noise),
            table.number("agility", *AGILITY_RANGE, default=Kalman.agility),
            table.number("fade", *FADE_RANGE_S, default=Kalman.fade_s),
        )
        for key in ("noise", "agility", "fade"):
            if table.has(key) and table.value("predict", HOLD) == HOLD:
                table.mistake(f'only a channel with predict = "{KALMAN}" has {key}', key)
        table.finish()
        return Live(name, rest, tau_s, kalman if predict == KALMAN else None)

    def action(self, table: Table, name: str) -> Action:
        if name == MASTER_NAME:
            table.mistake(f'"{MASTER_NAME}" names the master tempo in scores; expected another name')
        tempo = table.number("tempo", *TEMPO_RANGE, default=1.0)
        tau_s = _tau(table, Action.tau_s)
        entry = table.choice("entry", ("sync", "start"), "sync")
        warp_s = table.number("warp", *WARP_RANGE_S, default=Action.warp_s)
        cycles = table.integer("cycles", *CYCLES_RANGE, default=1) if table.has("cycles") else None
        if cycles is not None and table.value("entry", "sync") == "sync":
            table.mistake('only an action with entry = "start" has cycles', "cycles")
        table.require("map", f'map = [ ["DOF", LOW, HIGH, "FUNCTION"], ... ], {_MAPPING} for each DOF it moves')
        mappings = self.mappings(table)
        table.finish()
        return Action(name, mappings, tempo, tau_s, entry, warp_s, cycles)

    def mappings(self, table: Table) -> tuple[MappingEntry, ...]:
        rows = table.array("map", f"an array of mappings, each {_MAPPING[2:]}")
        if rows == []:
            table.mistake("is empty, expected at least one mapping", "map")
        seen: dict[str, int] = {}
        entries = []
        for index, row in enumerate(rows or []):
            if not isinstance(row, list) or len(row) != 4:
                table.mistake(f"found {found(row)}, expected {_MAPPING}", "map", index)
                continue
            self.mapping_count += 1
            dof = str(row[0])
            if dof in seen:
                table.mistake(f"maps {dof} again, expected it once; see map[{seen[dof]}]", "map", index)
            seen.setdefault(dof, index)
            entries.append(self.mapping((*table.path, "map", index), row))
        return tuple(entry for entry in entries if entry)

    def mapping(self, path: KeyPath, row: list[Any]) -> MappingEntry | None:
        dof, low, high, text = row
        known = isinstance(dof, str) and dof in self.dofs
        if not known:
            hint = did_you_mean(dof, self.dofs) if isinstance(dof, str) else ""
            self.document.mistake((*path, 0), f"unknown DOF {found(dof)}{hint}")
        # A DOF that is unknown may be of either kind: then only what is wrong for both is a mistake.
        least = 0 if known and not self.dofs[dof].is_relative else -1
        good = [check_number(self.document, (*path, column), row[column], least, 1) for column in (1, 2)]
        function = self.function(path, text)
        return MappingEntry(dof, float(low), float(high), function) if known and all(good) and function else None

    def function(self, path: KeyPath, text: Any) -> Function | None:
        function = self.functions.parse(text)
        if isinstance(function, FunctionError):
            self.document.mistake((*path, 3), f"found {found(text)}: {function}")
            return None
        self.declare_channels(function)
        return function

    def declare_channels(self, function: Function) -> None:
        """Note the live channels that a function reads without their being declared."""
        for name in function.channels:
            self.lives.setdefault(name, Live(name))

    def mood(self, table: Table, name: str) -> Mood:
        tempo = table.number("tempo", *MASTER_TEMPO_RANGE, default=1.0) if table.has("tempo") else None
        mood = Mood(name, read_gains(table), tempo)
        table.finish()
        return mood

    def check_counts(self, dofs: dict[str, Dof], actions: dict[str, Action], curves: dict[str, Curve]) -> None:
        if not dofs:
            self.root.mistake("has no DOF, expected at least one [dof.NAME]")
        pools = Pools(curves, list(self.lives))
        for action in actions.values():
            for entry in action.mappings:
                pools.code(entry.function)
        samples = sum(map(len, pools.curves))
        words = sum(map(len, pools.programs))
        for key, what, count, most in (
            ("dof", "DOFs", len(dofs), formats.DOFS_MAX),
            ("action", "actions", len(actions), formats.ACTIONS_MAX),
            ("action", "mappings", self.mapping_count, formats.MAPPINGS_MAX),
            ("live", "live channels", len(self.lives), formats.LIVES_MAX),
            ("function", "different tables in use", len(pools.curves), formats.CURVES_MAX),
            ("function", "samples of different tables in use", samples, formats.SAMPLES_POOL),
            ("action", "different expressions", len(pools.programs), program.PROGRAMS_MAX),
            ("action", "words of compiled expressions", words, program.POOL_WORDS),
            ("action", "different pairs of threshold and least gap of blinks", len(pools.blinks), formats.BLINKS_MAX),
        ):
            if count > most:
                self.root.mistake(f"has {count} {what}, expected at most {most}", key)


def _limits(table: Table, relative: bool) -> Limits:
    """Return the limits of a DOF: `limits` is its range, or a table that names speed and acceleration too."""
    if not isinstance(table.value("limits"), dict):
        return Limits(read_range(table, "limits", relative))
    inner = table.table("limits")
    limits = read_limits(inner, relative)
    inner.finish()
    return limits


def _tau(table: Table, default: tuple[float, float]) -> tuple[float, float]:
    """Return the time constants of rise and fall: `tau` is one number for both or an array of the two."""
    if isinstance(table.value("tau"), list):
        both = table.numbers("tau", 2, *TAU_RANGE_S, what="the time constants of rise and fall")
        return (both[0], both[1]) if both else default
    tau_s = table.number("tau", *TAU_RANGE_S, default=-1)
    return default if tau_s < 0 else (tau_s, tau_s)
