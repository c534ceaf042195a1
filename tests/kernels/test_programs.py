"""Programs: words from the wire are refused or evaluated, never outside arrays or 32 bits; what is valid gives its value."""

import math
import random
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from marotte.expressions import compile_expression, parse
from shared import formats, program
from tests import reference_functions as reference
from tests.checked import load_checked
from tests.generate_expressions import random_expression
from tests.kernels.values import cycles, fractions_q24, halves, integers, values_q15, weights_q28, words

MODULE = load_checked("firmware/programs.py")
SINE = load_checked("firmware/functions.py").sine_table()
FADE_Q15 = load_checked("firmware/foresight.py").fade_table(SINE)
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


BLOCK = 16
FADE_ERROR = 2.0**-13
"""What is rounded or dropped on the way to the mean and back, eight units of Q16 at most."""
SINE_ERROR = 2.0**-15
"""Of a sine from -1 to 1: half a unit of the raised one. The table of fades divides it by the angle."""


class Stack(list):
    """Words that every port reads as they were written; a 64-bit one does not know negative ones."""

    def __setitem__(self, place, word):
        assert 0 <= word < 1 << 30
        super().__setitem__(place, word)


def machine():
    """Return the machine with a stack that has been used and is watched."""
    programs = MODULE.Programs()
    programs._stack = Stack([(1 << 30) - 1] * len(programs._stack))
    return programs


def tables(pools, actions, signal=b"\1"):
    """Return tables of programs, and of actions as lists of mappings: (dof, program, low_q15, high_q15).

    Every array ends where its contents end, so that an access beyond them is an error.
    """
    curves = list(CURVES.values())
    mappings = [mapping for action in actions for mapping in action]
    first = [sum(map(len, actions[:i])) for i in range(len(actions))]
    played = [[program for _, program, _, _ in action] for action in actions]
    same = [at + programs.index(p) for at, programs in zip(first, played, strict=True) for p in programs]
    dofs, programs, lows, highs = zip(*mappings, strict=True)
    return SimpleNamespace(
        first_mapping=halves(first),
        mapping_count=bytes(map(len, actions)),
        mapped_dof=bytes(dofs),
        function=bytes([formats.FUNCTION_PROGRAM] * len(mappings)),
        argument=halves(programs),
        same=halves(same),
        low_q15=halves(lows),
        high_q15=halves(highs),
        signal=signal,
        program_start=halves(sum(map(len, pools[:k])) for k in range(len(pools))),
        program_words=halves(map(len, pools)),
        pool=words(word for pool in pools for word in pool),
        curve_start=halves(sum(map(len, curves[:k])) for k in range(len(curves))),
        curve_samples=halves(map(len, curves)),
        curve_mean_q15=halves((sum(curve) + len(curve) // 2) // len(curve) for curve in curves),
        samples_q15=halves(sample for curve in curves for sample in curve),
    )


def evaluate(pool, phase=(0, 0), lives=None):
    """Return the value, Q15, of a program that has been checked, at a phase (cycle, fraction_q24)."""
    lives = lives or LIVES.values()
    value = halves([7])
    actions = SimpleNamespace(playing=b"\0", found=1, cycle=halves([phase[0]]), fraction_q24=words([phase[1]]))
    t = tables([pool], [[(0, 0, 0, ONE)]])
    engine = machine()
    engine.evaluate(t, actions, SINE, GRADIENTS, words(lives), value)
    assert 0 <= value[0] <= ONE
    return value[0]


def courses(rows):
    """Return lists of up to 16 values in 16 places each, the last one without what is behind its end."""
    return [value for row in rows[:-1] for value in [*row, *[0] * (BLOCK - len(row))]] + list(rows[-1])


def add(tables, playing, phases, weights, lives, sums, spacing_q2=None, pace_q22=None):
    """Add a block to `sums`, two lists with 16 places per DOF. Per action that plays: phases, weights; per channel: `lives`."""
    frames = len(phases[0])
    outlook = SimpleNamespace(
        playing=bytes(playing),
        found=len(playing),
        cycle_course=halves(courses([[cycle for cycle, _ in row] for row in phases])),
        fraction_course_q24=words(courses([[fraction_q24 for _, fraction_q24 in row] for row in phases])),
        live_course_q28=words(courses(lives)),
        pace_q22=words(pace_q22 or []),
        weight_course_q28=words(courses(weights)),
    )
    spacing_q2 = halves(spacing_q2 or [0] * frames)
    shift = bytes(SHIFTS[: len(tables.signal)])
    engine = machine()
    engine.add(tables, outlook, SINE, GRADIENTS, frames, spacing_q2, FADE_Q15, shift, *sums)


SHIFTS = (0, 3, 6, 16)
"""Of the weights of DOFs 0.."""


def evaluate_block(pool, phases, lives=None, spacing_q2=None, pace_q22=0):
    """Return the values, Q15, of a program in the frames of a block: sums of one mapping from 0 to 1 with the least weight."""
    frames = len(phases)
    numerator, denominator = words([0] * frames), words([0] * frames)
    lives = lives or [[live] * frames for live in LIVES.values()]
    t = tables([pool], [[(0, 0, 0, ONE)]])
    add(t, [0], [phases], [[1] * frames], lives, (numerator, denominator), spacing_q2, [pace_q22])
    assert list(denominator) == [1] * frames
    return list(numerator)


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
    value = halves([value_q15] * 3)
    t = tables([checked([program.CONST, 1 << 14])], [[(0, 0, 0, ONE)] * 3])
    t.function = bytes([formats.FUNCTION_RSIN, formats.FUNCTION_PROGRAM, formats.FUNCTION_PROGRAM])
    t.same = halves([0, 1, 1])
    actions = SimpleNamespace(playing=b"\0", found=1, cycle=halves([0]), fraction_q24=words([0]))
    engine = machine()
    engine.evaluate(t, actions, SINE, GRADIENTS, words([]), value)
    assert list(value) == [value_q15, ONE // 4, value_q15]


# --- blocks of frames to come

blocks = st.lists(phases, min_size=1, max_size=BLOCK)
live_values = integers(0, formats.WEIGHT_ONE)
EXTREMES = [
    [program.CONST, LIMIT, program.CONST, -LIMIT, program.SUB],
    [program.CONST, -LIMIT, program.CONST, LIMIT, program.SUB],
    [program.CONST, -LIMIT, program.CONST, -LIMIT, program.ADD],
    [program.CONST, -LIMIT, program.CONST, LIMIT, program.MUL],
    [program.CONST, -LIMIT, program.SCALE, program.SCALE_MAX, program.SHIFT_MIN],
    [program.CONST, LIMIT, program.SCALE, -program.SCALE_MAX, program.SHIFT_MAX],
    [program.CONST, LIMIT, program.CONST, -LIMIT, program.CONST, -LIMIT, program.LERP],
    [program.CONST, -LIMIT, program.CONST, LIMIT, program.CONST, LIMIT, program.LERP],
    [program.CURVE, 2, 256, UNIT - 1],
    [program.NOISE, 15, -256, 255, UNIT - 1],
    [program.RCOS, 256, UNIT - 1],
]
EDGES = [(4095, UNIT - 1), (0, 0), (15, UNIT - 1), (4095, 0)]


@given(valid_programs(), blocks, st.data())
def test_block_has_the_values_of_its_frames_to_the_bit(pool, phases, data):
    lives = [data.draw(st.lists(live_values, min_size=len(phases), max_size=len(phases))) for _ in LIVES]
    kept = checked(pool)
    each = [evaluate(kept, phase, frame) for phase, frame in zip(phases, zip(*lives, strict=True), strict=True)]
    assert evaluate_block(kept, phases, lives) == each


@pytest.mark.parametrize("pool", EXTREMES)
def test_block_of_the_ends_of_all_ranges_stays_in_32_bits(pool):
    kept = checked(pool)
    assert evaluate_block(kept, EDGES) == [evaluate(kept, phase) for phase in EDGES]
    for pace_q22 in (0, 1, 1 << 21, (1 << 22) - 1):
        values = evaluate_block(kept, EDGES, spacing_q2=[508] * len(EDGES), pace_q22=pace_q22)
        assert all(0 <= value <= ONE for value in values)


def test_block_with_the_deepest_stack_is_evaluated():
    deepest = checked([*[program.RSIN, 16, 0] * 16, *[program.MIN] * 15])
    assert evaluate_block(deepest, EDGES * 4) == [evaluate(deepest, phase) for phase in EDGES * 4]


POOLS = [
    [program.RSIN, 16, 0],
    [program.NOISE, 2, -24, 7, 5000, program.LIVE, 1, program.MUL],
    [program.CURVE, 1, 32, 99, program.CONST, 20000, program.SUB],
]
ends_q15 = st.tuples(values_q15, values_q15)


@given(st.integers(0, 1 << 32), st.integers(1, BLOCK))
def test_sums_are_those_of_all_mappings_on_processed_dofs(seed, frames):
    """Numerator and denominator of a DOF grow by `w * (low + (high - low) * v)` and `w`, a weight shifted as its DOF's are."""
    rng = random.Random(seed)

    def rows(count, end, length=frames):
        return [[rng.randrange(end) for _ in range(length)] for _ in range(count)]

    signal = bytes(rng.choices([0, 1, 1], k=4))
    actions = [
        [(rng.randrange(4), rng.randrange(3), rng.randrange(ONE + 1), rng.randrange(ONE + 1)) for _ in range(mappings)]
        for mappings in (1, 4, 6)
    ]
    playing = rng.sample(range(3), rng.randint(1, 3))
    phases = [[(rng.randrange(formats.CYCLES), rng.randrange(UNIT)) for _ in range(frames)] for _ in playing]
    lives = rows(len(LIVES), formats.WEIGHT_ONE + 1)
    weights = rows(len(playing), 1 << 11)
    before = rows(2, 1 << 20, 4 * BLOCK)
    pools = [checked(pool) for pool in POOLS]
    expected = [list(some) for some in before]
    for i, row, heavy in zip(playing, phases, weights, strict=True):
        for dof, number, low, high in actions[i]:
            for b in range(frames if signal[dof] else 0):
                value = evaluate(pools[number], row[b], [channel[b] for channel in lives])
                weight = heavy[b] // 2 ** SHIFTS[dof]
                expected[0][BLOCK * dof + b] += weight * (low + math.floor((high - low) * value / ONE + 0.5))
                expected[1][BLOCK * dof + b] += weight
    sums = [words(some) for some in before]
    add(tables(pools, actions, signal), playing, phases, weights, lives, sums)
    assert [list(some) for some in sums] == expected


@given(weights_q28, ends_q15, blocks)
def test_sum_of_the_greatest_weight_stays_below_2_to_the_30(weight_q28, ends, phases):
    """A DOF's weights are shifted until they stay below 2^15; DOF 3 is that of the greatest one."""
    frames = len(phases)
    sums = words([0] * 4 * BLOCK), words([0] * 4 * BLOCK)
    add(
        tables([checked(POOLS[0])], [[(3, 0, *ends)]], b"\1\1\1\1"), [0], [phases], [[weight_q28] * frames],
        [[0] * frames], sums,
    )  # fmt: skip
    assert set(sums[1][3 * BLOCK : 3 * BLOCK + frames]) == {weight_q28 >> SHIFTS[3]}
    assert all(0 <= top <= (weight_q28 >> SHIFTS[3]) * ONE < 1 << 30 for top in sums[0])


class Counted(list):
    """A list that counts how often it is read."""

    reads = 0

    def __getitem__(self, place):
        self.reads += 1
        return super().__getitem__(place)


@pytest.mark.parametrize(
    ("dofs", "signal", "evaluated"),
    [([0], b"\1\1", 1), ([0, 1, 0], b"\1\1", 1), ([0, 1, 1], b"\0\1", 1), ([0, 0], b"\0\1", 0)],
)
def test_program_that_stands_in_an_action_several_times_is_evaluated_once(dofs, signal, evaluated):
    pool = checked(POOLS[1])
    t = tables([pool], [[(dof, 0, 0, ONE) for dof in dofs]], signal)
    t.pool = Counted(pool)
    sums = words([0] * 2 * BLOCK), words([0] * 2 * BLOCK)
    add(t, [0], [EDGES], [[1 << 20] * 4], [[0] * 4] * 2, sums)
    assert t.pool.reads == evaluated * len(pool)


# --- sketches

WAVES = [
    (program.RSIN, 0.5),
    (program.RCOS, 0.5),
    (program.NOISE, 0.5),
    *[(program.CURVE, sum(samples) / len(samples) / ONE) for samples in CURVES.values()],
]
waves = st.integers(0, len(WAVES) - 1)
spacings_q2 = integers(0, 508)


@given(waves, slopes, fractions, blocks, st.data(), integers(0, (1 << 22) - 1))
def test_wave_of_a_sketch_fades_to_its_mean_by_the_way_to_the_next_frame(wave, a_q4, b_q24, phases, data, pace_q22):
    """By `sinc^2` of that part of a cycle, in whole 64ths; nothing is left of it from one cycle on.

    What moves by more than half a cycle per frame seems to move the other way.
    """
    opcode, mean = WAVES[wave]
    first = {program.NOISE: [3], program.CURVE: [wave - 3]}.get(opcode, [])
    pool = checked([opcode, *first, a_q4, *([0] if opcode == program.NOISE else []), b_q24])
    spacing_q2 = data.draw(st.lists(spacings_q2, min_size=len(phases), max_size=len(phases)))
    way_q22 = a_q4 * pace_q22 // 16 % (1 << 22)
    way_q22 = min(way_q22, (1 << 22) - way_q22)
    values = evaluate_block(pool, phases, spacing_q2=spacing_q2, pace_q22=pace_q22)
    for value, phase, wide in zip(values, phases, spacing_q2, strict=True):
        part = math.floor(64 * way_q22 * wide / (1 << 24)) / 64
        plain = evaluate(pool, phase) / ONE
        left, error = 1.0, 0.0
        if part:
            sinc = math.sin(math.pi * part) / (math.pi * part) if part < 1 else 0.0
            left, error = sinc**2, 2 * sinc * SINE_ERROR / (math.pi * part)
        if wide:
            assert abs(value / ONE - (mean + (plain - mean) * left)) <= FADE_ERROR + abs(plain - mean) * error
        else:
            assert value == plain * ONE


@given(blocks, slopes, integers(0, (1 << 22) - 1))
def test_only_waves_fade_in_a_sketch(phases, a_q4, pace_q22):
    """Where all waves have come to their mean, the rest of a program still does what it did."""
    spacing_q2 = [8] * len(phases)
    still = checked([program.LIVE, 0, program.CONST, 20000, program.MUL])
    assert evaluate_block(still, phases, spacing_q2=spacing_q2, pace_q22=pace_q22) == evaluate_block(still, phases)
    moving = checked([program.RSIN, 16, 0, program.LIVE, 0, program.MUL])
    mean = checked([program.CONST, 1 << 15, program.LIVE, 0, program.MUL])
    gone = evaluate_block(moving, phases, spacing_q2=spacing_q2, pace_q22=1 << 21)
    assert gone == evaluate_block(mean, phases)
