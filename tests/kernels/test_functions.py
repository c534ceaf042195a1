"""Periodic functions against the reference's, in 32 bits over all phases, gradients and live values."""

import functools
import math
from fractions import Fraction

import numpy
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shared import formats
from tests import reference_functions as reference
from tests.checked import load_checked
from tests.kernels.values import cycles, fractions_q24, halves, integers, values_q15, weights_q28, words

MODULE = load_checked("firmware/functions.py")
SINE = MODULE.sine_table()
ONE = formats.VALUE_ONE
ERROR = 2.0**-14
"""Half a unit of the values from the table, from its interpolation, and from the rounding of the phase, and a little."""

gradient_words = integers(0, 65535, 32768)


def evaluate(phases, mappings, gradients=None, lives_q28=(0,) * formats.LIVES_MAX, curves=()):
    """Return the values of all mappings, a list for each action.

    `phases` are (cycle, fraction_q24) of the actions; every one has all the `mappings`, pairs (function, argument).
    `curves` are at most two lists of samples.
    """
    count, width = len(phases), len(mappings)
    functions, arguments = zip(*mappings, strict=True)
    values = halves([0xAAAA] * (count * width))
    MODULE.evaluate(
        bytes(range(count)),
        count,
        halves(cycle for cycle, _ in phases),
        words(fraction for _, fraction in phases),
        halves(range(0, count * width, width)),
        bytes([width] * count),
        bytes(functions * count),
        halves(arguments * count),
        halves(range(count * width)),
        SINE,
        halves(gradients or [0] * 16 * 256),
        words(lives_q28),
        halves([0, *(len(curve) for curve in curves[:-1])]),
        halves(map(len, curves)),
        halves(sample for curve in curves for sample in curve),
        values,
    )
    assert all(0 <= value <= ONE for value in values)
    return [list(values[start : start + width]) for start in range(0, count * width, width)]


def test_sine_table_is_the_raised_sine_rounded():
    exact = [(1 + math.sin(2 * math.pi * i / 512)) / 2 * ONE for i in range(513)]
    assert numpy.abs(numpy.array(SINE) - exact).max() <= 0.5 + 1e-6
    assert (SINE[0], SINE[128], SINE[256], SINE[384], SINE[512]) == (ONE // 2, ONE, ONE // 2, 0, ONE // 2)


@pytest.mark.parametrize(
    ("code", "wave"), [(formats.FUNCTION_RSIN, reference.rsin), (formats.FUNCTION_RCOS, reference.rcos)]
)
def test_waves_are_the_definitions_all_round(code, wave):
    fractions = [*range(0, 1 << 24, 8191), (1 << 24) - 1, 1 << 22, 1 << 23, 3 << 22]
    for start in range(0, len(fractions), 64):
        some = fractions[start : start + 64]
        found = [values[0] for values in evaluate([(1, fraction) for fraction in some], [(code, 0)])]
        assert found == pytest.approx([wave(fraction / 2**24) * ONE for fraction in some], rel=0, abs=ERROR * ONE)


@given(cycles, fractions_q24, st.integers(0, 15), st.lists(gradient_words, min_size=2, max_size=256))
def test_noise_is_the_definition_for_any_gradients(cycle, fraction_q24, table, some):
    own = [some[i % len(some)] for i in range(256)]
    gradients = [65535] * (table * 256) + own + [65535] * ((15 - table) * 256)
    found = evaluate([(cycle, fraction_q24)], [(formats.FUNCTION_NOISE, table)], gradients)[0][0]
    phase = cycle + fraction_q24 / 2**24
    expected = reference.noise([(word - 32768) / 32768 for word in own], phase)
    assert abs(found / ONE - expected) < ERROR


@given(cycles)
def test_noise_crosses_the_middle_at_whole_phases(cycle):
    assert evaluate([(cycle, 0)], [(formats.FUNCTION_NOISE, 3)], [65535] * 16 * 256) == [[ONE // 2]]


@given(values_q15)
def test_constants_are_themselves(value_q15):
    assert evaluate([(9, 77)], [(formats.FUNCTION_CONST, value_q15)]) == [[value_q15]]


@given(st.lists(weights_q28, min_size=formats.LIVES_MAX, max_size=formats.LIVES_MAX))
def test_live_channels_are_rounded_and_end_at_one(lives_q28):
    channels = range(formats.LIVES_MAX)
    found = evaluate([(9, 77)], [(formats.FUNCTION_LIVE, channel) for channel in channels], lives_q28=lives_q28)[0]
    assert found == [min(ONE, math.floor(lives_q28[channel] / 2**13 + 0.5)) for channel in channels]


samples_q15 = st.lists(values_q15, min_size=2, max_size=formats.SAMPLES_MAX)


@given(fractions_q24, samples_q15, samples_q15)
@example((1 << 24) - 1, [0, ONE], [ONE, 0] * 128)
@example((1 << 24) - 1, [ONE, 0] * 128, [0, ONE])
def test_curves_are_linear_between_their_samples_and_lead_back_to_the_first(fraction_q24, first, second):
    curves = first, second
    found = evaluate([(9, fraction_q24)], [(formats.FUNCTION_CURVE, 0), (formats.FUNCTION_CURVE, 1)], curves=curves)
    for value, samples in zip(found[0], curves, strict=True):
        place = Fraction(fraction_q24, 1 << 24) * len(samples)
        rest = place - math.floor(place)
        a, b = samples[math.floor(place)], samples[math.floor(place + 1) % len(samples)]
        exact = a + (b - a) * rest
        # half a unit, what the place's 15 bits drop, and a rounding of the phase by 2^-23 for every sample
        assert abs(value - exact) <= Fraction(1, 2) + 1 + Fraction(len(samples), 256)


@pytest.mark.parametrize("count", [2, 3, 255, 256])
def test_curve_is_continuous_at_its_end(count):
    samples = [ONE, *[0] * (count - 1)]
    places = [(1 << 24) - 1, (1 << 24) - 2, (1 << 24) - 3, 0, 1]
    found = evaluate([(0, place) for place in places], [(formats.FUNCTION_CURVE, 0)], curves=[samples])
    assert all(abs(value - ONE) <= 3 for (value,) in found)


@given(st.lists(values_q15, min_size=1, max_size=8), st.data())
def test_repeated_functions_take_the_value_of_the_one_before(values, data):
    same = [data.draw(st.integers(0, m)) for m in range(len(values))]
    same = [m if same[place] != place else place for m, place in enumerate(same)]
    found = halves([7, *values, 9])
    MODULE.repeat(bytes([1]), 1, halves([0, 1]), bytes([1, len(values)]), halves([0, *(m + 1 for m in same)]), found)
    assert list(found) == [7, *(values[m] for m in same), 9]


def test_repeated_functions_are_not_evaluated():
    values = halves([7] * 2)
    one = halves([0])
    MODULE.evaluate(
        b"\0", 1, one, words([1 << 22]), one, b"\2", b"\0\0", halves([0, 0]), halves([0, 0]), SINE, None, None, one, one,
        None, values,
    )  # fmt: skip
    assert list(values) == [ONE, 0]


def test_functions_of_one_action_share_its_phase_and_no_other():
    codes = [(formats.FUNCTION_RSIN, 0), (formats.FUNCTION_RCOS, 0), (formats.FUNCTION_CONST, 5)]
    found = evaluate([(0, 0), (0, 1 << 22), (0, 1 << 23)], codes)
    assert found == [[ONE // 2, ONE, 5], [ONE, ONE // 2, 5], [ONE // 2, 0, 5]]


@functools.cache
def drawn(seed, spread_q15):
    """Return the gradients of all tables, 16 lists of 256 numbers."""
    gradients = halves([0] * 16 * 256)
    for k in range(1, 17):
        MODULE.fill_gradients(gradients, k, seed, spread_q15)
    numbers = [(word - 32768) / 32768 for word in gradients]
    return [numbers[start : start + 256] for start in range(0, len(numbers), 256)]


ZERO_STREAM = -0x85EBCA77 * pow(0x9E3779B1, -1, 2**32) % 2**32
"""The seed for which table 1 starts from 0, where the definition takes 1."""


@pytest.mark.parametrize("seed", [0, 1, 1999, 2**31, 2**32 - 1, ZERO_STREAM])
def test_gradients_are_the_definition_to_the_bit(seed):
    assert drawn(seed, 0) == [reference.noise_gradients(seed, table) for table in range(1, 17)]


@pytest.mark.parametrize("spread_q15", [1, 10_000, ONE // 2, ONE - 1, ONE])
def test_gradients_are_spread_as_defined(spread_q15):
    unit = 1 / 32768  # a gradient of exactly 1 is kept as the number below it
    for table in range(1, 17):
        expected = reference.noise_gradients(1999, table, spread_q15 / ONE)
        assert drawn(1999, spread_q15)[table - 1] == pytest.approx(expected, rel=0, abs=unit)


@given(st.integers(1, 2**32 - 1), values_q15)
def test_gradients_follow_the_generator_from_any_state(state, spread_q15):
    gradients = halves([0] * 6)
    MODULE._draw(gradients, 1, 4, state & 0xFFFF, state >> 16, spread_q15)
    assert (gradients[0], gradients[5]) == (0, 0)
    for word in gradients[1:5]:
        state = reference.xorshift(state)
        gradient = ((state >> 16) - 32768) / 32768
        spread = spread_q15 / ONE
        magnitude = spread + (1 - spread) * abs(gradient)
        expected = magnitude if gradient >= 0 else -magnitude
        assert abs((word - 32768) / 32768 - expected) <= (1 / 32768 if spread else 0)
