"""Programs for the machine of `shared/program.py`, put together from their parts, with the range of all values in them.

    part = programs.total(programs.scaled(programs.wave("rsin", 32, 0), Fraction(1, 2)), programs.constant(Fraction(1, 4)))
    print(part.instructions, part.low, part.high)

Each function returns the part of a program that leaves one more value on the stack. What is certain is done here: numbers are
combined exactly, and a factor becomes one SCALE. What is not is bounded by interval arithmetic (the primitives give 0..1).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

from marotte.errors import MarotteError
from marotte.fixed import fixed
from shared import formats, program

Instruction: TypeAlias = tuple[int | str, ...]
"""An opcode and its operands; a table or live channel by its name, as only the whole puppet knows its index."""

VALUE_MAX = 8
"""No value that is computed on the way is beyond, half of what the machine can hold: so it never saturates."""
FACTOR_MAX = 1000

_CYCLE_BITS = formats.PHASE_BITS
_NOISE_CYCLES = formats.GRADIENTS


class FunctionError(MarotteError):
    """A text is no function; says what was found and what is expected."""


@dataclass(frozen=True)
class Part:
    """A program, or a part of one."""

    low: Fraction
    high: Fraction
    """Its value is never below `low` or above `high`."""
    instructions: tuple[Instruction, ...] = ()
    """What leaves its value on the stack; nothing as long as it is a number that may be combined with others."""
    depth: int = 1
    """How many places of the stack that takes."""
    is_constant: bool = False
    """Whether it is a number, `low`."""

    @property
    def words(self) -> int:
        """The length of its program."""
        return sum(map(len, self.instructions))


def constant(value: Fraction) -> Part:
    """Return a number; as a factor it may be beyond VALUE_MAX."""
    return Part(value, value, is_constant=True)


def pushed(part: Part) -> Part:
    """Return a part whose value is on the stack: a number becomes an instruction. Raises FunctionError."""
    if part.instructions:
        return part
    if abs(part.low) > VALUE_MAX:
        raise FunctionError(f"found {float(part.low):g}, expected all values in -{VALUE_MAX}..{VALUE_MAX}")
    instruction = (program.CONST, fixed(part.low, program.VALUE_BITS))
    return Part(part.low, part.high, (instruction,), is_constant=True)


def live(name: str) -> Part:
    """Return the value of a live channel."""
    return _primitive(program.LIVE, name)


def curve(name: str, a_q4: int, b_q24: int) -> Part:
    """Return the value of a table function at a phase."""
    return _primitive(program.CURVE, name, a_q4, b_q24 % (1 << _CYCLE_BITS))


def wave(name: str, a_q4: int, b_q24: int) -> Part:
    """Return the value of `rsin`, `rcos` or `noiseN` at a phase."""
    cycle, fraction_q24 = divmod(b_q24, 1 << _CYCLE_BITS)
    if name == "rsin":
        return _primitive(program.RSIN, a_q4, fraction_q24)
    if name == "rcos":
        return _primitive(program.RCOS, a_q4, fraction_q24)
    return _primitive(program.NOISE, int(name.removeprefix("noise")) - 1, a_q4, cycle % _NOISE_CYCLES, fraction_q24)


def total(left: Part, right: Part) -> Part:
    """Return the sum of two parts."""
    return _symmetric(program.ADD, left, right, left.low + right.low, left.high + right.high)


def difference(left: Part, right: Part) -> Part:
    """Return the difference of two parts."""
    return _combined((program.SUB,), [left, right], left.low - right.high, left.high - right.low)


def product(left: Part, right: Part) -> Part:
    """Return the product of two parts."""
    if left.is_constant:
        return scaled(right, left.low)
    if right.is_constant:
        return scaled(left, right.low)
    corners = [x * y for x in (left.low, left.high) for y in (right.low, right.high)]
    return _symmetric(program.MUL, left, right, min(corners), max(corners))


def scaled(part: Part, factor: Fraction) -> Part:
    """Return a part times a number: SCALE, or less where less will do. Raises FunctionError."""
    low, high = sorted((part.low * factor, part.high * factor))
    if part.is_constant or factor == 0:
        return constant(low)
    if factor == 1:
        return part
    if factor == -1:
        return _combined((program.NEG,), [part], low, high)
    if abs(factor) > FACTOR_MAX:
        raise FunctionError(f"found {float(factor):g} as a factor, expected at most {FACTOR_MAX}")
    shift = program.SHIFT_MAX
    while abs(fixed(factor, shift)) >= program.SCALE_MAX:
        shift -= 1
    mantissa = fixed(factor, shift)
    return _combined((program.SCALE, mantissa, shift), [part], low, high) if mantissa else constant(Fraction(0))


def absolute(part: Part) -> Part:
    """Return the absolute value of a part."""
    least, most = sorted((abs(part.low), abs(part.high)))
    return _combined((program.ABS,), [part], Fraction(0) if part.low <= 0 <= part.high else least, most)


def minimum(left: Part, right: Part) -> Part:
    """Return the lesser of two parts."""
    return _symmetric(program.MIN, left, right, min(left.low, right.low), min(left.high, right.high))


def maximum(left: Part, right: Part) -> Part:
    """Return the greater of two parts."""
    return _symmetric(program.MAX, left, right, max(left.low, right.low), max(left.high, right.high))


def clamped(part: Part, low: Part, high: Part) -> Part:
    """Return `min(max(part, low), high)`."""
    least = min(max(part.low, low.low), high.low)
    return _combined((program.CLAMP,), [part, low, high], least, min(max(part.high, low.high), high.high))


def interpolated(start: Part, end: Part, share: Part) -> Part:
    """Return `start + (end - start) * share`. Raises FunctionError if the way from start to end is too long."""
    way = difference(start, end)
    if max(-way.low, way.high) > VALUE_MAX:
        raise FunctionError(f"lerp goes as far as {float(max(-way.low, way.high)):g}, expected at most {VALUE_MAX}")
    corners = [  # it is linear in each of the three, so that its extremes are at corners
        a + (b - a) * x for a in (start.low, start.high) for b in (end.low, end.high) for x in (share.low, share.high)
    ]
    return _combined((program.LERP,), [start, end, share], min(corners), max(corners))


def _primitive(opcode: int, *operands: int | str) -> Part:
    return Part(Fraction(0), Fraction(1), ((opcode, *operands),))


def _combined(instruction: Instruction, operands: list[Part], low: Fraction, high: Fraction) -> Part:
    """Return what one instruction makes of its operands; of numbers it is the number that they give."""
    if all(operand.is_constant for operand in operands):
        return constant(low)
    operands = [pushed(operand) for operand in operands]
    depth = max(place + operand.depth for place, operand in enumerate(operands))
    before = tuple(part for operand in operands for part in operand.instructions)
    return Part(low, high, (*before, instruction), depth)


def _symmetric(opcode: int, left: Part, right: Part, low: Fraction, high: Fraction) -> Part:
    """Return what an instruction makes of two operands in any order: the deeper one comes first."""
    operands = [right, left] if right.depth > left.depth else [left, right]
    return _combined((opcode,), operands, low, high)
