"""The motion's oracle for the signal tap: seven bands of the base, amplified each by its own gain, in float64.

Written from the definitions of `docs/motion.md` alone, in the form of a cascade, and sharing no code with `firmware`, `shared`
or `host`. The future of the base comes from `tests.reference_future`.

Readings where the definitions leave a choice:
- All gains are 1 at first.
- News is a cue that sets weights, live channels or a tempo, even where it sets what was set before; band gains are none, as
  the base does not depend on them.
- Both parts of a step of the offset are taken before the signal is clamped.
"""

import itertools
import math
from typing import NamedTuple

import numpy

from tests.reference_future import FarSightedPuppet

BANDS = 7
WINDOW = 254
"""Frames of the past, and of the future, that the lowest bands need."""

KERNEL = {-2: 1 / 16, -1: 4 / 16, 0: 6 / 16, 1: 4 / 16, 2: 1 / 16}
_GAIN_TAU_S = 0.25
_GAIN_SNAP = 2.0**-10
_OFFSET_TAU_S = 0.15


class Signal(NamedTuple):
    """What the definitions demand of some frames; arrays begin with the frame.

    base, signal: values [frames, dofs].
    gains: the gains in force [frames, 7], highest band first.
    offset: what carries the signal over news [frames, dofs].
    is_clamped: whether the signal would have left its range [frames, dofs].
    is_at_rest: whether the last news is 254 frames ago and the DOF's weights and all gains are at their targets [frames, dofs].
    weight_sums: the lowest sum of a DOF's weights, HOLD included, in the frame and all that were foreseen in it [frames, dofs].
    news: frames in which something arrived.
    is_processed: per DOF whether it has signal processing; elsewhere the signal is the base.
    is_decided: whether the reference's decisions were clear; see `ReferencePuppet.is_decided`.
    """

    base: numpy.ndarray
    signal: numpy.ndarray
    gains: numpy.ndarray
    offset: numpy.ndarray
    is_clamped: numpy.ndarray
    is_at_rest: numpy.ndarray
    weight_sums: numpy.ndarray
    news: list
    is_processed: numpy.ndarray
    is_decided: bool


def render_signal(puppet, score, frames):
    """Return the `Signal` of the first frames of a score; `puppet` and `score` are valid files as `tomllib` gives them."""
    reference = FarSightedPuppet(puppet, score)
    news = sorted(n for n, cues in reference.cues.items() if n < frames and any(is_news(cue, puppet) for cue in cues))
    gains, gains_rest = glide(gain_targets(puppet, reference.cues, frames), reference.frame_rate)
    shape = frames, len(reference.dofs)
    base, weight_sums, corrections, steps = (numpy.zeros(shape) for _ in range(4))
    weights_rest = numpy.empty(shape, bool)
    foretold = None
    for start, end in itertools.pairwise([*sorted({0, *news}), frames]):
        # As far as frame `end` is foretold to see in the frame before it.
        future, sums_ahead = _play(reference, slice(start, end), base, weight_sums, weights_rest)
        past = base[numpy.arange(start - WINDOW, start + 1).clip(0)]
        bands = band_pass(numpy.concatenate([past, future]))
        corrections[start:end] = apply_gains(bands[:-1], gains[start:end]) - base[start:end]
        if foretold:
            bands_foretold, base_foretold = foretold
            steps[start] = apply_gains(bands_foretold, gains[start : start + 1])[0] - base_foretold - corrections[start]
        foretold = bands[-1:], future[end - start - 1]
        for n in range(start, end):
            in_sight = sums_ahead[n - start : n - start + WINDOW]
            weight_sums[n] = numpy.minimum(weight_sums[n], in_sight.min(axis=0))
    offset = settle(steps, (gains == 1).all(axis=1), reference.frame_rate)
    lowest = [-1 if dof.get("kind") == "relative" else 0 for dof in puppet["dof"].values()]
    wanted = base + corrections + offset
    is_processed = numpy.array(reference.is_processed)
    signal = numpy.where(is_processed, wanted.clip(lowest, 1), base)
    since_news = [n - max((frame for frame in news if frame <= n), default=0) for n in range(frames)]
    return Signal(
        base=base,
        signal=signal,
        gains=gains,
        offset=numpy.where(is_processed, offset, 0),
        is_clamped=is_processed & (wanted != signal),
        is_at_rest=weights_rest & (gains_rest & (numpy.array(since_news) >= WINDOW))[:, None],
        weight_sums=weight_sums,
        news=news,
        is_processed=is_processed,
        is_decided=reference.is_decided(),
    )


def _play(reference, stretch, base, weight_sums, weights_rest):
    """Write a stretch of frames that only its first brings news to; return what is foretold in that one.

    That are base and sums of weights of the rest of the stretch and the 255 frames after it.
    """
    for n in range(stretch.start, stretch.stop):
        base[n] = reference.step()
        weight_sums[n] = reference.weight_sums
        weights_rest[n] = reference.weights_rest
        if n == stretch.start:
            ahead = reference.foresee(stretch.stop - stretch.start + WINDOW)
    return ahead


def is_news(cue, puppet):
    """Return whether a cue sets what the base depends on; a mood does if it has a tempo."""
    has_tempo = "tempo" in cue or "tempo" in puppet.get("mood", {}).get(cue.get("mood"), {})
    return has_tempo or any(key in cue for key in ("behaviour", "weights", "live"))


def gain_targets(puppet, cues, frames):
    """Return the targets of the seven gains, [frames, 7], that cues by frame set; a mood without gains sets all to 1."""
    targets = numpy.ones((frames, BANDS))
    for frame in sorted(frame for frame in cues if frame < frames):
        for cue in cues[frame]:
            if "mood" in cue:
                targets[frame:] = puppet["mood"][cue["mood"]].get("gains", [1] * BANDS)
            if "gains" in cue:
                targets[frame:] = cue["gains"]
    return targets


def glide(targets, frame_rate):
    """Return the gains [frames, 7] that follow their targets from 1 on, and whether all have arrived [frames]."""
    a = 1 - math.exp(-1 / (frame_rate * _GAIN_TAU_S))
    gains = numpy.empty_like(targets)
    gain = numpy.ones(BANDS)
    for n, target in enumerate(targets):
        gain = gain + (target - gain) * a
        gain = numpy.where(abs(target - gain) < _GAIN_SNAP, target, gain)
        gains[n] = gain
    return gains, (gains == targets).all(axis=1)


def low_pass(values, k):
    """Return the frames of `G_{k+1}` that can be had of those of `G_k`: 2 * 2^k fewer at either end."""
    margin = 2 << k
    frames = len(values) - 2 * margin
    return sum(weight * values[margin + (m << k) : margin + (m << k) + frames] for m, weight in KERNEL.items())


def band_pass(values):
    """Return `L_0` .. `L_6` and `G_7` of some frames, [frames - 508, 8, ...]: for the first and last 254 there are none."""
    frames = len(values) - 2 * WINDOW
    bands = []
    margin = WINDOW
    for k in range(BANDS):
        lower = low_pass(values, k)
        band = values[2 << k : len(values) - (2 << k)] - lower
        margin -= 2 << k
        bands.append(band[margin : margin + frames])
        values = lower
    return numpy.stack([*bands, values], axis=1)


def apply_gains(bands, gains):
    """Return `G_7 + sum gain_k * L_k` of some frames."""
    return bands[:, BANDS] + numpy.einsum("nk,nk...->n...", gains, bands[:, :BANDS])


def taps(gains):
    """Return the 509 taps of the filter with these gains, from 254 frames ago to 254 frames ahead."""
    impulse = numpy.zeros(4 * WINDOW + 1)
    impulse[2 * WINDOW] = 1
    bands = band_pass(impulse)
    return apply_gains(bands, numpy.broadcast_to(gains, (len(bands), BANDS)))


def settle(steps, is_flat, frame_rate):
    """Return the offset [frames, dofs] of steps that die out critically damped; 0 where `is_flat`: all gains are 1."""
    k = math.exp(-1 / (frame_rate * _OFFSET_TAU_S))
    offsets = numpy.empty_like(steps)
    e = v = numpy.zeros(steps.shape[1:])
    for n, step in enumerate(steps):
        slope = v + e / _OFFSET_TAU_S
        e, v = k * (e + slope / frame_rate), k * (v - slope / (frame_rate * _OFFSET_TAU_S))
        e = e + step
        if is_flat[n]:
            e = v = numpy.zeros_like(e)
        offsets[n] = e
    return offsets
