"""Expressions: what compiles does what the definitions say, and what does not is told why."""

import ast
import random
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from marotte.expressions import NESTING_MAX, TEXT_MAX, compile_expression, parse
from marotte.functions import Function, FunctionError, parse_function
from marotte.pools import Pools
from marotte.puppet import Curve
from shared import program
from tests.generate_expressions import random_expression, random_phase
from tests.program_machine import run
from tests.reference_functions import FunctionCompiler, noise, noise_gradients, rcos, rsin, table_value

TABLES = {"SAW": (0.0, 1.0), "ODD": (0.1, 0.9, 0.3, 0.7, 1.0, 0.0, 0.2)}
LIVES = {"GAZE": 0.3, "SPEED": 0.85}
SEED = 1999
GRADIENTS = [noise_gradients(SEED, k) for k in range(1, 17)]
WAVES = [rsin, rcos, *(lambda x, g=g: noise(g, x) for g in GRADIENTS)]
PHASES = (0.0, 0.13, 0.5, 1.999, 77.25, 1023.7, 4095.9)
TOLERANCE = 2**-10  # constants are rounded to 2^-17, factors to 2^-20 of themselves; amplified eightfold at most
FUNCTIONS = {name: Function("curve", (name,)) for name in TABLES} | {"OTHER": Function("rsin")}


def expected_values(text):
    """Return what the oracle says of a text at PHASES, clamped to 0..1."""
    puppet = {"seed": SEED, "function": {name: {"table": list(samples)} for name, samples in TABLES.items()}}
    function = FunctionCompiler(puppet, LIVES.__getitem__).compile(text, 0)
    return [function(phase) for phase in PHASES]


def words_of(text):
    """Return the words of an expression, and the curves that they count."""
    part = compile_expression(parse(text), TABLES)
    pools = Pools(
        {name: Curve(name, FUNCTIONS[name], samples=samples) for name, samples in TABLES.items()}, list(LIVES)
    )
    pools.code(Function("program", program=part.instructions))
    curves = [lambda x, samples=samples: table_value([q15 / 32768 for q15 in samples], x) for samples in pools.curves]
    (words,) = pools.programs
    return words, curves


def compiled_values(text):
    """Return what the compiled program gives at PHASES, clamped to 0..1."""
    words, curves = words_of(text)
    return [min(max(run(words, phase, WAVES, curves, list(LIVES.values())), 0), 1) for phase in PHASES]


@pytest.mark.parametrize("seed", range(400))
def test_expression_compiled_gives_the_values_of_the_definitions(seed):
    rng = random.Random(seed)
    text = random_expression(rng, list(TABLES), list(LIVES), depth=rng.randint(1, 3))
    assert compiled_values(text) == pytest.approx(expected_values(text), abs=TOLERANCE), text


@pytest.mark.parametrize(
    "text",
    [
        "0.7*rsin(2*t + 0.25) + 0.3*noise1(t/2)",
        "rsin(0.25 + t*2)",
        "rsin(-t)",
        "rcos(2*(t + 0.5)/4 - (1 - t))",
        "noise16(-16*t + 300.75)",
        "noise2(0.0625*t - 0.001)",
        "rsin(0.25)",
        "rsin(t - t + 0.3)",
        "table(ODD)",
        "table(SAW, 3*t - 0.5)",
        "clamp(3*rsin(t) - 1)",
        "clamp(3*rsin(t) - 1, 0.2)",
        "clamp(3*rsin(t) - 1, hi=live(GAZE))",
        "clamp(rsin(t), hi=0.9, lo=noise1(t)/2)",
        "lerp(const(0.25), rsin(t), live(SPEED))",
        "min(rsin(t), rcos(t), 0.4, noise1(t))",
        "max(0.3 + 0.1, live(GAZE)*live(SPEED))",
        "abs(rsin(t) - 0.5) - -0.25",
        "+rsin(t)*-1 + 1",
        "2*3*(0.1 - 0.05)*rsin(t)",
        "0*rsin(t) + 0.5",
        "0.001*rsin(t)/0.002",
        "rsin(t)/3",
        "1000*(0.001*noise4(t))",
        "1e-9*rsin(t) + 1e-30*rcos(t)",
        "0.5 - rsin(t)*rsin(t)*rsin(t)",
        "1/4 + (2 - 1.5)",
        "100*0.01*rsin(t)",
        "7.9999",
    ],
)
def test_expression_of_every_form(text):
    assert compiled_values(text) == pytest.approx(expected_values(text), abs=TOLERANCE)


@given(seed=st.integers(0, 2**32))
def test_expression_phase_is_exact(seed):
    text = f"rsin({random_phase(random.Random(seed))})"
    (_, a_q4, b_q24), _ = words_of(text)
    code = compile(ast.Expression(ast.parse(text, mode="eval").body.args[0]), "phase", "eval")
    at_0, at_1 = (eval(code, {"t": t}) for t in (0, 1))
    assert a_q4 / 16 == pytest.approx(at_1 - at_0, abs=1e-9)
    excess = b_q24 / 2**24 - at_0
    assert abs(excess - round(excess)) <= 2**-25 + 1e-12


@pytest.mark.parametrize(
    ("text", "kind", "arguments"),
    [
        ("rsin(t)", "rsin", ()),
        ("rcos(1*t + 4)", "rcos", ()),
        ("noise7(t)", "noise", (7,)),
        ("noise7(t + 256)", "noise", (7,)),
        ("1*live(GAZE)", "live", ("GAZE",)),
        ("table(SAW)", "curve", ("SAW",)),
        ("table(SAW, t - 1)", "curve", ("SAW",)),
        ("SAW", "curve", ("SAW",)),
        ("OTHER", "rsin", ()),
        ("const(0.25) + 0.5", "const", (0.75,)),
        ("2.5", "const", (1,)),
        ("-1.3", "const", (0,)),
        ("blink", "blink", (0.98, 2.0)),
        ("rtrigsin()", "rtrigsin", (0.98, 2.0)),
        ("blink(0.5)", "blink", (0.5, 2.0)),
        ("blink(min_gap=0, threshold=1)", "blink", (1, 0)),
        ("noise7(t + 1)", "program", ()),
        ("rsin(2*t)", "program", ()),
    ],
)
def test_function_becomes_what_it_is_in_effect(text, kind, arguments):
    function = parse_function(text, FUNCTIONS)
    assert (function.kind, function.arguments) == (kind, arguments)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0.5*rsin(t)", [program.RSIN, 16, 0, program.SCALE, 1 << 19, 20]),
        ("rsin(t)/-3", [program.RSIN, 16, 0, program.SCALE, -699051, 21]),
        ("-rcos(t/16)", [program.RCOS, 1, 0, program.NEG]),
        ("noise3(t - 0.5)", [program.NOISE, 2, 16, 255, 1 << 23]),
        ("0.25 + 2*3*rsin(t)", [program.CONST, 1 << 14, program.RSIN, 16, 0, program.SCALE, 6 << 17, 17, program.ADD]),
        ("0.5 - 0.25*2*const(0.5)", [program.CONST, 1 << 14]),
    ],
)
def test_expression_words(text, words):
    assert list(words_of(text)[0]) == words


def test_expression_takes_the_deeper_operand_first():
    text = "rsin(t)"
    for k in range(1, 12):
        text = f"min(noise{k}(t), {text})"
    assert compile_expression(parse(text)).depth == 2


MISTAKES = [
    ("t", "t is the phase, which goes on for ever"),
    (
        "0.5*t",
        "found t by itself, expected it in the arguments of rsin, rcos and noise1 to noise16, and the second of table",
    ),
    ("rsin(t)*t", "found t by itself"),
    ("min(t, 1)", "found t by itself"),
    ("const(t)", "const has t as its value, expected a number in 0..1"),
    ("const(1.5)", "const has 1.5 as its value, expected a number in 0..1"),
    ("rsin(t*t)", "rsin has t * t as its phase, expected a*t + b with numbers a and b"),
    ("rsin(rsin(t))", "rsin has rsin(t) as its phase, expected a*t + b"),
    ("rsin(2/t)", "found a division by t, expected one by a number other than 0"),
    ("rsin(t/3)", "rsin has t / 3 as its phase, expected a multiple of 1/16 in -16..16 as the factor of t"),
    ("noise1(0.03*t)", "expected a multiple of 1/16 in -16..16 as the factor of t"),
    ("noise1(16.0625*t)", "expected a multiple of 1/16 in -16..16 as the factor of t"),
    ("rsin()", "found rsin(), expected for rsin its phase: rsin(t)"),
    ("rsin(t, t)", "found rsin(t, t), expected for rsin its phase: rsin(t)"),
    ("rsin(*t)", "found rsin(*t), expected for rsin its phase: rsin(t)"),
    ("0.5*rsin", "rsin needs its phase in an expression: rsin(t)"),
    ("abs(rsin(t), 1)", "expected for abs one value"),
    ("min(rsin(t))", "expected for min two values or more"),
    ("lerp(1, 2)", "expected for lerp two values and a share: lerp(a, b, x)"),
    ("lerp(1, 2, x=rsin(t))", "expected for lerp two values and a share"),
    ("max(1, 2, key=3)", "found max(1, 2, key=3), expected arguments without names"),
    ("clamp(rsin(t), 0.5, lo=0.1)", "expected lo and hi, once at most each"),
    ("clamp(rsin(t), low=0.1)", "expected lo and hi, once at most each"),
    ("clamp(rsin(t), **x)", "expected lo and hi, once at most each"),
    ("clamp(rsin(t), 0.9, 0.1)", "found clamp(rsin(t), 0.9, 0.1), expected lo <= hi"),
    ("rsin(t)/0", "found a division by 0, expected one by a number other than 0"),
    ("rsin(t)/live(X)", "found a division by live(X)"),
    ("9*rsin(t)", "9 * rsin(t) can be 0 to 9, expected all values in -8..8"),
    ("rsin(t) + 7.5", "rsin(t) + 7.5 can be 7.5 to 8.5, expected all values in -8..8"),
    ("(9*rsin(t))/9", "9 * rsin(t) can be 0 to 9"),
    ("(3*rsin(t))*(3*rcos(t))", "can be 0 to 9, expected all values in -8..8"),
    ("rsin(t) + 9", "found 9, expected all values in -8..8"),
    ("lerp(-5*rsin(t), 5*rsin(t), 0.5)", "lerp goes as far as 10, expected at most 8"),
    ("1000000*1000000", "1000000 * 1000000 can be 1e+12, expected all values in -1000000..1000000"),
    ("1e999", "found 1e309, expected numbers up to 1000000"),
    ("2000*(0.001*rsin(t))", "found 2000 as a factor, expected at most 1000"),
    ("rsin(t)**2", "found rsin(t) ** 2, expected numbers, + - * /, and calls of functions"),
    ("rsin(t) if 1 else 0", "found rsin(t) if 1 else 0"),
    ("True", "found True"),
    ("x.rsin(t)", "found x.rsin(t)"),
    ("open(t)", 'unknown function "open"'),
    ("noise17(t)", 'unknown function "noise17"; expected noise1 to noise16'),
    ("rsinn(t)", 'unknown function "rsinn"; did you mean "rsin"?'),
    ("GAZE + 0.1", 'unknown name "GAZE"; a live channel is written live(GAZE)'),
    ("live(1)", "live has 1 as its argument, expected the name of a channel"),
    ("table(t)", 'unknown table "t"; expected a [function.t] with a table'),
    ("table(SAWW, t)", 'unknown table "SAWW"; did you mean "SAW"?'),
    ("table(OTHER, t)", 'unknown table "OTHER"'),
    ("table(1, t)", "table has 1 as its first argument, expected the name of a [function.NAME]"),
    ("SAW(t)", '"SAW" is a table: write table(SAW, t)'),
    ("0.5*SAW", '"SAW" is a table: write table(SAW, t)'),
    ("0.5*OTHER(t)", '"OTHER" is a [function.OTHER], and functions do not call each other'),
    ("1 - OTHER", '"OTHER" is a [function.OTHER], and functions do not call each other'),
    ("0.5*blink(0.9, 1)", "blink stands alone, not inside an expression"),
    ("1 - blink", "blink stands alone, not inside an expression"),
    ("blink(0.9, 1, 2)", "found blink(0.9, 1, 2), expected blink(threshold, min_gap), both numbers"),
    ("blink(gap=1)", "expected blink(threshold, min_gap), both numbers"),
    ("rtrigsin(t)", "rtrigsin has t as its threshold, expected a number in 0..1"),
    ("+".join(["noise1(t)/9"] * 15), "words when compiled, expected at most 128: shorten it"),
    ("-" * 200 + "rsin(t)", f"is nested more than {NESTING_MAX} deep"),
    ("(" * 99 + "1" + ")" * 99 + "+1" * 400, f"is nested more than {NESTING_MAX} deep"),
    ("1" * (TEXT_MAX + 1), f"is longer than {TEXT_MAX} characters"),
    ("(" * 500, "not a function or expression"),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[text[:30] for text, _ in MISTAKES])
def test_expression_mistake_is_named(text, expected):
    with pytest.raises(FunctionError, match=re.escape(expected)):
        parse_function(text, FUNCTIONS)


def test_expression_that_keeps_too_many_values_is_refused():
    text = "rsin(t)"
    for k in range(1, 17):
        text = f"const(0.5)/1 - {text}" if k == 1 else f"rcos({k}*t)/8 - ({text})"
    with pytest.raises(FunctionError, match=r"keeps 17 values at once, expected at most 16: nest it less"):
        parse_function(text)


TOKENS = "rsin( noise3( table(SAW, clamp( lerp( live(GAZE) min( abs( t t) ) , + - * / 2 0.5 1e9 ( const( blink( lo= ** 0.3) [ '"


@given(text=st.text(max_size=40) | st.lists(st.sampled_from(TOKENS.split()), max_size=25).map("".join))
@example("-" * 990 + "t")
@example("rsin(" * 190 + "t" + ")" * 190)
@example("1+" * 499 + "1")
@example("0x" + "f" * 900)
@example("1e-999*rsin(t)")
@example("\ud800")
def test_expression_of_any_text_is_valid_or_a_mistake(text):
    try:
        function = parse_function(text, FUNCTIONS)
    except FunctionError as error:
        assert "\n" not in str(error)
        assert len(str(error)) < 300
        return
    if function.kind == "program":
        words, curves = words_of(text)
        assert len(words) <= program.WORDS_MAX
        for phase in PHASES:
            assert abs(run(words, phase, WAVES, curves, [0.0, 1.0])) <= 8 + TOLERANCE
