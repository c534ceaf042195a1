"""The puppet that `bench.py` measures, as the messages of an upload and as lines of Python for the MCU's own tables."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from marotte.character import response
from marotte.link import pack
from marotte.mcu.raw_repl import RawRepl
from marotte.puppet import Character
from shared import formats, messages, program

DOFS = 10
ACTIONS = 30
PLAYING = 6
MAPPINGS = 6
FRAMES = 100
RATE_HZ = 30
LINES_AT_ONCE = 40
SPEED = 10.0
ACCEL = 200.0
"""Limits per second and per second squared."""

CHARACTER = Character(f_hz=3.0, zeta=0.5, r=0.5)

PATIENCE_US = 30_000_000
START_US = 1_000_000
"""What the firmware takes at most until it listens."""

FUNCTIONS = (
    (formats.FUNCTION_NOISE, None),
    (formats.FUNCTION_NOISE, None),
    (formats.FUNCTION_RSIN, 0),
    (formats.FUNCTION_RCOS, 0),
)
"""Function and argument of the mappings of an action, in turn; None is another argument for each."""

CURVE_SAMPLES = 64
BLINK_THRESHOLD_Q16 = 0x8000
BLINK_GAP_Q18 = 1 << 18

_ARGUMENTS = {formats.FUNCTION_NOISE: formats.NOISE_TABLES}


SETUP = f"""
room.clear()
import array, gc, micropython, time
gc.collect()
from firmware.link import Link  # first, while the heap has room for the text of its dictionary
from firmware import actions, clock, compositor, functions, weights
from firmware.board_rp2040 import Board
from firmware.cues import GAIN, WEIGHT
from firmware.puppet import Puppet
board = Board()
puppet = Puppet(board)
staged = puppet.staged
took_us = array.array("i", range({FRAMES}))
def nothing():
    pass
def catch_up():
    while puppet.future.pending:
        puppet.prepare()
def frames(call, afterwards=nothing):
    gc.collect()
    micropython.heap_lock()
    for n in range({FRAMES}):
        begun = time.ticks_us()
        call()
        took_us[n] = time.ticks_diff(time.ticks_us(), begun)
        afterwards()
    micropython.heap_unlock()
    return list(took_us)
def tell(kind, body, count):
    assert puppet.cues.put(kind, body, 0, len(body), count) == 0
"""
"""While a call is timed the heap is locked, as it is in the main loop: else MicroPython looks there for room for the locals of
larger functions. `catch_up` does the work between frames."""

PLAY = """
puppet.stop()
puppet.commit()
staged = puppet.staged
puppet.start()
catch_up()
board.stop_ticks()
tell(WEIGHT, {targets}, {actions})
for _ in range(60):
    puppet.step()
    catch_up()
"""


@dataclass(frozen=True)
class Cost:
    """A line of the table; times in microseconds."""

    name: str
    median_us: float
    greatest_us: float

    @classmethod
    def of(cls, name: str, times_us: list[float], overhead_us: float = 0) -> Cost:
        return cls(name, statistics.median(times_us) - overhead_us, max(times_us) - overhead_us)


def numbers(printed: str) -> list[list[float]]:
    """Return the lists of numbers that were printed, a line each."""
    return [[float(word) for word in line.strip("[]").split(",")] for line in printed.split("\r\n") if line]


@dataclass(frozen=True)
class Stage:
    """So many actions with `mappings` mappings each; `functions` as FUNCTIONS. Programs differ only in their last constant."""

    actions: int = ACTIONS
    functions: Sequence[tuple[int, int | None]] = FUNCTIONS
    words: Sequence[int] = (program.CONST, 0)
    motor_period_us: int = formats.MOTOR_PERIOD_MAX_US
    has_characters: bool = False
    playing: int = PLAYING
    dofs: int = DOFS
    mappings: int = MAPPINGS
    rate_hz: int = RATE_HZ

    def targets(self, weight: float = 1.0) -> dict[int, int]:
        """Return weight targets for those that play, all different."""
        return {action: round(weight * formats.WEIGHT_ONE) - 1000 * action for action in range(self.playing)}

    def messages(self) -> Iterator[tuple[str, dict[str, int], list[dict[str, int]]]]:
        """Yield the upload's messages in their order."""
        alpha_q26 = formats.ALPHA_ONE >> 3
        kinds = {kind for kind, _ in self.functions}
        curves = self.mappings if formats.FUNCTION_CURVE in kinds or program.CURVE in self.words else 0
        programs = self.mappings if formats.FUNCTION_PROGRAM in kinds else 0
        blinks = self.mappings if kinds & {formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN} else 0
        # fmt: off
        yield _message(
            "begin", self.rate_hz, self.dofs, self.actions, self.actions * self.mappings, 1, curves, programs, blinks, 1999, 0,
            alpha_q26, 500, formats.SILENT_IDLE,
        )
        # fmt: on
        yield _message("robot", self.motor_period_us, 0, formats.NO_PIN, 0, 0)
        tick_s = self.motor_period_us * 1e-6
        speed_q24 = int(SPEED * tick_s * formats.POSITION_ONE)
        accel_q24 = int(ACCEL * tick_s**2 * formats.POSITION_ONE)
        for dof in range(self.dofs):
            limits = (0, formats.VALUE_ONE, speed_q24, accel_q24, int(blinks == 0))
            yield _message("dof", dof, formats.KIND_ABSOLUTE, formats.VALUE_ONE // 2, *limits)
        for dof in range(self.dofs):
            if self.has_characters:
                yield "character", {"dof": dof, **response(CHARACTER, tick_s).fixed()}, []
            output = _message("output", dof, formats.DRIVER_PINS, 1, 16000, 32000, 0, formats.VALUE_ONE)
            yield output[0], output[1], [{"setting": 2 + dof}]
        for action in range(self.actions):
            tempo_q16 = 50000 + 7 * action
            entry = (formats.ENTRY_START, alpha_q26, 0)
            yield _message(
                "action", action, tempo_q16, alpha_q26, alpha_q26, self.mappings * action, self.mappings, *entry
            )
        items = [name for name, _ in messages.find(messages.MAPPINGS)[3]]
        for action in range(self.actions):
            values = [self._mapping(action, number) for number in range(self.mappings)]
            entries = [dict(zip(items, entry, strict=True)) for entry in values]
            yield "mappings", {"first_mapping": self.mappings * action}, entries
        yield _message("live", 0, formats.WEIGHT_ONE // 2, alpha_q26, alpha_q26, formats.PREDICT_HOLD, 0, 0, 0)
        for curve in range(curves):
            samples = [{"value_q15": 500 * n + curve} for n in range(CURVE_SAMPLES)]
            yield "curve", {"curve": curve, "samples": CURVE_SAMPLES}, samples
        for number in range(programs):
            words = [*self.words, program.CONST, number, program.ADD]
            yield "program", {"program": number, "words": len(words)}, [{"word": word} for word in words]
        for blink in range(blinks):
            yield _message("blink", blink, BLINK_THRESHOLD_Q16, BLINK_GAP_Q18)
        yield "commit", {}, []

    def _mapping(self, action: int, number: int) -> tuple[int, ...]:
        code, argument = self.functions[number % len(self.functions)]
        if argument is None:
            argument = (action + number) % _ARGUMENTS.get(code, self.mappings)
        return (action + number) % self.dofs, code, argument, 100 * action, formats.VALUE_ONE - 500 * number


def load(repl: RawRepl, stage: Stage) -> None:
    """Fill the MCU's staged tables."""
    lines = list(_lines(stage))
    for start in range(0, len(lines), LINES_AT_ONCE):
        repl.exec("\n".join(lines[start : start + LINES_AT_ONCE]), PATIENCE_US)


def _lines(stage: Stage) -> Iterator[str]:
    """Yield a stage as lines of Python for the MCU's own tables, without the commit."""
    for name, fields, items in stage.messages():
        values = ", ".join(str(value) for value in fields.values())
        if name == "mappings":
            for number, item in enumerate(items):
                yield f"assert staged.mapping({fields['first_mapping'] + number}, *{tuple(item.values())}) is None"
        elif name != "commit":
            if name == "output":
                settings = [item["setting"] for item in items]
                yield f"assert staged.output({values}, array.array('H', {settings}), {len(settings)}) is None"
                continue
            yield f"assert staged.{name}({values}) is None"
            method = {"curve": "sample", "program": "word"}.get(name)
            for item in items:
                yield f"assert staged.{method}({', '.join(map(str, item.values()))}) is None"


def _message(name: str, *values: int) -> tuple[str, dict[str, int], list[dict[str, int]]]:
    fields = messages.find(getattr(messages, name.upper()))[2]
    return name, dict(zip([field for field, _ in fields], values, strict=True)), []


def play(repl: RawRepl, stage: Stage) -> None:
    """Load a stage on the MCU and play it until all weights are there."""
    load(repl, stage)
    repl.exec(PLAY.format(targets=weight_targets(stage.targets()), actions=stage.actions), PATIENCE_US)


def start_firmware(repl: RawRepl, code: str) -> None:
    """Start code that calls `perform`, and wait until the host may speak: before that a byte 3 would be taken for Ctrl-C."""
    repl.exec("room.clear()\nimport gc, micropython\ngc.collect()")
    repl.start("micropython.kbd_intr(-1)\n" + code)
    repl.mcu.run_for(START_US)


def weight_targets(targets_q28: dict[int, int]) -> bytes:
    """Return the payload that sets weight targets at once."""
    items = [{"action": action, "target_q28": target} for action, target in targets_q28.items()]
    return pack("weight_targets", {"frame": formats.FRAME_NOW}, items)
