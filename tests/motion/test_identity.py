"""The same numbers on every MCU: 64-bit and 32-bit words on a PC, and Thumb code on the emulated RP2040.

A difference would be an overflow or a sign bug. The RP2040's pins are read in the same run: tick by tick their pulses are those
that the motor layer has written on the PC, to one count of the PWM timer.
"""

import hashlib
import random
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy
import pytest

import marotte
from marotte.emulated import connected
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.rendering import Rendering
from marotte.wiring import Robot
from tests.corners import corners
from tests.corners_full import full_corners
from tests.corners_signal import signal_corners
from tests.generate import random_robot
from tests.motion.playing import TAPS, Case, load, random_case, random_gains_case, tap

SEEDS, GAINS_SEEDS = range(200, 220), range(220, 224)
SECONDS = 5
WORKERS = 2

TIMER_COUNT_US = 0.32
BRIDGE_US = 50
BRIDGE_COUNT_US = 0.008
AFTER_TICK_US = 2200
"""A servo's period begins so long after the tick that has written its pulse, and what it takes to start a PWM slice."""

WRITTEN_US = 3400
"""After so long a tick has written what it has to write, and before the next one."""

BUSY_ACTIONS, BUSY_RATE_HZ, CALM_RATE_HZ = 30, 50, 120
"""An RP2040 is in time with 30 actions at 50 frames a second and quick ticks; with more it is with slower ones."""


class Played(NamedTuple):
    """One case on the three MCUs.

    `reference` is the PC again, with a robot whose outputs are written in each tick; `drives` are what the PCs have written,
    `edges` those of the RP2040's pins.
    """

    case: Case
    robot: Robot
    renderings: dict[str, Rendering]
    drives: dict[str, dict]
    edges: dict[int, list[tuple[int, int]]]


def identity_cases():
    """Return the cases: random ones with a robot, corners with the largest and the smallest numbers, and band gains."""
    cases = []
    for seed in SEEDS:
        case = random_case(seed, SECONDS)
        robot = random_robot(random.Random(-seed), case.puppet)
        if len(case.puppet["action"]) > BUSY_ACTIONS or case.puppet.get("frame_rate", 30) > BUSY_RATE_HZ:
            for rated in (robot, *robot["output"].values()):
                if "rate" in rated:
                    rated["rate"] = min(rated["rate"], CALM_RATE_HZ)
        cases.append(case._replace(robot=robot))
    named = (
        "everything at once",
        "fastest phases",
        "one of each function",
        "phases behind the master's",
        "blink after re-entry",
    )
    cases += [Case(*corner) for corner in (*corners(), *full_corners()) if corner.name in named]
    cases += [random_gains_case(seed, SECONDS, 4, dofs=5, actions=8) for seed in GAINS_SEEDS]
    return cases + [Case(*corner) for corner in signal_corners(4) if corner.name in ("leaps of the master", "moods")]


CASES = identity_cases()


@pytest.fixture(scope="module")
def played(rp2040_image_path):
    """Futures of `Played`, one for each case."""

    def on_all(case):
        puppet, score, robot = load(case)
        renderings, drives = {}, {}
        for name, bits, driven in (("unix", 64, robot), ("unix32", 32, robot), ("reference", 64, in_each_tick(robot))):
            with UnixMcu(bits) as mcu:
                renderings[name] = marotte.render(puppet, score, SECONDS, mcu, connected(mcu, driven))
                drives[name] = mcu.drives()
        with Rp2040Mcu(rp2040_image_path) as mcu:
            renderings["rp2040"] = marotte.render(puppet, score, SECONDS, mcu, connected(mcu, robot))
            edges = {pin: mcu.edges(pin) for pin in drives["unix"]}
        return Played(case, robot, renderings, drives, edges)

    with ThreadPoolExecutor(WORKERS) as pool:
        yield [pool.submit(on_all, case) for case in CASES]


def in_each_tick(robot):
    """Return the robot with all outputs written in each tick of the same motor layer."""
    outputs = {name: replace(output, rate_hz=None) for name, output in robot.outputs.items()}
    written = replace(robot, rate_hz=1e6 / (robot.motor_period_us - 1), outputs=outputs)  # 1 us: periods are rounded up
    assert written.motor_period_us == robot.motor_period_us
    return written


@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_renderings_are_identical_to_the_bit_on_all_mcus(played, number):
    renderings = played[number].result().renderings
    late = [rendering.status["late_frames"] for rendering in renderings.values()]
    assert not any(late), "the motor layer had to guess"
    cut_short = [rendering.status["cut_short"] for rendering in renderings.values()]
    assert not any(cut_short), "there was no time for the future"
    for name in TAPS:
        expected = tap(renderings["unix"], name)
        for kind in ("reference", "unix32", "rp2040"):
            found = tap(renderings[kind], name)
            differ = numpy.argwhere(found != expected)
            assert found.shape == expected.shape and not len(differ), f"{name} on {kind} differs, first at {differ[0]}"


def test_rp2040_tells_what_it_ran(played, rp2040_image_path):
    sha256 = hashlib.sha256(rp2040_image_path.read_bytes()).hexdigest()
    reports = [future.result().renderings["rp2040"].report for future in played]
    assert {report["image_sha256"] for report in reports} == {sha256}
    instructions = [report["instructions"] for report in reports]
    assert min(instructions) > 10_000_000
    print(f"image {sha256}, {sum(instructions)} instructions in {len(reports)} runs")


@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_pulses_written_are_identical_on_both_pcs(played, number):
    drives = played[number].result().drives
    assert drives["unix32"] == drives["unix"]


@pytest.mark.parametrize("number", range(len(SEEDS)), ids=[case.name for case in CASES[: len(SEEDS)]])
def test_pulses_on_the_pins_are_those_that_the_motor_layer_has_written(played, number):
    _, robot, _, drives, edges = played[number].result()
    if not robot.outputs:
        pytest.skip("this robot has no outputs")
    period_us = robot.motor_period_us
    written = written_by_tick(drives["reference"], period_us, robot)
    base_us = None
    for output in robot.outputs.values():
        pin = output.drive.pulse_pin
        if pin is None:
            continue
        found = pulses(edges[pin])
        rises_us = numpy.array([pulse.start_ns / 1000 for pulse in found])
        base_us = rises_us[0] - AFTER_TICK_US if base_us is None else base_us
        assert numpy.allclose(numpy.diff(rises_us), robot.written_us(output), rtol=0, atol=0.001), f"pin {pin}"
        ticks = numpy.arange(len(found)) * robot.turns(output)
        widths_us = numpy.array([pulse.width_ns / 1000 for pulse in found])
        assert_follows(pin, ticks, widths_us, written[pin], TIMER_COUNT_US)
    for output in robot.outputs.values():
        if output.drive.pulse_pin is None and base_us is not None and robot.turns(output) == 1:
            for pin in set(output.drive.pins) & set(written):
                widths_us = duties(edges[pin], base_us, period_us)
                assert_follows(pin, numpy.arange(len(widths_us)), widths_us, written[pin], BRIDGE_COUNT_US)


def assert_follows(pin, ticks, widths_us, expected_us, tolerance_us):
    """Assert that the widths found after some ticks are those expected, which may begin any number of ticks later or earlier.

    Before the first that is expected stands what the pin has while nothing moves.
    """

    def wrong(shift):
        places = (ticks + shift).clip(0, None)
        known = places < len(expected_us)
        return numpy.abs(widths_us[known] - expected_us[places[known]]) > tolerance_us

    span = ticks[-1] // 4
    fewest = min((wrong(shift) for shift in range(-span, span)), key=lambda off: (off.sum(), -len(off)))
    assert len(fewest) > 0.7 * len(ticks)
    first = numpy.flatnonzero(fewest)[:1]
    assert not fewest.any(), f"pin {pin}: {fewest.sum()} of {len(fewest)} pulses are wrong, the first is number {first}"


def written_by_tick(drives, period_us, robot):
    """Return the widths in microseconds that were in force after each tick, arrays by pin.

    They begin at one tick. Until its first width a servo's pin counts as if it had that already, a bridge's as low.
    """
    servo_pins = {output.drive.pulse_pin for output in robot.outputs.values()}
    first_us = min(drive.t_us[0] for drive in drives.values())
    last_us = max(drive.t_us[-1] for drive in drives.values())
    ticks = numpy.arange(first_us, last_us + 1, period_us)
    written = {}
    for pin, drive in drives.items():
        places = numpy.searchsorted(numpy.array(drive.t_us), ticks, side="right") - 1
        widths_us = numpy.array(drive.value) / (1 << 18)
        before_us = widths_us[0] if pin in servo_pins else 0
        written[pin] = numpy.where(places < 0, before_us, widths_us[places.clip(0)])
    return written


def duties(edges, base_us, period_us):
    """Return for each tick from `base_us` on how long a bridge's pin was high in a period of the bridge after it."""
    t_us = numpy.array([t_ns / 1000 for t_ns, _ in edges])
    levels = numpy.array([level for _, level in edges])
    high_us = numpy.concatenate([[0], numpy.cumsum(numpy.diff(t_us) * levels[:-1])])
    ends_us = numpy.arange(base_us + min(WRITTEN_US - AFTER_TICK_US, period_us), t_us[-1], period_us)

    def high_until(at_us):
        place = numpy.searchsorted(t_us, at_us, side="right") - 1
        return numpy.where(place < 0, 0, high_us[place] + (at_us - t_us[place]) * levels[place])

    return high_until(ends_us) - high_until(ends_us - BRIDGE_US)
