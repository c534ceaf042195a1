"""Prediction of a live channel: a Kalman filter's parameters as the puppet's file has them, and as the MCU has them.

The filter takes a channel's targets for readings of a stick that moves at a constant velocity but for a random walk of that.
Its gains depend on the ratio of two variances alone, so both travel in a unit chosen to fit the MCU's words.

Source: SPEC section 6; `firmware/kalman.py` has the equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from shared import formats

NOISE_RANGE = (0.0005, 0.1)
AGILITY_RANGE = (0.1, 20)
FADE_RANGE_S = (0.02, 1)

_NOISE_MAX_Q16 = formats.VARIANCE_MAX_Q16 // 2
_COVARIANCE_MAX_Q16 = 1 << 27
"""Half of what the MCU lets covariances grow to: readings that come and go make a little more than a long silence does."""


@dataclass(frozen=True)
class Kalman:
    """How a live channel is predicted."""

    noise: float = 0.005
    """Standard deviation of a reading, in units of the channel (0..1): tremor and the steps of the stick's converter."""
    agility: float = 3.0
    """How much the stick's velocity changes in a second, as a standard deviation, in units a second: more follows quicker and
    trembles more."""
    fade_s: float = 0.08
    """Time constant with which the velocity dies out, in what is predicted and while nothing arrives."""


def kalman_fields(kalman: Kalman, frame_rate_hz: int) -> dict[str, int]:
    """Return `process_q16`, `noise_q16` and `fade_q15` as the message `live` has them."""
    fade = math.exp(-1 / (frame_rate_hz * kalman.fade_s))
    process = kalman.agility**2 / frame_rate_hz**3  # of a velocity per frame, in a frame
    noise = kalman.noise**2
    unit = max(noise / _NOISE_MAX_Q16, process * _growth(fade) / _COVARIANCE_MAX_Q16)
    return {
        "process_q16": max(round(process / unit), 1),
        "noise_q16": max(round(noise / unit), 1),
        "fade_q15": min(round(fade * (1 << formats.VALUE_BITS)), (1 << formats.VALUE_BITS) - 1),
    }


def _growth(fade: float) -> float:
    """Return what the position's variance, by that of the process, comes to in the frame that ends a long silence."""
    kept = fade * fade
    p22 = 1 / (1 - kept)
    p12 = (kept * p22 + 0.5) / (1 - kept)
    p11 = (kept * (2 * p12 + p22) + 1 / 3) / (1 - kept)
    return p11 + 2 * p12 + p22 + 1 / 3
