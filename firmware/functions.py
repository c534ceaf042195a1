"""Periodic functions: raised sine and cosine, coherent noise, constants and live channels; all give values in 0..1.

Values are Q15, 0..32768 inclusive. Errors against the definitions stay below 2^-14: half a unit each from the sine
table, its interpolation and the rounding of the phase.
"""

from array import array

import micropython
from micropython import const

from shared.formats import GRADIENTS

# One step of the sine table, 2 pi / 512, as a rotation in Q40.
_STEP_COS_Q40 = 1099428836573
_STEP_SIN_Q40 = 13492699036


def sine_table():
    """Return `(1 + sin(2 pi i / 512)) / 2` in Q15 for i = 0..512, an array of 513 unsigned 16-bit words.

    A quarter is turned step by step in Q40 integers, so every MCU gets the same table whatever its floats are; the rest
    is symmetry.
    """
    table = array("H", bytes(2 * 513))
    cosine = 1 << 40
    sine = 0
    for i in range(129):
        half = (sine + (1 << 25)) >> 26
        table[i] = 16384 + half
        table[256 - i] = 16384 + half
        table[256 + i] = 16384 - half
        table[512 - i] = 16384 - half
        turned = (cosine * _STEP_COS_Q40 - sine * _STEP_SIN_Q40 + (1 << 39)) >> 40
        sine = (sine * _STEP_COS_Q40 + cosine * _STEP_SIN_Q40 + (1 << 39)) >> 40
        cosine = turned
    return table


@micropython.viper
def _draw(gradients: ptr16, first: int, count: int, low: int, high: int, spread_q15: int):
    """Fill `gradients[first:first+count]` from the xorshift state `high * 65536 + low`; see `fill_gradients`."""
    n = 0
    while n < count:
        # x ^= x << 13; x ^= x >> 17; x ^= x << 5, on two halves of 16 bits
        shifted = ((high << 13) | (low >> 3)) & 0xFFFF
        low = low ^ ((low << 13) & 0xFFFF)
        high = high ^ shifted
        low = low ^ (high >> 1)
        shifted = ((high << 5) | (low >> 11)) & 0xFFFF
        low = low ^ ((low << 5) & 0xFFFF)
        high = high ^ shifted
        g = high - 32768
        if spread_q15:
            size = g if g >= 0 else 0 - g
            size = spread_q15 + (((32768 - spread_q15) * size + 16384) >> 15)
            g = size if g >= 0 else 0 - size
            if g > 32767:
                g = 32767
        gradients[first + n] = g + 32768
        n += 1


def fill_gradients(gradients, k, seed, spread_q15):
    """Draw the gradients of noise table `k` (1..16) of a puppet seed into its 256 of 16 * 256 unsigned 16-bit words.

    A gradient -1 <= g < 1 is stored as `32768 * g + 32768`. The table starts from `(seed * 0x9E3779B1 + k * 0x85EBCA77)
    mod 2^32`, or 1 if that is 0. `spread_q15` (0..32768) raises small magnitudes: `|g|` becomes `spread + (1 - spread)
    * |g|`, 0 counting as positive. Allocates large integers.
    """
    state = (seed * 0x9E3779B1 + k * 0x85EBCA77) & 0xFFFFFFFF or 1
    _draw(gradients, (k - 1) * GRADIENTS, GRADIENTS, state & 0xFFFF, state >> 16, spread_q15)


# As in shared.formats; viper inlines constants of its own file only.
_RSIN = const(0)
_RCOS = const(1)
_NOISE = const(2)
_CONST = const(3)
_LIVE = const(4)
_CURVE = const(5)
_ELSEWHERE = const(255)


@micropython.viper
def evaluate(
    playing: ptr8,
    found: int,
    cycle: ptr16,
    fraction_q24: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    function: ptr8,
    argument: ptr16,
    same: ptr16,
    sine: ptr16,
    gradients: ptr16,
    live_q28: ptr32,
    curve_start: ptr16,
    curve_samples: ptr16,
    samples_q15: ptr16,
    value_q15: ptr16,
):
    """Write the function value of every mapping of the playing actions to `value_q15`, Q15 in 0..32768.

    Programs, blinks and repetitions of a function within its action are left to `programs`, `blinks` and `repeat`.

    Noise: with `j` whole and `u` the fraction, `h = u * (1-u) * (g[j] * (1-u) - g[j+1] * u)`, the value is `1/2 + 2 *
    h`. Bits: `u` and `g` in Q15, so their products stay within 2^30, and as `(1-u) + u = 1` so does their difference.
    A curve's place is the phase in Q22 times at most 256 samples: 2^30.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        phase = fraction_q24[i]
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            code = int(function[m])
            if int(same[m]) != m:
                code = _ELSEWHERE
            if code <= 1:
                angle = phase
                if code == _RCOS:
                    angle = (phase + 0x400000) & 0xFFFFFF
                k = angle >> 15
                a = int(sine[k])
                f = a + (((int(sine[k + 1]) - a) * (angle & 0x7FFF) + 0x4000) >> 15)
            elif code == _NOISE:
                k = int(argument[m]) << 8
                j = int(cycle[i])
                u = (phase + 0x100) >> 9
                v = 32768 - u
                g = int(gradients[k + (j & 255)]) - 32768
                g_next = int(gradients[k + ((j + 1) & 255)]) - 32768
                slope = (g * v - g_next * u + 0x4000) >> 15
                f = 16384 + ((((u * v + 0x2000) >> 14) * slope + 0x4000) >> 15)
            elif code == _CONST:
                f = int(argument[m])
            elif code == _LIVE:
                f = (live_q28[int(argument[m])] + 0x1000) >> 13
                if f > 32768:
                    f = 32768
            elif code == _CURVE:
                k = int(argument[m])
                samples = int(curve_samples[k])
                place = ((phase + 2) >> 2) * samples
                j = place >> 22
                if j >= samples:
                    j = 0
                    place = 0
                u = (place & 0x3FFFFF) >> 7
                first = int(curve_start[k])
                a = int(samples_q15[first + j])
                j += 1
                if j == samples:
                    j = 0
                f = a + (((int(samples_q15[first + j]) - a) * u + 0x4000) >> 15)
            else:
                f = 0
            value_q15[m] = f
            m += 1
        n += 1


@micropython.viper
def repeat(playing: ptr8, found: int, first_mapping: ptr16, mappings: ptr8, same: ptr16, value_q15: ptr16):
    """Copy the values of functions that stand in their action already: `same[m]` is the mapping that has computed it."""
    n = 0
    while n < found:
        i = int(playing[n])
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            value_q15[m] = value_q15[same[m]]
            m += 1
        n += 1
