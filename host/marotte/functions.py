"""The FUNCTION of a mapping: read from its text in the puppet file.

Source: docs/motion.md, functions. A text is a bare name (`"noise2"`), a call (`"const(0.3)"`, `"live(GAZE_YAW)"`,
`"blink(0.93, 1.2)"`), the name of a `[function.NAME]`, or an expression of primitives. It is parsed with Python's own parser and
never evaluated.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Collection
from dataclasses import dataclass

from marotte.errors import MarotteError
from marotte.tomlfile import did_you_mean
from shared import formats

BLINKS = {"blink": (0.98, 2.0), "rtrigsin": (0.98, 2.0)}
"""The functions that stand alone, and their default threshold and least gap (in periods)."""
MIN_GAP_MAX = 1000
TEXT_MAX = 500

_NOISES = tuple(f"noise{k}" for k in range(1, formats.NOISE_TABLES + 1))
PRIMITIVES = ("rsin", "rcos", *_NOISES, "const", "live", "table", *BLINKS)
"""The names that a `[function.NAME]` cannot have."""
_OPERATIONS = ("min", "max", "abs", "clamp", "lerp")
_PHASE = "t"
_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div)
_NOISE = re.compile(r"noise(\d+)")


class FunctionError(MarotteError):
    """A text is no function; says what was found and what is expected."""


@dataclass(frozen=True)
class Function:
    """What a mapping interpolates with: a value in 0..1 for every phase."""

    kind: str
    """`rsin`, `rcos`, `noise`, `const`, `live`, `blink`, `rtrigsin`, `function` or `expression`."""
    arguments: tuple[float | str, ...] = ()
    """`noise`: the table 1..16; `const`: its value; `live`: the channel; `blink`, `rtrigsin`: threshold and least gap in
    periods; `function`: its name; `expression`: its text."""


def parse_function(text: object, functions: Collection[str] = ()) -> Function:
    """Return the function that a text means; `functions` are the names of the file's `[function.NAME]`.

    Raises FunctionError.
    """
    if not isinstance(text, str):
        raise FunctionError('expected a function in quotes, such as "noise1" or "rsin"')
    node = _parse(text)
    if isinstance(node, ast.Name):
        return _bare(node.id, functions)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        function = _call(node.func.id, node.args)
        if function:
            return function
    if isinstance(node, ast.Constant):
        raise FunctionError(f"found a number; a constant function is written const({text.strip()})")
    _check_expression(node)
    return Function("expression", (text,))


def check_expression(text: str) -> None:
    """Raise FunctionError if a text is no expression of the primitives."""
    _check_expression(_parse(text))


def _parse(text: str) -> ast.expr:
    if len(text) > TEXT_MAX:
        raise FunctionError(f"is longer than {TEXT_MAX} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        column = f" in column {error.offset}" if error.offset else ""
        raise FunctionError(f"not a function or expression: {error.msg}{column}") from None
    except (ValueError, RecursionError, MemoryError):
        raise FunctionError("not a function or expression") from None


def _bare(name: str, functions: Collection[str]) -> Function:
    noise = _noise_table(name)
    if noise:
        return Function("noise", (noise,))
    if name in ("rsin", "rcos"):
        return Function(name)
    if name in BLINKS:
        return Function(name, BLINKS[name])
    if name == "const":
        raise FunctionError("const needs its value, in 0..1: const(0.3)")
    if name == "live":
        raise FunctionError("live needs its channel: live(GAZE_YAW)")
    if name == "table":
        raise FunctionError(
            'table needs the name of a [function.NAME] with a table; the name alone, without "table", will do'
        )
    if name in functions:
        return Function("function", (name,))
    raise FunctionError(f'unknown function "{name}"{did_you_mean(name, [*PRIMITIVES, *functions])}')


def _call(name: str, arguments: list[ast.expr]) -> Function | None:
    """Return the function that a call at the outermost level means, None if it is an expression like any other."""
    if name == "const":
        return Function("const", (_number(name, arguments, 0, "its value", 0, 1, count=1),))
    if name == "live":
        return Function("live", (_channel(arguments),))
    if name in BLINKS:
        if not arguments:
            return Function(name, BLINKS[name])
        threshold = _number(name, arguments, 0, "its threshold", 0, 1, count=2)
        return Function(name, (threshold, _number(name, arguments, 1, "its least gap", 0, MIN_GAP_MAX, count=2)))
    is_phase = len(arguments) == 1 and isinstance(arguments[0], ast.Name) and arguments[0].id == _PHASE
    return _bare(name, ()) if is_phase and (name in ("rsin", "rcos") or _NOISE.fullmatch(name)) else None


def _noise_table(name: str) -> int:
    match = _NOISE.fullmatch(name)
    if match and name not in _NOISES:
        raise FunctionError(f'unknown function "{name}"; expected noise1 to noise{formats.NOISE_TABLES}')
    return int(match[1]) if match else 0


def _number(name: str, arguments: list[ast.expr], index: int, what: str, low: float, high: float, count: int) -> float:
    if len(arguments) != count:
        raise FunctionError(
            f"expected {count} {'number' if count == 1 else 'numbers'} for {name}, not {len(arguments)}"
        )
    value = _literal(arguments[index])
    if value is None or not low <= value <= high:
        shown = ast.unparse(arguments[index])
        raise FunctionError(f"{name} has {shown} as {what}, expected a number in {low:g}..{high:g}")
    return value


def _literal(node: ast.expr) -> float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        value = _literal(node.operand)
        return value if value is None or isinstance(node.op, ast.UAdd) else -value
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        try:
            return float(node.value)
        except OverflowError:
            return None
    return None


def _channel(arguments: list[ast.expr]) -> str:
    if len(arguments) != 1 or not isinstance(arguments[0], ast.Name):
        raise FunctionError("live has one argument, the name of a channel: live(GAZE_YAW)")
    return arguments[0].id


def _check_expression(node: ast.AST) -> None:
    if isinstance(node, ast.Name) and node.id == _PHASE:
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        return
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        _check_expression(node.operand)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, _OPERATORS):
        _check_expression(node.left)
        _check_expression(node.right)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        _check_call(node.func.id, node.args)
    else:
        raise FunctionError(f"found {ast.unparse(node)}, expected numbers, + - * /, and calls of primitives")


def _check_call(name: str, arguments: list[ast.expr]) -> None:
    if name in BLINKS:
        raise FunctionError(f"{name} stands alone, not inside an expression")
    known = [name for name in PRIMITIVES if name not in BLINKS] + list(_OPERATIONS)
    if name not in known and not _noise_table(name):
        raise FunctionError(f'unknown function "{name}"{did_you_mean(name, known)}')
    if name == "live":
        _channel(arguments)
        return
    for argument in arguments[1 if name == "table" else 0 :]:
        _check_expression(argument)
