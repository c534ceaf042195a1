"""The periodic functions in float64: the half of the motion's oracle that gives values to phases.

Written from the definitions of `docs/motion.md` alone and sharing no code with `firmware`, `shared`
or `host`, so that agreement means something. Nothing here is fast and nothing is fixed point.

Phases and times are in periods, values are plain floats. A FUNCTION of a mapping is either a pure
one, `f(phase) -> 0..1`, or a `TriggeredSine`, which has a memory.

Readings where the definitions leave a choice:
- A puppet that names no seed has seed 1.
- `table(NAME)` is `table(NAME, t)`; the bare name of a table function means the same.
- An expression in `[function.NAME]` may be one call of `blink` or `rtrigsin`, as in a mapping.
- `clamp` takes its bounds by place or by name; `min` and `max` take two or more arguments; the
  bounds, like every argument that is not a phase, may be expressions.
- Numbers are the decimals that the file shows: 0.1 in `a*t + b` is one tenth.
"""

import ast
import math
from fractions import Fraction
from typing import ClassVar

_MASK_32 = 0xFFFFFFFF
_SEED_FACTOR = 0x9E3779B1
_STREAM_FACTOR = 0x85EBCA77
_DEFAULT_SEED = 1
_GRADIENTS = 256
_LONG_AGO_PERIODS = 2048.0
_MARGIN_PERIODS = 1 / 1024
_DEFAULT_THRESHOLD = 0.98
_DEFAULT_MIN_GAP_PERIODS = 2.0


def xorshift(state):
    """Return the state after `state` of the 32-bit xorshift generator (13, 17, 5)."""
    state ^= (state << 13) & _MASK_32
    state ^= state >> 17
    state ^= (state << 5) & _MASK_32
    return state


def stream_start(seed, stream):
    """Return the xorshift state from which a stream of the puppet's `seed` starts, never 0.

    Streams 1..16 are the noise tables, 256 + m is the random stream of mapping m.
    """
    return (seed * _SEED_FACTOR + stream * _STREAM_FACTOR) & _MASK_32 or 1


def noise_gradients(seed, table, spread=0.0):
    """Return the 256 gradients, -1..1, of noise table 1..16 for a puppet's seed and `noise_spread`."""
    state = stream_start(seed, table)
    gradients = []
    for _ in range(_GRADIENTS):
        state = xorshift(state)
        gradient = ((state >> 16) - 32768) / 32768
        magnitude = spread + (1 - spread) * abs(gradient)
        gradients.append(magnitude if gradient >= 0 else -magnitude)
    return gradients


def rsin(x):
    """The paper's Raised Sine: 0..1, period 1."""
    return (1 + math.sin(2 * math.pi * (x - math.floor(x)))) / 2


def rcos(x):
    """The paper's Raised Cosine: 0..1, period 1."""
    return (1 + math.cos(2 * math.pi * (x - math.floor(x)))) / 2


def noise(gradients, x):
    """Return 1/2 + twice the Hermite spline that is 0 with slope `gradients[j]` at every integer j."""
    j = math.floor(x)
    u = x - j
    here, following = gradients[j % _GRADIENTS], gradients[(j + 1) % _GRADIENTS]
    return 0.5 + 2 * u * (1 - u) * (here * (1 - u) - following * u)


def table_value(samples, x):
    """Return the curve of period 1 through `samples` at phases i/n, linear between them."""
    position = (x - math.floor(x)) * len(samples)
    i = math.floor(position)
    here, following = samples[i % len(samples)], samples[(i + 1) % len(samples)]
    return here + (following - here) * (position - i)


_TRIGGERED = {"rtrigsin": rsin, "blink": rcos}


class TriggeredSine:
    """The paper's Random Triggered Sine (`rtrigsin`), or its continuous sister `blink`.

    Args:
        wave: `rsin` for `rtrigsin`, `rcos` for `blink`.
        threshold: a blink starts when the frame's random number, 0..1, is above it.
        min_gap: periods that must have passed since the last blink started.
        stream: xorshift state from which the mapping's own random numbers start.

    Attributes:
        closest_periods: the smallest distance, so far, between a time and the limit that it was
            compared with: below the accuracy of a phase another implementation may decide otherwise.
    """

    def __init__(self, wave, threshold, min_gap, stream):
        self.wave = wave
        self.threshold = threshold
        self.min_gap = min_gap
        self.stream = stream
        self.closest_periods = math.inf
        self.enter()

    def enter(self):
        """Forget the blinks, as when the action enters; the random stream goes on."""
        self.blinking = False
        self.started_at = None

    def __call__(self, phase):
        """Return the value, 0..1, at `phase` and take the one step of this frame."""
        self.stream = xorshift(self.stream)
        random = (self.stream >> 16) / 65536
        if not self.blinking and random > self.threshold and self._exceeds(phase, self.min_gap):
            self.blinking = True
            self.started_at = phase
        elif self.blinking and self._exceeds(phase, 1):
            self.blinking = False
        return self.wave(phase - self.started_at) if self.blinking else 1.0

    def _exceeds(self, phase, periods):
        since = _LONG_AGO_PERIODS
        if self.started_at is not None:
            since = min(phase - self.started_at, _LONG_AGO_PERIODS)
        excess = since - (periods + _MARGIN_PERIODS)
        self.closest_periods = min(self.closest_periods, abs(excess))
        return excess > 0


class FunctionCompiler:
    """Turns the FUNCTION texts of one puppet into callables of the phase.

    Args:
        puppet: the puppet file as `tomllib` gives it.
        read_live: `read_live(name)` gives the filtered value of a live channel at the time of the call.

    Raises:
        ValueError: from `compile`, when a text is not in the grammar. This is a safety net for the
            generator of puppets, not the checker of files.

    What it builds of numbers are its class attributes, so that a subclass can take arrays of phases.
    """

    WAVES: ClassVar = {"rsin": rsin, "rcos": rcos}
    noise = staticmethod(noise)
    table_value = staticmethod(table_value)
    least, most = min, max

    def __init__(self, puppet, read_live):
        self._functions = puppet.get("function", {})
        self._seed = puppet.get("seed", _DEFAULT_SEED)
        self._read_live = read_live
        self._primitives = dict(self.WAVES)
        for k in range(1, 17):
            gradients = noise_gradients(self._seed, k, puppet.get("noise_spread", 0))
            self._primitives[f"noise{k}"] = lambda x, gradients=gradients: self.noise(gradients, x)

    def compile(self, text, mapping_index):
        """Return the callable of FUNCTION `text`; `mapping_index` counts the puppet's mappings from 0."""
        if text in self._functions:
            definition = self._functions[text]
            if "table" in definition:
                return lambda phase: self.table_value(definition["table"], phase)
            text = definition["expr"]
        elif text in self._primitives or text in _TRIGGERED:
            text += "(t)" if text in self._primitives else "()"
        tree = ast.parse(text, mode="eval").body
        if isinstance(tree, ast.Call) and tree.func.id in _TRIGGERED:
            return self._triggered(tree, mapping_index)
        expression = self._expression(tree)
        return lambda phase: self.least(self.most(expression(phase), 0.0), 1.0)

    def _triggered(self, call, mapping_index):
        options = {"threshold": _DEFAULT_THRESHOLD, "min_gap": _DEFAULT_MIN_GAP_PERIODS}
        options.update(zip(options, (float(_number(node)) for node in call.args), strict=False))
        options.update({keyword.arg: float(_number(keyword.value)) for keyword in call.keywords})
        stream = stream_start(self._seed, 256 + mapping_index)
        return TriggeredSine(_TRIGGERED[call.func.id], stream=stream, **options)

    def _expression(self, node):
        """Return a callable of the phase for one node of an expression."""
        match node:
            case ast.Constant() | ast.UnaryOp(operand=ast.Constant()):
                value = float(_number(node))
                return lambda phase: value
            case ast.UnaryOp(op=ast.USub()):
                operand = self._expression(node.operand)
                return lambda phase: -operand(phase)
            case ast.UnaryOp(op=ast.UAdd()):
                return self._expression(node.operand)
            case ast.BinOp(op=ast.Add()):
                left, right = self._expression(node.left), self._expression(node.right)
                return lambda phase: left(phase) + right(phase)
            case ast.BinOp(op=ast.Sub()):
                left, right = self._expression(node.left), self._expression(node.right)
                return lambda phase: left(phase) - right(phase)
            case ast.BinOp(op=ast.Mult()):
                left, right = self._expression(node.left), self._expression(node.right)
                return lambda phase: left(phase) * right(phase)
            case ast.BinOp(op=ast.Div()):
                left, divisor = self._expression(node.left), float(_number(node.right))
                return lambda phase: left(phase) / divisor
            case ast.Call(func=ast.Name()):
                return self._call(node.func.id, node)
        raise ValueError(f"not an expression: {ast.unparse(node)}")

    def _call(self, name, call):
        if name in self._primitives:
            return _at_phase(self._primitives[name], call.args[0])
        if name == "table":
            samples = self._functions[call.args[0].id]["table"]
            argument = call.args[1] if len(call.args) > 1 else ast.Name("t")
            return _at_phase(lambda x: self.table_value(samples, x), argument)
        if name == "live":
            channel = call.args[0].id
            return lambda phase: self._read_live(channel)
        if name == "const":
            return self._expression(call.args[0])
        operands = [self._expression(argument) for argument in call.args]
        if name in ("min", "max", "abs"):
            combine = {"min": self.least, "max": self.most, "abs": abs}[name]
            return lambda phase: combine(*[operand(phase) for operand in operands])
        if name == "lerp":
            start, end, x = operands
            return lambda phase: start(phase) + (end(phase) - start(phase)) * x(phase)
        if name == "clamp":
            bounds = dict(zip(("lo", "hi"), operands[1:], strict=False))
            bounds.update({keyword.arg: self._expression(keyword.value) for keyword in call.keywords})
            low = bounds.get("lo", lambda phase: 0.0)
            high = bounds.get("hi", lambda phase: 1.0)
            return lambda phase: self.least(self.most(operands[0](phase), low(phase)), high(phase))
        raise ValueError(f"not a function: {name}")


def _at_phase(function, argument):
    """Return the callable `phase -> function(a*phase + b)` for the argument's tree `a*t + b`."""
    a, b = (float(coefficient) for coefficient in _affine(argument))
    return lambda phase: function(a * phase + b)


def _affine(node):
    """Return the exact (a, b) of a tree that stands for `a*t + b`."""
    match node:
        case ast.Name(id="t"):
            return Fraction(1), Fraction(0)
        case ast.UnaryOp(op=ast.USub()):
            a, b = _affine(node.operand)
            return -a, -b
        case ast.UnaryOp(op=ast.UAdd()):
            return _affine(node.operand)
        case ast.BinOp(op=ast.Add()):
            (a, b), (c, d) = _affine(node.left), _affine(node.right)
            return a + c, b + d
        case ast.BinOp(op=ast.Sub()):
            (a, b), (c, d) = _affine(node.left), _affine(node.right)
            return a - c, b - d
        case ast.BinOp(op=ast.Mult()):
            (a, b), (c, d) = _affine(node.left), _affine(node.right)
            if a and c:
                raise ValueError(f"not of the form a*t + b: {ast.unparse(node)}")
            return a * d + b * c, b * d
        case ast.BinOp(op=ast.Div()):
            (a, b), divisor = _affine(node.left), _number(node.right)
            return a / divisor, b / divisor
    return Fraction(0), _number(node)


def _number(node):
    """Return the exact decimal that a tree shows, signed or not."""
    match node:
        case ast.Constant(value=int() | float()):
            return Fraction(str(node.value))
        case ast.UnaryOp(op=ast.USub()):
            return -_number(node.operand)
        case ast.UnaryOp(op=ast.UAdd()):
            return _number(node.operand)
    raise ValueError(f"not a number: {ast.unparse(node)}")
