"""The motion's oracle against values worked out by hand or by other means."""

import math
import random
import tomllib
from fractions import Fraction

import numpy
import pytest

from tests.corners import SECONDS, corners
from tests.generate import random_puppet, random_score, to_toml
from tests.reference import ReferencePuppet, checkpoints, render
from tests.reference_actions import SmoothedValue, frame_of_cue, tempo_q16, whole_cycles
from tests.reference_functions import rsin


def weights_score(*cues):
    """Return a score from pairs (time in seconds, weight targets)."""
    return {"cue": [{"at": at_s, "weights": weights} for at_s, weights in cues]}


def one_dof_puppet(function, low=0, high=1, dof=None, **action):
    return {"dof": {"NECK": dof or {}}, "action": {"NOD": {"map": [["NECK", low, high, function]], **action}}}


@pytest.mark.parametrize(
    ("at_s", "frame_rate", "frame"),
    [
        (0, 30, 0),
        (1.1, 100, 110),
        (0.1, 30, 3),
        (0.7, 10, 7),
        (0.333333, 30, 10),
        (0.333334, 30, 11),
        (86400.0, 30, 2592000),
    ],
)
def test_cue_acts_in_the_first_frame_not_before_its_decimal_time(at_s, frame_rate, frame):
    assert frame_of_cue(at_s, frame_rate) == frame


def test_wrap_takes_exact_halves_downwards():
    assert [whole_cycles(Fraction(k, 2)) for k in (-3, -1, 0, 1, 3)] == [-1, 0, 0, 1, 2]
    assert whole_cycles(Fraction(1, 2) - Fraction(1, 512)) == 0


def test_tempo_rounds_to_65536ths():
    assert [tempo_q16(tempo) for tempo in (1, 0.5, 0.05, 1.3)] == [65536, 32768, 3277, 85197]


@pytest.mark.parametrize(("tau_s", "frame_rate", "target"), [(0.25, 30, 1), (0.03, 60, 4), (10, 10, 0.3)])
def test_weight_follows_the_step_response_of_two_filters_and_arrives_exactly(tau_s, frame_rate, target):
    weight = SmoothedValue(0.0, tau_s, frame_rate)
    weight.target = target
    a = 1 - math.exp(-1 / (frame_rate * tau_s))
    for n in range(1, math.ceil(18 * tau_s * frame_rate) + 1):
        weight.step()
        assert weight.value == pytest.approx(target * (1 - (1 - a) ** n * (1 + n * a)), abs=2**-17)
    assert weight.value == target


def test_weight_rises_and_falls_with_times_of_its_own():
    weight = SmoothedValue(0.0, [0.1, 2.0], 30)
    weight.target = 1.0
    weight.step()
    rise, fall = 1 - math.exp(-1 / 3), 1 - math.exp(-1 / 60)
    assert weight.value == pytest.approx(rise**2)
    weight.target = 0.0
    weight.step()
    smoothed = rise * (1 - fall)
    assert weight.value == pytest.approx(rise**2 + (smoothed - rise**2) * fall)


def test_unused_dofs_stand_at_their_rest():
    puppet = {"dof": {"A": {}, "B": {"rest": 0.2}, "C": {"kind": "relative"}}}
    base, weight_sums = render(puppet, {}, 3)
    assert (base == [0.5, 0.2, 0]).all()
    assert (weight_sums == 1).all()


def test_base_at_rest_is_the_convex_sum_under_the_masks():
    puppet = {
        "dof": {"A": {}, "B": {}},
        "action": {
            "ONE": {"map": [["A", 0.2, 0.4, "const(0.5)"], ["B", 1, 0, "const(0.25)"]]},
            "THREE": {"map": [["A", 0, 1, "const(0.9)"]]},
        },
    }
    base, weight_sums = render(puppet, weights_score((0, {"ONE": 1, "THREE": 3})), 300)
    assert base[-1] == pytest.approx([(1 * 0.3 + 3 * 0.9) / 4, 0.75])
    assert weight_sums[-1] == pytest.approx([4, 1])


def test_wheel_eases_in_and_out_against_hold():
    puppet = one_dof_puppet("const(1)", dof={"kind": "relative"})
    base, weight_sums = render(puppet, weights_score((0, {"NOD": 1}), (10, {"NOD": 0})), 600)
    a = 1 - math.exp(-1 / (30 * 0.25))
    # Action and HOLD have the same time constant, so their sum stays 1 and the speed is the weight.
    assert base[0, 0] == pytest.approx(a**2)
    assert weight_sums == pytest.approx(1, abs=2**-17)
    assert base[299, 0] == 1
    assert base[303, 0] == pytest.approx((1 - a) ** 4 * (1 + 4 * a))
    assert base[-1, 0] == 0


def test_hold_keeps_the_place_where_an_action_left_an_absolute_dof():
    puppet = one_dof_puppet("const(0.9)", tau=0.1)
    base, _ = render(puppet, weights_score((0, {"NOD": 1}), (10, {"NOD": 0})), 600)
    assert base[0, 0] > 0.5
    assert base[299:, 0] == pytest.approx(0.9)


def test_hold_that_is_still_strong_keeps_its_old_place():
    puppet = one_dof_puppet("const(0.9)")
    base, _ = render(puppet, weights_score((0, {"NOD": 1}), (0.5, {"NOD": 0})), 600)
    assert base[14, 0] > 0.6
    assert base[-1, 0] == 0.5


def test_hold_takes_the_base_of_the_frame_before():
    puppet = one_dof_puppet("rsin", tempo=0.3)
    score = weights_score((0, {"NOD": 1}), (9, {"NOD": 0}))
    base, _ = render(puppet, score, 900)
    assert base[-1] == base[269]


def test_cues_of_one_frame_act_in_order_of_time_then_file():
    puppet = one_dof_puppet("const(1)")
    score = weights_score((0.99, {"NOD": 3}), (0.98, {"NOD": 2}), (0.99, {"NOD": 4}), (0.97, {"NOD": 1}))
    reference = ReferencePuppet(puppet, score)
    reference.advance_to(600)
    assert reference.weights == {"NOD": 4}


def test_cue_applies_its_behaviour_before_its_weights_and_its_mood_before_its_tempo():
    puppet = {
        "dof": {"NECK": {}},
        "action": {name: {"map": [["NECK", 0, 1, "rsin"]]} for name in ("A", "B", "C")},
        "behaviour": {"HAPPY": {"A": 1, "B": 2}},
        "mood": {"NERVOUS": {"tempo": 2}},
    }
    cue = {"tempo": {"global": 0.5}, "weights": {"B": 3}, "mood": "NERVOUS", "behaviour": "HAPPY"}
    reference = ReferencePuppet(puppet, {"cue": [{"at": 0, "weights": {"C": 1}}, {"at": 1} | cue]})
    reference.advance_to(600)
    assert reference.weights == {"A": 1, "B": 3, "C": 0}
    assert reference.phases["A"] == pytest.approx(1 + 570 / 30 * 0.5)


def test_phases_are_exact_after_24_hours():
    puppet = one_dof_puppet("rsin", tempo=1.3)
    score = {"cue": [{"at": 0, "weights": {"NOD": 1}}, {"at": 7.7, "tempo": {"global": 0.7}}]}
    frames = 2_592_000
    reference = ReferencePuppet(puppet, score)
    reference.advance_to(frames)
    master = Fraction(231, 30) + Fraction(round(0.7 * 65536), 65536) * (frames - 231) / 30
    exact = Fraction(round(1.3 * 65536), 65536) * master % 4096
    assert reference.phases["NOD"] == pytest.approx(float(exact), abs=1e-9)
    assert reference.step()[0] == pytest.approx(rsin(float(exact)), abs=1e-8)


def test_entry_takes_the_masters_phase_or_begins_its_own():
    actions = {name: {"entry": name, "map": [["NECK", 0, 1, "rsin"]], "warp": 10} for name in ("sync", "start")}
    reference = ReferencePuppet({"dof": {"NECK": {}}, "action": actions}, weights_score((1.7, {"sync": 1, "start": 1})))
    reference.advance_to(52)
    assert reference.phases["sync"] == pytest.approx(52 / 30)
    # One frame after its own time began at 0; the offset of 0.3 periods has begun to shrink.
    assert reference.phases["start"] == pytest.approx(1 / 30 - (1.7 - 2) * (math.exp(-1 / 300) - 1))


def test_tempo_change_keeps_the_phase_and_warps_it_to_the_masters():
    puppet = one_dof_puppet("rsin", tempo=1.3, warp=0.5)
    score = {"cue": [{"at": 0, "weights": {"NOD": 1}}, {"at": 5.5, "tempo": {"NOD": 0.7}}]}
    reference = ReferencePuppet(puppet, score)
    phases = []
    for _ in range(1200):
        phases.append(reference.phases["NOD"])
        reference.step()
    assert phases[165] == pytest.approx(1.3 * 5.5, abs=1e-4)
    steps = numpy.diff(phases)
    # The nominal phase falls back to 3.85, so the offset is 0.3 periods: it slows the time down by half at first.
    assert steps[:165] == pytest.approx(1.3 / 30, abs=1e-5)
    assert (steps[165:] >= 0.7 / 30 / 2 - 1e-6).all()
    assert (steps[165:] <= 0.7 / 30 * 1.5 + 1e-6).all()
    assert steps[165] == pytest.approx(0.7 / 30 / 2, abs=1e-6)
    assert (phases[-1] - 0.7 * 1199 / 30 + 0.5) % 1 == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("cycles", [1, 2, 5])
def test_gesture_ends_by_itself_after_its_cycles(cycles):
    puppet = one_dof_puppet("rsin", entry="start", cycles=cycles, tau=0.05)
    reference = ReferencePuppet(puppet, weights_score((1, {"NOD": 1})))
    weights = []
    for _ in range(30 * cycles + 200):
        reference.step()
        weights.append(reference.weights["NOD"])
    # At tempo 1, entering at a whole master phase, its time is the master's: a period is 30 frames.
    end = 30 + 30 * cycles
    assert weights[29] == 0 < weights[30]
    assert weights[end - 1] == 1 > weights[end]
    assert weights[-1] == 0


def test_gesture_called_again_while_it_fades_goes_on_for_all_its_periods():
    puppet = one_dof_puppet("rsin", entry="start", cycles=1, tau=1)
    reference = ReferencePuppet(puppet, weights_score((0, {"NOD": 1}), (1.5, {"NOD": 1})))
    phases = []
    targets = []
    for _ in range(90):
        phases.append(reference.phases["NOD"])
        reference.step()
        targets.append(reference.targets["NOD"])
    assert targets == [1] * 30 + [0] * 15 + [1] * 30 + [0] * 15
    assert phases[45] == pytest.approx(1.5)


@pytest.mark.parametrize("level", ["core", "full"])
def test_checkpoints_are_frames_of_the_full_render(level):
    for seed in range(12):
        rng = random.Random(seed)
        puppet = random_puppet(rng, level, actions=5)
        score = random_score(rng, puppet, 10, level)
        base, weight_sums = render(puppet, score, 700)
        visited = []
        for n, base_there, weight_sums_there in checkpoints(puppet, score, 700, 61):
            visited.append(n)
            assert base_there == pytest.approx(base[n], abs=1e-9)
            assert weight_sums_there == pytest.approx(weight_sums[n], abs=1e-12)
        assert visited == [*range(0, 700, 61), 699]


@pytest.mark.parametrize("level", ["core", "full"])
def test_random_files_survive_toml_repeat_and_stay_in_range(level):
    for seed in range(20):
        drawn = []
        for _ in range(2):
            rng = random.Random(seed)
            puppet = random_puppet(rng, level)
            drawn.append((puppet, random_score(rng, puppet, 4, level)))
        assert drawn[0] == drawn[1]
        puppet, score = drawn[0]
        assert tomllib.loads(to_toml(puppet)) == puppet
        assert tomllib.loads(to_toml(score)) == score
        assert 1 <= sum(len(action["map"]) for action in puppet["action"].values()) <= 512
        base, weight_sums = render(puppet, score, 60)
        lowest = [-1 if dof.get("kind") == "relative" else 0 for dof in puppet["dof"].values()]
        assert (base >= numpy.array(lowest) - 1e-9).all()
        assert (base <= 1 + 1e-9).all()
        assert (weight_sums > 0).all()


def test_close_decisions_are_told():
    puppet = one_dof_puppet("rsin", entry="start", cycles=1, tempo=1)
    reference = ReferencePuppet(puppet, weights_score((0, {"NOD": 1})))
    reference.advance_to(20)
    assert reference.is_decided()
    reference.advance_to(40)
    assert reference.closest["gesture"] == pytest.approx(1 / 1024)
    assert reference.is_decided()
    assert not reference.is_decided(phase_error=1 / 512)


def test_corners_reach_what_they_are_named_for():
    lowest_sums = {}
    for name, puppet, score in corners():
        assert tomllib.loads(to_toml(puppet)) == puppet
        base, weight_sums = render(puppet, score, SECONDS * puppet.get("frame_rate", 30))
        assert (abs(base) <= 1 + 1e-9).all()
        lowest_sums[name] = weight_sums.min(), weight_sums.max()
    assert lowest_sums["faint hand-over to 0.0005 at 10 Hz"][0] < 1e-6
    assert lowest_sums["everything at once"][1] > 255
