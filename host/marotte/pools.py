"""What the mappings of a puppet share on the wire: curves, programs and blinks, equal ones once each.

    pools = Pools(puppet.functions, list(puppet.lives))
    code, argument = pools.code(entry.function)

Everything is in the fixed point of `shared/formats.py` and `shared/program.py`; indices count in the order of first use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from marotte.fixed import fixed
from marotte.functions import Function
from marotte.puppet import Curve
from shared import formats, program

T = TypeVar("T")

THRESHOLD_BITS = 16
GAP_BITS = 18


class Pools:
    """The pools of one puppet, filled as `code` is asked for its functions."""

    def __init__(self, functions: Mapping[str, Curve], lives: Sequence[str]) -> None:
        """`functions` are the puppet's, for the samples of its tables; `lives` are its channels in their order."""
        self._functions = functions
        self._lives = lives
        self._curves: dict[tuple[int, ...], int] = {}
        self._programs: dict[tuple[int, ...], int] = {}
        self._blinks: dict[tuple[int, int], int] = {}

    @property
    def curves(self) -> list[tuple[int, ...]]:
        """The samples of each curve, `value_q15`."""
        return list(self._curves)

    @property
    def programs(self) -> list[tuple[int, ...]]:
        """The words of each program."""
        return list(self._programs)

    @property
    def blinks(self) -> list[tuple[int, int]]:
        """Threshold (Q16, rounded down as a random number of 16 bits has to exceed it) and least gap (Q18) of each blink."""
        return list(self._blinks)

    def code(self, function: Function) -> tuple[int, int]:
        """Return a mapping's function code and argument. Raises KeyError for a table or channel that the puppet lacks."""
        argument: Any = function.arguments[0] if function.arguments else 0
        match function.kind:
            case "rsin":
                return formats.FUNCTION_RSIN, 0
            case "rcos":
                return formats.FUNCTION_RCOS, 0
            case "noise":
                return formats.FUNCTION_NOISE, argument - 1
            case "const":
                return formats.FUNCTION_CONST, fixed(argument, formats.VALUE_BITS)
            case "live":
                return formats.FUNCTION_LIVE, self._lives.index(argument)
            case "curve":
                return formats.FUNCTION_CURVE, self._curve(argument)
            case "program":
                return formats.FUNCTION_PROGRAM, _index(self._programs, self._words(function))
            case "blink":
                return formats.FUNCTION_BLINK, self._blink(function)
            case "rtrigsin":
                return formats.FUNCTION_RTRIGSIN, self._blink(function)
        raise ValueError(f"the function {function} has no code on the wire")

    def _curve(self, name: str) -> int:
        samples_q15 = tuple(fixed(sample, formats.VALUE_BITS) for sample in self._functions[name].samples)
        return _index(self._curves, samples_q15)

    def _words(self, function: Function) -> tuple[int, ...]:
        words: list[int] = []
        for opcode, *operands in function.program:
            if opcode == program.CURVE:
                operands[0] = self._curve(str(operands[0]))
            elif opcode == program.LIVE:
                operands[0] = self._lives.index(str(operands[0]))
            words += [int(opcode), *map(int, operands)]
        return tuple(words)

    def _blink(self, function: Function) -> int:
        threshold, min_gap = (float(argument) for argument in function.arguments)
        return _index(self._blinks, (math.floor(math.ldexp(threshold, THRESHOLD_BITS)), fixed(min_gap, GAP_BITS)))


def _index(pool: dict[T, int], item: T) -> int:
    """Return the index of an item in a pool, to which it is added if it is not there."""
    return pool.setdefault(item, len(pool))
