"""What `future` counts and copies, by plain Python, within its arrays."""

import random

from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, values_q15, words

bands = load_checked("firmware/bands.py")
MODULE = load_checked("firmware/future.py")


@given(
    st.lists(
        st.lists(st.tuples(st.integers(0, 3), integers(0, 6), st.integers(0, 2)), max_size=5), min_size=1, max_size=8
    ),
    st.lists(integers(0, 65535), min_size=3, max_size=3),
    st.data(),
)
def test_load_is_that_of_who_plays(actions, program_words, data):
    """An action is a list of mappings: DOF, function, argument."""
    flat = [mapping for mappings in actions for mapping in mappings]
    dofs, functions, arguments = zip(*flat, strict=True) if flat else ((), (), ())
    first = halves(sum(map(len, actions[:i])) for i in range(len(actions)))
    playing = data.draw(st.lists(st.sampled_from(range(len(actions))), unique=True))
    signal = bytes([1, 0, 1, 1])
    counts = bytes(map(len, actions))
    mapped = [mapping for i in playing for mapping in actions[i]]
    assert MODULE._load(bytes(playing), len(playing), counts) == len(mapped)
    found = MODULE._program_words(
        bytes(playing), len(playing), first, counts, bytes(dofs), signal, bytes(functions), halves(arguments),
        halves(program_words),
    )  # fmt: skip
    assert found == sum(
        program_words[argument]
        for dof, function, argument in mapped
        if function == formats.FUNCTION_PROGRAM and signal[dof]
    )


values = st.lists(values_q15, min_size=4, max_size=4)


@given(values, integers(0, 3), integers(0, 15))
def test_values_are_spread_over_a_block_or_put_to_one_of_its_places(values, dofs, knot):
    block = halves([7] * 64)
    MODULE._spread(dofs, halves(values), block)
    spread = [value for value in values[:dofs] for _ in range(16)] + [7] * 16 * (4 - dofs)
    assert list(block) == spread
    MODULE._put_knot(dofs, halves(values[::-1]), block, knot)
    assert list(block) == [
        values[::-1][at // 16] if at % 16 == knot and at // 16 < dofs else value for at, value in enumerate(spread)
    ]


@given(values, values, integers(0, 4))
def test_copy_takes_so_many_and_no_more(source, target, count):
    copied = halves(target)
    MODULE._copy_halves(halves(source), copied, count)
    assert list(copied) == source[:count] + target[count:]


def test_processed_dofs_are_counted():
    for dofs, signal, expected in ((1, [0], 0), (3, [1, 0, 1], 2), (2, [1, 0, 1], 1), (16, [1] * 16, 16)):
        assert MODULE._processed(dofs, bytes(signal)) == expected


@st.composite
def exchanges(draw):
    """Return old rows and which old DOFs are processed, and what the new DOFs were: up to 16, each old one at most once."""
    before = draw(st.integers(1, 16))
    rows = draw(st.permutations(range(16)))[:before]
    signal = draw(st.lists(st.booleans(), min_size=before, max_size=before))
    olds = draw(st.permutations([*range(before), *[formats.NEW] * 16]))
    return bytes(rows), bytes(signal), bytes(olds[: draw(st.integers(0, 16))])


@given(exchanges(), st.integers(0, 99))
def test_rows_of_dofs_that_stay_are_kept_and_others_get_free_ones(exchange, seed):
    rows, signal, keep = exchange
    draw = random.Random(seed)
    rest, base = ([draw.randint(0, 32768) for _ in range(16)] for _ in range(2))
    before = [draw.randint(0, 32768) for _ in range(256)]
    given_rows, after, value = bytearray([99] * 16), halves([7] * 256), halves([7] * 16)
    MODULE._match_rows(
        len(keep), keep, signal, rows, given_rows, halves(rest), halves(base), halves(before), after, value
    )
    assert len(set(given_rows[: len(keep)])) == len(keep)
    for dof, was in enumerate(keep):
        is_kept = was != formats.NEW and signal[was]
        start = rest[dof] if was == formats.NEW else base[was]
        assert value[dof] == start
        assert given_rows[dof] == rows[was] if is_kept else given_rows[dof] < 16
        expected = before[16 * was : 16 * was + 16] if is_kept else [start] * 16
        assert list(after[16 * dof : 16 * dof + 16]) == expected
    assert list(given_rows[len(keep) :]) == [99] * (16 - len(keep))


@given(exchanges(), st.lists(values_q15, min_size=16, max_size=16))
def test_dof_that_begins_to_be_processed_was_always_where_it_is(exchange, values):
    rows, signal, keep = exchange
    free = [row for row in range(16) if row not in [rows[was] for was in keep if was != formats.NEW and signal[was]]]
    is_kept = [was != formats.NEW and signal[was] for was in keep]
    row = bytes(rows[was] if kept else free.pop(0) for was, kept in zip(keep, is_kept, strict=True))
    base, third, level = words([-7] * 4096), words([-7] * 4096), words([-7] * 128)
    MODULE._begin_rows(len(keep), keep, signal, row, halves(values), base, third, level)
    untouched = set(range(16))
    for dof, kept in enumerate(is_kept):
        if not kept:
            untouched.discard(row[dof])
            both = values[dof] * 0x10001 - (1 << 32 if values[dof] >> 15 else 0)
            for ring in (base, third):
                assert list(ring[256 * row[dof] : 256 * row[dof] + 256]) == [both] * 256
            assert list(level[dof::16]) == [2 * values[dof] + bands.ZERO_Q16] * 8
        else:
            assert list(level[dof::16]) == [-7] * 8
    for place in untouched:
        assert list(base[256 * place : 256 * place + 256]) == [-7] * 256
