"""Rows of the rings under other tables, by plain Python, within their arrays."""

import random

from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, values_q15, words

bands = load_checked("firmware/bands.py")
MODULE = load_checked("firmware/rings.py")


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
