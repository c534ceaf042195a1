#!/usr/bin/env python3
"""What a frame costs: the firmware's layers timed one by one on the emulated RP2040, with the image that is flashed.

The stage has 10 DOFs and 30 actions with 6 mappings each, of which 6 actions play. Motor ticks do not run while layers are
timed; they are measured in performances of their own. Times are read from the chip's own timer (whole microseconds) around
every call, less those of a call with the same arguments that does nothing, with the heap locked as the main loop locks it. What
the whole frame costs beyond its layers is MicroPython collecting their arguments, and its part in signal processing, which has
tables of its own. The emulator counts the cycles of every instruction, but knows no flash cache: on a real Pico its misses come
on top, most of all for code that runs seldom.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from bench_motor import measure_ticks, percentile
from bench_parts import measure_exchange, measure_functions
from bench_signal import STAGES, Load, measure_free_heap, measure_loads, measure_parts, perform, title, with_figures
from bench_stage import ACTIONS, DOFS, FRAMES, MAPPINGS, PATIENCE_US, PLAYING, SETUP, Cost, Stage, numbers, play

from marotte.images import rp2040_image
from marotte.link import VirtualCarrier, pack, wire_packet
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.session import DICTIONARY, Session
from shared import formats, messages

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "motion.md"

PERFORMANCE_FRAMES = 300
CHUNK_BYTES = 32
CHUNKS = 20

LAYERS = {
    "cues": ("puppet.cues", "apply"),
    "HOLD's targets": ("compositor", "hold_targets"),
    "weights": ("weights", "integrate"),
    "which actions play": ("actions", "_select"),
    "phases": ("actions", "_phases"),
    "ends of gestures": ("actions", "_end_gestures"),
    "which targets rise": ("actions", "_risen"),
    "functions": ("functions", "evaluate"),
    "repeated functions": ("functions", "repeat"),
    "compositor": ("compositor", "blend"),
    "to the motor layer": ("puppet.motor", "put"),
    "warping": ("actions", "_warp"),
    "master phase": ("clock", "advance"),
}
"""Line of the table, and the call that it measures: what it is an attribute of, and its name."""

MEASURE_FRAMES = """
print(frames(nothing))
print(frames(puppet.step, catch_up))
"""

MEASURE_LAYERS = """
TIMED = '''def timed(call, arguments):
    %s = arguments
    begun = time.ticks_us()
    call(%s)
    return time.ticks_diff(time.ticks_us(), begun)
'''
timers = {{}}
def timers_for(count):
    if count not in timers:
        names = ", ".join("a%d" % n for n in range(count))
        exec(TIMED % (names + "," if names else "_", names), globals())
        exec("@micropython.viper\\ndef empty(%s):\\n    pass" % names, globals())
        timers[count] = timed, empty
    return timers[count]
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
            timed, empty = timers_for(len(arguments))
            micropython.heap_lock()
            took_us += timed(self.call, arguments) - timed(empty, arguments)
            micropython.heap_unlock()
        self.times.append(took_us)
        self.seen.clear()
layers = [Layer(place, name) for place, name in ({layers})]
for _ in range({frames}):
    puppet.step()
    for layer in layers:
        layer.measure()
    gc.collect()
    catch_up()
    for layer in layers:
        layer.seen.clear()
for layer in layers:
    print(layer.times)
"""

MEASURE_TELEMETRY = """
link = Link(board, puppet)
puppet.motor.heard()
link.telemetry.ask(7, 1, 1)
board.send = timers_for(3)[1]
def report():
    puppet.motor.heard()
    puppet.motor.tapped[0] = puppet.frame - 1
    link.report()
    puppet.frame += 1
print(frames(report))
"""

RECEIVE = """
time.sleep_ms(4)
begun = time.ticks_us()
count = board.receive(chunk)
took = time.ticks_diff(time.ticks_us(), begun)
print(took, count)
"""


def measure_layers(repl: RawRepl) -> list[Cost]:
    """Measure the whole frame, an idle action, and every layer by itself."""
    repl.exec(SETUP, PATIENCE_US)
    frame = {}
    for actions in (2 * ACTIONS, ACTIONS):
        play(repl, Stage(actions))
        overhead, times = numbers(repl.exec(MEASURE_FRAMES, PATIENCE_US))
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
    stage = Stage()
    session.upload(stage)  # type: ignore[arg-type]
    session.telemetry(formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR, 1, 1)
    session.arm()
    session.weight_targets(0, stage.targets())
    session.start()
    while session.weights[0] < PERFORMANCE_FRAMES:
        session.pump(20_000)
    return session.status()


def print_loads(loads: dict[str, list[Load]]) -> None:
    """Print what frames cost with the future that they have to know."""
    for name, some in loads.items():
        print(
            f"\n{name}\n{'us: median, max':42}{'frame':>14}{'then':>14}{'both':>14}{'mean':>8}{'longest portion':>17}"
        )
        for load in some:
            times = "".join(
                f"{cost.median_us:8.0f}{cost.greatest_us:6.0f}" for cost in (load.step, load.work, load.both)
            )
            portion = f"{load.portion_us:17.0f}" if load.portion_us else ""
            print(f"{load.name:42}{times}{load.mean_us:8.0f}{portion}")


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description="what a frame costs on the emulated RP2040")
    parser.add_argument(
        "--docs", action="store_true", help="write the figures of signal processing to docs/motion.md, too"
    )
    is_documented = parser.parse_args().docs
    image = rp2040_image()
    with Rp2040Mcu(image.path, timed_flash=False) as mcu:
        repl = RawRepl(mcu)
        costs = [*measure_layers(repl), measure_receiving(repl)]
    with Rp2040Mcu(image.path, timed_flash=False) as mcu:
        repl = RawRepl(mcu)
        repl.exec(SETUP, PATIENCE_US)
        functions = measure_functions(repl)
        exchange = measure_exchange(repl)
        clk_hz = mcu.report()["clk_hz"]
    loads: dict[str, list[Load]] = {}
    parts: list[Cost] = []
    for stage in STAGES:
        with Rp2040Mcu(image.path, timed_flash=False) as mcu:
            repl = RawRepl(mcu)
            repl.exec(SETUP, PATIENCE_US)
            loads[title(stage)] = measure_loads(repl, stage)
            parts = parts or measure_parts(repl, stage)
    heap_free = measure_free_heap(image.path, STAGES[-1])
    statuses = [perform(image.path, stage) for stage in STAGES]
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
    for heading, some in (
        ("", costs),
        ("one evaluation", functions),
        ("signal processing", parts),
        ("an exchange of tables", exchange),
    ):
        print(f"\n{heading:32}{'median us':>10}{'max us':>10}")
        for cost in some:
            print(f"{cost.name:32}{cost.median_us:10.1f}{cost.greatest_us:10.1f}")
    print_loads(loads)
    if is_documented:
        text = DOCUMENT.read_text(encoding="utf-8")
        DOCUMENT.write_text(with_figures(text, loads, statuses, heap_free), encoding="utf-8")
    print(f"\n{'a score with news, gains, telemetry':60}{'late frames':>12}{'longest us':>12}{'late us':>10}")
    for name, status in zip(loads, statuses, strict=True):
        counts = f"{status['late_frames']:12d}{status['frame_max_us']:12d}{status['late_max_us']:10d}"
        print(f"{name:60}{counts}")
    ticks = measure_ticks(image.path)
    print(
        f"\n{'motor ticks, link saturated':32}{'p50 us':>10}{'p99 us':>10}{'max us':>10}{'late p50':>10}{'p99':>6}{'max':>6}"
    )
    for kind in ticks:
        took = "".join(f"{percentile(kind.took_us, share):10d}" for share in (0.5, 0.99, 1))
        late = "".join(f"{percentile(kind.late_us, share):{width}d}" for share, width in ((0.5, 10), (0.99, 6), (1, 6)))
        print(f"{kind.name:32}{took}{late}")
        print(f"{'  frames late, longest frame':32}{kind.status['late_frames']:10d}{kind.status['frame_max_us']:10d}")
    print(f"\nin a performance with all telemetry every frame, {PERFORMANCE_FRAMES} frames")
    print(f"{'the whole frame':32}{'':10}{told['frame_max_us']:10.1f}")
    print(f"{'a frame begun late':32}{'':10}{told['late_max_us']:10.1f}")
    print(f"\n{'free heap':32}{heap_free:10d} bytes")
    print(f"{'image (UF2)':32}{image.path.stat().st_size:10d} bytes, of which half is flash contents")
    print(f"{'power on to welcome':32}{welcome_us / 1000:10.1f} ms, at the very first start {first_us / 1000:.1f} ms")
    print(f"{'image sha256':32}{image.sha256}")


if __name__ == "__main__":
    main()
