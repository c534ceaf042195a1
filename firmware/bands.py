"""Seven frequency bands: the cascade of Bruderlin and Williams over past and future at once.

`G_0` is the base, `G_{k+1}(n) = sum kernel(m) * G_k(n + m * 2^k)` with the kernel `[1 4 6 4 1] / 16`, m = -2..2; the band `k` is
`G_k - G_{k+1}`. Frame `n` needs `G_1 .. G_7` at `n` alone. All of them from `G_3` on are symmetric filters of `G_3` at every
eighth frame, of 5, 13, 29 and 61 taps, so two rings are kept: the base from the past through the present to the future, and its
`G_3`. That takes 38 products per DOF and frame where a filter of the base takes 255.

Source: SPEC of motion signal processing; Bruderlin and Williams, Motion Signal Processing (1995).
"""

from array import array

import micropython
from micropython import const

from shared.formats import BANDS

LEVELS = BANDS + 1  # G_0 .. G_7
REACH = 2 * (2**BANDS - 1)  # frames that the lowest band looks ahead and back
THIRD_REACH = 14  # of G_3
RING = 512  # frames in a ring
ZERO_Q16 = 1 << 20  # what is added to levels, which changes may bring below 0

_RING = const(511)
_DOFS = const(16)
_ZERO = const(0x100000)
_DELTA_ZERO = const(0x10000)


def _kernels(count):
    """Return `c_0 .. c_count` as lists of integers around their middle: `c_k` has sum 16^k and 2^(k+2) - 3 taps."""
    kernels = [[1]]
    for k in range(count):
        before = kernels[-1]
        kernel = [0] * (len(before) + 4 * 2**k)
        for n, part in enumerate((1, 4, 6, 4, 1)):
            for place, value in enumerate(before):
                kernel[place + n * 2**k] += part * value
        kernels.append(kernel)
    return kernels


def tap_table():
    """Return the halves of `c_1 .. c_4` from their middle on, 3 + 7 + 15 + 31 words, times 16, 16^2, 16^3, 16^4. Allocates."""
    table = array("i")
    for kernel in _kernels(4)[1:]:
        for value in kernel[len(kernel) // 2 :]:
            table.append(value)
    return table


@micropython.viper
def smooth(base_q15: ptr16, third_q15: ptr16, row: ptr8, dofs: int, signal: ptr8, first: int, frames: int, scratch: ptr32):
    """Compute `G_3` anew from the base's ring, of the frames `first .. first + frames - 1`, up to 17.

    Three times the kernel, in place in `scratch`, 41 words. Bits: Q15 becomes Q19, Q23, Q27.
    """
    d = 0
    while d < dofs:
        if signal[d]:
            at = int(row[d]) << 9
            n = first - 14
            k = frames + 24
            i = 0
            a = int(base_q15[at + (n & _RING)])
            b = int(base_q15[at + ((n + 1) & _RING)])
            c = int(base_q15[at + ((n + 2) & _RING)])
            e = int(base_q15[at + ((n + 3) & _RING)])
            n += 4
            while i < k:
                g = int(base_q15[at + (n & _RING)])
                scratch[i] = a + g + ((b + e) << 2) + 6 * c
                a = b
                b = c
                c = e
                e = g
                n += 1
                i += 1
            k = frames + 16
            i = 0
            while i < k:
                scratch[i] = scratch[i] + scratch[i + 8] + ((scratch[i + 2] + scratch[i + 6]) << 2) + 6 * scratch[i + 4]
                i += 1
            i = 0
            while i < frames:
                g = scratch[i] + scratch[i + 16] + ((scratch[i + 4] + scratch[i + 12]) << 2) + 6 * scratch[i + 8]
                third_q15[at + ((first + i) & _RING)] = (g + 0x800) >> 12
                i += 1
        d += 1


@micropython.viper
def split(
    base_q15: ptr16, third_q15: ptr16, row: ptr8, dofs: int, signal: ptr8, frame: int, taps: ptr32, level_q16: ptr32
):
    """Write `G_0 .. G_7` of a frame to 8 x 16 words, in Q16 with 2^20 added.

    `taps` is `tap_table`. Bits: `G_3` with 1/2 subtracted is within 2^14, pairs of it within 2^15, taps have the sum 2^16.
    """
    d = 0
    while d < dofs:
        if signal[d]:
            at = int(row[d]) << 9
            a = int(base_q15[at + (frame & _RING)])
            level_q16[d] = (a << 1) + _ZERO
            pair = int(base_q15[at + ((frame + 1) & _RING)]) + int(base_q15[at + ((frame - 1) & _RING)])
            pair_2 = int(base_q15[at + ((frame + 2) & _RING)]) + int(base_q15[at + ((frame - 2) & _RING)])
            level_q16[_DOFS + d] = ((6 * a + (pair << 2) + pair_2 + 4) >> 3) + _ZERO
            a = a * taps[3] + pair * taps[4] + pair_2 * taps[5]
            j = 3
            while j < 7:
                a += taps[3 + j] * (
                    int(base_q15[at + ((frame + j) & _RING)]) + int(base_q15[at + ((frame - j) & _RING)])
                )
                j += 1
            level_q16[2 * _DOFS + d] = ((a + 0x40) >> 7) + _ZERO
            a = int(third_q15[at + (frame & _RING)])
            level_q16[3 * _DOFS + d] = (a << 1) + _ZERO
            a -= 16384
            b = a * taps[3]
            c = a * taps[10]
            e = a * taps[25]
            a = a * taps[0]
            j = 1
            while j < 31:
                pair = (
                    int(third_q15[at + ((frame + (j << 3)) & _RING)])
                    + int(third_q15[at + ((frame - (j << 3)) & _RING)])
                    - 32768
                )
                e += taps[25 + j] * pair
                if j < 15:
                    c += taps[10 + j] * pair
                    if j < 7:
                        b += taps[3 + j] * pair
                        if j < 3:
                            a += taps[j] * pair
                j += 1
            level_q16[4 * _DOFS + d] = ((a + 4) >> 3) + 32768 + _ZERO
            level_q16[5 * _DOFS + d] = ((b + 0x40) >> 7) + 32768 + _ZERO
            level_q16[6 * _DOFS + d] = ((c + 0x400) >> 11) + 32768 + _ZERO
            level_q16[7 * _DOFS + d] = ((e + 0x4000) >> 15) + 32768 + _ZERO
        d += 1


@micropython.viper
def differ(
    dofs: int, signal: ptr8, knots: int, after_q15: ptr16, before_q15: ptr16, delta_q15: ptr32, changed: ptr8
) -> int:
    """Write what has changed at the knots, 16 places per DOF, with 2^16 added; mark and count the DOFs of which anything has."""
    count = 0
    d = 0
    while d < dofs:
        found = 0
        if signal[d]:
            at = d << 4
            end = at + knots
            while at < end:
                change = int(after_q15[at]) - int(before_q15[at])
                if change:
                    found = 1
                delta_q15[at] = change + _DELTA_ZERO
                at += 1
        changed[d] = found
        count += found
        d += 1
    return count


@micropython.viper
def bend(
    base_q15: ptr16,
    third_q15: ptr16,
    row: ptr8,
    dofs: int,
    changed: ptr8,
    first_dof: int,
    frame: int,
    end: int,
    knot: ptr8,
    first_knot: int,
    knots: int,
    delta_q15: ptr32,
):
    """Let both rings follow a change, straight from knot to knot, from `first_knot` to before frame `end`.

    Knots are counted from `frame`, DOFs are those from `first_dof` to before `dofs`; behind the last knot the change stays.
    Bits: a change and its slope have 8 binary places more, 2^24.
    """
    last = knots - 1
    d = first_dof
    while d < dofs:
        if changed[d]:
            at = int(row[d]) << 9
            n = frame + int(knot[first_knot])
            b = first_knot
            while n < end:
                now = (delta_q15[(d << 4) + b] - _DELTA_ZERO) << 8
                slope = 0
                until = end
                if b < last:
                    until = frame + int(knot[b + 1])
                    if until > end:
                        until = end
                    k = int(knot[b + 1]) - int(knot[b])
                    slope = (((delta_q15[(d << 4) + b + 1] - _DELTA_ZERO) << 8) - now) // k
                    b += 1
                now += 128
                while n < until:
                    k = at + (n & _RING)
                    change = now >> 8
                    value = int(base_q15[k]) + change
                    if value < 0:
                        value = 0
                    if value > 32768:
                        value = 32768
                    base_q15[k] = value
                    value = int(third_q15[k]) + change
                    if value < 0:
                        value = 0
                    if value > 32768:
                        value = 32768
                    third_q15[k] = value
                    now += slope
                    n += 1
        d += 1


@micropython.viper
def put_block(base_q15: ptr16, row: ptr8, dofs: int, signal: ptr8, first: int, frames: int, future_q15: ptr16):
    """Store a block, 16 places per DOF, in the base's ring from frame `first` on."""
    d = 0
    while d < dofs:
        if signal[d]:
            at = int(row[d]) << 9
            n = 0
            while n < frames:
                base_q15[at + ((first + n) & _RING)] = future_q15[(d << 4) + n]
                n += 1
        d += 1


@micropython.viper
def fill(
    base_q15: ptr16,
    third_q15: ptr16,
    row: ptr8,
    dofs: int,
    signal: ptr8,
    first: int,
    frames: int,
    value_q15: ptr16,
    stride: int,
    at: int,
):
    """Fill both rings from frame `first` on with one value per DOF, `value[at + stride * dof]`."""
    d = 0
    while d < dofs:
        if signal[d]:
            place = int(row[d]) << 9
            a = int(value_q15[at + stride * d])
            n = first
            end = first + frames
            while n < end:
                base_q15[place + (n & _RING)] = a
                third_q15[place + (n & _RING)] = a
                n += 1
        d += 1


@micropython.viper
def column(base_q15: ptr16, row: ptr8, dofs: int, frame: int, value_q15: ptr16):
    """Read one frame of all DOFs from the base's ring."""
    d = 0
    while d < dofs:
        value_q15[d] = base_q15[(int(row[d]) << 9) + (frame & _RING)]
        d += 1


@micropython.viper
def put_column(base_q15: ptr16, row: ptr8, dofs: int, frame: int, value_q15: ptr16):
    """Store one frame of all DOFs in the base's ring."""
    d = 0
    while d < dofs:
        base_q15[(int(row[d]) << 9) + (frame & _RING)] = value_q15[d]
        d += 1
