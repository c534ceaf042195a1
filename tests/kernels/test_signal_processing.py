"""Gains, corrections and the offset that dies out, against float64, in 32 bits over all levels and gains."""

import math

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, rates_hz, values_q15, words

MODULE = load_checked("firmware/signal_processing.py")
ONE4 = formats.GAIN4_ONE
ZERO_Q16 = load_checked("firmware/bands.py").ZERO_Q16
ZERO_Q20 = MODULE.ZERO_Q20
SIGNAL = b"\1\0\1"
MOST_Q20 = 0xFFFFFF

gains4_q16 = integers(0, 8 << 16, 4 << 16, ONE4, ONE4 + 1, ONE4 - 1)
gain_lists = st.lists(gains4_q16, min_size=formats.BANDS, max_size=formats.BANDS)
offsets_q20 = integers(-MOST_Q20, MOST_Q20, 0, 31, -31)


@given(gain_lists, gain_lists, rates_hz)
def test_gains_move_by_their_share_and_arrive(targets, gains, rate_hz):
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    alpha_q15 = processing._alpha_q15
    share = -math.expm1(-1 / (0.25 * rate_hz))
    assert alpha_q15 == pytest.approx(share * 32768, abs=1)
    moved = words(gains)
    count = MODULE._glide(formats.BANDS, words(targets), moved, alpha_q15, ONE4)
    assert count == sum(gain != ONE4 for gain in moved)
    for target, before, after in zip(targets, gains, moved, strict=True):
        expected = before + (target - before) * alpha_q15 / 32768
        if after == target:
            assert abs(target - expected) < 64 + 9
        else:
            assert abs(after - expected) <= 8 * share + 0.5 + 1e-9  # 4 places less, rounded
            assert abs(after - target) >= 64


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
def test_gains_arrive_within_two_seconds(rate_hz):
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    processing.rest()
    processing.target4_q16[3] = 0
    for _ in range(3 * rate_hz):
        assert processing.glide()
    assert processing.gain4_q16[3] == 0
    processing.target4_q16[3] = ONE4
    gliding = [processing.glide() for _ in range(3 * rate_hz)]
    assert gliding[0] and not gliding[-1]


levels_q16 = st.lists(st.lists(integers(0, 1 << 16), min_size=3, max_size=3), min_size=8, max_size=8)


def levels(rows):
    """Return `level_q16` of three DOFs."""
    return words(value + ZERO_Q16 for row in rows for value in [*row, *[0] * 13])


@given(levels_q16, gain_lists)
def test_correction_is_the_bands_with_gains_less_one(rows, gains):
    corr = words([-7] * 16)
    MODULE._correct(3, SIGNAL, levels(rows), words(gains), ONE4, corr)
    for dof in (0, 2):
        bands = [rows[k][dof] - rows[k + 1][dof] for k in range(7)]
        expected = sum((gain - ONE4) / 65536 * band * 16 for gain, band in zip(gains, bands, strict=True))
        # gains have 12 bits behind the point, half a unit; every product is rounded
        error = sum(abs(band) for band in bands) * 16 * 2.0**-13 + 7 / 2
        assert abs(corr[dof] - ZERO_Q20 - expected) <= error
    assert corr[1] == corr[3] == -7


@given(
    st.lists(values_q15, min_size=3, max_size=3),
    st.lists(integers(-(1 << 24), 1 << 24, 0), min_size=3, max_size=3),
    st.lists(offsets_q20, min_size=3, max_size=3),
    st.lists(offsets_q20.map(lambda rate: rate // 8), min_size=3, max_size=3),
    rates_hz,
)
def test_signal_is_the_base_corrected_and_clipped(base, corrections, offsets, rates, rate_hz):
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    keep, share = processing._keep_q15, processing._share_q15
    assert share == pytest.approx(32768 / (0.15 * rate_hz), abs=0.6)
    assert keep == pytest.approx(32768 * math.exp(-1 / (0.15 * rate_hz)), abs=1)
    both = words([ZERO_Q20] * 32)
    both[0:3] = words(offset + ZERO_Q20 for offset in offsets)
    both[16:19] = words(rate + ZERO_Q20 for rate in rates)
    signal = halves([7] * 4)
    corr = words(number + ZERO_Q20 for number in corrections)
    clipped = MODULE._finish(3, SIGNAL, halves(base), corr, both, keep, share, signal)
    expected_clipped = 0
    for dof in range(3):
        if not SIGNAL[dof]:
            assert (signal[dof], both[dof], both[16 + dof]) == (
                base[dof], offsets[dof] + ZERO_Q20, rates[dof] + ZERO_Q20,
            )  # fmt: skip
            continue
        s, q = share / 32768, keep / 32768
        pull = rates[dof] + offsets[dof] * s
        exact = (offsets[dof] + pull) * q, (rates[dof] - pull * s) * q
        found = both[dof] - ZERO_Q20, both[16 + dof] - ZERO_Q20
        if found == (0, 0):
            assert max(map(abs, exact)) < 32 + 8
        else:
            assert max(abs(a - b) for a, b in zip(found, exact, strict=True)) <= 8  # two units for each product
        value = math.floor((corrections[dof] + found[0]) / 32 + 0.5) + base[dof]
        assert signal[dof] == min(max(value, 0), formats.VALUE_ONE)
        expected_clipped += signal[dof] != value
    assert (clipped, signal[3]) == (expected_clipped, 7)


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
def test_offset_dies_out_critically_damped(rate_hz):
    """`e = e_0 (1 + t / tau) exp(-t / tau)`; over a second, right to 1/200 of the step."""
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    both, signal, start = words([ZERO_Q20] * 32), halves([0]), 1 << 19
    both[0] += start
    for frame in range(1, 3 * rate_hz):
        MODULE._finish(
            1, b"\1", halves([0]), words([ZERO_Q20]), both, processing._keep_q15, processing._share_q15, signal
        )
        t = frame / rate_hz / 0.15
        assert abs((both[0] - ZERO_Q20) / start - (1 + t) * math.exp(-t)) < 1 / 200
    assert (both[0], both[16]) == (ZERO_Q20, ZERO_Q20)


corrections_q20 = integers(-(1 << 23), 1 << 23)


@given(
    st.lists(st.tuples(*[corrections_q20] * 3, offsets_q20, offsets_q20), min_size=3, max_size=3),
    st.sampled_from([10, 30, 60]),
    integers(0, 63, 1),
)
def test_offset_takes_up_what_the_correction_has_lost(entries, rate_hz, age):
    """Entries are `corr` as it was foreseen and is, the step that has been added already, `e` and `v / F`."""
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    left, lost = processing._left_q15[age], processing._lost_q15[age]
    before, after, steps, offsets, rates = (
        words(number + ZERO_Q20 for number in column) for column in zip(*entries, strict=True)
    )
    both = words([*offsets, *[-7] * 13, *rates, *[-7] * 13])
    MODULE._step(3, SIGNAL, before, after, left, lost, steps, both)
    tolerance = 2 if age else 0
    for dof, (was, now, step, off, rate) in enumerate(entries):
        e, v = both[dof] - ZERO_Q20, both[16 + dof] - ZERO_Q20
        if SIGNAL[dof]:
            more = was - now - step
            assert abs(e - numpy.clip(off + more * left / 32768, -MOST_Q20, MOST_Q20)) <= tolerance
            assert abs(v - (rate - more * lost / 32768)) <= tolerance
            assert steps[dof] - ZERO_Q20 == was - now
        else:
            assert (e, v, steps[dof] - ZERO_Q20) == (off, rate, step)


def test_news_find_the_correction_and_the_gains_of_their_frame():
    news, steps, gains = words([-7] * 4), words([-7] * 4), words([-7] * 8)
    MODULE._note(3, words([5, 6, 7, 8]), news, steps, 7, words(range(20, 28)), gains)
    assert (list(news), list(steps)) == ([5, 6, 7, -7], [ZERO_Q20] * 3 + [-7])
    assert list(gains) == [20, 21, 22, 23, 24, 25, 26, -7]


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
def test_offset_that_begins_late_is_what_it_would_be_by_then(rate_hz):
    """`e = (1 + t / tau) exp(-t / tau)` and `v = -t / tau^2 exp(-t / tau)`, up to 63 frames after the news."""
    processing = MODULE.SignalProcessing()
    processing.load(rate_hz)
    for age in range(64):
        t = age / rate_hz / 0.15
        assert abs(processing._left_q15[age] / 32768 - (1 + t) * math.exp(-t)) < 1 / 500
        assert abs(processing._lost_q15[age] / 32768 - t * math.exp(-t) / (0.15 * rate_hz)) < 1 / 500


def test_bypass_lets_the_base_through_and_forgets_offsets():
    offsets, signal = words([5] * 32), halves([9] * 4)
    MODULE._pass(3, halves([1, 32768, 0, 4]), offsets, signal)
    assert list(signal) == [1, 32768, 0, 9]
    assert list(offsets) == ([ZERO_Q20] * 3 + [5] * 13) * 2
