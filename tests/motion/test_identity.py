"""The same numbers on every MCU: 64-bit and 32-bit words on a PC, and Thumb code on the emulated RP2040.

A difference would be an overflow or a sign bug. The RP2040's pins are read in the same run: their pulses are those that the
motor tap and the robot file ask for, to one count of the PWM timer.
"""

import bisect
import hashlib
import math
import random
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy
import pytest

from marotte.link import unpack
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.pulses import pulses
from marotte.rendering import Rendering
from shared import codec
from tests.corners import corners
from tests.corners_full import full_corners
from tests.motion.playing import TAPS, Case, play, random_case, tap

SEEDS = range(200, 220)
SECONDS = 5
WORKERS = 2

TIMER_COUNT_US = 0.32
FRAME_LONGEST_US = 4_000
"""From the instant of a frame to the last byte of its telemetry, at most."""

OUTPUT_PINS = (*range(2, 23), *range(26, 29))


class Played(NamedTuple):
    """One case on the three MCUs; `edges` by DOF and `reported_us`, the instants of the taps messages, on the RP2040."""

    case: Case
    renderings: dict[str, Rendering]
    edges: dict[str, list[tuple[int, int]]]
    reported_us: list[int]


class ListenedRp2040(Rp2040Mcu):
    """An emulated RP2040 that remembers all that it has sent."""

    def __init__(self, image):
        super().__init__(image)
        self.sent = []

    def receive(self, link=None):
        received = super().receive(link)
        self.sent += received
        return received


def random_robot(rng, puppet):
    """Return a robot with a pin, a range, a trim and a sense of its own for most DOFs; no two share a PWM channel."""
    pins = {pin % 16: pin for pin in rng.sample(OUTPUT_PINS, len(OUTPUT_PINS))}
    free = rng.sample(list(pins.values()), len(pins))
    outputs = {}
    for name in puppet["dof"]:
        if rng.random() < 0.9:
            low_us, high_us = rng.choice(
                ((1000, 2000), (600.5, 2700), sorted(rng.uniform(600, 2700) for _ in range(2)))
            )
            outputs[name] = {
                "pin": free.pop(),
                "pulse_us": [round(low_us, 3), round(high_us, 3)],
                "trim_us": round(rng.uniform(-300, 300), 2),
                "invert": rng.random() < 0.4,
            }
    return {"name": "random", "output": outputs}


def identity_cases():
    """Return the cases: random ones with limits and a robot, and the corners with the largest and the smallest numbers."""
    cases = []
    for seed in SEEDS:
        rng = random.Random(-seed)
        case = random_case(seed, SECONDS)
        for dof in case.puppet["dof"].values():
            if rng.random() < 0.4:
                least = -1 if dof.get("kind") == "relative" else 0
                middle = 0 if least else dof.get("rest", 0.5)
                dof["limits"] = [round(rng.uniform(least, middle), 3), round(rng.uniform(middle, 1), 3)]
        cases.append(case._replace(robot=random_robot(rng, case.puppet)))
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
        renderings = {kind: play(case, SECONDS, kind) for kind in ("unix", "unix32")}
        with ListenedRp2040(rp2040_image_path) as mcu:
            renderings["rp2040"] = play(case, SECONDS, mcu)
            outputs = (case.robot or {}).get("output", {})
            edges = {name: mcu.edges(output["pin"]) for name, output in outputs.items()}
        return Played(case, renderings, edges, taps_instants_us(mcu.sent))

    with ThreadPoolExecutor(WORKERS) as pool:
        yield [pool.submit(on_all, case) for case in CASES]


def taps_instants_us(sent):
    """Return the instants at which the taps messages of frames 0, 1, 2 .. ended; `sent` is what an MCU sent, in pieces."""
    instants_us = []
    packet = bytearray()
    for t_us, data in sent:
        for byte in data:
            if byte:
                packet.append(byte)
                continue
            length = codec.decode(packet, len(packet))
            message = unpack(packet[0], bytes(packet[2 : length - 4])) if length > 0 else None
            if message and message.name == "taps":
                assert message.fields["frame"] == len(instants_us)
                instants_us.append(t_us)
            packet.clear()
    return instants_us


def pulse_us(output, share):
    """Return the pulse width at a share 0..1 of the DOF's range, as the robot file defines it."""
    low_us, high_us = (end_us + output["trim_us"] for end_us in output["pulse_us"])
    return low_us + (high_us - low_us) * (1 - share if output["invert"] else share)


@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_renderings_are_identical_to_the_bit_on_all_mcus(played, number):
    renderings = played[number].result().renderings
    for name in TAPS:
        expected = tap(renderings["unix"], name)
        for kind in ("unix32", "rp2040"):
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


@pytest.mark.parametrize("number", range(len(SEEDS)), ids=[case.name for case in CASES[: len(SEEDS)]])
def test_pulses_on_the_pins_are_those_of_the_motor_tap(played, number):
    case, renderings, edges, reported_us = played[number].result()
    rendering = renderings["rp2040"]
    # The MCU goes on for some frames after the last one that is rendered.
    end_us = next(iter(reported_us[len(rendering.frames) :]), math.inf) - FRAME_LONGEST_US
    for name, output in case.robot["output"].items():
        dof = rendering.puppet.dofs[name]
        least = -1 if dof.is_relative else 0
        rest = min(max(dof.rest, dof.limits[0]), dof.limits[1])
        # From frame -1, which is the rest before the start, the widths in the order of frames.
        widths_us = [pulse_us(output, (value - least) / (1 - least)) for value in (rest, *rendering.motor[name])]
        found = [pulse for pulse in pulses(edges[name]) if pulse.start_ns / 1000 < end_us]
        assert len(found) >= (SECONDS - 0.1) / 0.02
        for pulse in found:
            expected = widths_in_effect(widths_us, reported_us, pulse.start_ns / 1000)
            error_us = min(abs(pulse.width_ns / 1000 - width_us) for width_us in expected)
            assert error_us <= TIMER_COUNT_US, (
                f"{name}: the pulse at {pulse.start_ns / 1e9:.4f} s is {pulse.width_ns / 1000:.2f} us long, expected {expected}"
            )


def widths_in_effect(widths_us, reported_us, at_us):
    """Return the widths that a pulse may have that begins `at_us`.

    It is that of the last frame reported, and while the next frame may be under way, that one's too.
    """
    done = bisect.bisect_right(reported_us, at_us)
    begun = bisect.bisect_right(reported_us, at_us + FRAME_LONGEST_US)
    return widths_us[done : begun + 1]
