"""The bands of signal processing as frequencies: where each has its peak, and what gains make of the whole.

Source: SPEC section 6, after Bruderlin and Williams: `G_{k+1}` is `G_k` through the kernel `[1 4 6 4 1] / 16` with its taps `2^k`
frames apart, the bands are `L_k = G_k - G_{k+1}`, the filtered motion is `G_7 + sum(gain_k * L_k)`.
"""

from __future__ import annotations

import math
from functools import cache

from shared.formats import BANDS

_GRID = 1 << 12  # places between frequency 0 and half the frame rate at which a peak is looked for
_HALVINGS = 40


def responses(frequency: float) -> list[float]:
    """Return what the bands let through at a frequency in cycles a frame (0..0.5), and last what is below them all.

    They sum to 1. The kernel being symmetric, they are real.
    """
    shares = []
    low = 1.0
    for band in range(BANDS):
        lower = low * _kernel(frequency * 2**band)
        shares.append(low - lower)
        low = lower
    return [*shares, low]


def centres_hz(frame_rate_hz: int) -> tuple[float, ...]:
    """Return the frequency at which each band lets most through, the highest first."""
    return tuple(peak * frame_rate_hz for peak in _peaks())


def hertz(frequency_hz: float) -> str:
    """Return a frequency with two digits, such as 15, 4.2, 2.0 and 0.49."""
    return f"{frequency_hz:#.2g}".rstrip(".")


@cache
def _peaks() -> tuple[float, ...]:
    """Return the peaks of the bands in cycles a frame: the best place of a grid, then by thirds between its neighbours."""
    grid = [responses(place / 2 / _GRID) for place in range(_GRID + 1)]
    peaks = []
    for band in range(BANDS):
        best = max(range(_GRID + 1), key=lambda place: grid[place][band])
        low, high = (min(max(place, 0), _GRID) / 2 / _GRID for place in (best - 1, best + 1))
        for _ in range(_HALVINGS):
            third = (high - low) / 3
            if responses(low + third)[band] < responses(high - third)[band]:
                low += third
            else:
                high -= third
        peaks.append((low + high) / 2)
    return tuple(peaks)


def _kernel(frequency: float) -> float:
    """Return the response of `[1 4 6 4 1] / 16`: `(6 + 8 cos w + 2 cos 2w) / 16`, the fourth power of `cos(w / 2)`."""
    return math.cos(math.pi * frequency) ** 4
