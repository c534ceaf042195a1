"""The FUNCTION of a mapping: read from its text in the puppet file.

Source: docs/motion.md, functions. A text is a bare name (`"noise2"`), a call of one that stands alone (`"blink(0.93, 1.2)"`), the
name of a `[function.NAME]`, or an expression (`"const(0.3)"`, `"live(GAZE_YAW)"`, `"0.5*rsin(2*t)"`). An expression becomes what
it is in effect: `"rsin(t + 1)"` is `rsin`.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass

from marotte.expressions import (
    PHASE,
    STANDALONE,
    WAVES,
    compile_expression,
    number_in,
    parse,
    shown,
    unknown_function,
)
from marotte.programs import FunctionError, Instruction, Part
from shared import program

__all__ = ["PRIMITIVES", "Function", "FunctionError", "parse_expression", "parse_function"]

PRIMITIVES = (*WAVES, "const", "live", "table", *STANDALONE)
"""The names that a `[function.NAME]` cannot have, with `t`."""

BLINK_DEFAULTS = {"threshold": 0.98, "min_gap": 2.0}
MIN_GAP_MAX = 1000


@dataclass(frozen=True)
class Function:
    """What a mapping interpolates with: a value in 0..1 for every phase."""

    kind: str
    """`rsin`, `rcos`, `noise`, `const`, `live`, `curve`, `program`, `blink` or `rtrigsin`."""
    arguments: tuple[float | str, ...] = ()
    """`noise`: the table 1..16; `const`: its value; `live`: the channel; `curve`: the `[function.NAME]`; `blink`, `rtrigsin`:
    threshold and least gap in periods."""
    program: tuple[Instruction, ...] = ()
    """`program`: its instructions, tables and live channels by name."""

    @property
    def blinks(self) -> bool:
        """Whether its future is not known."""
        return self.kind in STANDALONE

    @property
    def channels(self) -> tuple[str, ...]:
        """The live channels that it reads."""
        if self.kind == "live":
            return (str(self.arguments[0]),)
        return tuple(str(operands[0]) for opcode, *operands in self.program if opcode == program.LIVE)


def parse_function(text: object, functions: Mapping[str, Function] | None = None) -> Function:
    """Return the function that a text means; `functions` are the file's `[function.NAME]`, by name.

    Raises FunctionError.
    """
    if not isinstance(text, str):
        raise FunctionError('expected a function in quotes, such as "noise1" or "rsin"')
    functions = functions or {}
    node = parse(text)
    if isinstance(node, ast.Name):
        return _bare(node.id, functions)
    return _function(node, functions)


def parse_expression(text: str, functions: Mapping[str, Function]) -> Function:
    """Return the function that the `expr` of a `[function.NAME]` means; `functions` are those that it may use.

    Raises FunctionError.
    """
    node = parse(text)
    if isinstance(node, ast.Name) and node.id in STANDALONE:
        return _bare(node.id, functions)
    return _function(node, functions)


def _function(node: ast.expr, functions: Mapping[str, Function]) -> Function:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in STANDALONE:
        return _blink(node.func.id, node)
    tables = [name for name, function in functions.items() if function.kind == "curve"]
    return _simplest(compile_expression(node, tables, [name for name in functions if name not in tables]))


def _bare(name: str, functions: Mapping[str, Function]) -> Function:
    if name in ("rsin", "rcos"):
        return Function(name)
    if name in WAVES:
        return Function("noise", (int(name.removeprefix("noise")),))
    if name in STANDALONE:
        return Function(name, tuple(BLINK_DEFAULTS.values()))
    if name == "const":
        raise FunctionError("const needs its value, in 0..1: const(0.3)")
    if name == "live":
        raise FunctionError("live needs its channel: live(GAZE_YAW)")
    if name == "table":
        raise FunctionError("table needs the name of a [function.NAME] with a table; the name alone will do, too")
    if name == PHASE:
        raise FunctionError("t is the phase, which goes on for ever; expected a function of it, such as rsin(t)")
    if name in functions:
        return functions[name]
    raise unknown_function(name, [*PRIMITIVES, *functions])


def _blink(name: str, call: ast.Call) -> Function:
    """Return `blink` or `rtrigsin` with its threshold and its least gap, by place or by name."""
    names = list(BLINK_DEFAULTS)[: len(call.args)] + [keyword.arg for keyword in call.keywords]
    values = [*call.args, *(keyword.value for keyword in call.keywords)]
    if len(names) != len(values) or len(set(names)) != len(names) or not set(names) <= set(BLINK_DEFAULTS):
        raise FunctionError(f"found {shown(call)}, expected {name}(threshold, min_gap), both numbers")
    nodes = dict(zip(names, values, strict=True))
    threshold, min_gap = BLINK_DEFAULTS.values()
    if "threshold" in nodes:
        threshold = float(number_in(nodes["threshold"], name, "its threshold", 0, 1))
    if "min_gap" in nodes:
        min_gap = float(number_in(nodes["min_gap"], name, "its least gap", 0, MIN_GAP_MAX))
    return Function(name, (threshold, min_gap))


def _simplest(part: Part) -> Function:
    """Return a function that costs the least of those that give a program's values."""
    if part.is_constant:
        return Function("const", (min(max(float(part.low), 0.0), 1.0),))
    match part.instructions:
        case [(program.RSIN, 16, 0)]:
            return Function("rsin")
        case [(program.RCOS, 16, 0)]:
            return Function("rcos")
        case [(program.NOISE, int(table), 16, 0, 0)]:
            return Function("noise", (table + 1,))
        case [(program.CURVE, str(name), 16, 0)]:
            return Function("curve", (name,))
        case [(program.LIVE, str(name))]:
            return Function("live", (name,))
    return Function("program", program=part.instructions)
