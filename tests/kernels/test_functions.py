"""Periodic functions against the reference's, in 32 bits over all phases, gradients and live values."""

import functools
import math

import numpy
import pytest
from hypothesis import given
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


def evaluate(phases, mappings, gradients=None, lives_q28=(0,) * formats.LIVES_MAX):
    """Return the values of all mappings, a list for each action.

    `phases` are (cycle, fraction_q24) of the actions; every one has all the `mappings`, pairs (function, argument).
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
        SINE,
        halves(gradients or [0] * 16 * 256),
        words(lives_q28),
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


def test_functions_of_one_action_share_its_phase_and_no_other():
    codes = [(formats.FUNCTION_RSIN, 0), (formats.FUNCTION_RCOS, 0), (formats.FUNCTION_CONST, 5)]
    found = evaluate([(0, 0), (0, 1 << 22), (0, 1 << 23)], codes)
    assert found == [[ONE // 2, ONE, 5], [ONE, ONE // 2, 5], [ONE // 2, 0, 5]]


@functools.cache
def drawn(seed, spread_q15):
    """Return the gradients of all tables, 16 lists of 256 numbers."""
    gradients = halves([0] * 16 * 256)
    MODULE.fill_gradients(gradients, seed, spread_q15)
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
