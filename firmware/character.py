"""Character: second-order dynamics of a DOF, `y + k1 y' + k2 y'' = u + k3 u'`.

With `f`, `zeta` and `r` (`k1 = zeta / (pi f)`, `k2 = 1 / (2 pi f)^2`, `k3 = r zeta / (2 pi f)`) a DOF lags behind, swings
over or takes a run-up. The host solves the equation exactly for an input that is linear within a tick, which is stable for
whatever `f`, `zeta`, `r` and rate: with `e = u - y`, `w = y' / (2 pi f)` and `d` what the input moves in the tick,

    y += c0 e + c1 w + c2 d        w += c3 e + c4 w + c5 d

`w` is of the size of `y`, so nothing is lost to rounding however slow the DOF: what `e` below 2^-17 adds still counts.

Source: SPEC of motor control.
"""

import micropython
from micropython import const

from firmware.tables import words
from shared.formats import DOFS_MAX

_TERMS = const(6)
_ZERO = const(0x10000000)
_LIMIT = const(0x4000000)  # 4 in Q24
_RATE_LIMIT = const(0x8000000)  # 8


@micropython.viper
def _respond(
    input_q24: ptr32,
    output_q24: ptr32,
    before_q24: ptr32,
    rate_q24: ptr32,
    dofs: int,
    used: ptr8,
    coefficient_q24: ptr32,
    operand: ptr32,
):
    """Move every DOF that has a character by one tick; `output` is the input for the others.

    `input`, `output`, `before` (the input of the last tick) and `rate` are Q24 with 16 added, the coefficients too.
    Output saturates at -4..4, rate at -8..8, the input's step at -1..1.
    Bits: an operand has 28 with its sign, in limbs of 14 + 14; a coefficient 29, in limbs of 14 + 15. Products of limbs stay
    below 2^29. With coefficients as the host computes them (2 at most for error and rate, 16 for the slope) the sum of a row
    stays within 2 * 6 + 2 * 8 + 16 = 44 in Q24.
    """
    d = 0
    while d < dofs:
        u = input_q24[d] - _ZERO
        y = u
        if used[d]:
            slope = u - (before_q24[d] - _ZERO)
            if slope > 0x1000000:
                slope = 0x1000000
            if slope < -0x1000000:
                slope = -0x1000000
            y = output_q24[d] - _ZERO
            w = rate_q24[d] - _ZERO
            operand[0] = before_q24[d] - _ZERO - y + _ZERO
            operand[1] = w + _ZERO
            operand[2] = slope + _ZERO
            row = 0
            while row < 2:
                total = 0
                column = 0
                while column < 3:
                    x = operand[column] - _ZERO
                    c = coefficient_q24[d * _TERMS + row * 3 + column] - _ZERO
                    c_high = c >> 15
                    c_low = c & 0x7FFF
                    high = x >> 14
                    low = x & 0x3FFF
                    # x * c / 2^24: high * c_high * 2^29, high * c_low * 2^14, low * c_high * 2^15, low * c_low
                    total += (
                        ((high * c_high) << 5)
                        + ((high * c_low + ((low * c_high) << 1) + ((low * c_low) >> 14) + 0x200) >> 10)
                    )
                    column += 1
                if row == 0:
                    y += total
                else:
                    w += total
                row += 1
            if y > _LIMIT:
                y = _LIMIT
            if y < -_LIMIT:
                y = -_LIMIT
            if w > _RATE_LIMIT:
                w = _RATE_LIMIT
            if w < -_RATE_LIMIT:
                w = -_RATE_LIMIT
            rate_q24[d] = w + _ZERO
        output_q24[d] = y + _ZERO
        before_q24[d] = u + _ZERO
        d += 1


class Character:
    """The dynamics of all DOFs. `output_q24` (with 16 added) is where each of them is led."""

    def __init__(self, tables):
        self.output_q24 = words(DOFS_MAX)
        self._before_q24 = words(DOFS_MAX)
        self._rate_q24 = words(DOFS_MAX)
        self._operand = words(3)
        self._tables = tables

    def stand(self, dof, position_q24):
        """Let a DOF stand at a place."""
        self.output_q24[dof] = self._before_q24[dof] = position_q24 + _ZERO
        self._rate_q24[dof] = _ZERO

    def rearrange(self, gather_words, keep, scratch, dofs):
        """Let other tables have other DOFs."""
        gather_words(self.output_q24, keep, scratch, dofs, _ZERO, 0)
        gather_words(self._before_q24, keep, scratch, dofs, _ZERO, 0)
        gather_words(self._rate_q24, keep, scratch, dofs, _ZERO, 0)

    def load(self, tables):
        """Take over which DOFs have a character, and its coefficients; a tick may come at any time."""
        self._tables = tables

    def respond(self, dofs, input_q24):
        """Take the step of one tick towards the input, which is Q24 with 16 added."""
        tables = self._tables
        # fmt: off
        _respond(
            input_q24, self.output_q24, self._before_q24, self._rate_q24, dofs, tables.has_character,
            tables.response_q24, self._operand,
        )
        # fmt: on
