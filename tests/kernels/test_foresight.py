"""The base of frames to come against the definitions of functions and the convex sum in float64."""

import math
import random

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests import reference_functions as reference
from tests.checked import load_checked
from tests.kernels.values import halves, integers, values_q15, words

MODULE = load_checked("firmware/foresight.py")
SINE = load_checked("firmware/functions.py").sine_table()
FADE = MODULE.fade_table(SINE)
ONE = formats.VALUE_ONE
NEVER = 255


def test_fades_are_those_of_the_definition():
    """The sine table is right to half a unit of 2^-14, which `sinc` has 20 / c times, and its square twice."""
    assert (len(FADE), FADE[0]) == (65, ONE)
    for c in range(1, 65):
        assert abs(FADE[c] - ONE * numpy.sinc(c / 64) ** 2) <= 2 * 20.4 / c * numpy.sinc(c / 64) + 1.5


class Scene:
    """Actions at random, all that decides about a block of their base motion, and the arrays that kernels have for it.

    An action maps a DOF once at most. Functions that stand in an action twice name the first of them.
    """

    def __init__(self, seed):
        draw = random.Random(seed)
        self.dofs, self.frames = draw.randint(1, 16), draw.randint(1, 16)
        actions = draw.choice([1, 2, 5, 64])
        self.playing = bytes(draw.sample(range(actions), draw.randint(1, actions)))
        self.found = len(self.playing)
        dofs_of = [draw.sample(range(self.dofs), draw.randint(0, self.dofs)) for _ in range(actions)]
        self.first_mapping = halves(sum(map(len, dofs_of[:i])) for i in range(actions))
        self.mappings = bytes(map(len, dofs_of))
        self.mapped_dof = bytes(dof for dofs in dofs_of for dof in dofs)
        curves = [[draw.choice([0, ONE, draw.randint(0, ONE)]) for _ in range(count)] for count in (2, 3, 256)]
        self.curve_start = halves([0, 2, 5])
        self.curve_samples = halves(map(len, curves))
        self.curve_mean_q15 = halves(round(sum(curve) / len(curve)) for curve in curves)
        self.samples_q15 = halves(sample for curve in curves for sample in curve)
        self.curves = curves
        self.gradients = halves(draw.choice([0, 65535, draw.randint(0, 65535)]) for _ in range(16 * 256))
        pairs = [
            (0, 0), (1, 0), *((2, table) for table in (0, 7, 15)), *((3, value) for value in (0, 5000, ONE)), (4, 0), (4, 7),
            (5, 0), (5, 1), (5, 2), (6, 3),
        ]  # fmt: skip
        self.functions, same = [], []
        for dofs in dofs_of:
            begin = len(same)
            for _ in dofs:
                self.functions.append(draw.choice(pairs))
                same.append(begin + self.functions[begin:].index(self.functions[-1]))
        self.same = halves(same)
        count = len(same)
        self.low_q15, self.high_q15 = (
            halves(draw.choice([0, ONE, draw.randint(0, ONE)]) for _ in range(count)) for _ in "lh"
        )
        self.signal = bytes(draw.random() < 0.8 for _ in range(16))
        places = range(16 * self.found)
        most = draw.choice([1 << 12, formats.WEIGHT_ONE, formats.WEIGHT_MAX])
        self.weight_course_q28 = words(draw.choice([0, most, draw.randint(0, most)]) for _ in places)
        self.cycle_course = halves(draw.choice([0, 4095, draw.randint(0, 4095)]) for _ in places)
        self.fraction_course_q24 = words(draw.choice([0, (1 << 24) - 1, draw.getrandbits(24)]) for _ in places)
        self.live_course_q28 = words(draw.choice([0, formats.WEIGHT_MAX, draw.randint(0, 1 << 28)]) for _ in range(128))
        self.pace_q22 = words(draw.choice([0, 1 << 21, (1 << 22) - 1, draw.getrandbits(22)]) for _ in range(self.found))
        self.spacing_q2 = halves(draw.choice([0, 4, 6, draw.randint(0, 508)]) for _ in range(16))
        self.hold_q15 = halves(draw.choice([0, ONE, draw.randint(0, ONE)]) for _ in range(16))
        self.hold_course_q28 = words(draw.choice([0, formats.WEIGHT_ONE, draw.getrandbits(28)]) for _ in range(256))
        self.shift = bytearray([99] * 16)
        self.numerator, self.denominator = words([-7] * 256), words([-7] * 256)

    def peaks(self, course_q28, count):
        """Return the greatest weights on the way, as outlooks have them."""
        return words(max(course_q28[16 * n : 16 * n + self.frames]) for n in range(count))

    def balance(self):
        """Run `_balance`."""
        hold_peak = self.peaks(self.hold_course_q28, self.dofs)
        MODULE._balance(
            self.playing, self.found, self.frames, self.peaks(self.weight_course_q28, self.found), self.first_mapping,
            self.mappings, self.mapped_dof, self.dofs, hold_peak, self.hold_course_q28, self.hold_q15,
            words([-1] * self.dofs), self.shift, self.numerator, self.denominator,
        )  # fmt: skip

    def evaluate(self, sketching):
        """Run `_evaluate`."""
        functions, arguments = zip(*self.functions, strict=True) if self.functions else ((), ())
        MODULE._evaluate(
            self.playing, self.found, self.frames, sketching, self.cycle_course, self.fraction_course_q24,
            self.weight_course_q28, self.first_mapping, self.mappings, self.mapped_dof, self.signal, bytes(functions),
            halves(arguments), self.same, self.low_q15, self.high_q15, self.shift, SINE, self.gradients,
            self.live_course_q28, self.curve_start, self.curve_samples, self.curve_mean_q15, self.samples_q15,
            self.pace_q22, self.spacing_q2, FADE, halves([9] * 16), halves([9] * 256), self.numerator, self.denominator,
        )  # fmt: skip

    def mapped(self):
        """Yield the place in the list, the DOF, and the number of every mapping of those who play."""
        for n, i in enumerate(self.playing):
            for m in range(self.first_mapping[i], self.first_mapping[i] + self.mappings[i]):
                yield n, self.mapped_dof[m], m

    def value(self, n, m, b):
        """Return what a function's value is in a frame, and its mean, or None for what no sketch fades; in float64."""
        code, argument = self.functions[m]
        phase = self.cycle_course[16 * n + b] + self.fraction_course_q24[16 * n + b] / 2**24
        if code == formats.FUNCTION_RSIN:
            return reference.rsin(phase), 0.5
        if code == formats.FUNCTION_RCOS:
            return reference.rcos(phase), 0.5
        if code == formats.FUNCTION_NOISE:
            table = [(word - 32768) / 32768 for word in self.gradients[256 * argument : 256 * argument + 256]]
            return reference.noise(table, phase), 0.5
        if code == formats.FUNCTION_CURVE:
            samples = [sample / ONE for sample in self.curves[argument]]
            return reference.table_value(samples, phase), sum(samples) / len(samples)
        if code == formats.FUNCTION_LIVE:
            return min(self.live_course_q28[16 * argument + b] / formats.WEIGHT_ONE, 1), None
        return argument / ONE, None

    def fade(self, n, b):
        """Return by what a function counts at a knot: `sinc^2` of the part of a cycle between knots, in 64ths."""
        pace = self.pace_q22[n] / 2**22
        part = math.floor(64 * min(pace, 1 - pace) * self.spacing_q2[b] / 4) / 64
        return numpy.sinc(part) ** 2 if part < 1 else 0.0


SEEDS = range(40)


@pytest.mark.parametrize("seed", SEEDS)
def test_weights_of_a_dof_fill_15_bits_and_no_more(seed):
    scene = Scene(seed)
    scene.balance()
    assert bytes(scene.shift[scene.dofs :]) == bytes([99] * (16 - scene.dofs))
    peaks = scene.peaks(scene.weight_course_q28, scene.found)
    for dof in range(scene.dofs):
        parts = [max(scene.hold_course_q28[16 * dof : 16 * dof + scene.frames])]
        parts += [peaks[n] for n, there, _ in scene.mapped() if there == dof]
        total = sum(part >> scene.shift[dof] for part in parts)
        assert total < 1 << 15
        assert scene.shift[dof] == 0 or sum(part + 256 for part in parts) >> scene.shift[dof] >= (1 << 14) - 1
        for b in range(16):
            at = 16 * dof + b
            weight = scene.hold_course_q28[at] >> scene.shift[dof]
            expected = (weight * scene.hold_q15[dof], weight) if b < scene.frames else (-7, -7)
            assert (scene.numerator[at], scene.denominator[at]) == expected


VALUE_ERROR = 4 / ONE
"""Two units of the functions, as in `functions` (curves of 256 samples have half a unit more), half of the range, one of the fade
and its rounding, and half of what has been rounded of a mean.
"""


@pytest.mark.parametrize("sketching", [0, 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_sums_are_those_of_the_functions_and_weights(seed, sketching):
    scene = Scene(seed)
    scene.balance()
    expected, weights = numpy.array(scene.numerator, float) / ONE, numpy.array(scene.denominator)
    hold = weights.copy()
    scene.evaluate(sketching)
    for n, dof, m in scene.mapped():
        if not scene.signal[dof] or scene.functions[m][0] == formats.FUNCTION_PROGRAM:
            continue
        for b in range(scene.frames):
            value, mean = scene.value(n, m, b)
            if sketching and mean is not None:
                value = mean + (value - mean) * scene.fade(n, b)
            weight = scene.weight_course_q28[16 * n + b] >> scene.shift[dof]
            low, high = scene.low_q15[m] / ONE, scene.high_q15[m] / ONE
            weights[16 * dof + b] += weight
            expected[16 * dof + b] += weight * (low + (high - low) * value)
    assert list(scene.denominator) == list(weights)
    error = VALUE_ERROR + (2 * 20.4 / ONE if sketching else 0)  # of fades, see above
    assert numpy.all(numpy.abs(numpy.array(scene.numerator) / ONE - expected) <= (weights - hold) * error + 1e-6)


def divide(dof, frames, capture=NEVER, relative=0, signal=1):
    """Return the base of a DOF: (shift, hold_q15, HOLD's weights, others' weights, others' values in Q15)."""
    shift, hold_q15, holds_q28, weights, values = dof
    numerator, denominator = words([3] * 32), words([3] * 32)
    for b in range(frames):
        hold = holds_q28[b] >> shift
        numerator[16 + b] = hold * hold_q15 + weights[b] * values[b]
        denominator[16 + b] = hold + weights[b]
    future, course = halves([7] * 32), words([0] * 16 + list(holds_q28))
    MODULE._divide(
        2, frames, bytes([0, signal]), bytes([0, shift]), halves([0, hold_q15]), course, bytes([0, relative]),
        bytes([NEVER, capture]), bytes(KNOTS), numerator, denominator, future,
    )  # fmt: skip
    assert list(future[:16]) == [7] * 16
    assert list(future[16 + frames :]) == [7] * (16 - frames)
    return list(future[16 : 16 + frames])


KNOTS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 162, 254)
columns = st.tuples(
    integers(14, 20),
    values_q15,
    st.lists(integers(0, (1 << 28) - 1, formats.FAINT_Q28, formats.FAINT_Q28 - 1), min_size=16, max_size=16),
    st.lists(integers(0, (1 << 14) - 1), min_size=16, max_size=16),
    st.lists(values_q15, min_size=16, max_size=16),
)


def base_of(hold, hold_q15, weight, value_q15):
    """Return the convex sum, rounded; HOLD's value where nothing has a weight."""
    total = hold + weight
    return (hold * hold_q15 + weight * value_q15 + total // 2) // total if total else hold_q15


@given(columns, integers(1, 16), integers(0, NEVER, 254, 3, 5), st.integers(0, 1))
def test_base_is_the_convex_sum_and_hold_captures_what_it_takes_over(dof, frames, capture, relative):
    shift, hold_q15, holds_q28, weights, values = dof
    expected = []
    for b in range(frames):
        takes_over = b and KNOTS[b - 1] <= capture < KNOTS[b] and capture != NEVER
        if takes_over and not relative and holds_q28[b - 1] < formats.FAINT_Q28:
            hold_q15 = expected[-1]
        expected.append(base_of(holds_q28[b] >> shift, hold_q15, weights[b], values[b]))
    assert divide(dof, frames, capture, relative) == expected


def test_base_of_a_dof_that_is_not_processed_is_left():
    assert divide((14, 5, [1 << 27] * 16, [3] * 16, [9] * 16), 16, signal=0) == [7] * 16
