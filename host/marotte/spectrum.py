"""The spectrum of a course of values, in bins of a sixth of an octave. Needs numpy, which comes along with matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence

BINS_PER_OCTAVE = 6


def spectrum(values: Sequence[float], rate_hz: float) -> tuple[list[float], list[float]]:
    """Return frequencies in Hz and the amplitudes there, those of a sixth of an octave each put together.

    The mean is taken away and a Hann window applied. The sum of the squares is that of the motion. A sine of amplitude `a` gives
    `a` at its frequency, or somewhat less where a sixth of an octave is narrower than the window's three lines.
    """
    import numpy as np

    count = len(values)
    window = np.hanning(count + 1)[:-1]
    if not window.any():
        return [], []
    # The window spreads a sine over several lines; with this scale their squares sum up to that of its amplitude.
    scale = 2 / math.sqrt(count * np.square(window).sum())
    lines = np.abs(np.fft.rfft((np.asarray(values) - np.mean(values)) * window))[1:] * scale
    frequencies = np.fft.rfftfreq(count, 1 / rate_hz)[1:]
    bins = np.round(np.log2(frequencies * count / rate_hz) * BINS_PER_OCTAVE)
    centres = [float(np.exp(np.log(frequencies[bins == each]).mean())) for each in np.unique(bins)]
    amplitudes = [float(np.sqrt(np.square(lines[bins == each]).sum())) for each in np.unique(bins)]
    return centres, amplitudes
