"""Motion signal processing: gains on seven frequency bands, a change of affect over everything that moves.

    filtered = G_7 + sum gain_k * (G_k - G_{k+1}),  k = 0..6,   corr = filtered - base = sum (gain_k - 1) * (G_k - G_{k+1})

News changes the whole future and the bands with it. What `corr` jumps by because of that is taken back by an offset `e`, which
dies out critically damped with 0.15 s: the motion does not jerk, and there is no delay. With all gains 1 the signal is the base.

Source: SPEC of motion signal processing; the paper's section on it. There, five samples were waited for.
"""

import micropython
from micropython import const

from firmware.tables import halves, words
from firmware.trajectory import exp_q15
from shared.formats import BANDS, DOFS_MAX, GAIN4_ONE

ZERO_Q20 = 1 << 28  # what is added to signed words, as a 64-bit port reads words without their sign

_DOFS = const(16)
_ZERO = const(0x10000000)
_GAIN_MS = const(250)  # time constant of the gains
_OFFSET_MS = const(150)  # of the offset
_AGES = const(64)  # frames after news for which offsets allow


@micropython.viper
def _glide(bands: int, target4_q16: ptr32, gain4_q16: ptr32, alpha_q15: int, one4_q16: int) -> int:
    """Move every gain a step towards its target; return how many are not 1.

    Nearer than 2^-10 it arrives. Bits: differences have 19 with 4 less places, the coefficient at most 14.
    """
    moved = 0
    k = 0
    while k < bands:
        target = target4_q16[k]
        gain = gain4_q16[k]
        difference = target - gain
        if difference:
            gain += (((difference + 8) >> 4) * alpha_q15 + 0x400) >> 11
            difference = target - gain
            if -64 < difference and difference < 64:
                gain = target
            gain4_q16[k] = gain
        if gain != one4_q16:
            moved += 1
        k += 1
    return moved


@micropython.viper
def _correct(dofs: int, signal: ptr8, level_q16: ptr32, gain4_q16: ptr32, one4_q16: int, corr_q20: ptr32):
    """Write `corr` of every DOF, with 2^28 added. Bits: bands are within 2^16, gains minus 1 in Q12 within 5: below 2^31."""
    d = 0
    while d < dofs:
        if signal[d]:
            total = 0
            at = d
            above = level_q16[at]
            k = 0
            while k < 7:
                at += _DOFS
                below = level_q16[at]
                total += ((above - below) * ((gain4_q16[k] - one4_q16 + 8) >> 4) + 0x80) >> 8
                above = below
                k += 1
            corr_q20[d] = total + _ZERO
        d += 1


@micropython.viper
def _finish(
    dofs: int,
    signal: ptr8,
    base_q15: ptr16,
    corr_q20: ptr32,
    offset_q20: ptr32,
    keep_q15: int,
    share_q15: int,
    signal_q15: ptr16,
) -> int:
    """Write `clamp(base + corr + e)` of every DOF; return how many were clipped. `offset` holds 2 x 16 words, `e` and `v / F`.

    First `e` goes on: `share` is `1 / (F tau)`, `keep` is `exp(-share)`. Bits: `e` is within 16, 2^24; limbs of 13 + 12 bits
    times 15.
    """
    clipped = 0
    d = 0
    while d < dofs:
        value = int(base_q15[d])
        if signal[d]:
            off = offset_q20[d] - _ZERO
            rate = offset_q20[_DOFS + d] - _ZERO
            if off or rate:
                pull = rate + ((off >> 12) * share_q15 >> 3) + ((off & 0xFFF) * share_q15 >> 15)
                off += pull
                off = ((off >> 12) * keep_q15 >> 3) + ((off & 0xFFF) * keep_q15 >> 15)
                rate -= ((pull >> 12) * share_q15 >> 3) + ((pull & 0xFFF) * share_q15 >> 15)
                rate = ((rate >> 12) * keep_q15 >> 3) + ((rate & 0xFFF) * keep_q15 >> 15)
                if -32 < off and off < 32 and -32 < rate and rate < 32:
                    off = 0
                    rate = 0
                offset_q20[d] = off + _ZERO
                offset_q20[_DOFS + d] = rate + _ZERO
            value += (corr_q20[d] - _ZERO + off + 16) >> 5
            if value < 0:
                value = 0
                clipped += 1
            if value > 32768:
                value = 32768
                clipped += 1
        signal_q15[d] = value
        d += 1
    return clipped


@micropython.viper
def _step(
    dofs: int,
    signal: ptr8,
    before_q20: ptr32,
    after_q20: ptr32,
    left_q15: int,
    lost_q15: int,
    step_q20: ptr32,
    offset_q20: ptr32,
):
    """Let `step` be what `corr` has lost by the news; add what is `left` of it by now to every `e`, what it `lost` to `v / F`.

    What `step` was before has been added already. `e` stays within 16. Bits: `corr` is within 16, 2^24; limbs of 14 + 12 bits
    times 15.
    """
    d = 0
    while d < dofs:
        if signal[d]:
            step = before_q20[d] - after_q20[d]
            more = step - (step_q20[d] - _ZERO)
            step_q20[d] = step + _ZERO
            off = offset_q20[d] - _ZERO + ((more >> 12) * left_q15 >> 3) + ((more & 0xFFF) * left_q15 >> 15)
            if off > 0xFFFFFF:
                off = 0xFFFFFF
            if off < -0xFFFFFF:
                off = -0xFFFFFF
            offset_q20[d] = off + _ZERO
            rate = offset_q20[_DOFS + d] - _ZERO
            rate -= ((more >> 12) * lost_q15 >> 3) + ((more & 0xFFF) * lost_q15 >> 15)
            offset_q20[_DOFS + d] = rate + _ZERO
        d += 1


@micropython.viper
def _note(dofs: int, corr_q20: ptr32, news_q20: ptr32, step_q20: ptr32, bands: int, gain4_q16: ptr32, news4_q16: ptr32):
    """Keep a frame's `corr` and gains; no step has been added yet."""
    d = 0
    while d < dofs:
        news_q20[d] = corr_q20[d]
        step_q20[d] = _ZERO
        d += 1
    k = 0
    while k < bands:
        news4_q16[k] = gain4_q16[k]
        k += 1


@micropython.viper
def _pass(dofs: int, base_q15: ptr16, offset_q20: ptr32, signal_q15: ptr16):
    """Let the signal be the base, and forget the offsets."""
    d = 0
    while d < dofs:
        signal_q15[d] = base_q15[d]
        offset_q20[d] = _ZERO
        offset_q20[_DOFS + d] = _ZERO
        d += 1


class SignalProcessing:
    """The gains and the offsets. `gain4_q16` are the gains of the last frame, with 4 added; `target4_q16` is set from outside."""

    def __init__(self):
        self.target4_q16 = words(BANDS)
        self.gain4_q16 = words(BANDS)
        self._corr_q20 = words(DOFS_MAX)
        self._after_q20 = words(DOFS_MAX)
        self._news_q20 = words(DOFS_MAX)  # `corr` of the last frame with news, from what was foreseen then
        self._step_q20 = words(DOFS_MAX)  # what it lost by them, as far as that is known
        self._news4_q16 = words(BANDS)  # the gains of that frame
        self._is_noted = False
        self._is_active = False
        self._offset_q20 = words(2 * DOFS_MAX)
        self._alpha_q15 = self._keep_q15 = self._share_q15 = 0
        self._left_q15 = halves(_AGES)  # of an offset of 1 that began so many frames ago
        self._lost_q15 = halves(_AGES)  # its `-v / F`

    def load(self, rate_hz):
        """Take over the frame rate; allocates."""
        self._alpha_q15 = 32768 - exp_q15(1000, _GAIN_MS * rate_hz)
        self._keep_q15 = exp_q15(1000, _OFFSET_MS * rate_hz)
        self._share_q15 = (1000 * 32768 + _OFFSET_MS * rate_hz // 2) // (_OFFSET_MS * rate_hz)
        left_q15 = 32768
        lost_q15 = 0
        for age in range(_AGES):
            self._left_q15[age] = left_q15
            self._lost_q15[age] = lost_q15
            pull_q15 = (left_q15 * self._share_q15 >> 15) - lost_q15
            left_q15 = (left_q15 + pull_q15) * self._keep_q15 >> 15
            lost_q15 = (lost_q15 + (pull_q15 * self._share_q15 >> 15)) * self._keep_q15 >> 15

    def rest(self):
        """Set what holds before frame 0: all gains 1, no offsets."""
        self._is_active = self._is_noted = False
        for band in range(BANDS):
            self.target4_q16[band] = self.gain4_q16[band] = GAIN4_ONE
        for place in range(2 * DOFS_MAX):
            self._offset_q20[place] = ZERO_Q20

    def rearrange(self, gather_words, keep, scratch, dofs):
        """Let other tables have other DOFs; new ones have no offset."""
        for at in range(0, 2 * _DOFS, _DOFS):
            gather_words(self._offset_q20, keep, scratch, dofs, ZERO_Q20, at)

    def glide(self):
        """Move the gains by one frame; return whether any of them is not 1."""
        return _glide(BANDS, self.target4_q16, self.gain4_q16, self._alpha_q15, GAIN4_ONE) != 0

    def process(self, tables, base_q15, level_q16, signal_q15):
        """Compute the signal of a frame from its base, and from its levels as they were foreseen; return how many were clipped.

        If something has arrived, the levels are others, but `e` takes up the difference: the signal of this frame is the same.
        `note` is called then, and `follow` when they are known.
        """
        self._is_active = True
        # fmt: off
        _correct(tables.dofs, tables.signal, level_q16, self.gain4_q16, GAIN4_ONE, self._corr_q20)
        return _finish(
            tables.dofs, tables.signal, base_q15, self._corr_q20, self._offset_q20, self._keep_q15, self._share_q15,
            signal_q15,
        )
        # fmt: on

    def bypass(self, tables, base_q15, signal_q15):
        """Let the signal be the base, as it is with all gains 1."""
        self._is_active = self._is_noted = False
        _pass(tables.dofs, base_q15, self._offset_q20, signal_q15)

    def note(self, tables):
        """Note that the last frame had news: `corr` is what it was foreseen to be."""
        self._is_noted = self._is_active
        if self._is_noted:
            # fmt: off
            _note(
                tables.dofs, self._corr_q20, self._news_q20, self._step_q20, BANDS, self.gain4_q16, self._news4_q16
            )
            # fmt: on

    def follow(self, tables, level_q16, age):
        """Let the offsets take up the step of `corr` in the frame with the last news, whose levels are known now, or better now.

        That was `age` frames before the last one: what the offsets would be by now is added.
        """
        if self._is_noted and age < _AGES:
            # fmt: off
            _correct(tables.dofs, tables.signal, level_q16, self._news4_q16, GAIN4_ONE, self._after_q20)
            _step(
                tables.dofs, tables.signal, self._news_q20, self._after_q20, self._left_q15[age], self._lost_q15[age],
                self._step_q20, self._offset_q20,
            )
            # fmt: on
