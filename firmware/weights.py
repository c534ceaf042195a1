"""Weights: targets arrive at discrete instants and are integrated into continuous change.

Two exponential filters in cascade, so that position and velocity are continuous: first `x += (g - x) * a`, then
`w += (x - w) * a` with the new `x`. The same kernels serve the actions' weights, the live channels, and HOLD: `integrate`
for the frame that is due, `foresee` and `sketch` for those to come, which signal processing wants to know.
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


@micropython.viper
def foresee(
    items: ptr8,
    found: int,
    frames: int,
    target_q28: ptr32,
    x_q28: ptr32,
    w_q28: ptr32,
    rise_q26: ptr32,
    fall_q26: ptr32,
    course_q28: ptr32,
    peak_q28: ptr32,
):
    """Move the listed entries on by up to 16 frames and write down every step: `w` of item `n` in frame `b` is
    `course[16 * n + b]`.

    Each step is that of `integrate`. `peak[n]` is the greatest `w` on the way.
    """
    n = 0
    while n < found:
        i = int(items[n])
        g = target_q28[i]
        x = x_q28[i]
        w = w_q28[i]
        at = n << 4
        end = at + frames
        peak = 0
        if w == g and x == g:
            peak = g
            while at < end:
                course_q28[at] = g
                at += 1
        else:
            while at < end:
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
                if w > peak:
                    peak = w
                course_q28[at] = w
                at += 1
            x_q28[i] = x
            w_q28[i] = w
        peak_q28[n] = peak
        n += 1


@micropython.viper
def sketch(
    items: ptr8,
    found: int,
    knots: int,
    strides: ptr8,
    turn: ptr8,
    turned_q13: int,
    power_q15: ptr16,
    target_q28: ptr32,
    x_q28: ptr32,
    w_q28: ptr32,
    rise_q26: ptr32,
    fall_q26: ptr32,
    course_q28: ptr32,
    peak_q28: ptr32,
):
    """Write down what `w` of the listed entries will be at a few frames to come, each `strides[b]` frames behind the one before.

    `s` steps of both filters at once, `q = 1 - a`: `x' - g = q^s (x - g)`, `w' - g = q^s ((w - g) + s a (x - g))`. After
    `turn[n]` steps item `n` gets the target `turned`; 255 is never. `course` and `peak` are as in `foresee`; nothing else
    changes. `power` is scratch: powers that serve items with the same coefficient. Bits: differences in Q13 within 2^15, powers
    in Q15; where a power is not 0, `s * a * power` is below 3/8.
    """
    cached = 0
    n = 0
    while n < found:
        i = int(items[n])
        g = target_q28[i] >> 15
        x = (x_q28[i] >> 15) - g
        w = (w_q28[i] >> 15) - g
        turns = int(turn[n])
        a = rise_q26[i] if x < 0 else fall_q26[i]
        peak = 0
        power = 32768
        known = 0
        steps = 0
        at = n << 4
        b = 0
        if turns == 255:
            if x == 0 and w == 0:
                peak = g
                while b < knots:
                    course_q28[at + b] = g << 15
                    b += 1
            elif a != cached:
                cached = a
                while b < knots:
                    part = int(strides[b])
                    if part != known:
                        known = part
                        power = 32768
                        square = (0x4000000 - a + 0x400) >> 11
                        k = part
                        while k:
                            if k & 1:
                                power = (power * square + 0x4000) >> 15
                            square = (square * square + 0x4000) >> 15
                            k = k >> 1
                    power_q15[b] = power
                    b += 1
                b = 0
            while b < knots:
                part = int(strides[b])
                power = int(power_q15[b])
                if power:
                    w = ((w + ((((part * ((a + 0x400) >> 11)) >> 6) * x + 0x100) >> 9)) * power + 0x4000) >> 15
                    x = (x * power + 0x4000) >> 15
                else:
                    x = 0
                    w = 0
                k = g + w
                if k < 0:
                    k = 0
                if k > peak:
                    peak = k
                course_q28[at + b] = k << 15
                b += 1
        while b < knots:
            stride = int(strides[b])
            while stride:
                if steps == turns:
                    x += g - turned_q13
                    w += g - turned_q13
                    g = turned_q13
                    turns = 255
                    a = rise_q26[i] if x < 0 else fall_q26[i]
                    known = 0
                part = stride
                if steps < turns and steps + stride > turns and turns < 255:
                    part = turns - steps
                if part != known:
                    known = part
                    power = 32768
                    square = (0x4000000 - a + 0x400) >> 11
                    k = part
                    while k:
                        if k & 1:
                            power = (power * square + 0x4000) >> 15
                        square = (square * square + 0x4000) >> 15
                        k = k >> 1
                if power:
                    w = ((w + ((((part * ((a + 0x400) >> 11)) >> 6) * x + 0x100) >> 9)) * power + 0x4000) >> 15
                    x = (x * power + 0x4000) >> 15
                else:
                    x = 0
                    w = 0
                steps += part
                stride -= part
            k = g + w
            if k < 0:
                k = 0
            if k > peak:
                peak = k
            course_q28[at] = k << 15
            at += 1
            b += 1
        peak_q28[n] = peak << 15
        n += 1
