"""The exchange of tables: every state array is gathered by the list of old places; equal functions are found."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, tempos_q16, words

MODULE = load_checked("firmware/exchange.py")
TABLES = load_checked("firmware/tables.py")
COUNT = 6

any_word = integers(-(1 << 31), (1 << 31) - 1, 0)
any_half = integers(0, 65535)
places = st.lists(st.integers(0, COUNT - 1) | st.just(formats.NEW), min_size=COUNT, max_size=COUNT)
counts = st.integers(0, COUNT)
ROWS = 3
rows = st.integers(0, ROWS - 1)
"""An array may have several values for each owner, row by row."""


def lists_of(numbers):
    return st.lists(numbers, min_size=COUNT, max_size=COUNT)


def gathered(values, old, count, fresh):
    new = [fresh if k == formats.NEW else values[k] for k in old[:count]]
    return new + values[count:]


@given(lists_of(any_word), places, counts, any_word, rows)
def test_words_go_where_their_owners_went(values, old, count, fresh, row):
    others = [[n] * COUNT for n in range(ROWS)]
    others[row] = values
    found = words(list(itertools.chain(*others)))
    MODULE.gather_words(found, bytes(old), words([-1] * COUNT), count, fresh, row * COUNT)
    others[row] = gathered(values, old, count, fresh)
    assert list(found) == list(itertools.chain(*others))


@given(lists_of(any_half), places, counts, any_half, rows)
def test_halves_go_where_their_owners_went(values, old, count, fresh, row):
    others = [[n] * COUNT for n in range(ROWS)]
    others[row] = values
    found = halves(list(itertools.chain(*others)))
    MODULE.gather_halves(found, bytes(old), words([-1] * COUNT), count, fresh, row * COUNT)
    others[row] = gathered(values, old, count, fresh)
    assert list(found) == list(itertools.chain(*others))


@given(places, *[lists_of(tempos_q16)] * 4, counts)
def test_tempos_of_what_stays_change_where_the_file_has_changed(old, before, after, tempos, wanted, count):
    after = [before[k] if k != formats.NEW and n % 2 else after[n] for n, k in enumerate(old)]  # many are as before
    found, found_wanted = words(tempos), words(wanted)
    MODULE.settle_tempos(bytes(old), words(before), words(after), count, found, found_wanted)
    for i in range(COUNT):
        if i >= count:
            assert (found[i], found_wanted[i]) == (tempos[i], wanted[i])
        elif old[i] == formats.NEW:
            assert (found[i], found_wanted[i]) == (after[i], after[i])
        else:
            changed = before[old[i]] != after[i]
            assert (found[i], found_wanted[i]) == (tempos[i], after[i] if changed else wanted[i])


def repeats(mappings):
    """Return which mapping each has its value from; `mappings` are (function, argument) of one action."""
    tables = TABLES.Tables()
    tables.first_mapping[1], tables.mapping_count[1] = 3, len(mappings)
    for m, (function, argument) in enumerate(mappings):
        tables.function[3 + m], tables.argument[3 + m] = function, argument
    tables.link_repeats(1)
    return [same - 3 for same in tables.same[3 : 3 + len(mappings)]]


functions = st.tuples(st.integers(0, formats.FUNCTION_RTRIGSIN), st.integers(0, 2))


@given(st.lists(functions, max_size=formats.DOFS_MAX))
def test_equal_functions_of_an_action_are_evaluated_once_but_every_blink_for_itself(mappings):
    assert repeats(mappings) == [
        mappings.index(mapping) if mapping[0] < formats.FUNCTION_BLINK else m for m, mapping in enumerate(mappings)
    ]
