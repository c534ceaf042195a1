"""Character of a DOF, second-order dynamics, as the coefficients with which the MCU steps it from motor tick to motor tick.

The plant is `y + k1*y' + k2*y'' = u + k3*u'` with `k1 = zeta/(pi*f)`, `k2 = 1/(2*pi*f)^2`, `k3 = r*zeta/(2*pi*f)`. Its
state is `y` and `w = y'/omega`, `omega = 2*pi*f`. Within a tick of T seconds the input is a straight line from `u[k]` to
`u[k+1]`, for which the step is exact. With the error `e = u[k] - y[k]` and the slope `d = u[k+1] - u[k]`:

    y[k+1] = y[k] + position_error*e + position_rate*w[k] + position_slope*d
    w[k+1] = w[k] + rate_error*e + rate_rate*w[k] + rate_slope*d

Differences are what is multiplied, so that rounded coefficients leave no error where the puppet stands.

Source: SPEC section 7. On a straight line `u = u0 + s*t` the plant has the solution `u + (k3 - k1)*s`; what deviates from it
follows the matrix exponential of the plant without input, here in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from fractions import Fraction

from marotte.fixed import fixed
from marotte.puppet import Character
from shared import formats


@dataclass(frozen=True)
class Response:
    """The coefficients of one tick, in the order of the wire; each is within -16..16."""

    position_error: float
    position_rate: float
    position_slope: float
    rate_error: float
    rate_rate: float
    rate_slope: float

    def fixed(self) -> dict[str, int]:
        """Return them as the message `character` has them."""
        return {f"{field.name}_q24": fixed(getattr(self, field.name), formats.RESPONSE_BITS) for field in fields(self)}


def response(character: Character, tick_s: float | Fraction) -> Response:
    """Return the coefficients of a character for motor ticks of this length; exact but for float64's rounding."""
    tick_s = float(tick_s)
    omega = 2 * math.pi * character.f_hz
    lead_s = (character.r - 2) * character.zeta / omega  # k3 - k1
    angle = omega * tick_s
    m00, m01, m10, m11 = _transition(angle, character.zeta)
    return Response(
        position_error=1 - m00,
        position_rate=m01,
        position_slope=1 + (lead_s * (1 - m00) - m01 / omega) / tick_s,
        rate_error=-m10,
        rate_rate=m11 - 1,
        rate_slope=((1 - m11) / omega - lead_s * m10) / tick_s,
    )


def _transition(angle: float, zeta: float) -> tuple[float, float, float, float]:
    """Return the exponential of `[[0, 1], [-1, -2*zeta]] * angle`, row by row: how position and rate deviate one tick on.

    With `a = zeta*angle` the matrix is `-a` times the unit matrix plus one whose square is `(zeta^2 - 1)*angle^2` times the unit
    matrix, so that its exponential needs one cosine and one sine, hyperbolic beyond the critical damping of 1.
    """
    damping = zeta * angle
    turn = angle * math.sqrt(abs(zeta * zeta - 1))
    if zeta < 1:
        cosine, sine_ratio = math.cos(turn), math.sin(turn) / turn
    elif zeta > 1:
        cosine, sine_ratio = math.cosh(turn), math.sinh(turn) / turn
    else:
        cosine = sine_ratio = 1.0
    decay = math.exp(-damping)
    rate = decay * sine_ratio * angle
    return (
        decay * (cosine + damping * sine_ratio),
        rate,
        -rate,
        decay * (cosine - damping * sine_ratio),
    )
