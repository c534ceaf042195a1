"""Hypothesis strategies for the fixed-point numbers that kernels get, their ends included, and arrays of them."""

from array import array

from hypothesis import strategies as st

from shared import formats

ALPHA_LAST = formats.ALPHA_ONE - 1
HALF_CYCLE_Q28 = (1 << 27) + (1 << 18)  # and the margin of 1/1024 that tempo matching leaves


def integers(least, greatest, *others):
    """Integers of a range in which the ends, and others of interest, come up often."""
    ends = sorted(
        number for number in {least, least + 1, greatest - 1, greatest, *others} if least <= number <= greatest
    )
    return st.sampled_from(ends) | st.integers(least, greatest)


weights_q28 = integers(0, formats.WEIGHT_MAX, formats.WEIGHT_ONE, formats.SNAP_Q28, formats.FAINT_Q28)
alphas_q26 = integers(1, ALPHA_LAST)
values_q15 = integers(0, formats.VALUE_ONE, formats.VALUE_ONE // 2)
tempos_q16 = integers(formats.TEMPO_MIN_Q16, formats.TEMPO_MAX_Q16, formats.TEMPO_ONE)
master_tempos_q16 = integers(formats.MASTER_TEMPO_MIN_Q16, formats.MASTER_TEMPO_MAX_Q16, formats.TEMPO_ONE)
rates_hz = integers(formats.FRAME_RATE_MIN_HZ, formats.FRAME_RATE_MAX_HZ, 30)
cycles = integers(0, formats.CYCLES - 1)
offsets_q28 = integers(-HALF_CYCLE_Q28, HALF_CYCLE_Q28, 0)
fractions_q24 = integers(0, (1 << formats.PHASE_BITS) - 1, 1 << 22, 1 << 23, 3 << 22)


def words(values):
    """Return an array of signed 32-bit words."""
    return array("i", values)


def halves(values):
    """Return an array of unsigned 16-bit words."""
    return array("H", values)
