"""The machine that runs programs, written from the description in `shared/program.py` in plain floats.

It says what the words mean, one at a time, and refuses what no compiler may give: unknown opcodes, operands out of their ranges,
a stack that is too deep, too shallow or not left with the one value of the program.
"""

from shared import formats, program


def run(words, phase, waves, curves, lives):
    """Return the value that a program leaves, not clamped to 0..1, at a phase.

    Args:
        words: the program.
        phase: the action's phase in periods, at least 0.
        waves: callables of a phase: `rsin`, `rcos`, then the noises 1 to 16.
        curves: callables of a phase, by index.
        lives: values of the live channels, by index.
    """
    stack = []
    words = list(words)
    deepest = 0
    while words:
        opcode = words.pop(0)
        operands = [words.pop(0) for _ in range(program.OPERANDS[opcode])]
        taken = [stack.pop() for _ in range(program.TAKES[opcode])][::-1]
        stack.append(_value(opcode, operands, taken, phase, waves, curves, lives))
        assert abs(stack[-1]) <= program.LIMIT_Q16 / 2**program.VALUE_BITS
        deepest = max(deepest, len(stack))
    assert deepest <= program.DEPTH_MAX
    (value,) = stack
    return value


def _value(opcode, operands, taken, phase, waves, curves, lives):
    match opcode, operands, taken:
        case program.CONST, [value_q16], []:
            assert abs(value_q16) <= program.LIMIT_Q16
            return value_q16 / 2**program.VALUE_BITS
        case ((program.RSIN | program.RCOS), [a_q4, b_q24], []):
            return waves[opcode - program.RSIN](_argument(a_q4, 0, b_q24, phase))
        case program.NOISE, [table, a_q4, b_cycle, b_q24], []:
            assert 0 <= table < formats.NOISE_TABLES
            return waves[2 + table](_argument(a_q4, b_cycle, b_q24, phase))
        case program.CURVE, [curve, a_q4, b_q24], []:
            return curves[curve](_argument(a_q4, 0, b_q24, phase))
        case program.LIVE, [live], []:
            return lives[live]
        case program.ADD, [], [a, b]:
            return a + b
        case program.SUB, [], [a, b]:
            return a - b
        case program.MUL, [], [a, b]:
            return a * b
        case program.SCALE, [factor, shift], [x]:
            assert abs(factor) <= program.SCALE_MAX
            assert program.SHIFT_MIN <= shift <= program.SHIFT_MAX
            return x * factor / 2**shift
        case program.NEG, [], [x]:
            return -x
        case program.ABS, [], [x]:
            return abs(x)
        case program.MIN, [], [a, b]:
            return min(a, b)
        case program.MAX, [], [a, b]:
            return max(a, b)
        case program.CLAMP, [], [x, low, high]:
            return min(max(x, low), high)
        case program.LERP, [], [a, b, x]:
            return a + (b - a) * x
    raise AssertionError(f"no such instruction: {opcode} {operands} on {taken}")


def _argument(a_q4, b_cycle, b_q24, phase):
    assert abs(a_q4) <= program.A_MAX_Q4
    assert 0 <= b_cycle < 256
    assert 0 <= b_q24 < 2**formats.PHASE_BITS
    return a_q4 * phase / 16 + b_cycle + b_q24 / 2**formats.PHASE_BITS
