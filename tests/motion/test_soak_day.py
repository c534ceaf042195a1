"""A day of the pet: all 2 592 000 frames of 24 h one after another, none sought or skipped, against the reference.

The pet plays its score at each full hour; between them it goes through its behaviours and moods. Every 19th frame is
compared, and the last one, whose number is a multiple of 19. `make test` plays the first ten minutes; `make soak` plays the
day, and a day of some random puppets, whose cues come in the first minute and whose phases go far. They do not blink: in a
day some blink would be too close to call.
"""

import time
import tomllib
from pathlib import Path

import numpy
import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.prompter import Prompter
from shared.formats import TAP_BASE
from tests.motion.bounds import fractions_of_bound
from tests.motion.playing import Case, load, random_case
from tests.reference import ReferencePuppet, checkpoints

PUPPETS = Path(__file__).parents[2] / "puppets"
FRAME_RATE_HZ = 30
HOUR_S = 3600
CUE_EVERY_S = 97
TAPS_EVERY = 19
PUMP_US = 200_000

GESTURES_END_S = 60 + 20 * 80
"""By then even 20 cycles at the slowest tempos are over, and nothing is left to decide."""

DRAWS = 1000
DAY_FRAMES = 24 * HOUR_S * FRAME_RATE_HZ
TEN_MINUTES_FRAMES = 18_013


def pet_for(frames):
    """Return the pet with cues for so many frames."""
    puppet, score = (tomllib.loads((PUPPETS / name).read_text()) for name in ("pet.toml", "pet-score.toml"))
    assert puppet["frame_rate"] == FRAME_RATE_HZ
    behaviours, moods = list(puppet["behaviour"]), list(puppet["mood"])
    seconds = frames // FRAME_RATE_HZ
    cues = [cue | {"at": round(hour_s + cue["at"], 3)} for hour_s in range(0, seconds, HOUR_S) for cue in score["cue"]]
    for n, at_s in enumerate(range(CUE_EVERY_S, seconds, CUE_EVERY_S)):
        cues.append({"at": at_s, "behaviour": behaviours[n % len(behaviours)], "mood": moods[n // 2 % len(moods)]})
    return Case("pet", puppet, {"cue": cues})


def play_and_compare(case, frames):
    """Play so many frames; return (frames compared, worst fraction of either bound, the firmware's status at the end)."""
    assert (frames - 1) % TAPS_EVERY == 0, "the last frame must be one of those that are compared"
    puppet, score, robot = load(case)
    points = checkpoints(case.puppet, case.score, frames, TAPS_EVERY)
    is_relative = numpy.array([dof.is_relative for dof in puppet.dofs.values()])
    compared, worst, expected_frame = 0, 0.0, -1
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet, robot))
        session.telemetry(TAP_BASE, TAPS_EVERY, 0)
        prompter = Prompter(session, score.steps(puppet))
        prompter.reached(-1)
        session.start()
        while expected_frame < frames - 1:
            session.pump(PUMP_US)
            while session.taps and expected_frame < frames - 1:
                frame, _, values_q15 = session.taps.popleft()
                expected_frame, expected, weight_sums = next(points)
                assert frame == expected_frame
                shares = numpy.array(values_q15) / 32768
                base = numpy.where(is_relative, 2 * shares - 1, shares)
                worst = max(worst, *fractions_of_bound(base, expected, weight_sums))
                assert worst <= 1, f"frame {frame}: the base is off by {worst:.3f} of its bound"
                compared += 1
            prompter.reached(expected_frame)
        assert prompter.is_done
        return compared, worst, session.status()


def test_ten_minutes_of_the_pet_keep_the_bounds():
    compared, _, status = play_and_compare(pet_for(TEN_MINUTES_FRAMES), TEN_MINUTES_FRAMES)
    assert compared == (TEN_MINUTES_FRAMES - 1) // TAPS_EVERY + 1
    assert (status["late_targets"], status["late_frames"], status["damaged"]) == (0, 0, 0)


@pytest.mark.soak
def test_a_day_of_the_pet_keeps_the_bounds(capsys):
    assert_long_run_is_right(pet_for(DAY_FRAMES), DAY_FRAMES, capsys)


@pytest.mark.soak
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_a_day_of_a_random_puppet_keeps_the_bounds(seed, capsys):
    case = decided_case(seed)
    frames = 24 * HOUR_S * case.puppet.get("frame_rate", FRAME_RATE_HZ)
    assert_long_run_is_right(case, frames - (frames - 1) % TAPS_EVERY, capsys)


def decided_case(seed):
    """Return the seed's first random case that does not blink and in which every decision is clear."""
    for draw in range(DRAWS):
        case = random_case(seed, 60, draw, dofs=5, actions=8)
        texts = [text for action in case.puppet["action"].values() for *_, text in action["map"]]
        if any(text.startswith(("blink", "rtrigsin")) for text in texts):
            continue
        reference = ReferencePuppet(case.puppet, case.score)
        reference.advance_to(GESTURES_END_S * reference.frame_rate)
        if reference.is_decided():
            return case
    raise AssertionError(f"seed {seed}: none of {DRAWS} draws will do")


def assert_long_run_is_right(case, frames, capsys):
    begun_s = time.monotonic()
    compared, worst, status = play_and_compare(case, frames)
    with capsys.disabled():
        print(
            f"\na day of {case.name}: {frames} frames, {compared} of them compared, worst error {worst:.3f} of its bound, "
            f"{status['late_targets']} late targets, in {time.monotonic() - begun_s:.0f} s"
        )
    assert (status["late_targets"], status["late_frames"], status["damaged"]) == (0, 0, 0)
