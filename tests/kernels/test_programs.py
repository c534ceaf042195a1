"""Programs: words from the wire are refused or evaluated, never outside arrays or 32 bits; what is valid gives its value."""

import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from marotte.expressions import compile_expression, parse
from shared import formats, program
from tests import reference_functions as reference
from tests.checked import load_checked
from tests.generate_expressions import random_expression
from tests.kernels.values import cycles, fractions_q24, halves, integers, values_q15, words

MODULE = load_checked("firmware/programs.py")
SINE = load_checked("firmware/functions.py").sine_table()
ONE = formats.VALUE_ONE
UNIT = 1 << formats.PHASE_BITS
LIMIT = program.LIMIT_Q16
PRIMITIVE_ERROR = 2.0**-14
"""Of a wave in 0..1: its table, its interpolation and the rounding of the phase, as of the functions alone."""
STEP_ERROR = 2.0**-15
"""What one operation drops or rounds, at most two units of Q16."""

GRADIENTS = halves(random.Random(1).choices(range(65536), k=formats.NOISE_TABLES * formats.GRADIENTS))
CURVES = {
    "SAW": [0, ONE],
    "ODD": [3277, 29491, 9830, 22938, ONE, 0, 6554],
    "FINE": [ONE * (n * 37 % 256) // 255 for n in range(256)],
}
LIVES = {"GAZE": 80_530_637, "SPEED": formats.WEIGHT_ONE}


def evaluate(pool, phase=(0, 0)):
    """Return the value, Q15, of a program that has been checked, at a phase (cycle, fraction_q24).

    Every array ends where its contents end, so that an access beyond them is an error.
    """
    curves = list(CURVES.values())
    starts = [sum(map(len, curves[:k])) for k in range(len(curves))]
    samples = halves(sample for curve in curves for sample in curve)
    value = halves([7])
    zero, one = halves([0]), b"\1"
    MODULE._evaluate(
        b"\0", 1, halves([phase[0]]), words([phase[1]]), zero, one, bytes([formats.FUNCTION_PROGRAM]), zero, zero,
        zero, halves([len(pool)]), words(pool), SINE, GRADIENTS, words(LIVES.values()), halves(starts),
        halves(map(len, curves)), samples, words([-1] * program.DEPTH_MAX), value,
    )  # fmt: skip
    assert 0 <= value[0] <= ONE
    return value[0]


def checked(pool):
    """Return the words as the MCU keeps them, or None for a program that it refuses."""
    kept = words(pool)
    return kept if MODULE.check(kept, 0, len(kept), len(CURVES), len(LIVES)) is None else None


any_word = integers(-(1 << 31), (1 << 31) - 1, 0) | st.integers(-300, 300) | integers(-LIMIT - 1, LIMIT + 1)
phases = st.tuples(cycles, fractions_q24)
fractions = integers(0, UNIT - 1)
slopes = integers(-program.A_MAX_Q4, program.A_MAX_Q4, 16)
OPERANDS = {
    program.CONST: st.tuples(integers(-LIMIT, LIMIT, 0)),
    program.RSIN: st.tuples(slopes, fractions),
    program.RCOS: st.tuples(slopes, fractions),
    program.NOISE: st.tuples(st.integers(0, formats.NOISE_TABLES - 1), slopes, st.integers(0, 255), fractions),
    program.CURVE: st.tuples(st.integers(0, len(CURVES) - 1), slopes, fractions),
    program.LIVE: st.tuples(st.integers(0, len(LIVES) - 1)),
    program.SCALE: st.tuples(
        integers(-program.SCALE_MAX, program.SCALE_MAX), integers(program.SHIFT_MIN, program.SHIFT_MAX)
    ),
}


@st.composite
def instructions(draw):
    opcode = draw(st.integers(0, len(program.OPERANDS) - 1))
    return opcode, *draw(OPERANDS.get(opcode, st.just(())))


@st.composite
def valid_programs(draw):
    """Programs that leave one value, of operands at the ends of their ranges that no compiler would give."""
    drawn, height = [], 0
    for _ in range(draw(st.integers(1, 30))):
        fitting = [
            opcode
            for opcode, takes in enumerate(program.TAKES)
            if takes <= height and height - takes + 1 <= program.DEPTH_MAX
        ]
        opcode = draw(st.sampled_from(fitting))
        drawn += [opcode, *draw(OPERANDS.get(opcode, st.just(())))]
        height += 1 - program.TAKES[opcode]
    return drawn + [program.SUB] * (height - 1)


def is_program(pool):
    """Return whether words are a program, by the description in `shared/program.py`."""
    limits = {
        program.CONST: [(-LIMIT, LIMIT)],
        program.RSIN: [(-256, 256), (0, UNIT - 1)],
        program.RCOS: [(-256, 256), (0, UNIT - 1)],
        program.NOISE: [(0, 15), (-256, 256), (0, 255), (0, UNIT - 1)],
        program.CURVE: [(0, len(CURVES) - 1), (-256, 256), (0, UNIT - 1)],
        program.LIVE: [(0, len(LIVES) - 1)],
        program.SCALE: [(-(1 << 20), 1 << 20), (10, 40)],
    }
    pool, height = list(pool), 0
    while pool:
        opcode = pool.pop(0)
        if opcode not in range(16) or height < program.TAKES[opcode] or len(pool) < program.OPERANDS[opcode]:
            return False
        height += 1 - program.TAKES[opcode]
        operands = [pool.pop(0) for _ in range(program.OPERANDS[opcode])]
        ranges = limits.get(opcode, [])
        if height > 16 or any(not least <= word <= most for word, (least, most) in zip(operands, ranges, strict=True)):
            return False
    return height == 1


def assert_refused_or_evaluated(pool, phase):
    kept = checked(pool)
    assert (kept is not None) == is_program(pool)
    if kept is not None:
        evaluate(kept, phase)


@given(st.lists(any_word, max_size=40), phases)
def test_random_words_are_refused_or_evaluated(pool, phase):
    assert_refused_or_evaluated(pool, phase)


@given(st.lists(instructions(), max_size=40), phases)
def test_random_instructions_are_refused_or_evaluated(drawn, phase):
    assert_refused_or_evaluated([word for instruction in drawn for word in instruction], phase)


@given(valid_programs(), st.data(), phases)
def test_programs_with_a_wrong_word_are_refused_or_evaluated(pool, data, phase):
    place = data.draw(st.integers(0, len(pool) - 1))
    change = data.draw(st.sampled_from(["replaced", "missing", "twice"]))
    middle = {"replaced": [data.draw(any_word)], "missing": [], "twice": [pool[place]] * 2}[change]
    assert_refused_or_evaluated([*pool[:place], *middle, *pool[place + 1 :]], phase)


@given(valid_programs(), st.lists(phases, min_size=1, max_size=3))
@example([program.CONST, LIMIT, program.SCALE, program.SCALE_MAX, program.SHIFT_MIN], [(0, 0)])
@example([program.CONST, -LIMIT, program.SCALE, program.SCALE_MAX, program.SHIFT_MAX], [(0, 0)])
@example([program.CONST, LIMIT, program.SCALE, -program.SCALE_MAX, program.SHIFT_MAX], [(0, 0)])
@example([program.CONST, LIMIT, program.CONST, LIMIT, program.CONST, LIMIT, program.LERP], [(0, 0)])
@example([program.CONST, -LIMIT, program.CONST, LIMIT, program.CONST, LIMIT, program.LERP], [(0, 0)])
@example([program.CONST, LIMIT, program.CONST, LIMIT, program.MUL], [(0, 0)])
@example([program.CURVE, 2, 256, UNIT - 1], [(4095, UNIT - 1)])
@example([program.NOISE, 15, -256, 255, UNIT - 1], [(4095, UNIT - 1)])
def test_valid_programs_are_evaluated_whatever_their_operands(pool, some):
    kept = checked(pool)
    assert kept is not None
    for phase in some:
        evaluate(kept, phase)


class Meant:
    """An interpreter in floats that follows the meaning, and how far fixed point may be from it."""

    def __init__(self, phase):
        self._phase = phase[0] + phase[1] / UNIT
        self._stack = []

    def value(self, pool):
        """Return (value, error) of a program, clamped to 0..1."""
        pool = list(pool)
        while pool:
            opcode = pool.pop(0)
            operands = [pool.pop(0) for _ in range(program.OPERANDS[opcode])]
            taken = [self._stack.pop() for _ in range(program.TAKES[opcode])][::-1]
            value, error = self._step(opcode, operands, taken)
            self._stack.append((min(max(value, -16.0), 16.0), error))
        ((value, error),) = self._stack
        return min(max(value, 0.0), 1.0), error + STEP_ERROR

    def _step(self, opcode, operands, taken):
        values, errors = [value for value, _ in taken], [error for _, error in taken]
        match opcode, operands, values:
            case program.CONST, [value_q16], _:
                return value_q16 / 65536, 0
            case program.RSIN, [a, b], _:
                return reference.rsin(self._at(a, 0, b)), self._steep(a, 3.2)
            case program.RCOS, [a, b], _:
                return reference.rcos(self._at(a, 0, b)), self._steep(a, 3.2)
            case program.NOISE, [k, a, cycle, b], _:
                gradients = [(word - 32768) / 32768 for word in GRADIENTS[256 * k : 256 * k + 256]]
                return reference.noise(gradients, self._at(a, cycle, b)), self._steep(a, 2)
            case program.CURVE, [k, a, b], _:
                samples = list(CURVES.values())[k]
                curve = [sample / ONE for sample in samples]
                return reference.table_value(curve, self._at(a, 0, b)), self._steep(a, len(samples))
            case program.LIVE, [k], _:
                return list(LIVES.values())[k] / formats.WEIGHT_ONE, STEP_ERROR
            case program.ADD, _, [x, y]:
                return x + y, sum(errors)
            case program.SUB, _, [x, y]:
                return x - y, sum(errors)
            case program.MUL, _, [x, y]:
                return x * y, abs(x) * errors[1] + abs(y) * errors[0] + errors[0] * errors[1] + STEP_ERROR
            case program.SCALE, [factor, shift], [x]:
                return x * factor / 2.0**shift, errors[0] * abs(factor) / 2.0**shift + STEP_ERROR
            case program.NEG, _, [x]:
                return -x, errors[0]
            case program.ABS, _, [x]:
                return abs(x), errors[0]
            case program.MIN, _, _:
                return min(values), max(errors)
            case program.MAX, _, _:
                return max(values), max(errors)
            case program.CLAMP, _, [x, low, high]:
                return min(max(x, low), high), max(errors)
            case program.LERP, _, [a, b, x]:
                way = min(max(b - a, -16.0), 16.0)
                swept = abs(way) * errors[2] + (errors[0] + errors[1]) * (abs(x) + errors[2])
                return a + way * x, errors[0] + swept + STEP_ERROR
        raise AssertionError(f"no such instruction: {opcode} {operands} on {taken}")

    def _at(self, a_q4, cycle, b_q24):
        return a_q4 * self._phase / 16 + cycle + b_q24 / UNIT

    @staticmethod
    def _steep(a_q4, slope):
        """Return the error of a wave: its phase is rounded by 2^-23 period of the action, and once more by 2^-15 of a sample."""
        return PRIMITIVE_ERROR + slope * abs(a_q4) / 16 * 2.0**-23 + slope * 2.0**-23


@given(valid_programs(), phases)
@example([program.NOISE, 3, 16, 0, 0], (77, 1 << 22))
@example([program.NOISE, 3, -40, 200, 1 << 22], (4095, UNIT - 1))
@example([program.CURVE, 0, 16, 0], (5, UNIT * 3 // 4))
def test_valid_programs_give_what_they_mean(pool, phase):
    value, error = Meant(phase).value(pool)
    assert abs(evaluate(checked(pool), phase) / ONE - value) <= error


def compiled(text):
    """Return the words of an expression over CURVES and LIVES."""
    pool = []
    for opcode, *operands in compile_expression(parse(text), CURVES).instructions:
        if opcode in (program.CURVE, program.LIVE):
            operands[0] = list(CURVES if opcode == program.CURVE else LIVES).index(operands[0])
        pool += [opcode, *operands]
    return pool


@given(st.integers(0, 1 << 32), phases)
def test_expressions_give_the_values_that_their_programs_mean(seed, phase):
    rng = random.Random(seed)
    pool = compiled(random_expression(rng, list(CURVES), list(LIVES), depth=rng.randint(1, 3)))
    kept = checked(pool)
    assert kept is not None
    value, error = Meant(phase).value(pool)
    assert error < 2**-7
    assert abs(evaluate(kept, phase) / ONE - value) <= error


CONST_1 = [program.CONST, 1 << 16]


@pytest.mark.parametrize(
    ("pool", "bad"),
    [
        ([], 0),
        ([16], 0),
        ([-1], 0),
        ([program.ADD], 0),
        ([*CONST_1, program.ADD], 2),
        ([*CONST_1, *CONST_1, program.CLAMP], 4),
        ([*CONST_1, *CONST_1], 4),
        ([program.CONST], 0),
        ([*CONST_1, program.SCALE, 5], 2),
        ([program.CONST, LIMIT + 1], 1),
        ([program.CONST, -LIMIT - 1], 1),
        ([program.RSIN, 257, 0], 1),
        ([program.RSIN, 16, UNIT], 2),
        ([program.NOISE, 16, 16, 0, 0], 1),
        ([program.NOISE, 0, 16, 256, 0], 3),
        ([program.CURVE, 3, 16, 0], 1),
        ([program.CURVE, -1, 16, 0], 1),
        ([program.LIVE, 2], 1),
        ([*CONST_1, program.SCALE, 5, 9], 4),
        ([*CONST_1, program.SCALE, 5, 41], 4),
        ([*CONST_1 * 17, *[program.ADD] * 16], 32),
    ],
)
def test_bad_program_is_refused_at_its_place(pool, bad):
    kept = words(pool)
    assert MODULE.check(kept, 0, len(kept), len(CURVES), len(LIVES)) == bad


def test_program_within_a_pool_ends_where_it_ends():
    kept = words([99, program.CONST, 5, program.NEG, 1])
    assert MODULE.check(kept, 1, 4, 0, 0) is None
    assert (kept[0], kept[4]) == (99, 1)
    kept = words([program.CONST, 5])
    assert MODULE.check(kept, 0, 1, 0, 0) == 0


def test_deepest_stack_is_evaluated():
    assert evaluate(checked([*[program.CONST, 1024] * 16, *[program.ADD] * 15])) == ONE // 4


def test_values_saturate_on_the_way():
    twelve = [program.CONST, 12 << 16]
    assert evaluate(checked([*twelve, *twelve, program.ADD, program.CONST, 31 << 15, program.SUB])) == ONE // 2
    assert evaluate(checked([program.CONST, -2 << 16])) == 0
    assert evaluate(checked([program.CONST, 2 << 16])) == ONE


@given(values_q15)
def test_function_that_is_no_program_or_stands_in_its_action_already_is_left_alone(value_q15):
    value = halves([value_q15] * 2)
    one = halves([1, 1])
    MODULE._evaluate(
        b"\0", 1, one, words([0]), halves([0]), b"\2", bytes([formats.FUNCTION_RSIN, formats.FUNCTION_PROGRAM]), one,
        halves([0, 0]), one, one, words([program.CONST]), SINE, GRADIENTS, None, None, None, None, None, value,
    )  # fmt: skip
    assert list(value) == [value_q15] * 2
