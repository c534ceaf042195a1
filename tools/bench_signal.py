"""What motion signal processing costs: frames with the future that they have to know, and performances on the real main loop.

A frame is `Puppet.step`; what is to come is worked out in portions between frames. Both are timed while nothing arrives and with
news: other weight targets for all who play.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace

from bench_stage import FRAMES, PATIENCE_US, Cost, Stage, numbers, play, start_firmware, weight_targets

from marotte.link import VirtualCarrier, pack
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.session import Session
from shared import formats

GAINS = (2.5, 2.0, 1.4, 0.7, 1.2, 0.8, 1.1)
"""None of them 1; what they are makes no difference."""

SMALL = Stage()
LARGE = Stage(actions=64, playing=8, dofs=16, rate_hz=60)
LARGEST = Stage(actions=64, playing=64, dofs=16, mappings=8, rate_hz=60)
STAGES = (SMALL, LARGE, LARGEST, replace(LARGEST, rate_hz=30))
NEWS = {
    "nothing arrives": (0, False),
    "news every 20th frame": (20, False),
    "news in every frame": (1, False),
    "waiting news in every frame": (1, True),
}
"""In every so many frames; waiting, as what is stamped does, or arriving when the frame is due."""

SETTLE_FRAMES = 40
"""Until the future is known again after news."""

PERFORMANCE_FRAMES = 300
NEWS_EVERY = 20
PATIENCE_S = 20.0
"""For the answer of firmware that has more to do than there is time for."""

ALL_TAPS = formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR

BEGIN = "<!-- figures of make bench ARGS=--docs -->"
END = "<!-- end of figures -->"

MEASURE = """
news = ({first}, {second})
step_us = array.array("i", range({frames}))
work_us = array.array("i", range({frames}))
portion_us = array.array("i", [0])
def portions():
    while puppet.future.pending:
        begun = time.ticks_us()
        puppet.prepare()
        portion_us[0] = max(portion_us[0], time.ticks_diff(time.ticks_us(), begun))
def course(every, is_waiting, count):
    gc.collect()
    micropython.heap_lock()
    for _ in range({settle}):
        puppet.step()
        catch_up()
    for n in range({frames}):
        has_news = every and n % every == 0
        if has_news and not is_waiting:
            tell(WEIGHT, news[n // every % 2], count)
        begun = time.ticks_us()
        puppet.step()
        step_us[n] = time.ticks_diff(time.ticks_us(), begun)
        if has_news and is_waiting:
            tell(WEIGHT, news[n // every % 2], count)
        begun = time.ticks_us()
        catch_up()
        work_us[n] = time.ticks_diff(time.ticks_us(), begun)
    portion_us[0] = 0
    if every == 1:
        for n in range(20):
            tell(WEIGHT, news[n % 2], count)
            puppet.step()
            portions()
    micropython.heap_unlock()
"""

MEASURE_START = """
puppet.stop()
tell(WEIGHT, news[0], {actions})
begun = time.ticks_us()
puppet.start()
catch_up()
took = time.ticks_diff(time.ticks_us(), begun)
board.stop_ticks()
print([took])
"""

COURSE = """
course({every}, {is_waiting}, {actions})
print(list(step_us))
print(list(work_us))
print(list(portion_us))
"""

PARTS = {
    "a sketch: news takes two": "future._sketch(t, puppet, True)",
    "a block of 16 frames to come": "future._foresight.evaluate(t, future._outlook, 16, 0, puppet)",
    "the bands of a frame": "future._rings.split(t, future._frame)",
    "the signal from the bands": "puppet.processing.process(t, puppet.base_q15, future.level_q16, puppet.signal_q15)",
}
"""Parts of it, each a call that may be repeated."""

MEASURE_PART = """
t = puppet.tables
future = puppet.future
def part():
    {call}
print(frames(part))
"""


COLLECTED = """
from firmware.board_rp2040 import Board
from firmware.main import perform
class CollectingBoard(Board):
    def heap_free(self):
        gc.collect()
        return gc.mem_free()
perform(CollectingBoard())
"""


@dataclass(frozen=True)
class Load:
    """Times of the frames of one course: the frame, work until the next one, both; the longest portion of it, 0 if unknown."""

    name: str
    step: Cost
    work: Cost
    both: Cost
    mean_us: float
    portion_us: float


def title(stage: Stage) -> str:
    """Return what a stage is."""
    return f"{stage.dofs} DOFs, {stage.actions} actions, {stage.playing} playing, {stage.mappings} mappings, {stage.rate_hz} Hz"


def measure_loads(repl: RawRepl, stage: Stage) -> list[Load]:
    """Measure courses of a stage with all gains 1 and with other gains, calm and with news."""
    play(repl, stage)
    news = [weight_targets(stage.targets(weight)) for weight in (0.6, 0.9)]
    repl.exec(MEASURE.format(first=news[0], second=news[1], frames=FRAMES, settle=SETTLE_FRAMES), PATIENCE_US)
    (overhead,) = numbers(repl.exec("print(frames(nothing))", PATIENCE_US))
    overhead_us = statistics.median(overhead)
    loads = []
    for gains in ("all gains 1", "other gains"):
        if loads:
            repl.exec(f"tell(GAIN, {_gains()}, {formats.BANDS})", PATIENCE_US)
        for name, (every, is_waiting) in NEWS.items():
            code = COURSE.format(every=every, is_waiting=is_waiting, actions=stage.actions)
            printed = repl.exec(code, PATIENCE_US)
            step_us, work_us, (portion_us,) = numbers(printed)
            both_us = [step + work for step, work in zip(step_us, work_us, strict=True)]
            step, work = (Cost.of(name, times_us, overhead_us) for times_us in (step_us, work_us))
            both = Cost.of(name, both_us, 2 * overhead_us)
            loads.append(
                Load(f"{gains}, {name}", step, work, both, statistics.mean(both_us) - 2 * overhead_us, portion_us)
            )
    return loads


def measure_parts(repl: RawRepl, stage: Stage) -> list[Cost]:
    """Measure parts of signal processing on the stage that plays, and what it takes to begin again."""
    (overhead,) = numbers(repl.exec(MEASURE_PART.format(call="pass"), PATIENCE_US))
    overhead_us = statistics.median(overhead)
    costs = []
    for name, call in PARTS.items():
        (times_us,) = numbers(repl.exec(MEASURE_PART.format(call=call), PATIENCE_US))
        costs.append(Cost.of(name, times_us, overhead_us))
    (times_us,) = numbers(repl.exec(MEASURE_START.format(actions=stage.actions), PATIENCE_US))
    return [*costs, Cost.of("from start to frame 0", times_us)]


def measure_free_heap(image: str, stage: Stage) -> int:
    """Return how much of the heap is free when the firmware begins to play, garbage not counted, in bytes."""
    with Rp2040Mcu(image, timed_flash=False) as mcu:
        start_firmware(RawRepl(mcu), COLLECTED)
        session = _open(mcu, stage)
        session.start()
        return session.status()["heap_free"]


def perform(image: str, stage: Stage) -> dict[str, int]:
    """Perform a score with gains and with news every 20th frame, all telemetry in every frame, motor ticks at 50 Hz.

    Returns the firmware's status at the end.
    """
    with Rp2040Mcu(image, timed_flash=False) as mcu:
        session = _open(mcu, stage)
        session.telemetry(ALL_TAPS, 1, 1)
        session.arm()
        session.weight_targets(0, stage.targets())
        session.gains(0, dict(enumerate(_gains4_q16())))
        session.start()
        told = 0
        while session.weights[0] < PERFORMANCE_FRAMES:
            if session.weights[0] >= told:
                told += NEWS_EVERY
                session.weight_targets(told, stage.targets(0.6 if told // NEWS_EVERY % 2 else 0.9))
            session.pump(20_000)
        return session.status(PATIENCE_S)


def _open(mcu: Rp2040Mcu, stage: Stage) -> Session:
    session = Session(VirtualCarrier(mcu))
    session.open()
    session.upload(stage)  # type: ignore[arg-type]
    return session


def with_figures(text: str, loads: dict[str, list[Load]], statuses: list[dict[str, int]], heap_free: int) -> str:
    """Return a document's text with the tables between the marks replaced. Raises ValueError if a mark is missing."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    lines = [
        "| puppet | | frame: median, longest | then | both | both, on average | longest portion |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, some in loads.items():
        for load in some[len(NEWS) :]:
            times = [
                f"{cost.median_us / 1000:.1f}, {cost.greatest_us / 1000:.1f}"
                for cost in (load.step, load.work, load.both)
            ]
            portion = f"{load.portion_us / 1000:.1f}" if load.portion_us else ""
            cells = [name, load.name.partition(", ")[2], *times, f"{load.mean_us / 1000:.1f}", portion]
            lines.append(f"| {' | '.join(cells)} |")
            name = ""
    lines += [
        "",
        f"Performances of {PERFORMANCE_FRAMES} frames on the real main loop, with all telemetry in every frame, motor ticks at "
        f"50 Hz and, in every {NEWS_EVERY}th frame, news that was stamped a little ahead, in milliseconds:",
        "",
        "| puppet | frames that came too late for their tick | longest frame | a frame begun late, at most |",
        "| --- | --- | --- | --- |",
    ]
    for name, status in zip(loads, statuses, strict=True):
        times = [f"{status[key] / 1000:.1f}" for key in ("frame_max_us", "late_max_us")]
        lines.append(f"| {name} | {status['late_frames']} | {' | '.join(times)} |")
    lines += [
        "",
        f"When it begins to play, {heap_free} bytes of the RP2040's heap are free, whatever the puppet is like.",
    ]
    tables = "\n".join(lines)
    return f"{before}{BEGIN}\n{tables}\n{END}{after}"


def _gains4_q16() -> list[int]:
    return [round((gain + 4) * formats.GAIN_ONE) for gain in GAINS]


def _gains() -> bytes:
    items = [{"band": band, "gain4_q16": gain} for band, gain in enumerate(_gains4_q16())]
    return pack("gains", {"frame": formats.FRAME_NOW}, items)
