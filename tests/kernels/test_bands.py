"""The bands' cascade over its ring against the definition in float64, and what is stored in the rings, in 32 bits."""

import random

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, values_q15, words

MODULE = load_checked("firmware/bands.py")
TAPS = MODULE.tap_table()
ONE = formats.VALUE_ONE
RING = 512
KERNEL = numpy.array([1, 4, 6, 4, 1]) / 16
KNOTS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 162, 254)
ROW = bytes([2, 0, 1])
"""Rows of three DOFs, of which the middle one is not processed."""
SIGNAL = b"\1\0\1"
frames = integers(0, (1 << 30) - 1, 511, 512)


def levels_of(values):
    """Return `G_0 .. G_7` of a ring of values, all places of it."""
    levels = [values]
    for k in range(7):
        levels.append(
            sum(part * numpy.roll(levels[-1], -m * 2**k) for m, part in zip(range(-2, 3), KERNEL, strict=True))
        )
    return levels


def rings(seed):
    """Return a ring of values in Q15 for each of three rows: noise, corners, and steps, in an order of their own."""
    draw = random.Random(seed)
    noise = [draw.randint(0, ONE) for _ in range(RING)]
    corners = [draw.choice([0, ONE]) for _ in range(RING)]
    level = 0
    steps = [level := draw.choice([level] * 40 + [0, ONE, draw.randint(0, ONE)]) for _ in range(RING)]
    return halves(value for row in draw.sample([noise, corners, steps], 3) for value in row)


def row_of(ring, dof):
    """Return the row of a DOF."""
    return ring[ROW[dof] * RING : ROW[dof] * RING + RING]


def test_taps_are_the_kernels_from_their_middle_on():
    found = []
    taps = numpy.array([1.0])
    for k in range(4):
        spread = numpy.zeros(4 * 2**k + 1)
        spread[:: 2**k] = KERNEL
        taps = numpy.convolve(taps, spread)
        found.extend(taps[len(taps) // 2 :] * 16 ** (k + 1))
    assert list(TAPS) == found
    assert len(TAPS) == 3 + 7 + 15 + 31


@given(frames, integers(1, 17), st.integers(0, 9))
def test_smoothing_is_three_times_the_kernel_wherever_the_ring_begins(first, count, seed):
    base = rings(seed)
    third = halves([7] * 3 * RING)
    before = base[:]
    MODULE.smooth(base, third, ROW, 3, SIGNAL, first, count, words([-1] * 41))
    assert base == before
    for dof in range(3):
        expected = levels_of(numpy.array(row_of(base, dof), float))[3]
        written = {(first + n) % RING for n in range(count)} if SIGNAL[dof] else set()
        for place, value in enumerate(row_of(third, dof)):
            assert abs(value - expected[place]) <= 0.5 if place in written else value == 7


@given(frames, st.integers(0, 9))
def test_levels_of_a_frame_are_the_cascade(frame, seed):
    """`G_3` is rounded to Q15, half a unit, and so are the levels above to Q16 (`G_2` by less places, then half a unit)."""
    base = rings(seed)
    third = halves([0] * 3 * RING)
    for first in range(0, RING, 16):
        MODULE.smooth(base, third, ROW, 3, b"\1\1\1", first, 16, words([-1] * 41))
    before = base[:], third[:]
    level = words([-7] * 8 * 16)
    MODULE.split(base, third, ROW, 3, SIGNAL, frame, TAPS, level)
    assert (base, third) == before
    for dof in range(16):
        found = [level[16 * k + dof] for k in range(8)]
        if dof >= 3 or not SIGNAL[dof]:
            assert found == [-7] * 8
            continue
        expected = [2 * values[frame % RING] for values in levels_of(numpy.array(row_of(base, dof), float))]
        for k, error in enumerate((0, 0.5, 0.5, 1, 1.5, 1.5, 1.5, 1.5)):
            assert abs(found[k] - MODULE.ZERO_Q16 - expected[k]) <= error


def test_levels_of_a_pose_are_the_pose():
    for value in (0, 1, ONE // 2, ONE - 1, ONE):
        level = words([-7] * 8 * 16)
        MODULE.split(halves([value] * RING), halves([value] * RING), b"\0", 1, b"\1", 300, TAPS, level)
        assert [level[16 * k] - MODULE.ZERO_Q16 for k in range(8)] == [2 * value] * 8


blocks = st.lists(values_q15, min_size=48, max_size=48)


@given(blocks, blocks, integers(1, 16), st.sets(integers(0, 2)))
def test_change_at_the_knots_is_noted_and_counted(after, before, knots, still):
    for dof in still:
        after[16 * dof : 16 * dof + knots] = before[16 * dof : 16 * dof + knots]
    delta, changed = words([-7] * 48), bytearray(3)
    count = MODULE.differ(3, SIGNAL, knots, halves(after), halves(before), delta, changed)
    for dof in range(3):
        differences = [after[16 * dof + b] - before[16 * dof + b] for b in range(knots)]
        expected = [difference + 65536 for difference in differences] if SIGNAL[dof] else [-7] * knots
        assert list(delta[16 * dof : 16 * dof + 16]) == expected + [-7] * (16 - knots)
        assert changed[dof] == (SIGNAL[dof] and any(differences))
    assert count == sum(changed)


@given(
    frames,
    integers(0, 271, 254, 255),
    st.lists(integers(-ONE, ONE), min_size=48, max_size=48),
    st.integers(0, 9),
    st.integers(0, 3),
    integers(0, 9),
    integers(1, 16),
)
def test_rings_follow_a_change_from_knot_to_knot(frame, count, deltas, seed, first_dof, first_knot, knots):
    first_knot = min(first_knot, knots - 1)
    base, third = rings(seed), rings(seed + 10)
    rows = base[:], third[:]
    delta = words(number + 65536 for number in deltas)
    MODULE.bend(
        base, third, ROW, 3, SIGNAL, first_dof, frame, frame + count, bytes(KNOTS[:knots]), first_knot, knots, delta
    )
    first = KNOTS[first_knot]
    for dof in range(3):
        change = numpy.interp(numpy.arange(RING), KNOTS[:knots], deltas[16 * dof : 16 * dof + knots])
        for after, before in zip((base, third), rows, strict=True):
            expected = numpy.array(row_of(before, dof), float)
            if SIGNAL[dof] and dof >= first_dof:
                places = numpy.arange(frame + first, frame + count) % RING
                expected[places] = numpy.clip(expected[places] + change[first:count], 0, ONE)
                # Half a unit; and a slope is cut off at 2^-8, which comes to 92 of these between the last knots.
                errors = numpy.abs(numpy.array(row_of(after, dof))[places] - expected[places])
                assert numpy.all(errors <= 0.5 + 92 / 256)
                others = numpy.setdiff1d(numpy.arange(RING), places)
                assert numpy.array_equal(numpy.array(row_of(after, dof))[others], expected[others])
            else:
                assert row_of(after, dof) == row_of(before, dof)


@given(frames, integers(0, 16), blocks, st.integers(0, 9))
def test_block_is_stored_in_the_ring(first, count, block, seed):
    base = rings(seed)
    expected = base[:]
    for dof in (0, 2):
        for n in range(count):
            expected[ROW[dof] * RING + (first + n) % RING] = block[16 * dof + n]
    MODULE.put_block(base, ROW, 3, SIGNAL, first, count, halves(block))
    assert base == expected


@pytest.mark.parametrize(("stride", "at"), [(1, 0), (16, 15)])
@given(first=frames, count=integers(0, RING), block=blocks, seed=st.integers(0, 9))
def test_rings_are_filled_with_a_value_per_dof(stride, at, first, count, block, seed):
    base, third = rings(seed), rings(seed + 10)
    expected = base[:], third[:]
    for ring in expected:
        for dof in (0, 2):
            for n in range(count):
                ring[ROW[dof] * RING + (first + n) % RING] = block[at + stride * dof]
    MODULE.fill(base, third, ROW, 3, SIGNAL, first, count, halves(block), stride, at)
    assert (base, third) == expected


@given(frames, st.lists(values_q15, min_size=3, max_size=3), st.integers(0, 9))
def test_column_of_the_ring_is_stored_and_read(frame, values, seed):
    base = rings(seed)
    expected = base[:]
    for dof in range(3):
        expected[ROW[dof] * RING + frame % RING] = values[dof]
    found = halves([9] * 4)
    MODULE.put_column(base, ROW, 3, frame, halves(values))
    assert base == expected
    MODULE.column(base, ROW, 3, frame, found)
    assert list(found) == [*values, 9]
