"""Character: the coefficients of a tick against a fine numerical integration of the plant that they stand for."""

import itertools
import math
from fractions import Fraction

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.character import response
from marotte.puppet import Character
from shared import formats

TICKS_S = (0.003008, 0.008, 0.02)
CORNERS = list(itertools.product((0.2, 2.5, 10), (0.1, 0.999999, 1, 1.000001, 3), (-4, -1, 0, 1, 4), TICKS_S))
STEPS = 400
"""Steps of Runge-Kutta within a tick: with 10 Hz, zeta 3 and 20 ms its error is below 1e-10."""


def integrate(character, tick_s, y, w, u0, u1):
    """Return y and y'/omega after one tick in which the input goes straight from u0 to u1, by Runge-Kutta of order 4."""
    omega = 2 * math.pi * character.f_hz
    k1 = character.zeta / (math.pi * character.f_hz)
    k2 = 1 / omega**2
    k3 = character.r * character.zeta / omega
    slope = (u1 - u0) / tick_s
    step_s = tick_s / STEPS

    def rates(t_s, state):
        position, rate = state
        return numpy.array([rate, (u0 + slope * t_s + k3 * slope - position - k1 * rate) / k2])

    state = numpy.array([y, w * omega])
    for number in range(STEPS):
        t_s = number * step_s
        first = rates(t_s, state)
        second = rates(t_s + step_s / 2, state + step_s / 2 * first)
        third = rates(t_s + step_s / 2, state + step_s / 2 * second)
        fourth = rates(t_s + step_s, state + step_s * third)
        state = state + step_s / 6 * (first + 2 * second + 2 * third + fourth)
    return state[0], state[1] / omega


def step(c, y, w, u0, u1):
    """Return the same by the coefficients."""
    e, d = u0 - y, u1 - u0
    return (
        y + c.position_error * e + c.position_rate * w + c.position_slope * d,
        w + c.rate_error * e + c.rate_rate * w + c.rate_slope * d,
    )


@pytest.mark.parametrize(("f_hz", "zeta", "r", "tick_s"), CORNERS)
def test_response_is_the_plants(f_hz, zeta, r, tick_s):
    character = Character(f_hz, zeta, r)
    c = response(character, tick_s)
    for state in ((0.3, 0.0, 0.3, 0.4), (0.5, 0.2, 0.7, 0.6), (0.0, -0.3, 1.0, 1.0)):
        assert step(c, *state) == pytest.approx(integrate(character, tick_s, *state), abs=1e-9)


@pytest.mark.parametrize(("f_hz", "zeta", "r", "tick_s"), CORNERS)
def test_response_fits_its_format(f_hz, zeta, r, tick_s):
    character = Character(f_hz, zeta, r)
    fixed = response(character, Fraction(tick_s)).fixed()
    assert list(fixed) == [
        "position_error_q24",
        "position_rate_q24",
        "position_slope_q24",
        "rate_error_q24",
        "rate_rate_q24",
        "rate_slope_q24",
    ]
    assert all(abs(value) < formats.RESPONSE_MAX_Q24 for value in fixed.values())
    for value, exact in zip(fixed.values(), vars(response(character, tick_s)).values(), strict=True):
        assert abs(value - exact * 2**formats.RESPONSE_BITS) <= 0.5 + 1e-6


@given(
    f_hz=st.floats(0.2, 10),
    zeta=st.floats(0.1, 3),
    r=st.floats(-4, 4),
    tick_s=st.sampled_from(TICKS_S),
    target=st.floats(0, 1),
)
def test_response_comes_to_rest_at_its_input_whatever_it_is_and_however_rounded(f_hz, zeta, r, tick_s, target):
    fixed = response(Character(f_hz, zeta, r), tick_s).fixed()
    a, b, _, c, d, _ = (value / 2**formats.RESPONSE_BITS for value in fixed.values())
    step_matrix = numpy.array([[1 - a, b], [-c, 1 + d]])  # of y - u and w, the input standing
    assert max(abs(numpy.linalg.eigvals(step_matrix))) < 1
    assert a > 0  # the only place where nothing changes is the input


def test_response_follows_a_ramp_as_the_plant_does():
    # after the transient y = u + (k3 - k1) * slope
    character = Character(2.0, 0.5, -1.0)
    c = response(character, 0.02)
    y = w = 0.0
    for tick in range(2000):
        y, w = step(c, y, w, tick * 0.001, (tick + 1) * 0.001)
    lead_s = (character.r - 2) * character.zeta / (2 * math.pi * character.f_hz)
    assert y == pytest.approx(2.0 + lead_s * 0.05, abs=1e-9)
