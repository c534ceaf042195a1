"""Tables from the wire are not trusted: whatever comes in whatever order, it is stored within the arrays or refused."""

from hypothesis import given
from hypothesis import strategies as st

from shared import formats, messages, program
from tests.checked import load_checked
from tests.kernels.values import integers

MODULE = load_checked("firmware/tables.py")
RANGES = {"B": (0, 255), "H": (0, 65535), "I": (0, (1 << 32) - 1), "i": (-(1 << 31), (1 << 31) - 1)}
BEGIN = {
    "frame_rate_hz": 30,
    "dofs": 2,
    "actions": 2,
    "mappings": 3,
    "lives": 1,
    "curves": 2,
    "programs": 2,
    "blinks": 1,
    "seed": 1,
    "spread_q15": 0,
    "hold_q26": 1,
    "link_timeout_ms": 500,
}
FIELDS = {name: (fields, items) for name, _, fields, items in messages.MESSAGES}


def numbers(kind):
    """Any number of a message's type, and often one that may be right."""
    least, greatest = RANGES[kind]
    return st.integers(0, 3) | integers(least, greatest, 16, 255, 257, 65536)


def calls(method, *kinds):
    return st.tuples(st.just(method), st.tuples(*map(numbers, kinds)))


def fields(name):
    return [kind for _, kind in FIELDS[name][0]]


def items(name):
    return [kind for _, kind in FIELDS[name][1]]


any_call = st.one_of(
    *(calls(name, *fields(name)) for name in ("dof", "action", "live", "blink", "curve", "program")),
    calls("mapping", *fields("mappings"), *items("mappings")),
    calls("sample", *items("curve")),
    calls("word", *items("program")),
    calls("keep", *fields("keep"), "B", *items("keep")),
)


@given(st.lists(any_call, max_size=60))
def test_tables_take_or_refuse_any_parts_in_any_order(parts):
    tables = MODULE.Tables()
    assert tables.begin(*BEGIN.values()) is None
    for method, arguments in parts:
        getattr(tables, method)(*arguments)
        assert tables.missing() >= 0
    for action in range(formats.ACTIONS_MAX):
        tables.link_repeats(action)
    tables.doubled()


@given(calls("begin", *fields("begin")))
def test_tables_take_or_refuse_any_beginning(part):
    tables = MODULE.Tables()
    if tables.begin(*part[1]) is None:
        assert tables.ready and tables.missing() >= 1
    else:
        assert not tables.ready


def test_curves_and_programs_fill_their_pools_and_no_more():
    tables = MODULE.Tables()
    tables.begin(*(BEGIN | {"curves": formats.CURVES_MAX, "programs": program.PROGRAMS_MAX}).values())
    curves = formats.SAMPLES_POOL // formats.SAMPLES_MAX
    for curve in range(curves):
        assert tables.curve(curve, formats.SAMPLES_MAX) is None
        assert [tables.sample(5) for _ in range(formats.SAMPLES_MAX)] == [None] * formats.SAMPLES_MAX
    assert (tables.curve(curves, 2), tables.sample(0)) == (1, 0)
    words = [program.CONST, 0, *[program.NEG] * (program.WORDS_MAX - 2)]
    programs = program.POOL_WORDS // program.WORDS_MAX
    for number in range(programs):
        assert tables.program(number, program.WORDS_MAX) is None
        assert [tables.word(word) for word in words] == [None] * program.WORDS_MAX
    assert (tables.program(programs, 2), tables.word(0)) == (1, 0)
