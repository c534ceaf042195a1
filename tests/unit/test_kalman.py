"""A filter's parameters in the MCU's words: their ratio, their ranges, and one behaviour at every frame rate."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.kalman import AGILITY_RANGE, FADE_RANGE_S, NOISE_RANGE, Kalman, kalman_fields
from shared import formats

FADE_ONE = 1 << formats.VALUE_BITS
CORNERS = list(itertools.product(NOISE_RANGE, AGILITY_RANGE, FADE_RANGE_S, (10, 30, 60)))


@pytest.mark.parametrize(("noise", "agility", "fade_s", "rate_hz"), CORNERS)
def test_fields_are_what_the_mcu_takes_at_all_corners(noise, agility, fade_s, rate_hz):
    fields = kalman_fields(Kalman(noise, agility, fade_s), rate_hz)
    assert 1 <= fields["process_q16"] <= formats.VARIANCE_MAX_Q16
    assert 1 <= fields["noise_q16"] <= formats.VARIANCE_MAX_Q16
    assert 0 <= fields["fade_q15"] < FADE_ONE


@given(st.floats(*NOISE_RANGE), st.floats(*AGILITY_RANGE), st.floats(*FADE_RANGE_S), st.integers(10, 60))
def test_fields_keep_the_ratio_of_the_variances(noise, agility, fade_s, rate_hz):
    fields = kalman_fields(Kalman(noise, agility, fade_s), rate_hz)
    process = (
        agility**2 / rate_hz * (1 / rate_hz) ** 2
    )  # white noise of so much a second, over a frame, of a velocity per frame
    rounding = 0.5 / fields["process_q16"] + 0.5 / fields["noise_q16"]
    if fields["noise_q16"] > 1:
        assert fields["process_q16"] / fields["noise_q16"] == pytest.approx(process / noise**2, rel=1.5 * rounding)
    else:
        assert process / noise**2 > 1000, "readings count fully in any case"


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
def test_fade_is_the_same_in_seconds_at_every_frame_rate(rate_hz):
    fade = kalman_fields(Kalman(fade_s=0.25), rate_hz)["fade_q15"] / FADE_ONE
    assert fade**rate_hz == pytest.approx(math.exp(-4), rel=0.001)


def test_fields_of_the_defaults_at_30_frames_a_second():
    # q / r = 3^2 / 30^3 / 0.005^2 = 13.33; after a long silence, with a fade of exp(-1 / 2.4), P11 comes to 2^27
    fields = kalman_fields(Kalman(), 30)
    assert fields["process_q16"] / fields["noise_q16"] == pytest.approx(40 / 3, rel=1e-6)
    assert fields["fade_q15"] == 21602
    p11 = p12 = p22 = 0.0
    for _ in range(500):
        p11, p12, p22 = (value * math.exp(-1 / 1.2) for value in (p11 + 2 * p12 + p22, p12 + p22, p22))
        p11, p12, p22 = (value + fields["process_q16"] * part for value, part in ((p11, 1 / 3), (p12, 1 / 2), (p22, 1)))
    assert p11 + 2 * p12 + p22 + fields["process_q16"] / 3 == pytest.approx(1 << 27, rel=1e-6)
