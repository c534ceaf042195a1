"""What `future` counts and copies, by plain Python, within its arrays."""

from hypothesis import given
from hypothesis import strategies as st

from tests.checked import load_checked
from tests.kernels.values import halves, integers, values_q15

MODULE = load_checked("firmware/future.py")


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
