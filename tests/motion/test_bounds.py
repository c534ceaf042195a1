"""The base tap against the float64 reference: the bounds of `docs/motion.md`, over random puppets and all corners.

`make test` plays some dozens of puppets, `make soak` some hundreds. A random draw in which the reference itself stands at
the edge of a decision (a weight within 2^-24 of the 1/256 that it is compared with, a gesture within 1/8192 period of its
end) says nothing: it is replaced by the next draw of its seed, and counted.
"""

import math
import random
import tomllib
from pathlib import Path

import numpy
import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.prompter import Prompter
from marotte.rendering import frame_count
from tests.corners import SECONDS as CORNER_SECONDS
from tests.corners import corners
from tests.corners_full import full_corners
from tests.motion.bounds import fractions_of_bound
from tests.motion.playing import Case, load, play, random_case, tap
from tests.reference import ReferencePuppet

PUPPETS = Path(__file__).parents[2] / "puppets"
QUICK_SEEDS, QUICK_SECONDS = range(30), 10
SOAK_SEEDS, SOAK_SECONDS = range(1000, 1400), 20
PET_SECONDS = 21
SETTLING_TAUS = 18
CORNERS = [*corners(), *full_corners()]
DRAWS = 20
"""Cases that are drawn for one seed before it counts as hopeless."""


def reference_base(case, frames):
    """Return (base, weight_sums) of the reference, arrays [frames, dofs], or None if a decision is too close to call."""
    reference = ReferencePuppet(case.puppet, case.score)
    base = numpy.empty((frames, len(reference.dofs)))
    weight_sums = numpy.empty_like(base)
    for n in range(frames):
        base[n] = reference.step()
        weight_sums[n] = reference.weight_sums
    return (base, weight_sums) if reference.is_decided() else None


def decided_case(seed, seconds):
    """Return the seed's first random case in which every decision is clear, what the reference expects, and its number."""
    for draw in range(DRAWS):
        case = random_case(seed, seconds, draw)
        expected = reference_base(case, frame_count(seconds, case.puppet.get("frame_rate", 30)))
        if expected:
            return case, expected, draw
    raise AssertionError(f"seed {seed}: {DRAWS} draws in a row were too close to call")


def assert_case_is_right(case, seconds, expected):
    """Play a case, hold its taps against the definitions, the motor tap against its range; return its fractions of the bounds."""
    rendering = play(case, seconds)
    base = tap(rendering, "base")
    if not any("gains" in part for part in (*case.puppet.get("mood", {}).values(), *case.score["cue"])):
        assert numpy.array_equal(base, tap(rendering, "signal")), (
            f"{case.name}: with all gains 1 the signal is the base"
        )
    low, high = numpy.array([dof.limits for dof in rendering.puppet.dofs.values()]).T
    rounding = 1 / 32768  # limits are rounded to the format of values
    motor = tap(rendering, "motor")
    assert (motor >= low - rounding).all() and (motor <= high + rounding).all(), f"{case.name}: beyond its limits"
    strong, weak = fractions_of_bound(base, *expected)
    assert strong <= 1 and weak <= 1, (
        f"{case.name}: the base is off by {strong:.3f} of the bound 1/2048 and, "
        f"where the weights sum to less than 1/64, by {weak:.3f} of 1/128"
    )
    return strong, weak


@pytest.mark.parametrize("seed", QUICK_SEEDS)
def test_base_of_random_puppets_keeps_the_bounds(seed):
    case, expected, _ = decided_case(seed, QUICK_SECONDS)
    assert_case_is_right(case, QUICK_SECONDS, expected)


@pytest.mark.parametrize("corner", CORNERS, ids=lambda corner: corner.name)
def test_base_of_corners_keeps_the_bounds(corner):
    case = Case(*corner)
    expected = reference_base(case, frame_count(CORNER_SECONDS, case.puppet.get("frame_rate", 30)))
    assert expected, "a decision of this corner is too close to call"
    assert_case_is_right(case, CORNER_SECONDS, expected)


def test_base_of_the_pet_keeps_the_bounds():
    puppet, score = (tomllib.loads((PUPPETS / name).read_text()) for name in ("pet.toml", "pet-score.toml"))
    case = Case("pet", puppet, score)
    assert_case_is_right(case, PET_SECONDS, reference_base(case, PET_SECONDS * puppet["frame_rate"]))


@pytest.mark.soak
def test_base_of_hundreds_of_random_puppets_keeps_the_bounds(capsys):
    found = []
    replaced = 0
    for seed in SOAK_SEEDS:
        case, expected, draw = decided_case(seed, SOAK_SECONDS)
        found.append(assert_case_is_right(case, SOAK_SECONDS, expected))
        replaced += draw
    strong, weak = numpy.max(found, axis=0)
    with capsys.disabled():
        print(
            f"\nbase tap: {len(found)} random puppets x {SOAK_SECONDS} s, worst error {strong:.3f} of 1/2048, "
            f"{weak:.3f} of 1/128 where weights are faint; {replaced} draws too close to call were replaced"
        )
    assert replaced < len(found)


@pytest.mark.parametrize("tau_s", [0.03, 0.1, 0.25, 2, 10, [0.03, 3], [3, 0.03]])
@pytest.mark.parametrize("frame_rate_hz", [10, 30, 60])
def test_weights_reach_their_targets_exactly_within_18_tau(tau_s, frame_rate_hz):
    rng = random.Random(f"{tau_s} {frame_rate_hz}")
    names = [f"ACTION_{i}" for i in range(12)]
    actions = {name: {"tau": tau_s, "map": [["NECK", 0, 1, "rsin"]]} for name in names}
    puppet = {"name": "weights", "frame_rate": frame_rate_hz, "dof": {"NECK": {}}, "action": actions}
    targets = {name: rng.choice((0, 0, 4, 0.0005, round(rng.uniform(0, 4), 4))) for name in names}
    last_s = 1.5
    cues = [{"at": at_s, "weights": {name: rng.choice((0, 4, 1.3)) for name in names}} for at_s in (0, 0.4, 1.1)]
    score = {"cue": [*cues, {"at": last_s, "weights": targets}]}
    longest_s = max(tau_s) if isinstance(tau_s, list) else tau_s
    settled = math.ceil((last_s + SETTLING_TAUS * longest_s) * frame_rate_hz)

    weights = weights_by_frame(Case("weights", puppet, score), settled + 10)
    expected = {i: round(target * 4096) for i, target in enumerate(targets.values()) if target}
    last_frame = math.ceil(last_s * frame_rate_hz)
    assert weights[last_frame] != expected
    # An action at 0 is not in the list at all: not even the last bit of its weight is left.
    assert [weights[frame] for frame in range(settled, settled + 10)] == [expected] * 10


def weights_by_frame(case, frames):
    """Return the weights telemetry, {action: weight_q12}, of frames 0 .. frames - 1."""
    puppet, score, _ = load(case)
    found = []
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet))
        session.telemetry(0, 0, 1)
        prompter = Prompter(session, score.steps(puppet))
        prompter.reached(-1)
        session.start()
        while len(found) < frames:
            session.pump(500_000 // puppet.frame_rate_hz)
            frame, weights = session.weights
            if frame == len(found):
                found.append(weights)
                prompter.reached(frame)
    return found
