"""The exchange of tables: every state array is gathered by the list of old places, in checked integers."""

from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, tempos_q16, words

MODULE = load_checked("firmware/exchange.py")
COUNT = 6

any_word = integers(-(1 << 31), (1 << 31) - 1, 0)
any_half = integers(0, 65535)
places = st.lists(st.integers(0, COUNT - 1) | st.just(formats.NEW), min_size=COUNT, max_size=COUNT)
counts = st.integers(0, COUNT)


def lists_of(numbers):
    return st.lists(numbers, min_size=COUNT, max_size=COUNT)


def gathered(values, old, count, fresh):
    new = [fresh if k == formats.NEW else values[k] for k in old[:count]]
    return new + values[count:]


@given(lists_of(any_word), places, counts, any_word)
def test_words_go_where_their_owners_went(values, old, count, fresh):
    found = words(values)
    MODULE.gather_words(found, bytes(old), words([-1] * COUNT), count, fresh)
    assert list(found) == gathered(values, old, count, fresh)


@given(lists_of(any_half), places, counts, any_half)
def test_halves_go_where_their_owners_went(values, old, count, fresh):
    found = halves(values)
    MODULE.gather_halves(found, bytes(old), words([-1] * COUNT), count, fresh)
    assert list(found) == gathered(values, old, count, fresh)


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
