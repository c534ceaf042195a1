"""The load that a budget counts with, by plain Python."""

from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers

MODULE = load_checked("firmware/budget.py")


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
