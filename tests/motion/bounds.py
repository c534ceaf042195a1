"""The bounds of `docs/motion.md` for the taps of base and signal, as numbers."""

from typing import NamedTuple

import numpy

from tests.reference_signal import WINDOW, taps

STRONG, WEAK = 1 / 2048, 1 / 128
STRONG_SUM = 1 / 64
"""A DOF's sum of weights, HOLD included, from which the strong bound holds."""

REST, REST_PER_TAP = 1 / 1024, 1 / 2048
MOVING, MOVING_WIDE = 1 / 50, 1 / 15
NARROW_GAIN = 2
"""The greatest gain, of either sign, with which the tighter bound of moving signals holds."""

VALUE_UNIT = 1 / 32768
SNAP_FRAMES = 2
"""By so many frames a gain may come to its target later where it is rounded."""

ROUNDING = 1e-9


def fractions_of_bound(base, expected, weight_sums):
    """Return the greatest error as a fraction of its bound, where the strong one holds and elsewhere (0 if nowhere)."""
    errors = numpy.abs(base - expected)
    is_strong = weight_sums >= STRONG_SUM
    return (errors[is_strong] / STRONG).max(initial=0), (errors[~is_strong] / WEAK).max(initial=0)


class Worst(NamedTuple):
    """The greatest error under one bound, as a fraction of it; where it was, and among how many values."""

    fraction: float = 0.0
    frame: int = -1
    dof: int = -1
    compared: int = 0


def signal_errors(base, signal, expected, relative):
    """Return the `Worst` of a signal by bound: `"rest"`, `"moving"` or `"wide"`, `"flat"`, and `"step"`.

    Arguments are taps [frames, dofs], the reference's `Signal` and per DOF whether it is relative. `"step"` is how much further
    than in the reference the difference of signal and base goes in frames of news. Values are left out that depend on frames
    with faint weights, the past and foreseen ones too, as the base is not held to the strong bound there.
    """
    sums = numpy.concatenate([numpy.full((WINDOW, base.shape[1]), numpy.inf), expected.weight_sums])
    lowest_sums = numpy.lib.stride_tricks.sliding_window_view(sums, WINDOW + 1, axis=0).min(axis=-1)
    is_compared = expected.is_processed & (lowest_sums >= STRONG_SUM)
    errors = numpy.abs(signal - expected.signal)
    is_narrow = numpy.abs(expected.gains).max() <= NARROW_GAIN
    kind, bound = ("moving", MOVING) if is_narrow else ("wide", MOVING_WIDE)

    is_news = numpy.isin(range(len(base)), [frame for frame in expected.news if frame > 0])[1:, None]
    steps = numpy.abs(numpy.diff(signal - base, axis=0)) - numpy.abs(
        numpy.diff(expected.signal - expected.base, axis=0)
    )
    is_flat = (expected.gains == 1).all(axis=1)
    has_been_flat = numpy.array([is_flat[max(n - SNAP_FRAMES, 0) : n + 1].all() for n in range(len(base))])
    units = numpy.where(relative, 2, 1) * VALUE_UNIT + ROUNDING
    return {
        "rest": _worst(errors / rest_bounds(expected.gains)[:, None], is_compared & expected.is_at_rest),
        kind: _worst(errors / bound, is_compared & ~expected.is_at_rest),
        "flat": _worst(numpy.abs(signal - base) / units, has_been_flat[:, None] & expected.is_processed),
        "step": _worst(steps / bound, is_news & is_compared[1:] & is_compared[:-1], first_frame=1),
    }


def rest_bounds(gains):
    """Return the bound of a signal at rest for gains [frames, 7]."""
    found, places = numpy.unique(gains, axis=0, return_inverse=True)
    return numpy.array([REST + REST_PER_TAP * numpy.abs(taps(some)).sum() for some in found])[places.ravel()]


def _worst(fractions, where, first_frame=0):
    shown = numpy.where(where, fractions, 0)
    frame, dof = numpy.unravel_index(shown.argmax(), shown.shape)
    return Worst(max(shown[frame, dof], 0), first_frame + frame, dof, int(where.sum()))
