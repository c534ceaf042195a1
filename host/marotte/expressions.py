"""Expressions: a custom function as the puppet file writes it, checked and compiled to a program.

    part = compile_expression(parse("0.7*rsin(2*t + 0.25) + 0.3*noise1(t/2)"))
    print(part.instructions)

Source: docs/motion.md, functions. A text is parsed with Python's own parser and never evaluated. Numbers are the decimals that
the text shows, kept exactly until they become words.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Collection
from fractions import Fraction
from functools import reduce

from marotte import programs
from marotte.fixed import fixed
from marotte.programs import FunctionError, Part
from marotte.tomlfile import did_you_mean
from shared import formats, program

TEXT_MAX = 1000
NESTING_MAX = 100
NUMBER_MAX = 1_000_000

PHASE = "t"
WAVES = ("rsin", "rcos", *(f"noise{k}" for k in range(1, formats.NOISE_TABLES + 1)))
"""The primitives of a phase."""
STANDALONE = ("blink", "rtrigsin")
"""The functions with a memory, which no expression can hold."""

_ARGUMENTS = {
    "table": (1, 2, "the name of a [function.NAME] with a table, and its phase: table(NOD, t)"),
    "live": (1, 1, "the name of a channel: live(GAZE_YAW)"),
    "const": (1, 1, "its value: const(0.3)"),
    "min": (2, NESTING_MAX, "two values or more"),
    "max": (2, NESTING_MAX, "two values or more"),
    "abs": (1, 1, "one value"),
    "clamp": (1, 3, "a value and, if not 0 and 1, its bounds: clamp(x, lo=0.2, hi=0.8)"),
    "lerp": (3, 3, "two values and a share: lerp(a, b, x)"),
} | {name: (1, 1, f"its phase: {name}(t)") for name in WAVES}
"""Least and greatest number of arguments of everything that can be called, and what they are."""

_SHOWN_MAX = 40
_A_BITS = 4


def parse(text: str) -> ast.expr:
    """Return the tree of a text. Raises FunctionError, for one that is too long or nested too deeply too."""
    if len(text) > TEXT_MAX:
        raise FunctionError(f"is longer than {TEXT_MAX} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            node = ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        column = f" in column {error.offset}" if error.offset else ""
        raise FunctionError(f"not a function or expression: {error.msg}{column}") from None
    except (ValueError, RecursionError, MemoryError):
        raise FunctionError("not a function or expression") from None
    _check_nesting(node)
    return node


def compile_expression(node: ast.expr, tables: Collection[str] = (), others: Collection[str] = ()) -> Part:
    """Return the program of a tree that `parse` gave.

    `tables` are the names of the `[function.NAME]` that hold a table, `others` those of the rest. Raises FunctionError.
    """
    part = programs.pushed(_Compiler(tables, others).value(node))
    if part.words > program.WORDS_MAX:
        raise FunctionError(f"is {part.words} words when compiled, expected at most {program.WORDS_MAX}: shorten it")
    if part.depth > program.DEPTH_MAX:
        raise FunctionError(f"keeps {part.depth} values at once, expected at most {program.DEPTH_MAX}: nest it less")
    return part


def number(node: ast.expr) -> Fraction | None:
    """Return the exact decimal that a tree shows, signed or not; None if it is no number. Raises FunctionError."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = number(node.operand)
        return -value if value is not None and isinstance(node.op, ast.USub) else value
    if not isinstance(node, ast.Constant):
        return None
    literal = node.value
    if isinstance(literal, bool) or not isinstance(literal, int | float):
        return None
    if literal > NUMBER_MAX:  # of infinity, too; Python reads no other odd number
        raise FunctionError(f"found {shown(node)}, expected numbers up to {NUMBER_MAX}")
    return Fraction(str(literal))


def number_in(node: ast.expr, name: str, what: str, low: float, high: float) -> Fraction:
    """Return the number that an argument is. Raises FunctionError if it is none, or not in `low`..`high`."""
    value = number(node)
    if value is None or not low <= value <= high:
        raise FunctionError(f"{name} has {shown(node)} as {what}, expected a number in {low:g}..{high:g}")
    return value


def shown(node: ast.expr) -> str:
    """Return a tree as text, not too long."""
    text = ast.unparse(node)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 4] + " ..."


def unknown_function(name: str, known: Collection[str]) -> FunctionError:
    """Return what to say of a function that there is not."""
    if name.startswith("noise") and name.removeprefix("noise").isdecimal():
        return FunctionError(f'unknown function "{name}"; expected noise1 to noise{formats.NOISE_TABLES}')
    return FunctionError(f'unknown function "{name}"{did_you_mean(name, known)}')


class _Compiler:
    """Compiles the nodes of one expression, bottom up."""

    def __init__(self, tables: Collection[str], others: Collection[str]) -> None:
        self.tables = tables
        self.others = others

    def value(self, node: ast.expr) -> Part:
        """Return a node's program, its values checked to be in range (numbers on their own may be factors or divisors)."""
        part = self._value(node)
        most = NUMBER_MAX if part.is_constant else programs.VALUE_MAX
        if not -most <= part.low <= part.high <= most:
            ends = " to ".join(f"{float(end):g}" for end in dict.fromkeys((part.low, part.high)))
            raise FunctionError(f"{shown(node)} can be {ends}, expected all values in -{most}..{most}")
        return part

    def _value(self, node: ast.expr) -> Part:
        literal = number(node)
        if literal is not None:
            return programs.constant(literal)
        match node:
            case ast.UnaryOp(op=ast.USub()):
                return programs.scaled(self.value(node.operand), Fraction(-1))
            case ast.UnaryOp(op=ast.UAdd()):
                return self.value(node.operand)
            case ast.BinOp(op=ast.Div()):
                return programs.scaled(self.value(node.left), 1 / _divisor(node))
            case ast.BinOp(op=ast.Add()):
                return programs.total(self.value(node.left), self.value(node.right))
            case ast.BinOp(op=ast.Sub()):
                return programs.difference(self.value(node.left), self.value(node.right))
            case ast.BinOp(op=ast.Mult()):
                return programs.product(self.value(node.left), self.value(node.right))
            case ast.Call(func=ast.Name(id=name)):
                return self._call(name, node)
            case ast.Name():
                raise self._bare_name(node.id)
        raise FunctionError(f"found {shown(node)}, expected numbers, + - * /, and calls of functions")

    def _call(self, name: str, call: ast.Call) -> Part:
        if name in STANDALONE:
            raise FunctionError(f"{name} stands alone, not inside an expression")
        if name in self.tables:
            raise FunctionError(f'"{name}" is a table: write table({name}, t)')
        if name in self.others:
            raise FunctionError(f'"{name}" is a [function.{name}], and functions do not call each other')
        if name not in _ARGUMENTS:
            raise unknown_function(name, [*_ARGUMENTS, *self.tables])
        least, most, what = _ARGUMENTS[name]
        if not least <= len(call.args) <= most or any(isinstance(argument, ast.Starred) for argument in call.args):
            raise FunctionError(f"found {shown(call)}, expected for {name} {what}")
        if call.keywords and name != "clamp":
            raise FunctionError(f"found {shown(call)}, expected arguments without names")
        match name:
            case "table":
                phase = call.args[1] if len(call.args) > 1 else ast.Name(PHASE)
                return programs.curve(self._table_name(call.args[0]), *_phase(name, phase))
            case "live":
                return programs.live(_channel(call.args[0]))
            case "const":
                return programs.constant(number_in(call.args[0], name, "its value", 0, 1))
            case "clamp":
                return self._clamp(call)
            case "min" | "max" | "abs" | "lerp":
                return _operation(name, [self.value(argument) for argument in call.args])
        return programs.wave(name, *_phase(name, call.args[0]))

    def _table_name(self, node: ast.expr) -> str:
        if not isinstance(node, ast.Name):
            raise FunctionError(
                f"table has {shown(node)} as its first argument, expected the name of a [function.NAME]"
            )
        if node.id not in self.tables:
            hint = did_you_mean(node.id, self.tables) or f"; expected a [function.{node.id}] with a table"
            raise FunctionError(f'unknown table "{node.id}"{hint}')
        return node.id

    def _clamp(self, call: ast.Call) -> Part:
        nodes = dict(zip(("lo", "hi"), call.args[1:], strict=False))
        for keyword in call.keywords:
            if keyword.arg not in ("lo", "hi") or keyword.arg in nodes:
                raise FunctionError(f"found {shown(call)}, expected lo and hi, once at most each")
            nodes[keyword.arg] = keyword.value
        bounds = {"lo": programs.constant(Fraction(0)), "hi": programs.constant(Fraction(1))}
        bounds |= {name: self.value(node) for name, node in nodes.items()}
        if bounds["lo"].low > bounds["hi"].high:
            raise FunctionError(f"found {shown(call)}, expected lo <= hi")
        return programs.clamped(self.value(call.args[0]), bounds["lo"], bounds["hi"])

    def _bare_name(self, name: str) -> FunctionError:
        if name == PHASE:
            places = "the arguments of rsin, rcos and noise1 to noise16, and the second of table"
            return FunctionError(f"found t by itself, expected it in {places}")
        if name in WAVES:
            return FunctionError(f"{name} needs its phase in an expression: {name}(t)")
        if name in STANDALONE:
            return FunctionError(f"{name} stands alone, not inside an expression")
        if name in self.tables:
            return FunctionError(f'"{name}" is a table: write table({name}, t)')
        if name in self.others:
            return FunctionError(f'"{name}" is a [function.{name}], and functions do not call each other')
        hint = did_you_mean(name, [*_ARGUMENTS, *self.tables])
        return FunctionError(f'unknown name "{name}"{hint or f"; a live channel is written live({name})"}')


def _check_nesting(node: ast.expr) -> None:
    """Raise FunctionError for a tree too deep to be walked recursively; walks it level by level itself."""
    level: list[ast.AST] = [node]
    for _ in range(NESTING_MAX):
        level = [child for parent in level for child in ast.iter_child_nodes(parent)]
        if not level:
            return
    raise FunctionError(f"is nested more than {NESTING_MAX} deep")


def _channel(node: ast.expr) -> str:
    if not isinstance(node, ast.Name):
        raise FunctionError(f"live has {shown(node)} as its argument, expected the name of a channel")
    return node.id


def _operation(name: str, parts: list[Part]) -> Part:
    match name:
        case "min":
            return reduce(programs.minimum, parts)
        case "max":
            return reduce(programs.maximum, parts)
        case "abs":
            return programs.absolute(parts[0])
    return programs.interpolated(*parts)


def _divisor(node: ast.BinOp) -> Fraction:
    value = number(node.right)
    if not value:
        raise FunctionError(f"found a division by {shown(node.right)}, expected one by a number other than 0")
    return value


def _phase(name: str, node: ast.expr) -> tuple[int, int]:
    """Return the factor in Q4 and the summand in Q24 of the argument of a primitive. Raises FunctionError."""
    affine = _affine(node)
    if affine is None:
        raise FunctionError(f"{name} has {shown(node)} as its phase, expected a*t + b with numbers a and b")
    a, b = affine
    a_q4 = fixed(a, _A_BITS)
    if Fraction(a_q4, 1 << _A_BITS) != a or abs(a_q4) > program.A_MAX_Q4:
        expected = "a multiple of 1/16 in -16..16 as the factor of t"
        raise FunctionError(f"{name} has {shown(node)} as its phase, expected {expected}")
    return a_q4, fixed(b, formats.PHASE_BITS)


def _affine(node: ast.expr) -> tuple[Fraction, Fraction] | None:
    """Return the (a, b) of a tree that stands for `a*t + b`, None if it does not."""
    literal = number(node)
    if literal is not None:
        return Fraction(0), literal
    if isinstance(node, ast.Name) and node.id == PHASE:
        return Fraction(1), Fraction(0)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        node = ast.BinOp(ast.Constant(-1 if isinstance(node.op, ast.USub) else 1), ast.Mult(), node.operand)
    if not isinstance(node, ast.BinOp):
        return None
    left, right = _affine(node.left), _affine(node.right)
    if left is None or right is None:
        return None
    (a, b), (c, d) = left, right
    match node.op:
        case ast.Add():
            return a + c, b + d
        case ast.Sub():
            return a - c, b - d
        case ast.Mult() if not (a and c):
            return a * d + b * c, b * d
        case ast.Div():
            divisor = _divisor(node)
            return a / divisor, b / divisor
    return None
