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
from tests.reference_functions import (
    FunctionCompiler,
    TriggeredSine,
    noise,
    noise_gradients,
    rcos,
    rsin,
    stream_start,
    table_value,
)


def weights_score(*cues):
    """Return a score from pairs (time in seconds, weight targets)."""
    return {"cue": [{"at": at_s, "weights": weights} for at_s, weights in cues]}


def one_dof_puppet(function, low=0, high=1, dof=None, **action):
    return {"dof": {"NECK": dof or {}}, "action": {"NOD": {"map": [["NECK", low, high, function]], **action}}}


def compiled(text, **puppet):
    return FunctionCompiler({"seed": 1999, **puppet}, {"GAZE": 0.75}.get).compile(text, 0)


@pytest.mark.parametrize(("seed", "table"), [(0, 1), (1999, 1), (1999, 16), (2**32 - 1, 7)])
def test_noise_gradients_follow_the_xorshift_of_the_definition(seed, table):
    x = (seed * 2654435761 + table * 2246822519) % 2**32 or 1
    expected = []
    for _ in range(256):
        x = (x ^ (x * 8192)) % 2**32
        x = x ^ (x // 131072)
        x = (x ^ (x * 32)) % 2**32
        expected.append((x // 65536 - 32768) / 32768)
    assert noise_gradients(seed, table) == expected


def test_stream_start_is_never_zero():
    # 0x85EBCA77 is odd, so stream 1 of some seed starts from 0 without the exception.
    seed = -0x85EBCA77 * pow(0x9E3779B1, -1, 2**32) % 2**32
    assert stream_start(seed, 1) == 1


def test_noise_spread_raises_small_magnitudes_and_keeps_signs():
    plain, spread, full = (noise_gradients(1999, 3, spread) for spread in (0, 0.25, 1))
    for g, h, one in zip(plain, spread, full, strict=True):
        sign = 1 if g >= 0 else -1
        assert h == pytest.approx(sign * (0.25 + 0.75 * abs(g)))
        assert one == sign


def test_noise_is_half_with_twice_the_gradient_as_slope_at_integers():
    gradients = noise_gradients(1999, 1)
    for j in (0, 1, 254, 255, 256, 4095):
        step = 1e-6
        slope = (noise(gradients, j + step) - noise(gradients, j - step)) / (2 * step)
        assert noise(gradients, j) == 0.5
        assert slope == pytest.approx(2 * gradients[j % 256], abs=1e-5)


def test_noise_reaches_both_ends_and_no_further():
    assert noise([1, -1] * 128, 0.5) == 1
    assert noise([-1, 1] * 128, 0.5) == 0
    gradients = noise_gradients(7, 1, spread=1)
    assert all(0 <= noise(gradients, k / 64) <= 1 for k in range(256 * 64))


def test_sines_take_the_values_of_the_quarters():
    assert [rsin(x) for x in (0, 0.25, 0.5, 0.75, 7.25)] == pytest.approx([0.5, 1, 0.5, 0, 1])
    assert [rcos(x) for x in (0, 0.25, 0.5, 0.75, -1)] == pytest.approx([1, 0.5, 0, 0.5, 1])


def test_table_is_linear_between_samples_and_closes():
    assert [table_value([0, 1, 0.5], x) for x in (0, 1 / 6, 1 / 3, 0.5, 2 / 3, 5 / 6, 1)] == pytest.approx(
        [0, 0.5, 1, 0.75, 0.5, 0.25, 0]
    )


@pytest.mark.parametrize(
    ("text", "phase", "expected"),
    [
        ("rsin", 0.25, 1),
        ("rsin(2*t)", 0.125, 1),
        ("rcos(t/2 + 0.25)", 0.5, 0),
        ("rsin(0.25 - t)", 0.25, 0.5),
        ("rsin(-t)", 0.25, 0),
        ("const(0.3)", 9, 0.3),
        ("live(GAZE)", 9, 0.75),
        ("1 - live(GAZE)", 9, 0.25),
        ("2 - live(GAZE)*2", 9, 0.5),
        ("(2 - live(GAZE))*0.5", 9, 0.625),
        ("-live(GAZE) + 1", 9, 0.25),
        ("live(GAZE)/3", 9, 0.25),
        ("rsin(t) + 1", 0.25, 1),
        ("rsin(t) - 2", 0.25, 0),
        ("min(0.9, live(GAZE), 0.8)", 0, 0.75),
        ("max(0.1, abs(0.1 - live(GAZE)))", 0, 0.65),
        ("clamp(live(GAZE), 0, 0.5)", 0, 0.5),
        ("clamp(live(GAZE), hi=0.5)", 0, 0.5),
        ("clamp(live(GAZE) - 1)", 0, 0),
        ("lerp(0.2, 0.6, live(GAZE))", 0, 0.5),
        ("CURVE", 0.25, 0.5),
        ("table(CURVE, t + 0.25)", 0.25, 1),
        ("table(CURVE)/2", 0.5, 0.5),
        ("HALF", 0.25, 0.5),
    ],
)
def test_function_texts_have_their_values(text, phase, expected):
    functions = {"CURVE": {"table": [0, 1]}, "HALF": {"expr": "0.5*rsin(t)"}}
    assert compiled(text, function=functions)(phase) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["t", "rsin(t*t)", "sin(t)", "1 if t else 2", "rsin(t)/rsin(t)", "2**0.5"])
def test_function_text_outside_the_grammar_is_refused(text):
    with pytest.raises((ValueError, TypeError)):
        compiled(text)


def test_triggered_sines_start_at_once_run_one_period_and_wait_for_the_gap():
    blink = TriggeredSine(rcos, threshold=-1, min_gap=1.5, stream=1)
    values = [blink(k / 4) for k in range(10)]
    # It starts at 0 and stops when more than one period has passed, at 5/4; the gap of 3/2 is exceeded at 7/4.
    assert values == pytest.approx([1, 0.5, 0, 0.5, 1, 1, 1, 1, 0.5, 0])
    assert TriggeredSine(rsin, threshold=-1, min_gap=0, stream=1)(3) == 0.5
    assert TriggeredSine(rsin, threshold=1, min_gap=0, stream=1)(3) == 1


def test_triggered_sine_compares_times_beyond_a_1024th_of_a_period():
    for end, expected in ((1 + 1 / 1024, rsin(1 / 1024)), (1 + 1.01 / 1024, 1)):
        rtrigsin = TriggeredSine(rsin, threshold=-1, min_gap=5, stream=1)
        rtrigsin(0)
        assert rtrigsin(end) == pytest.approx(expected)


def test_triggered_streams_differ_by_mapping_and_go_on_when_the_action_enters():
    compiler = FunctionCompiler({"seed": 5}, None)
    first, second = compiler.compile("blink", 0), compiler.compile("blink(0.9, min_gap=1)", 1)
    assert (first.threshold, first.min_gap) == (0.98, 2)
    assert (second.threshold, second.min_gap) == (0.9, 1)
    assert first.stream == (5 * 0x9E3779B1 + 256 * 0x85EBCA77) % 2**32
    assert second.stream == (5 * 0x9E3779B1 + 257 * 0x85EBCA77) % 2**32
    first(0)
    moved = first.stream
    first.enter()
    assert first.stream == moved != second.stream


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
