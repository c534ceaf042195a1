"""Weights: targets arrive at discrete instants and are integrated into continuous change.

Two exponential filters in cascade, so that position and velocity are continuous: first `x += (g - x) * a`, then
`w += (x - w) * a` with the new `x`. The same kernel serves the actions' weights, the live channels, and HOLD.
"""

import micropython


@micropython.viper
def integrate(count: int, target_q28: ptr32, x_q28: ptr32, w_q28: ptr32, rise_q26: ptr32, fall_q26: ptr32):
    """Move `x` and `w` of every entry one frame towards its target.

    All arrays are Q28 in 0..4 (0..2^30), the coefficients `1 - exp(-1 / (F * tau))` in Q26 below 1. `rise` holds while
    the target is above `x`. A value nearer than 2^-18 to where it goes arrives. Bits: a difference has 31 with its
    sign; times 26, in limbs of 16 + 15 and 13 + 13, no product passes 2^29 and no sum 2^31.
    """
    i = 0
    while i < count:
        g = target_q28[i]
        x = x_q28[i]
        w = w_q28[i]
        if w != g or x != g:
            difference = g - x
            a = rise_q26[i] if difference > 0 else fall_q26[i]
            a_high = a >> 13
            a_low = a & 0x1FFF
            high = difference >> 15
            low = difference & 0x7FFF
            x = (
                x
                + ((high * a_high) << 2)
                + ((((high * a_low) << 2) + low * a_high + ((low * a_low) >> 13) + 0x1000) >> 13)
            )
            difference = x - w
            high = difference >> 15
            low = difference & 0x7FFF
            w = (
                w
                + ((high * a_high) << 2)
                + ((((high * a_low) << 2) + low * a_high + ((low * a_low) >> 13) + 0x1000) >> 13)
            )
            difference = g - x
            if -1024 < difference and difference < 1024:
                x = g
                difference = g - w
                if -1024 < difference and difference < 1024:
                    w = g
            x_q28[i] = x
            w_q28[i] = w
        i += 1
