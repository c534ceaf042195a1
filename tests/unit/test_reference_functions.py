"""The oracle's periodic functions against values worked out by hand or by other means."""

import pytest

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
