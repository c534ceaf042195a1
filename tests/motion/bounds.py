"""The bounds of `docs/motion.md` for the base tap, as numbers."""

import numpy

STRONG, WEAK = 1 / 2048, 1 / 128
STRONG_SUM = 1 / 64
"""A DOF's sum of weights, HOLD included, from which the strong bound holds."""


def fractions_of_bound(base, expected, weight_sums):
    """Return the greatest error as a fraction of its bound, where the strong one holds and elsewhere (0 if nowhere)."""
    errors = numpy.abs(base - expected)
    is_strong = weight_sums >= STRONG_SUM
    return (errors[is_strong] / STRONG).max(initial=0), (errors[~is_strong] / WEAK).max(initial=0)
