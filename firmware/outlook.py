"""The outlook: what decides about frames to come, if nothing more arrives.

Weights and their targets, HOLD, live channels, phases and the ends of gestures follow from the present; an outlook is a copy
of them that can be moved on by itself, some frames at a time, while the puppet plays. What it writes down per frame, blocks of up
to 16, is what `foresight` computes the base motion from. A sketch does the same for a few frames far apart, in closed form and
less exactly, and leaves the outlook as it is.

Source: SPEC of motion signal processing; the paper's "compute ahead".
"""

import micropython
from micropython import const

from firmware import actions, compositor, weights
from firmware.tables import halves, words
from shared.formats import ACTIONS_MAX, DOFS_MAX, LIVES_MAX

BLOCK = 16  # frames or knots that are written down at once
NEVER = 255

_ONE_Q28 = const(0x10000000)


@micropython.viper
def _copy_words(source: ptr32, target: ptr32, count: int):
    """Copy words."""
    i = 0
    while i < count:
        target[i] = source[i]
        i += 1


@micropython.viper
def _copy_halves(source: ptr16, target: ptr16, count: int):
    """Copy 16-bit words."""
    i = 0
    while i < count:
        target[i] = source[i]
        i += 1


@micropython.viper
def _copy_bytes(source: ptr8, target: ptr8, count: int):
    """Copy bytes."""
    i = 0
    while i < count:
        target[i] = source[i]
        i += 1


@micropython.viper
def _advance_phases(
    playing: ptr8,
    found: int,
    frames: int,
    keep: int,
    rate_hz: int,
    master_tempo_q16: int,
    tempo_q16: ptr32,
    warp_q26: ptr32,
    cycle: ptr16,
    fraction_q30: ptr32,
    offset_q28: ptr32,
    cycle_course: ptr16,
    fraction_course_q24: ptr32,
):
    """Write the phases of the playing actions in the next frames: action `n` of the list in frame `b` to place `16 * n + b`.

    `cycle` and `fraction` hold the phase without its offset; both and the offset move on unless `keep` is 0. A frame adds
    `r * T / F`: whole cycles, and a rest in Q30, right to 2^-30; over 254 frames that is 2^-22 of a cycle. Offsets shrink as in
    `actions`. Bits: `r * T` in limbs of 10, below 2^27 and 2^28 + 2^16; fractions below 2^31.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        k = tempo_q16[i]
        upper = (k >> 10) * master_tempo_q16
        step_q22 = upper // rate_hz
        rest = ((upper - step_q22 * rate_hz) << 10) + (k & 0x3FF) * master_tempo_q16
        most = (step_q22 << 5) + rest // (rate_hz << 5)
        rest = rest // rate_hz
        step_q22 += rest >> 10
        step_q30 = ((step_q22 & 0x3FFFFF) << 8) | ((rest >> 2) & 0xFF)
        step_cycles = step_q22 >> 22
        whole = int(cycle[i])
        fraction = fraction_q30[i]
        o = offset_q28[i] - _ONE_Q28
        at = n << 4
        end = at + frames
        while at < end:
            total_q24 = (fraction >> 6) + ((o + 8) >> 4)
            cycle_course[at] = (whole + (total_q24 >> 24)) & 0xFFF
            fraction_course_q24[at] = total_q24 & 0xFFFFFF
            if o:
                high = o >> 15
                low = o & 0x7FFF
                a_high = warp_q26[i] >> 13
                a_low = warp_q26[i] & 0x1FFF
                step = ((high * a_high) << 2) + (
                    (((high * a_low) << 2) + low * a_high + ((low * a_low) >> 13) + 0x1000) >> 13
                )
                if step > most:
                    step = most
                if step < 0 - most:
                    step = 0 - most
                o -= step
            fraction += step_q30
            whole += step_cycles + (fraction >> 30)
            fraction = fraction & 0x3FFFFFFF
            at += 1
        if keep:
            cycle[i] = whole & 0xFFF
            fraction_q30[i] = fraction
            offset_q28[i] = o + _ONE_Q28
        n += 1


@micropython.viper
def _sketch_phases(
    playing: ptr8,
    found: int,
    knots: int,
    strides: ptr8,
    rate_hz: int,
    master_tempo_q16: int,
    tempo_q16: ptr32,
    warp_q26: ptr32,
    cycle: ptr16,
    fraction_q24: ptr32,
    offset_q28: ptr32,
    cycle_course: ptr16,
    fraction_course_q24: ptr32,
    pace_q22: ptr32,
):
    """Write the phases of the playing actions at the knots, and to `pace` by what part of a cycle a frame moves them on.

    `cycle` and `fraction` hold the phases without offsets. Offsets, here in Q20, shrink by the same amount in every frame as
    long as that is all they may, then by powers of what a frame leaves of them. Bits: a stride of up to 127 frames times a
    fraction in Q22 is below 2^29; half of what a frame advances is below 2^21, 9 places more make 2^30.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        k = tempo_q16[i]
        upper = (k >> 10) * master_tempo_q16
        step_q22 = upper // rate_hz
        rest = ((upper - step_q22 * rate_hz) << 10) + (k & 0x3FF) * master_tempo_q16
        step_q22 += (rest // rate_hz + 0x200) >> 10
        step_cycles = step_q22 >> 22
        step_q22 = step_q22 & 0x3FFFFF
        pace_q22[n] = step_q22
        whole = int(cycle[i])
        fraction = fraction_q24[i] >> 2
        o = (offset_q28[i] - _ONE_Q28) >> 8
        most = ((step_cycles << 22) + step_q22) >> 3
        a = (warp_q26[i] >> 11) + 1
        limit = (most << 9) // a
        if limit > 0x3FFFF:
            limit = 0x3FFFF
        limit = limit << 6
        at = n << 4
        b = 0
        while b < knots:
            stride = int(strides[b])
            fraction += stride * step_q22
            whole += stride * step_cycles + (fraction >> 22)
            fraction = fraction & 0x3FFFFF
            if o and stride:
                size = o if o >= 0 else 0 - o
                if size > limit and most:
                    k = (size - limit) // most + 1
                    if k > stride:
                        k = stride
                    size -= k * most
                    stride -= k
                if stride:
                    power = 32768
                    square = 32769 - a
                    while stride:
                        if stride & 1:
                            power = (power * square + 0x4000) >> 15
                        square = (square * square + 0x4000) >> 15
                        stride = stride >> 1
                    size = ((size >> 6) * power) >> 9
                o = size if o >= 0 else 0 - size
            total_q24 = (fraction << 2) + (o << 4)
            cycle_course[at] = (whole + (total_q24 >> 24)) & 0xFFF
            fraction_course_q24[at] = total_q24 & 0xFFFFFF
            at += 1
            b += 1
        n += 1


@micropython.viper
def _take_phases(playing: ptr8, found: int, fraction_q24: ptr32, fraction_q30: ptr32):
    """Turn the fractions of the playing actions into Q30."""
    n = 0
    while n < found:
        i = int(playing[n])
        fraction_q30[i] = fraction_q24[i] << 6
        n += 1


@micropython.viper
def _ends(
    playing: ptr8,
    found: int,
    knots: int,
    at_once: int,
    less: int,
    cycles: ptr16,
    target_q28: ptr32,
    start_q18: ptr32,
    cycle_course: ptr16,
    fraction_course_q24: ptr32,
    frame_of: ptr8,
    ends: ptr8,
) -> int:
    """Write to `ends[n]` how many frames action `n` of the list has until its gesture ends, 255 if it does not; return the least.

    The phases are those at `knots` frames, `frame_of[b]` from the first; between two of them they are taken to be even. With
    `at_once` not 0 a gesture may end in the first of them. `less` is subtracted from what is written. Bits: phases are Q18 modulo
    2^30; spans are shifted below 2^22 before they are multiplied by up to 127 frames.
    """
    least = 255
    n = 0
    while n < found:
        i = int(playing[n])
        ends[n] = 255
        if cycles[i]:
            if target_q28[i]:
                limit = (int(cycles[i]) << 18) - 256
                at = n << 4
                before = 0
                b = 0
                while b < knots:
                    gone = ((int(cycle_course[at + b]) << 18) | (fraction_course_q24[at + b] >> 6)) - start_q18[i]
                    gone = gone & 0x3FFFFFFF
                    if gone > limit and (b or at_once):
                        end = int(frame_of[b])
                        if b:
                            first = int(frame_of[b - 1])
                            span = (gone - before) & 0x3FFFFFFF
                            while span > 0x3FFFFF:
                                span = span >> 1
                                limit = limit >> 1
                                before = before >> 1
                            if span and limit >= before:
                                end = first + 1 + ((limit - before) * (end - first)) // (span + 1)
                        end -= less
                        if end > 254:
                            end = 254
                        ends[n] = end
                        if end < least:
                            least = end
                        b = knots
                    before = gone
                    b += 1
        n += 1
    return least


@micropython.viper
def _gestures(playing: ptr8, found: int, cycles: ptr16, target_q28: ptr32) -> int:
    """Return how many gestures are under way."""
    count = 0
    n = 0
    while n < found:
        i = int(playing[n])
        if cycles[i] and target_q28[i]:
            count += 1
        n += 1
    return count


@micropython.viper
def _end(playing: ptr8, found: int, ends: ptr8, target_q28: ptr32):
    """Set the targets of those to 0 that end now."""
    n = 0
    while n < found:
        if ends[n] == 0:
            i = int(playing[n])
            target_q28[i] = 0
        n += 1


@micropython.viper
def _turns(
    playing: ptr8,
    found: int,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    target_q28: ptr32,
    ends: ptr8,
    dofs: int,
    hold_target_q28: ptr32,
    turn: ptr8,
):
    """Write to `turn[d]` in how many frames HOLD will be wanted on a DOF because all gestures there have ended, 255 for never."""
    d = 0
    while d < dofs:
        turn[d] = 255 if hold_target_q28[d] else 0
        d += 1
    n = 0
    while n < found:
        i = int(playing[n])
        if target_q28[i]:
            m = int(first_mapping[i])
            end = m + int(mappings[i])
            while m < end:
                d = int(mapped_dof[m])
                if turn[d] < ends[n]:
                    turn[d] = ends[n]
                m += 1
        n += 1


@micropython.viper
def _drift(
    lives: int,
    frames: int,
    strides: ptr8,
    keep: int,
    fade_q15: ptr16,
    velocity_q28: ptr32,
    target_q28: ptr32,
    rise_q26: ptr32,
    fall_q26: ptr32,
    before_x_q28: ptr32,
    before_w_q28: ptr32,
    x_q28: ptr32,
    w_q28: ptr32,
    course_q28: ptr32,
) -> int:
    """Let the targets of channels that are known to move go on, and write `w` behind them down as `foresee` does; return how
    many move.

    Each frame `v = fade * v`, `target += v` within 0..1; `strides[b]` frames lead to the one that is written down. The filters
    are those of `integrate`, but for coefficients in Q15 and its last 2^-18. Bits: velocities within 1, stored with 1 added;
    products of limbs of 14 + 15 and 15 bits.
    """
    moving = 0
    i = 0
    while i < lives:
        v = velocity_q28[i] - _ONE_Q28
        if v:
            moving += 1
            g = target_q28[i]
            x = before_x_q28[i]
            w = before_w_q28[i]
            fade = int(fade_q15[i])
            at = i << 4
            b = 0
            while b < frames:
                k = int(strides[b])
                while k:
                    size = v if v >= 0 else 0 - v
                    size = (size >> 15) * fade + (((size & 0x7FFF) * fade) >> 15)
                    v = size if v >= 0 else 0 - size
                    g += v
                    if g < 0:
                        g = 0
                    if g > _ONE_Q28:
                        g = _ONE_Q28
                    a = (rise_q26[i] if g > x else fall_q26[i]) >> 11
                    difference = g - x
                    x += (difference >> 15) * a + (((difference & 0x7FFF) * a) >> 15)
                    difference = x - w
                    w += (difference >> 15) * a + (((difference & 0x7FFF) * a) >> 15)
                    k -= 1
                course_q28[at] = w
                at += 1
                b += 1
            if keep:
                velocity_q28[i] = v + _ONE_Q28
                target_q28[i] = g
                x_q28[i] = x
                w_q28[i] = w
        i += 1
    return moving


class Outlook:
    """What is known of the next frames, from `frame` on.

    `write` and `sketch` leave behind, for the `found` actions of the list `playing`, `weight_course_q28`, `cycle_course` and
    `fraction_course_q24` with their peaks, the same of HOLD and live channels, each with 16 places per item. `hold_q15` is the
    value that HOLD holds, and what `sketch` adds is `pace_q22`, `turn`.
    """

    def __init__(self, knots):
        """`knots` are the frames, from the present one on, that a sketch is made of."""
        self.frame = 0
        self.found = 0
        self.playing = bytearray(ACTIONS_MAX)
        self.hold_q15 = halves(DOFS_MAX)
        self.weight_course_q28 = words(ACTIONS_MAX * BLOCK)
        self.weight_peak_q28 = words(ACTIONS_MAX)
        self.cycle_course = halves(ACTIONS_MAX * BLOCK)
        self.fraction_course_q24 = words(ACTIONS_MAX * BLOCK)
        self.hold_course_q28 = words(DOFS_MAX * BLOCK)
        self.hold_peak_q28 = words(DOFS_MAX)
        self.live_course_q28 = words(LIVES_MAX * BLOCK)
        self.pace_q22 = words(ACTIONS_MAX)
        self.turn = bytearray(DOFS_MAX)
        self._nominal_cycle = halves(ACTIONS_MAX)
        self._nominal_q24 = words(ACTIONS_MAX)
        self.knots = bytearray(knots)
        self._all = bytearray(range(BLOCK))
        self._one = bytearray([1] * BLOCK)
        self._never = bytearray([NEVER] * BLOCK)
        strides = [knots[b] - knots[b - 1] for b in range(1, len(knots))]
        self._strides = bytearray([0] + strides)
        self._strides_before = bytearray([1] + strides)
        self._strides_behind = bytearray([0, knots[1] - 1] + strides[1:])
        self._ends = bytearray(ACTIONS_MAX)
        self._target_q28 = words(ACTIONS_MAX)
        self._x_q28 = words(ACTIONS_MAX)
        self._w_q28 = words(ACTIONS_MAX)
        self._start_q18 = words(ACTIONS_MAX)
        self._cycle = halves(ACTIONS_MAX)
        self._fraction_q30 = words(ACTIONS_MAX)
        self._offset_q28 = words(ACTIONS_MAX)
        self._zero_offset_q28 = words(ACTIONS_MAX)
        for i in range(ACTIONS_MAX):
            self._zero_offset_q28[i] = actions.ZERO_OFFSET_Q28
        self._live_target_q28 = words(LIVES_MAX)
        self._live_x_q28 = words(LIVES_MAX)
        self._live_w_q28 = words(LIVES_MAX)
        self._live_before_x_q28 = words(LIVES_MAX)
        self._live_before_w_q28 = words(LIVES_MAX)
        self._velocity_q28 = words(LIVES_MAX)
        self._live_peak_q28 = words(LIVES_MAX)
        self._hold_target_q28 = words(DOFS_MAX)
        self._hold_x_q28 = words(DOFS_MAX)
        self._hold_w_q28 = words(DOFS_MAX)
        self._wanted = bytearray(DOFS_MAX)
        self._power_q15 = halves(BLOCK)
        self._tempo_q16 = words(ACTIONS_MAX)
        self._master_tempo_q16 = 0
        self._has_gestures = False
        self._moving = 0

    def take(self, frame, tables, puppet):
        """Begin anew before `frame`, the puppet's next one, with all that decides about it."""
        a = puppet.actions
        count = tables.actions
        self.frame = frame
        self.found = a.found
        _copy_bytes(a.playing, self.playing, a.found)
        _copy_words(a.target_q28, self._target_q28, count)
        _copy_words(a.x_q28, self._x_q28, count)
        _copy_words(a.w_q28, self._w_q28, count)
        _copy_words(a.start_q18, self._start_q18, count)
        _copy_words(a.offset_q28, self._offset_q28, count)
        _copy_words(a.tempo_q16, self._tempo_q16, count)
        self._master_tempo_q16 = puppet.tempo_q16[0]
        a.nominal_phases(puppet.master, tables.frame_rate_hz, self._zero_offset_q28, self._cycle, self._nominal_q24)
        _take_phases(self.playing, self.found, self._nominal_q24, self._fraction_q30)
        target_q28, x_q28, w_q28 = puppet.live_state
        _copy_words(target_q28, self._live_target_q28, tables.lives)
        _copy_words(x_q28, self._live_x_q28, tables.lives)
        _copy_words(w_q28, self._live_w_q28, tables.lives)
        _copy_words(puppet.kalman.velocity_q28, self._velocity_q28, tables.lives)
        self._moving = tables.lives
        target_q28, x_q28, w_q28 = puppet.hold_state
        _copy_words(target_q28, self._hold_target_q28, tables.dofs)
        _copy_words(x_q28, self._hold_x_q28, tables.dofs)
        _copy_words(w_q28, self._hold_w_q28, tables.dofs)
        _copy_halves(puppet.hold_q15, self.hold_q15, tables.dofs)
        self._has_gestures = _gestures(self.playing, self.found, tables.cycles, self._target_q28) != 0

    def write(self, tables, frames, base_q15):
        """Write the next frames down, up to 16, and be behind them; return how many there were: gestures end between blocks.

        `base_q15` is the base of the frame before.
        """
        # fmt: off
        rate_hz = tables.frame_rate_hz
        if self._has_gestures:
            self._advance_phases(tables, rate_hz, frames, 0)
            end = self._first_end(tables, frames)
            if end == 0:
                self._end_gestures(tables, base_q15)
                end = self._first_end(tables, frames)
            frames = min(frames, end)
        self._advance_phases(tables, rate_hz, frames, 1)
        weights.foresee(
            self.playing, self.found, frames, self._target_q28, self._x_q28, self._w_q28, tables.rise_q26,
            tables.fall_q26, self.weight_course_q28, self.weight_peak_q28,
        )
        weights.foresee(
            self._all, tables.dofs, frames, self._hold_target_q28, self._hold_x_q28, self._hold_w_q28, tables.hold_q26,
            tables.hold_q26, self.hold_course_q28, self.hold_peak_q28,
        )
        if tables.lives:
            if self._moving:
                _copy_words(self._live_x_q28, self._live_before_x_q28, tables.lives)
                _copy_words(self._live_w_q28, self._live_before_w_q28, tables.lives)
            weights.foresee(
                self._all, tables.lives, frames, self._live_target_q28, self._live_x_q28, self._live_w_q28,
                tables.live_rise_q26, tables.live_fall_q26, self.live_course_q28, self._live_peak_q28,
            )
            if self._moving:
                self._moving = _drift(
                    tables.lives, frames, self._one, 1, tables.live_fade_q15, self._velocity_q28,
                    self._live_target_q28, tables.live_rise_q26, tables.live_fall_q26, self._live_before_x_q28,
                    self._live_before_w_q28, self._live_x_q28, self._live_w_q28, self.live_course_q28,
                )
        # fmt: on
        self.frame += frames
        return frames

    def _advance_phases(self, tables, rate_hz, frames, keep):
        # fmt: off
        _advance_phases(
            self.playing, self.found, frames, keep, rate_hz, self._master_tempo_q16, self._tempo_q16, tables.warp_q26,
            self._cycle, self._fraction_q30, self._offset_q28, self.cycle_course, self.fraction_course_q24,
        )
        # fmt: on

    def _first_end(self, tables, frames):
        # fmt: off
        return _ends(
            self.playing, self.found, frames, 1, 0, tables.cycles, self._target_q28, self._start_q18,
            self.cycle_course, self.fraction_course_q24, self._all, self._ends,
        )
        # fmt: on

    def _end_gestures(self, tables, base_q15):
        """Let gestures end in the first frame of the block, and HOLD have what that leaves."""
        _end(self.playing, self.found, self._ends, self._target_q28)
        # fmt: off
        compositor.hold_targets(
            tables.actions, self._target_q28, tables.first_mapping, tables.mapping_count, tables.mapped_dof,
            tables.dofs, tables.relative, base_q15, self._hold_target_q28, self._hold_w_q28, self.hold_q15,
            self._wanted,
        )
        # fmt: on
        self._has_gestures = _gestures(self.playing, self.found, tables.cycles, self._target_q28) != 0

    def sketch(self, tables, puppet, is_behind, knots):
        """Write the first `knots` knots down, as they are to be expected from the puppet's state between two frames.

        The first knot is the frame that comes next, or with `is_behind` the one that has just been, which is left to the
        caller. What `take` took is no longer whole then: `playing`, `found` and `hold_q15` are the present ones.
        """
        a = puppet.actions
        self.found = a.found
        _copy_bytes(a.playing, self.playing, a.found)
        _copy_halves(puppet.hold_q15, self.hold_q15, tables.dofs)
        rate_hz = tables.frame_rate_hz
        strides = self._strides if is_behind else self._strides_before
        live_target_q28, live_x_q28, live_w_q28 = puppet.live_state
        hold_target_q28, hold_x_q28, hold_w_q28 = puppet.hold_state
        # fmt: off
        a.nominal_phases(puppet.master, rate_hz, self._zero_offset_q28, self._nominal_cycle, self._nominal_q24)
        _sketch_phases(
            a.playing, a.found, knots, self._strides_behind if is_behind else self._strides,
            rate_hz, puppet.tempo_q16[0], a.tempo_q16, tables.warp_q26,
            self._nominal_cycle, self._nominal_q24, a.offset_q28, self.cycle_course, self.fraction_course_q24, self.pace_q22,
        )
        _ends(
            a.playing, a.found, knots, 0 if is_behind else 1, 1 if is_behind else 0, tables.cycles, a.target_q28, a.start_q18,
            self.cycle_course, self.fraction_course_q24, self.knots, self._ends,
        )
        _turns(
            a.playing, a.found, tables.first_mapping, tables.mapping_count, tables.mapped_dof, a.target_q28,
            self._ends, tables.dofs, hold_target_q28, self.turn,
        )
        weights.sketch(
            a.playing, a.found, knots, strides, self._ends, 0, self._power_q15, a.target_q28, a.x_q28, a.w_q28, tables.rise_q26,
            tables.fall_q26, self.weight_course_q28, self.weight_peak_q28,
        )
        weights.sketch(
            self._all, tables.dofs, knots, strides, self.turn, 8192, self._power_q15, hold_target_q28, hold_x_q28, hold_w_q28,
            tables.hold_q26, tables.hold_q26, self.hold_course_q28, self.hold_peak_q28,
        )
        if tables.lives:
            weights.sketch(
                self._all, tables.lives, knots, strides, self._never, 0, self._power_q15, live_target_q28, live_x_q28, live_w_q28,
                tables.live_rise_q26, tables.live_fall_q26, self.live_course_q28, self._live_peak_q28,
            )
            _drift(
                tables.lives, knots, strides, 0, tables.live_fade_q15, puppet.kalman.velocity_q28,
                live_target_q28, tables.live_rise_q26, tables.live_fall_q26, live_x_q28, live_w_q28,
                live_x_q28, live_w_q28, self.live_course_q28,
            )
        # fmt: on
