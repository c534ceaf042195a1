"""Random custom functions within the grammar of `docs/motion.md`, for `tests.generate`.

Every expression keeps to what the definitions demand of one: intermediate values within -8..8 by
plain interval arithmetic, phases `a*t + b` with `a` a multiple of 1/16 up to 16, and an amplification
of at most eight, so that the tight bound of the base tap holds for it. (Amplification is how far the
result can move per unit of error in the primitives' values; a steep `a` is not counted in it.)
"""

from typing import NamedTuple

_VALUE_LIMIT = 8
_AMPLIFICATION_LIMIT = 8
_SUM, _PRODUCT, _ATOM = range(3)


class _Expression(NamedTuple):
    """A text with the interval of its value, its amplification and how tightly its operator binds."""

    text: str
    low: float
    high: float
    amplification: float
    binding: int = _ATOM

    def within(self, binding):
        """Return the text as an operand of something that binds as given."""
        return self.text if self.binding >= binding else f"({self.text})"


def random_expression(rng, tables, channels, depth=3):
    """Return the text of an expression that uses some of the named tables and live channels."""
    while True:
        expression = _expression(rng, tables, channels, depth)
        if expression is not None:
            return expression.text


def random_phase(rng):
    """Return a text of the form `a*t + b`."""
    a = rng.choice((1, 2, -1, 3, 4, 16, 32, -16, 48, 256, rng.randint(-256, 256))) / 16
    times = rng.choice((f"{a:.10g}*t", f"t*{a:.10g}", f"t/{rng.choice((2, 4, 8, 16))}", "t", "-t"))
    b = rng.choice((0.25, 0.5, 1, round(rng.uniform(0, 4), 4)))
    return rng.choice((times, times, f"{times} + {b}", f"{times} - {b}", f"{b} + {times}"))


def _expression(rng, tables, channels, depth):
    """Return an expression, or None where a draw left the limits."""
    if depth == 0 or rng.random() < 0.2:
        return _leaf(rng, tables, channels)
    operands = [_expression(rng, tables, channels, depth - 1) for _ in range(3)]
    if None in operands:
        return None
    drawn = rng.choice((_sum, _difference, _product, _scaled, _divided, _extreme, _abs, _clamp, _lerp))(rng, *operands)
    inside = max(-drawn.low, drawn.high) <= _VALUE_LIMIT and drawn.amplification <= _AMPLIFICATION_LIMIT
    return drawn if inside else None


def _leaf(rng, tables, channels):
    kind = rng.choice(("number", "const", "rsin", "rcos", "noise", "noise", "table", "live"))
    if kind == "number":
        number = round(rng.uniform(-2, 2), 3)
        return _Expression(str(number), number, number, 0, _ATOM if number >= 0 else _SUM)
    if kind == "const":
        number = round(rng.uniform(0, 1), 4)
        return _Expression(f"const({number})", number, number, 0)
    if kind == "table" and tables:
        name = rng.choice(tables)
        return _Expression(rng.choice((f"table({name}, {random_phase(rng)})", f"table({name}, t)")), 0, 1, 1)
    if kind == "live" and channels:
        return _Expression(f"live({rng.choice(channels)})", 0, 1, 1)
    name = kind if kind in ("rsin", "rcos") else f"noise{rng.randint(1, 16)}"
    return _Expression(f"{name}({random_phase(rng)})", 0, 1, 1)


def _sum(rng, left, right, _):
    text = f"{left.text} + {right.within(_PRODUCT)}"
    return _Expression(
        text, left.low + right.low, left.high + right.high, left.amplification + right.amplification, _SUM
    )


def _difference(rng, left, right, _):
    text = f"{left.text} - {right.within(_PRODUCT)}"
    return _Expression(
        text, left.low - right.high, left.high - right.low, left.amplification + right.amplification, _SUM
    )


def _product(rng, left, right, _):
    corners = [x * y for x in (left.low, left.high) for y in (right.low, right.high)]
    reach = [max(abs(operand.low), abs(operand.high)) for operand in (left, right)]
    amplification = reach[1] * left.amplification + reach[0] * right.amplification
    text = f"{left.within(_PRODUCT)}*{right.within(_ATOM)}"
    return _Expression(text, min(corners), max(corners), amplification, _PRODUCT)


def _scaled(rng, operand, *_):
    factor = round(rng.uniform(0, 3), 3)
    number = _Expression(str(factor), factor, factor, 0)
    return _product(rng, *rng.choice(((number, operand), (operand, number))), None)


def _divided(rng, operand, *_):
    divisor = rng.choice((2, 3, 0.5, round(rng.uniform(0.3, 5), 3)))
    text = f"{operand.within(_PRODUCT)}/{divisor}"
    return _Expression(text, operand.low / divisor, operand.high / divisor, operand.amplification / divisor, _PRODUCT)


def _extreme(rng, left, right, _):
    name, choose = rng.choice((("min", min), ("max", max)))
    bounds = choose(left.low, right.low), choose(left.high, right.high)
    return _Expression(f"{name}({left.text}, {right.text})", *bounds, max(left.amplification, right.amplification))


def _abs(rng, operand, *_):
    reach = max(abs(operand.low), abs(operand.high))
    nearest = 0 if operand.low <= 0 <= operand.high else min(abs(operand.low), abs(operand.high))
    return _Expression(f"abs({operand.text})", nearest, reach, operand.amplification)


def _clamp(rng, operand, *_):
    low, high = sorted(round(rng.uniform(-1, 2), 3) for _ in range(2))
    bounds, (low, high) = rng.choice(
        (("", (0, 1)), (f", {low}, {high}", (low, high)), (f", lo={low}, hi={high}", (low, high)))
    )
    limited = [min(max(value, low), high) for value in (operand.low, operand.high)]
    return _Expression(f"clamp({operand.text}{bounds})", *limited, operand.amplification)


def _lerp(rng, start, end, x):
    way = _difference(rng, end, start, None)
    sweep = _product(rng, way, x, None)
    total = _sum(rng, start, sweep, None)
    steepest = max(
        total.amplification, way.amplification, sweep.amplification, abs(way.low), way.high, abs(sweep.low), sweep.high
    )
    return _Expression(f"lerp({start.text}, {end.text}, {x.text})", total.low, total.high, steepest)
