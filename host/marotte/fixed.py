"""Rounding numbers to fixed point."""

from __future__ import annotations

import math
from fractions import Fraction


def fixed(value: float | Fraction, bits: int) -> int:
    """Return `value` with `bits` binary places, rounded to nearest, halves up; exact whatever the value is."""
    return math.floor(Fraction(value) * (1 << bits) + Fraction(1, 2))
