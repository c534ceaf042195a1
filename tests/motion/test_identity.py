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
from tests.generate import random_robot
from tests.motion.playing import TAPS, Case, load, random_case, tap

SEEDS = range(200, 220)
SECONDS = 5
WORKERS = 2

TIMER_COUNT_US = 0.32
BRIDGE_US = 50
BRIDGE_COUNT_US = 0.008
AFTER_TICK_US = 1000
"""A servo's period begins so long after the tick that has written its pulse, at least."""

GRID_US = 600
"""How much longer than that it may take: what the firmware needs to start a PWM slice."""

LOW_MIN_US = 200
"""A pin is low for so long in each period."""


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
    """Return the cases: random ones with a robot, and the corners with the largest and the smallest numbers."""
    cases = []
    for seed in SEEDS:
        case = random_case(seed, SECONDS)
        cases.append(case._replace(robot=random_robot(random.Random(-seed), case.puppet)))
    named = (
        "everything at once",
        "fastest phases",
        "one of each function",
        "phases behind the master's",
        "blink after re-entry",
    )
    return cases + [Case(*corner) for corner in (*corners(), *full_corners()) if corner.name in named]


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
    period_us = robot.motor_period_us
    courses = {}  # by pin: ticks, widths, tolerance
    base_us = None
    for output in robot.outputs.values():
        pin = output.drive.pulse_pin
        if pin is None:
            continue
        found = pulses(edges[pin])
        rises_us = numpy.array([pulse.start_ns / 1000 for pulse in found]) - AFTER_TICK_US
        base_us = rises_us[0] if base_us is None else base_us
        ticks = numpy.rint((rises_us - base_us) / period_us).astype(int)
        assert numpy.abs(rises_us - base_us - ticks * period_us).max() < GRID_US, (
            f"{output.dof}: pulses beside the ticks"
        )
        assert (numpy.diff(ticks) == robot.turns(output)).all(), f"{output.dof}: pulses are missing"
        longest_us = robot.written_us(output) - LOW_MIN_US
        widths_us = numpy.array([pulse.width_ns / 1000 for pulse in found])
        courses[pin] = ticks, widths_us, longest_us, TIMER_COUNT_US
    if base_us is None:
        pytest.skip("this robot has no servo")
    for output in robot.outputs.values():
        if output.drive.pulse_pin is None and robot.turns(output) == 1:
            for pin in bridge_pins(output, drives["reference"]):
                ticks, widths_us = duties(edges[pin], base_us, period_us)
                courses[pin] = ticks, widths_us, BRIDGE_US, BRIDGE_COUNT_US
    written = written_by_tick(drives["reference"], period_us)
    shift = best_shift(courses, written)
    for pin, (ticks, widths_us, longest_us, tolerance_us) in courses.items():
        places = ticks + shift
        known = (places < len(written[pin])) & (ticks >= 0)
        assert known.sum() * period_us > 0.8 * SECONDS * 1e6 / max(1, numpy.diff(ticks).max(initial=1))
        expected_us = numpy.minimum(written[pin][places[known].clip(0)], longest_us)
        errors_us = numpy.abs(widths_us[known] - expected_us)
        worst = errors_us.argmax()
        assert errors_us[worst] <= tolerance_us, (
            f"pin {pin}, tick {ticks[known][worst]}: {widths_us[known][worst]:.3f} us long, expected {expected_us[worst]:.3f}; "
            f"{(errors_us > tolerance_us).sum()} of {len(errors_us)} are wrong"
        )


def bridge_pins(output, drives):
    """Return the PWM pins of a bridge."""
    return [pin for pin in output.drive.pins if pin in drives]


def written_by_tick(drives, period_us):
    """Return the widths in microseconds that were in force after each tick, arrays by pin.

    They begin at one tick, before which each pin has the first width that it gets at all.
    """
    first_us = min(drive.t_us[0] for drive in drives.values())
    last_us = max(drive.t_us[-1] for drive in drives.values())
    ticks = numpy.arange(first_us, last_us + 1, period_us)
    written = {}
    for pin, drive in drives.items():
        places = numpy.searchsorted(numpy.array(drive.t_us), ticks, side="right") - 1
        written[pin] = numpy.array(drive.value)[places.clip(0)] / (1 << 18)
    return written


def best_shift(courses, written):
    """Return by how many ticks the pins are behind what was written, so that most of the pulses fit."""
    longest = max(len(course[0]) for course in courses.values()) + max(len(widths) for widths in written.values())

    def misfits(shift):
        wrong = 0
        for pin, (ticks, widths_us, longest_us, tolerance_us) in courses.items():
            places = (ticks + shift).clip(0, len(written[pin]) - 1)
            wrong += (numpy.abs(widths_us - numpy.minimum(written[pin][places], longest_us)) > tolerance_us).sum()
        return wrong, abs(shift)

    return min(range(-longest, longest), key=misfits)


def duties(edges, base_us, period_us):
    """Return the ticks and how long a bridge's pin was high in the last period before the next tick."""
    t_us = numpy.array([t_ns / 1000 for t_ns, _ in edges])
    levels = numpy.array([level for _, level in edges])
    high_us = numpy.concatenate([[0], numpy.cumsum(numpy.diff(t_us) * levels[:-1])])
    ticks = numpy.arange(int((t_us[-1] - base_us) // period_us))
    ends_us = base_us + (ticks + 1) * period_us - BRIDGE_US / 2

    def high_until(at_us):
        place = numpy.searchsorted(t_us, at_us, side="right") - 1
        return numpy.where(place < 0, 0, high_us[place] + (at_us - t_us[place]) * levels[place])

    return ticks, high_until(ends_us) - high_until(ends_us - BRIDGE_US)
