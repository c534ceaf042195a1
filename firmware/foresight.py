"""Foresight: the base motion of frames to come, computed from an outlook, for the DOFs that signal processing looks at.

It is the functions and the compositor once more, over blocks of up to 16 frames, because what a kernel looks up once then
serves 16 times. Weights have 15 bits here where the compositor has 28; a frame to come may be right to a part in some ten
thousand, since it counts among 508 others. Blinks do not occur: nobody knows their future, so their DOFs are not processed.

In a sketch, whose frames lie apart, each stands for those around it: there a function counts for less the farther it gets on its
way from one to the next, by `sinc^2` of the part of a cycle, and what it lacks has its mean.
"""

import sys
from array import array

import micropython
from micropython import const

from firmware.outlook import BLOCK
from firmware.tables import halves, words
from shared.formats import DOFS_MAX

# As in shared.formats; viper inlines constants of its own file only.
_RCOS = const(1)
_NOISE = const(2)
_CONST = const(3)
_LIVE = const(4)
_CURVE = const(5)
_PROGRAM = const(6)


def fade_table(sine):
    """Return `sinc^2(c / 64)` for c = 0..64 in Q15, from the table of the raised sine; the same on every port. Allocates."""
    table = array("H", bytes(2 * 65))
    table[0] = 32768
    for c in range(1, 65):
        sinc_q15 = (sine[4 * c] - 16384) * 128000000 // (3141593 * c)
        table[c] = min(32768, sinc_q15 * sinc_q15 + 16384 >> 15)
    return table


@micropython.viper
def _balance(
    playing: ptr8,
    found: int,
    frames: int,
    peak_q28: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    dofs: int,
    hold_peak_q28: ptr32,
    hold_course_q28: ptr32,
    hold_q15: ptr16,
    weight_sum: ptr32,
    shift: ptr8,
    numerator: ptr32,
    denominator: ptr32,
):
    """Choose by how many bits each DOF's weights are shifted so that their sum stays below 2^15, and begin its sums with HOLD.

    `numerator` and `denominator` have 16 places per DOF; a numerator stays below 2^30.
    """
    d = 0
    while d < dofs:
        weight_sum[d] = (hold_peak_q28[d] >> 8) + 1
        d += 1
    n = 0
    while n < found:
        i = int(playing[n])
        w = (peak_q28[n] >> 8) + 1
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            d = int(mapped_dof[m])
            weight_sum[d] = weight_sum[d] + w
            m += 1
        n += 1
    d = 0
    while d < dofs:
        total = weight_sum[d]
        places = 8
        while total >= 0x8000:
            total = total >> 1
            places += 1
        while places and total < 0x4000:
            total = total << 1
            places -= 1
        shift[d] = places
        a = int(hold_q15[d])
        at = d << 4
        end = at + frames
        while at < end:
            w = hold_course_q28[at] >> places
            denominator[at] = w
            numerator[at] = w * a
            at += 1
        d += 1


@micropython.viper
def _evaluate(
    playing: ptr8,
    found: int,
    frames: int,
    sketching: int,
    cycle_course: ptr16,
    fraction_course_q24: ptr32,
    weight_course_q28: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    signal: ptr8,
    function: ptr8,
    argument: ptr16,
    same: ptr16,
    low_q15: ptr16,
    high_q15: ptr16,
    shift: ptr8,
    sine: ptr16,
    gradients: ptr16,
    live_course_q28: ptr32,
    curve_start: ptr16,
    curve_samples: ptr16,
    curve_mean_q15: ptr16,
    samples_q15: ptr16,
    pace_q22: ptr32,
    spacing_q2: ptr16,
    fade_q15: ptr16,
    faded_q15: ptr16,
    row_q15: ptr16,
    numerator: ptr32,
    denominator: ptr32,
):
    """Add every mapping of the playing actions to the sums of its DOF, but for programs and DOFs that are not processed.

    Functions are those of `functions.evaluate`, with the same bits; what stands in an action twice is computed once. `row` is
    scratch, 16 values for each of an action's mappings; `faded` is scratch for a sketch. Bits: a shifted
    weight and a value have 15 each; a pace folded to half a cycle in Q22 times a spacing of up to 127 frames in Q2 is
    below 2^30.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        first = n << 4
        begin = int(first_mapping[i])
        last = begin + int(mappings[i])
        known = 0
        if sketching:
            u = pace_q22[n]
            if u > 0x200000:
                u = 0x400000 - u
            b = 0
            while b < frames:
                a = 32768
                k = int(spacing_q2[b])
                if k:
                    k = (u * k) >> 18
                    a = int(fade_q15[k]) if k < 64 else 0
                faded_q15[b] = a
                b += 1
        m = begin
        while m < last:
            d = int(mapped_dof[m])
            code = int(function[m])
            if signal[d] and code < _PROGRAM:
                k = int(same[m]) - begin
                row = k << 4
                if (known >> k) & 1 == 0:
                    known = known | (1 << k)
                    b = 0
                    mean = 16384
                    if code <= _RCOS:
                        ahead = code << 22
                        while b < frames:
                            angle = (fraction_course_q24[first + b] + ahead) & 0xFFFFFF
                            k = angle >> 15
                            a = int(sine[k])
                            row_q15[row + b] = a + (((int(sine[k + 1]) - a) * (angle & 0x7FFF) + 0x4000) >> 15)
                            b += 1
                    elif code == _NOISE:
                        k = int(argument[m]) << 8
                        while b < frames:
                            j = int(cycle_course[first + b])
                            u = (fraction_course_q24[first + b] + 0x100) >> 9
                            v = 32768 - u
                            g = int(gradients[k + (j & 255)]) - 32768
                            g_next = int(gradients[k + ((j + 1) & 255)]) - 32768
                            slope = (g * v - g_next * u + 0x4000) >> 15
                            row_q15[row + b] = 16384 + ((((u * v + 0x2000) >> 14) * slope + 0x4000) >> 15)
                            b += 1
                    elif code == _LIVE:
                        j = int(argument[m]) << 4
                        while b < frames:
                            a = (live_course_q28[j + b] + 0x1000) >> 13
                            if a > 32768:
                                a = 32768
                            row_q15[row + b] = a
                            b += 1
                    elif code == _CURVE:
                        k = int(argument[m])
                        samples = int(curve_samples[k])
                        mean = int(curve_mean_q15[k])
                        k = int(curve_start[k])
                        while b < frames:
                            u = ((fraction_course_q24[first + b] + 2) >> 2) * samples
                            j = u >> 22
                            if j >= samples:
                                j = 0
                                u = 0
                            u = (u & 0x3FFFFF) >> 7
                            a = int(samples_q15[k + j])
                            j += 1
                            if j == samples:
                                j = 0
                            row_q15[row + b] = a + (((int(samples_q15[k + j]) - a) * u + 0x4000) >> 15)
                            b += 1
                    else:
                        a = int(argument[m])
                        while b < frames:
                            row_q15[row + b] = a
                            b += 1
                    if sketching:
                        if code <= _NOISE or code == _CURVE:
                            b = 0
                            while b < frames:
                                a = int(row_q15[row + b]) - mean
                                row_q15[row + b] = mean + ((a * int(faded_q15[b]) + 0x4000) >> 15)
                                b += 1
                low = int(low_q15[m])
                span = int(high_q15[m]) - low
                places = int(shift[d])
                at = d << 4
                b = 0
                while b < frames:
                    w = weight_course_q28[first + b] >> places
                    denominator[at] = denominator[at] + w
                    numerator[at] = numerator[at] + w * (low + ((span * int(row_q15[row + b]) + 0x4000) >> 15))
                    at += 1
                    b += 1
            m += 1
        n += 1


@micropython.viper
def _divide(
    dofs: int,
    frames: int,
    signal: ptr8,
    shift: ptr8,
    hold_q15: ptr16,
    hold_course_q28: ptr32,
    relative: ptr8,
    capture: ptr8,
    frame_of: ptr8,
    numerator: ptr32,
    denominator: ptr32,
    future_q15: ptr16,
):
    """Write the quotients of all DOFs' sums, 16 places per DOF; where all weights are 0 HOLD's value.

    `capture[d]` not 255: at the first frame behind that number of frames (`frame_of` counts them) HOLD takes over what the
    frame before it has, if it was faint there. Bits: sums below 2^30, quotients 15.
    """
    d = 0
    while d < dofs:
        if signal[d]:
            at = d << 4
            a = int(hold_q15[d])
            moved = 0
            b = 0
            while b < frames:
                if capture[d] != 255:
                    if b and relative[d] == 0 and moved == 0:
                        if frame_of[b - 1] <= capture[d] and frame_of[b] > capture[d]:
                            if hold_course_q28[at - 1] < 0x100000:
                                moved = int(future_q15[at - 1]) - a
                top = numerator[at]
                bottom = denominator[at]
                if moved:
                    top += (hold_course_q28[at] >> int(shift[d])) * moved
                if bottom:
                    future_q15[at] = (top + (bottom >> 1)) // bottom
                else:
                    future_q15[at] = a + moved
                at += 1
                b += 1
        d += 1


class Foresight:
    """Computes the base motion of blocks. `future_q15` has 16 values per DOF, the frames that the outlook has written down."""

    def __init__(self, sine, knots):
        """`knots` are the frames of a sketch, from the present one on."""
        self.future_q15 = halves(DOFS_MAX * BLOCK)
        self._evaluate = _evaluate
        if sys.platform == "rp2":
            from firmware.foresight_thumb import evaluate

            self._evaluate = evaluate
        self._sine = sine
        self._fade_q15 = fade_table(sine)
        self._spacing_q2 = halves(BLOCK)
        for b in range(1, len(knots)):
            wide = knots[min(b + 1, len(knots) - 1)] - knots[b - 1]
            self._spacing_q2[b] = 2 * wide if wide > 2 else 0
        self._weight_sum = words(DOFS_MAX)
        self._shift = bytearray(DOFS_MAX)
        self._numerator = words(DOFS_MAX * BLOCK)
        self._denominator = words(DOFS_MAX * BLOCK)
        self._faded_q15 = halves(BLOCK)
        self._row_q15 = halves(DOFS_MAX * BLOCK)
        self._at_once = halves(BLOCK)
        self._never = bytearray([255] * DOFS_MAX)

    def evaluate(self, tables, outlook, frames, sketching, puppet):
        """Compute the base of the frames that `outlook` has written down; `sketching` (0 or 1) that they are a sketch's."""
        t = tables
        o = outlook
        playing = o.playing
        found = o.found
        numerator = self._numerator
        denominator = self._denominator
        # fmt: off
        _balance(
            playing, found, frames, o.weight_peak_q28, t.first_mapping, t.mapping_count, t.mapped_dof, t.dofs,
            o.hold_peak_q28, o.hold_course_q28, o.hold_q15, self._weight_sum, self._shift, numerator, denominator,
        )
        self._evaluate(
            playing, found, frames, sketching, o.cycle_course, o.fraction_course_q24, o.weight_course_q28,
            t.first_mapping, t.mapping_count, t.mapped_dof, t.signal, t.function, t.argument, t.same, t.low_q15,
            t.high_q15, self._shift, self._sine, puppet.gradients, o.live_course_q28, t.curve_start, t.curve_samples,
            t.curve_mean_q15, t.samples_q15, o.pace_q22, self._spacing_q2, self._fade_q15, self._faded_q15,
            self._row_q15, numerator,
            denominator,
        )
        if t.programs:
            puppet.programs.add(
                t, o, self._sine, puppet.gradients, frames, self._spacing_q2 if sketching else self._at_once,
                self._fade_q15, self._shift, numerator, denominator,
            )
        _divide(
            t.dofs, frames, t.signal, self._shift, o.hold_q15, o.hold_course_q28, t.relative,
            o.turn if sketching else self._never, o.knots, numerator, denominator, self.future_q15,
        )
        # fmt: on
