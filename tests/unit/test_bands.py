"""Where the bands have their peaks, from the kernel alone."""

import cmath
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.bands import centres_hz, hertz, responses

KERNEL = {-2: 1 / 16, -1: 4 / 16, 0: 6 / 16, 1: 4 / 16, 2: 1 / 16}


def gaussian(level):
    """The taps of `G_level` by their distance in frames."""
    taps = {0: 1.0}
    for k in range(level):
        wider: dict[int, float] = {}
        for at, tap in taps.items():
            for m, weight in KERNEL.items():
                wider[at + m * 2**k] = wider.get(at + m * 2**k, 0.0) + tap * weight
        taps = wider
    return taps


GAUSSIANS = [gaussian(level) for level in range(8)]


@given(frequency=st.floats(0, 0.5))
def test_bands_respond_as_their_taps_say(frequency):
    levels = [sum(tap * cmath.exp(2j * cmath.pi * frequency * at) for at, tap in taps.items()) for taps in GAUSSIANS]
    expected = [upper - lower for upper, lower in pairwise(levels)] + levels[-1:]
    assert responses(frequency) == pytest.approx(expected, abs=1e-12)


def test_bands_have_their_peaks_where_the_definition_says():
    assert [hertz(centre) for centre in centres_hz(30)] == ["15", "4.2", "2.0", "0.99", "0.49", "0.25", "0.12"]


@pytest.mark.parametrize("rate_hz", [10, 50, 60])
def test_bands_scale_with_the_frame_rate(rate_hz):
    assert centres_hz(rate_hz) == pytest.approx([centre * rate_hz / 30 for centre in centres_hz(30)])


@pytest.mark.parametrize("band", range(7))
def test_bands_let_less_through_beside_their_peaks(band):
    (peak,) = centres_hz(1)[band : band + 1]
    most = responses(peak)[band]
    others = [responses(place / 5000)[band] for place in range(2501)]
    assert max(others) <= most + 1e-12
    assert responses(min(0.5, peak * 1.1))[band] <= most
    assert responses(peak * 0.9)[band] < most
