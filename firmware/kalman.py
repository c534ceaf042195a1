"""Prediction of live channels: a Kalman filter of constant velocity estimates how fast a target moves.

The targets of a live channel come when the host has something to say, at most one counts per frame. A channel with
`predict = "kalman"` has a state of position and velocity (per frame) and their covariances. In a frame in which a target
has arrived it goes on at a constant velocity but for a random walk of that, and the target is a reading of its position:

    p += v                                       P = F P F' + Q,  F = [[1, 1], [0, 1]],  Q = q [[1/3, 1/2], [1/2, 1]]
    K = [P11, P12] / (P11 + r)                   p += K1 (target - p),  v += K2 (target - p)
    P11 = K1 r,  P12 = K2 r,  P22 -= K2 P12

A stick that rests sends nothing, so silence means rest sooner or later: in a frame without a target the velocity dies out, and
so does the distance to the last target, by the factor `fade`, and what is not known of them with it:

    p = target + fade (p + v - target),  v = fade v      P = fade^2 F P F' + Q

What the target will do in frames to come is then, from the last target on, `v = fade v; target += v`, within 0..1.

Three numbers per channel come with the tables. `process_q16` is `q`, the variance of what a frame adds to the velocity,
and `noise_q16` is `r`, the variance of a reading, both in one unit, with 16 binary places, that the host chooses per
channel: only their ratio counts, and P has the same unit. 1 <= noise <= 2^27, 0 <= process <= 2^27. The unit should be
such that P11 stays below 2^28 in the longest silence; where it would pass that, P stays as it is for a frame, so that
nothing overflows whatever the numbers are. `fade_q15` is `exp(-1 / (F * fade))`, below 1.

Source: SPEC of motion signal processing (`predict`); the textbook's filter with white noise as acceleration. The fading in
silence is ours.
"""

import micropython
from micropython import const

from firmware.tables import words
from shared.formats import LIVES_MAX, NEW, WEIGHT_ONE

ZERO_Q28 = WEIGHT_ONE  # what is added to velocities, as a 64-bit port reads words without their sign

_LIVES = const(16)
_ONE = const(0x10000000)
_COVARIANCE_MAX = const(0x10000000)


@micropython.viper
def _estimate(
    lives: int,
    predict: ptr8,
    arrived: int,
    target_q28: ptr32,
    process_q16: ptr32,
    noise_q16: ptr32,
    fade_q15: ptr16,
    position_q28: ptr32,
    velocity_q28: ptr32,
    covariance_q16: ptr32,
):
    """Move the state of every channel with `predict` by one frame; the others are where their target is, at rest.

    `arrived` has the bit of each channel that got a target in this frame. Targets and positions are Q28 in 0..1, velocities per
    frame within -1..1 with 1 added. `covariance` holds 3 x 16 words, P11, P12 and P22; none is ever negative.
    Bits: P11 stays within 2^28, P12 and P22 within that and 2/3 of the process, as what they get P11 gets too; their sum
    has 31; P11 + r has 30 and is divided by with 15; gains are Q22 up to 3/2 (what goes to P12 goes to P11 too, but for
    the process, of which P12 gets 1/2 and P11 1/3), 23 bits in limbs of 12 + 11; the innovation stays within 2^29, in
    limbs of 15 + 15. Products of limbs stay below 2^27, and 2^30 when shifted.
    """
    i = 0
    while i < lives:
        target = target_q28[i]
        if predict[i]:
            p = position_q28[i]
            v = velocity_q28[i] - _ONE
            p11 = covariance_q16[i]
            p12 = covariance_q16[_LIVES + i]
            p22 = covariance_q16[2 * _LIVES + i]
            q = process_q16[i]
            has_arrived = (arrived >> i) & 1
            next11 = p11 + 2 * p12 + p22
            next12 = p12 + p22
            next22 = p22
            if has_arrived:
                p += v
            else:
                fade = int(fade_q15[i])
                away = p + v - target
                p = target + ((away >> 15) * fade) + (((away & 0x7FFF) * fade) >> 15)
                size = v if v >= 0 else 0 - v
                size = ((size >> 15) * fade) + (((size & 0x7FFF) * fade) >> 15)  # towards 0: it arrives there
                v = size if v >= 0 else 0 - size
                fade = (fade * fade) >> 15
                next11 = ((next11 >> 15) * fade) + (((next11 & 0x7FFF) * fade) >> 15)
                next12 = ((next12 >> 15) * fade) + (((next12 & 0x7FFF) * fade) >> 15)
                next22 = ((next22 >> 15) * fade) + (((next22 & 0x7FFF) * fade) >> 15)
            next11 += q // 3
            next12 += q >> 1
            next22 += q
            if next11 <= _COVARIANCE_MAX:
                p11 = next11
                p12 = next12
                p22 = next22
            if has_arrived:
                r = noise_q16[i]
                divisor = p11 + r
                shift = 0
                while divisor >= 0x8000:
                    divisor = divisor >> 1
                    shift += 1
                away = target - p
                away_high = away >> 15
                away_low = away & 0x7FFF
                before12 = p12
                row = 0
                while row < 2:
                    gain = p11 if row == 0 else before12
                    quotient = gain // divisor
                    gain = (quotient << 15) + (((gain - quotient * divisor) << 15) // divisor)
                    if shift > 7:
                        gain = gain >> (shift - 7)
                    else:
                        gain = gain << (7 - shift)
                    high = gain >> 11
                    low = gain & 0x7FF
                    # x * gain / 2^22: high * high * 2^26, high * low * 2^15, low * high * 2^11, low * low
                    change = ((away_high * high) << 4) + (
                        (((away_high * low) << 4) + away_low * high + ((away_low * low) >> 11) + 0x400) >> 11
                    )
                    kept = (((r >> 15) * high) << 4) + (
                        ((((r >> 15) * low) << 4) + (r & 0x7FFF) * high + (((r & 0x7FFF) * low) >> 11) + 0x400) >> 11
                    )
                    if row == 0:
                        p += change
                        p11 = kept
                    else:
                        v += change
                        p12 = kept
                        p22 -= (((before12 >> 15) * high) << 4) + (
                            (
                                (((before12 >> 15) * low) << 4)
                                + (before12 & 0x7FFF) * high
                                + (((before12 & 0x7FFF) * low) >> 11)
                                + 0x400
                            )
                            >> 11
                        )
                    row += 1
                if p22 < 0:
                    p22 = 0
            if p < 0:
                p = 0
            if p > _ONE:
                p = _ONE
            if v >= _ONE:
                v = _ONE - 1
            if v <= -_ONE:
                v = 1 - _ONE
        else:
            p = target
            v = 0
            p11 = 0
            p12 = 0
            p22 = 0
        position_q28[i] = p
        velocity_q28[i] = v + _ONE
        covariance_q16[i] = p11
        covariance_q16[_LIVES + i] = p12
        covariance_q16[2 * _LIVES + i] = p22
        i += 1


class Kalman:
    """What is known of how the live channels' targets move.

    `velocity_q28` is what each target moves per frame, with `ZERO_Q28` added; 0 for channels whose targets are held.
    `rest` and `rearrange` take tables with `live_rest_q28`, `step` tables with `lives`, `live_predict` (not 0: kalman),
    `live_process_q16`, `live_noise_q16` and `live_fade_q15`, which have been checked.
    """

    def __init__(self):
        self.velocity_q28 = words(LIVES_MAX)
        self._position_q28 = words(LIVES_MAX)
        self._covariance_q16 = words(3 * LIVES_MAX)

    def rest(self, tables):
        """Let every channel be known to stand at its rest."""
        for live in range(tables.lives):
            self._position_q28[live] = tables.live_rest_q28[live]
            self.velocity_q28[live] = ZERO_Q28
            for place in range(live, 3 * _LIVES, _LIVES):
                self._covariance_q16[place] = 0

    def step(self, tables, arrived, target_q28):
        """Take the step of one frame, after its targets have come.

        `arrived` has the bit of each channel that got one, `target_q28` all targets, in 0..1. Allocates nothing.
        """
        # fmt: off
        _estimate(
            tables.lives, tables.live_predict, arrived, target_q28, tables.live_process_q16, tables.live_noise_q16,
            tables.live_fade_q15, self._position_q28, self.velocity_q28, self._covariance_q16,
        )
        # fmt: on

    def is_moving(self, lives):
        """Return whether any of so many channels is known to move."""
        for live in range(lives):
            if self.velocity_q28[live] != ZERO_Q28:
                return True
        return False

    def rearrange(self, gather_words, keep, scratch, tables):
        """Let other tables have other channels; those that were not there before stand at their rest."""
        gather_words(self.velocity_q28, keep, scratch, tables.lives, ZERO_Q28, 0)
        gather_words(self._position_q28, keep, scratch, tables.lives, 0, 0)
        for place in range(0, 3 * _LIVES, _LIVES):
            gather_words(self._covariance_q16, keep, scratch, tables.lives, 0, place)
        for live in range(tables.lives):
            if keep[live] == NEW:
                self._position_q28[live] = tables.live_rest_q28[live]
