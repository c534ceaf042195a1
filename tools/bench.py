#!/usr/bin/env python3
"""What a frame costs: the firmware's layers timed one by one on the emulated RP2040, with the image that is flashed.

The stage has 10 DOFs and 30 actions with 6 mappings each, of which 6 actions play. Times are read from the chip's own
timer (whole microseconds) around every call, less those of a call with the same arguments that does nothing. What the whole
frame costs beyond its layers is MicroPython collecting their arguments. The emulator counts the cycles of every
instruction, but knows no flash cache: on a real Pico its misses come on top, most of all for code that runs seldom.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from marotte.images import rp2040_image
from marotte.link import VirtualCarrier, pack, wire_packet
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.session import DICTIONARY, Session
from shared import formats, messages

DOFS = 10
ACTIONS = 30
PLAYING = 6
MAPPINGS = 6
RATE_HZ = 30
FUNCTIONS = (formats.FUNCTION_NOISE, formats.FUNCTION_NOISE, formats.FUNCTION_RSIN, formats.FUNCTION_RCOS)
FRAMES = 100
PERFORMANCE_FRAMES = 300
CHUNK_BYTES = 32
CHUNKS = 20
LINES_AT_ONCE = 40
PATIENCE_US = 30_000_000

LAYERS = {
    "cues": ("puppet.cues", "apply"),
    "HOLD's targets": ("compositor", "hold_targets"),
    "weights": ("weights", "integrate"),
    "which actions play": ("actions", "select"),
    "phases": ("actions", "phases"),
    "functions": ("functions", "evaluate"),
    "compositor": ("compositor", "blend"),
    "motor": ("puppet.motor", "move"),
    "  PWM in it": ("board", "pulses"),
    "master phase": ("clock", "advance"),
}
"""Line of the table, and the call that it measures: what it is an attribute of, and its name."""

SETUP = """
import gc, micropython, time
from firmware import actions, clock, compositor, functions, weights
from firmware.board_rp2040 import Board
from firmware.puppet import Puppet
board = Board()
puppet = Puppet(board)
staged = puppet.staged
"""

PLAY = """
puppet.commit()
staged = puppet.staged
puppet.motor.arm()
puppet.start()
for action in range({playing}):
    puppet.weight_target_q28[action] = (1 << 28) - 1000 * action
for _ in range(60):
    puppet.step(False)
"""

MEASURE_FRAMES = """
def frames(call):
    times = []
    gc.collect()
    for _ in range({frames}):
        begun = time.ticks_us()
        call(False)
        times.append(time.ticks_diff(time.ticks_us(), begun))
    return times
def nothing(*_):
    pass
print(frames(nothing))
print(frames(puppet.step))
"""

MEASURE_LAYERS = """
empty = {{}}
def empty_for(arguments):
    count = len(arguments)
    if count not in empty:
        names = ", ".join("a%d" % n for n in range(count))
        exec("@micropython.viper\\ndef it(%s):\\n    pass" % names, globals())
        empty[count] = it
    return empty[count]
class Layer:
    def __init__(self, place, name):
        self.call = getattr(place, name)
        self.seen = []
        self.times = []
        setattr(place, name, self.remember)
    def remember(self, *arguments):
        self.seen.append(arguments)
        return self.call(*arguments)
    def measure(self):
        took_us = 0
        for arguments in self.seen:
            nothing = empty_for(arguments)
            begun = time.ticks_us()
            self.call(*arguments)
            middle = time.ticks_us()
            nothing(*arguments)
            took_us += 2 * middle - begun - time.ticks_us()
        self.times.append(took_us)
        self.seen.clear()
layers = [Layer(place, name) for place, name in ({layers})]
for _ in range({frames}):
    puppet.step(False)
    gc.collect()
    for layer in layers:
        layer.measure()
for layer in layers:
    print(layer.times)
"""

MEASURE_TELEMETRY = """
from firmware.link import Link
link = Link(board, puppet)
link.silent = False
link._taps, link._taps_every, link._weights_every = 7, 1, 1
board.send = empty_for((0, 0))
print(frames(lambda _: link.report()))
"""

RECEIVE = """
time.sleep_ms(4)
begun = time.ticks_us()
count = board.receive(chunk)
took = time.ticks_diff(time.ticks_us(), begun)
print(took, count)
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


class Stage:
    """The puppet that is measured, as the messages of an upload."""

    def __init__(self, actions: int):
        self._actions = actions

    def messages(self) -> Iterator[tuple[str, dict[str, int], list[dict[str, int]]]]:
        """Yield the upload's messages in their order."""
        alpha_q26 = formats.ALPHA_ONE >> 3
        begin = (RATE_HZ, DOFS, self._actions, self._actions * MAPPINGS, 0, 1999, 0, alpha_q26, 500)
        yield self._message("begin", *begin)
        for dof in range(DOFS):
            yield self._message("dof", dof, formats.KIND_ABSOLUTE, formats.VALUE_ONE // 2, 0, formats.VALUE_ONE)
            yield self._message("output", dof, 2 + dof, 16000, 32000)
        for action in range(self._actions):
            tempo_q16 = 50000 + 7 * action
            yield self._message("action", action, tempo_q16, alpha_q26, alpha_q26, MAPPINGS * action, MAPPINGS)
        items = [name for name, _ in messages.find(messages.MAPPINGS)[3]]
        for action in range(self._actions):
            values = [self._mapping(action, number) for number in range(MAPPINGS)]
            entries = [dict(zip(items, entry, strict=True)) for entry in values]
            yield "mappings", {"first_mapping": MAPPINGS * action}, entries
        yield "commit", {}, []

    def program(self) -> Iterator[str]:
        """Yield the same as lines of Python for the MCU's own tables, without the commit."""
        for name, fields, items in self.messages():
            values = ", ".join(str(value) for value in fields.values())
            if name == "mappings":
                first = fields["first_mapping"]
                for number, item in enumerate(items):
                    yield f"assert staged.mapping({first + number}, *{tuple(item.values())}) is None"
            elif name != "commit":
                yield f"assert staged.{name}({values}{', board' if name == 'output' else ''}) is None"

    @staticmethod
    def _message(name: str, *values: int) -> tuple[str, dict[str, int], list[dict[str, int]]]:
        fields = messages.find(getattr(messages, name.upper()))[2]
        return name, dict(zip([field for field, _ in fields], values, strict=True)), []

    @staticmethod
    def _mapping(action: int, number: int) -> tuple[int, ...]:
        code = FUNCTIONS[number % len(FUNCTIONS)]
        argument = (action + number) % formats.NOISE_TABLES if code == formats.FUNCTION_NOISE else 0
        return (action + number) % DOFS, code, argument, 100 * action, formats.VALUE_ONE - 500 * number


def numbers(printed: str) -> list[list[float]]:
    """Return the lists of numbers that were printed, a line each."""
    return [[float(word) for word in line.strip("[]").split(",")] for line in printed.split("\r\n") if line]


def load(repl: RawRepl, actions: int) -> None:
    """Load the stage on the MCU and play it until all weights are there."""
    lines = list(Stage(actions).program())
    for start in range(0, len(lines), LINES_AT_ONCE):
        repl.exec("\n".join(lines[start : start + LINES_AT_ONCE]), PATIENCE_US)
    repl.exec(PLAY.format(playing=PLAYING), PATIENCE_US)


def measure_layers(repl: RawRepl) -> list[Cost]:
    """Measure the whole frame, an idle action, and every layer by itself."""
    repl.exec(SETUP, PATIENCE_US)
    frame = {}
    for actions in (2 * ACTIONS, ACTIONS):
        load(repl, actions)
        overhead, times = numbers(repl.exec(MEASURE_FRAMES.format(frames=FRAMES), PATIENCE_US))
        frame[actions] = Cost.of("the whole frame", times, statistics.median(overhead))
    idle_us = (frame[2 * ACTIONS].median_us - frame[ACTIONS].median_us) / ACTIONS
    pairs = ", ".join(f'({place}, "{name}")' for place, name in LAYERS.values())
    printed = numbers(repl.exec(MEASURE_LAYERS.format(layers=pairs, frames=FRAMES), PATIENCE_US))
    layers = [Cost.of(name, times) for name, times in zip(LAYERS, printed, strict=True)]
    (times,) = numbers(repl.exec(MEASURE_TELEMETRY, PATIENCE_US))
    telemetry = Cost.of("taps and weights of it, packed", times, statistics.median(overhead))
    return [*layers, frame[ACTIONS], Cost("an idle action in it", idle_us, idle_us), telemetry]


def measure_receiving(repl: RawRepl) -> Cost:
    """Measure a byte that comes over USB: so many at a time are waiting when the firmware asks for them."""
    repl.exec(f"chunk = bytearray({CHUNK_BYTES})")
    times = []
    for _ in range(CHUNKS):
        repl.start(RECEIVE)
        repl.mcu.send(b"x" * CHUNK_BYTES)
        took, count = repl.finish().split()
        assert int(count) == CHUNK_BYTES
        times.append(int(took) / CHUNK_BYTES)
    return Cost.of("a byte received over USB", times)


def measure_welcome(mcu: Rp2040Mcu) -> int:
    """Return the time from power on to the answer to a greeting that waits for the chip, in microseconds."""
    hello = pack("hello", {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY})
    mcu.send(wire_packet(messages.HELLO, 0, hello))
    while True:
        mcu.run_for(1000)
        received = mcu.receive()
        if received:
            return received[0][0]


def measure_performance(mcu: Rp2040Mcu) -> dict[str, int]:
    """Perform with full telemetry; return the firmware's status at the end."""
    session = Session(VirtualCarrier(mcu))
    session.open()
    session.upload(Stage(ACTIONS))  # type: ignore[arg-type]
    session.telemetry(formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR, 1, 1)
    session.arm()
    session.weight_targets(0, {action: formats.WEIGHT_ONE - 1000 * action for action in range(PLAYING)})
    session.start()
    while session.weights[0] < PERFORMANCE_FRAMES:
        session.pump(20_000)
    return session.status()


def main() -> None:
    """Measure, and print the table."""
    image = rp2040_image()
    with Rp2040Mcu(image.path, timed_flash=False) as mcu:
        repl = RawRepl(mcu)
        costs = [*measure_layers(repl), measure_receiving(repl)]
        clk_hz = mcu.report()["clk_hz"]
    with tempfile.TemporaryDirectory() as folder:
        flash = Path(folder) / "flash.bin"
        with Rp2040Mcu(image.path, flash=flash) as mcu:  # the first start formats the flash
            first_us = measure_welcome(mcu)
        with Rp2040Mcu(image.path, flash=flash) as mcu:
            welcome_us = measure_welcome(mcu)
            told = measure_performance(mcu)
    print(
        f"RP2040 at {clk_hz / 1e6:g} MHz, emulated, without misses of the flash cache; {DOFS} DOFs, {ACTIONS} actions,"
    )
    print(f"{PLAYING} playing, {MAPPINGS} mappings each; {FRAMES} frames, pulses on all DOFs")
    print(f"\n{'':32}{'median us':>10}{'max us':>10}")
    for cost in costs:
        print(f"{cost.name:32}{cost.median_us:10.1f}{cost.greatest_us:10.1f}")
    print(f"\nin a performance with all telemetry every frame, {PERFORMANCE_FRAMES} frames")
    print(f"{'the whole frame':32}{'':10}{told['frame_max_us']:10.1f}")
    print(f"{'a frame begun late':32}{'':10}{told['late_max_us']:10.1f}")
    print(f"\n{'free heap':32}{told['heap_free']:10d} bytes")
    print(f"{'image (UF2)':32}{image.path.stat().st_size:10d} bytes, of which half is flash contents")
    print(f"{'power on to welcome':32}{welcome_us / 1000:10.1f} ms, at the very first start {first_us / 1000:.1f} ms")
    print(f"{'image sha256':32}{image.sha256}")


if __name__ == "__main__":
    main()
