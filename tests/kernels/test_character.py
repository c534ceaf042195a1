"""Character: second-order dynamics in 32 bits against the exact solution, at all corners of frequency, damping and response."""

import itertools
import math
import random
from types import SimpleNamespace

import numpy
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import integers, words
from tests.reference_motor import Character, characterised, exponential

MODULE = load_checked("firmware/character.py")
ONE = formats.POSITION_ONE
ZERO = MODULE._ZERO
DEAD_ZONE = 1 / 4096

F_HZ, ZETA, R = (0.2, 10), (0.1, 3), (-4, 4)
CORNERS = [(f_hz, zeta, r) for f_hz in (*F_HZ, 2) for zeta in (*ZETA, 1) for r in (*R, 0)]
PERIODS_US = (formats.MOTOR_PERIOD_MIN_US, formats.MOTOR_PERIOD_MAX_US)

characters = st.tuples(
    st.floats(*F_HZ) | st.sampled_from(F_HZ),
    st.floats(*ZETA) | st.sampled_from((*ZETA, 1.0)),
    st.floats(*R) | st.sampled_from((*R, 0.0)),
)
periods_us = integers(formats.MOTOR_PERIOD_MIN_US // 8, formats.MOTOR_PERIOD_MAX_US // 8).map(lambda n: 8 * n)


def transition(f_hz, zeta, period_us):
    """Return how y and w = y' / (2 pi f) go on from tick to tick where the input is 0."""
    natural = 2 * math.pi * f_hz
    return exponential(numpy.array([[0, 1], [-1, -2 * zeta]]) * natural * period_us / 1e6)


def coefficients(f_hz, zeta, r, period_us):
    """Return the six coefficients of a tick, from the exact solution; they are what the host sends, in Q24."""
    natural, tick_s = 2 * math.pi * f_hz, period_us / 1e6
    rows = []
    for place, start in enumerate(("e", "w", "d")):
        dynamics = Character(f_hz, zeta, r, 0)
        dynamics.y = -1.0 if place == 0 else 0.0  # so that u - y = 1 with u = 0
        dynamics.rate = natural if start == "w" else 0.0
        dynamics.advance(tick_s, 0.0, 1 / tick_s if start == "d" else 0.0)
        rows.append((dynamics.y + (place == 0), dynamics.rate / natural - (place == 1)))
    return [round(row[n] * ONE) for n in range(2) for row in rows]


def tables_of(responses):
    """What tables say of the characters of some DOFs."""
    tables = SimpleNamespace(has_character=bytearray(16), response_q24=words([0] * 96))
    for dof, numbers in responses.items():
        tables.has_character[dof] = 1
        tables.response_q24[6 * dof : 6 * dof + 6] = words([number + ZERO for number in numbers])
    return tables


class Moved:
    """One DOF with a character, at rest at first; values are 0..1 and floats."""

    def __init__(self, f_hz, zeta, r, period_us, start):
        self._kernel = MODULE.Character(tables_of({0: coefficients(f_hz, zeta, r, period_us)}))
        self._kernel.stand(0, round(start * ONE))
        self._input = words([0])

    @property
    def output(self):
        return (self._kernel.output_q24[0] - ZERO) / ONE

    @property
    def rate(self):
        return (self._kernel._rate_q24[0] - ZERO) / ONE

    def tick(self, value):
        """Take a tick and return the output."""
        self._input[0] = round(value * ONE) + ZERO
        self._kernel.respond(1, self._input)
        return self.output


def error_bound(f_hz, zeta, period_us, greatest):
    """Return how far the output may be from the exact one where input, output, rate and steps stay within `greatest`.

    In each tick either state is off by three products, each rounded to Q24 (and one unit of 2^-34 for the limb cut off), of a
    coefficient that is off by 2^-25 itself. Such an error goes on as the state does.
    """
    noise = 3 * (0.5 + 2**-9) / ONE + 2.0**-25 * 3 * greatest
    step = transition(f_hz, zeta, period_us)
    state, total = numpy.eye(2), 0.0
    for _ in range(200_000):
        share = numpy.abs(state[0]).sum()
        total += share
        state = state @ step
        if share < 1e-4 and numpy.abs(state).max() < 1e-4:
            return noise * (total + share) + 2 / ONE
    raise AssertionError("it does not die out")


def smooth_input(rng, ticks, period_us):
    """Return values that rest, go up and down in straight lines and sines, and rest again."""
    t_s = numpy.arange(ticks) * period_us / 1e6
    swing = numpy.sin(2 * math.pi * rng.uniform(0.1, 2) * t_s + rng.uniform(0, 6))
    window = numpy.clip(numpy.minimum(t_s - 0.2, t_s[-1] - 0.2 - t_s), 0, 1)
    return numpy.round((0.5 + 0.1 * swing * window + 0.05 * window) * ONE) / ONE


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize(("f_hz", "zeta", "r"), CORNERS)
def test_character_is_the_exact_solution_to_what_the_formats_leave(f_hz, zeta, r, period_us):
    inputs = smooth_input(random.Random(str((f_hz, zeta, r))), math.ceil(4e6 / period_us), period_us)
    expected = characterised(inputs, f_hz, zeta, r, period_us)
    dof = Moved(f_hz, zeta, r, period_us, inputs[0])
    errors, greatest = [], 0.0
    for value, right in zip(inputs[1:], expected[1:], strict=True):
        errors.append(dof.tick(value) - right)
        greatest = max(greatest, abs(dof.rate), abs(dof.output), abs(value - dof.output))
    assert greatest < 4, "this input must not saturate"
    # The bound is for errors that all go one way. They do not, so a 16th of the dead zone allowed is plenty.
    assert numpy.abs(errors).max() <= min(error_bound(f_hz, zeta, period_us, greatest), DEAD_ZONE / 16)


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize(("f_hz", "zeta"), list(itertools.product((*F_HZ, 1), (*ZETA, 0.5, 1))))
def test_character_has_no_dead_zone_above_a_4096th(f_hz, zeta, period_us):
    # To within a hundredth of the step, or a tenth of the zone, from either side and in either direction.
    slowest = 2 * math.pi * f_hz * (zeta - math.sqrt(max(0, zeta * zeta - 1)))
    ticks = math.ceil(math.log(1000) / slowest * 1e6 / period_us)
    for start, step in ((0.3, DEAD_ZONE), (0.7, -DEAD_ZONE)):
        dof = Moved(f_hz, zeta, 0, period_us, start)
        start = dof.output
        for _ in range(ticks):
            dof.tick(start + step)
        assert abs(dof.output - start - step) < DEAD_ZONE / 2
        for _ in range(ticks):
            dof.tick(start)
        assert abs(dof.output - start) < DEAD_ZONE / 2


@settings(max_examples=60)
@given(characters, periods_us, st.randoms(use_true_random=False))
def test_character_stays_in_32_bits_and_comes_to_rest_whatever_it_is_led_by(character, period_us, rng):
    f_hz, zeta, r = character
    dof = Moved(f_hz, zeta, r, period_us, rng.random())
    for _ in range(60):
        jump = rng.choice((0.0, 1.0, -0.5, 1.5, rng.uniform(-0.5, 1.5)))
        for _ in range(rng.choice((1, 1, 2, 20))):
            assert abs(dof.tick(jump)) <= 4 and abs(dof.rate) <= 8
    slowest = 2 * math.pi * f_hz * (zeta - math.sqrt(max(0, zeta * zeta - 1)))
    # Output and rate saturate a few times above 1; with r they are led there again by a last jump of 2.
    ticks = math.ceil(math.log(1e6) / slowest * 1e6 / period_us)
    for _ in range(min(ticks, 2000)):
        dof.tick(0.5)
    if ticks <= 2000:
        assert abs(dof.output - 0.5) < DEAD_ZONE


def test_character_saturates_on_either_side():
    for start, end, rate in ((0.0, 1.0, 8), (1.0, 0.0, -8)):
        dof = Moved(2, 3, 4, formats.MOTOR_PERIOD_MIN_US, start)
        dof.tick(end)
        assert dof.rate == rate
    # A sine in time with its swinging would come out with 1 / (2 * zeta) of its height and more.
    for middle in (0.5, -0.5):
        dof = Moved(1, 0.1, 4, 20_000, middle)
        found = [dof.tick(middle + math.sin(2 * math.pi * tick / 50)) for tick in range(1000)]
        assert (max(found) if middle > 0 else -min(found)) == 4


@pytest.mark.parametrize(("f_hz", "zeta", "r"), CORNERS)
def test_character_dies_out_after_a_jump(f_hz, zeta, r):
    period_us = 20_000
    dof = Moved(f_hz, zeta, r, period_us, 0.0)
    slowest = 2 * math.pi * f_hz * (zeta - math.sqrt(max(0, zeta * zeta - 1)))
    half = math.ceil(math.log(4096) / 2 / slowest * 1e6 / period_us)
    first = max(abs(dof.tick(1.0) - 1) for _ in range(half))
    second = max(abs(dof.tick(1.0) - 1) for _ in range(half))
    # By then exp(-4.16) = 1/64 is left of what the slowest part was; at zeta = 1, where both are alike, ten times as much.
    assert first < 5 and second <= first / 4 + DEAD_ZONE


def test_character_of_a_ramp_is_behind_by_k1_less_k3():
    f_hz, zeta, r, period_us = 1.0, 1.0, 0.5, 10_000
    lag_s = zeta / (math.pi * f_hz) - r * zeta / (2 * math.pi * f_hz)
    dof = Moved(f_hz, zeta, r, period_us, 0.0)
    for tick in range(1, 400):
        dof.tick(0.2 * tick * 0.01)
    assert dof.output == pytest.approx(0.2 * (3.99 - lag_s), abs=DEAD_ZONE)


def test_character_with_a_negative_response_goes_the_other_way_first():
    dof = Moved(2, 0.8, -2, 20_000, 0.5)
    found = [dof.tick(0.6) for _ in range(60)]
    assert min(found) < 0.48 and found[-1] == pytest.approx(0.6, abs=0.001)
    dof = Moved(2, 0.3, 0, 20_000, 0.5)
    found = [dof.tick(0.6) for _ in range(200)]
    # The overshoot of zeta = 0.3 is exp(-pi * zeta / sqrt(1 - zeta^2)) = 0.372 of the step; ticks may miss its top.
    assert 0.5 + 0.1 * 1.35 < max(found) < 0.5 + 0.1 * 1.375


def test_dofs_without_a_character_are_left_as_they_are():
    rng = random.Random(5)
    kernel = MODULE.Character(tables_of({1: coefficients(3, 0.5, 1, 20_000)}))
    alone = Moved(3, 0.5, 1, 20_000, 0.5)
    for dof in range(3):
        kernel.stand(dof, ONE // 2)
    for _ in range(50):
        inputs = [rng.randint(0, ONE) for _ in range(3)]
        kernel.respond(3, words([value + ZERO for value in inputs]))
        found = [value - ZERO for value in kernel.output_q24[:3]]
        assert found[0] == inputs[0] and found[2] == inputs[2]
        assert found[1] / ONE == alone.tick(inputs[1] / ONE)
