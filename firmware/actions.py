"""Actions: which of them play, their phases, and tempo matching.

An action's nominal phase is `N = r * P`, its tempo times the master phase. It is computed afresh from the exact master
phase in every frame, so nothing adds up and an action that sleeps costs nothing. Its own phase is `p = N + c + o`: a
whole number `c` that is kept, and an offset `o` within about half a cycle that is warped away, which brings the
action's time back to the master's. Whole cycles are kept modulo 4096, fractions in Q24, offsets in Q28.
"""

import micropython
from micropython import const

from firmware.tables import halves, words
from shared.formats import ACTIONS_MAX

ZERO_OFFSET_Q28 = 1 << 28
_ENTRY_START = const(1)


@micropython.viper
def _select(count: int, target_q28: ptr32, x_q28: ptr32, w_q28: ptr32, playing: ptr8) -> int:
    """Write the indices of the actions with a target or a weight above zero to `playing`; return how many there are."""
    found = 0
    i = 0
    while i < count:
        if target_q28[i] | x_q28[i] | w_q28[i]:
            playing[found] = i
            found += 1
        i += 1
    return found


@micropython.viper
def _phases(
    playing: ptr8,
    found: int,
    master: ptr32,
    rate_hz: int,
    tempo_q16: ptr32,
    kept_cycle: ptr16,
    offset_q28: ptr32,
    cycle: ptr16,
    fraction_q24: ptr32,
):
    """Write the phase of every playing action: `cycle[i]` in 0..4095, `fraction_q24[i]` in 0..2^24 - 1.

    With `P = whole + (sixteenth + remainder / F) / 2^16` and the tempo `k / 2^16`, `k` at most 2^19:
    `N = k * whole / 2^16 + (k * sixteenth + k * remainder / F) / 2^32`. `k` is split in two limbs of 10 bits, `whole`
    in two of 14, which keeps every product below 2^26 and every sum below 2^30. `N` is below the exact phase by less
    than 2^-24 cycle. Offsets are stored with one cycle (2^28) added, so that no stored word is negative.
    """
    whole_high = master[0] >> 14
    whole_low = master[0] & 0x3FFF
    sixteenth = master[1]
    remainder = master[2]
    n = 0
    while n < found:
        i = int(playing[n])
        k = tempo_q16[i]
        k_high = k >> 10
        k_low = k & 0x3FF
        # k * whole, modulo 2^28: cycles in Q16
        upper = (k_low * whole_high + (((k_high * whole_high) & 15) << 10)) & 0x3FFF
        cycles_q16 = (k_low * whole_low + (((k_high * whole_low) & 0x3FFFF) << 10) + (upper << 14)) & 0xFFFFFFF
        # k * (sixteenth + remainder / F), down to Q24
        part_q24 = ((k_low * sixteenth + (k * remainder) // rate_hz) >> 8) + ((k_high * sixteenth) << 2)
        sum_q24 = ((cycles_q16 & 0xFFFF) << 8) + part_q24 + ((offset_q28[i] - 0x10000000 + 8) >> 4)
        fraction_q24[i] = sum_q24 & 0xFFFFFF
        cycle[i] = ((cycles_q16 >> 16) + kept_cycle[i] + (sum_q24 >> 24)) & 0xFFF
        n += 1


@micropython.viper
def _rebase(
    cycle: ptr16, fraction_q24: ptr32, kept_cycle: ptr16, offset_q28: ptr32, i: int, p_cycle: int, p_q24: int
):
    """Choose `c` and `o` of action `i` so that its phase is `p`; `cycle[i]`, `fraction_q24[i]` hold its nominal phase.

    `o = wrap(p - N)` with `wrap(x) = x - floor(x + 1/2 + 1/1024)`, `c = p - N - o`. They become `p` afterwards.
    """
    difference_q24 = p_q24 - fraction_q24[i]
    turns = (difference_q24 + 0x804000) >> 24
    offset_q28[i] = ((difference_q24 - (turns << 24)) << 4) + 0x10000000
    kept_cycle[i] = (p_cycle - cycle[i] + turns) & 0xFFF
    cycle[i] = p_cycle
    fraction_q24[i] = p_q24


@micropython.viper
def _end_gestures(
    playing: ptr8,
    found: int,
    cycles: ptr16,
    target_q28: ptr32,
    before_q28: ptr32,
    cycle: ptr16,
    fraction_q24: ptr32,
    start_q18: ptr32,
):
    """Set the target of every gesture to 0 whose phase has advanced by more than `cycles - 1/1024` since it began.

    A gesture whose target rises in this frame (`before` is 0) has not begun yet.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        if cycles[i]:
            if target_q28[i]:
                if before_q28[i]:
                    phase_q18 = (int(cycle[i]) << 18) | (fraction_q24[i] >> 6)
                    if ((phase_q18 - start_q18[i]) & 0x3FFFFFFF) > (int(cycles[i]) << 18) - 256:
                        target_q28[i] = 0
        n += 1


@micropython.viper
def _risen(count: int, target_q28: ptr32, before_q28: ptr32, w_q28: ptr32, risen: ptr8) -> int:
    """List the actions whose target rose from 0 in this frame, 128 added if the weight is below 1/256; return how many.

    `before` becomes the targets of this frame.
    """
    found = 0
    i = 0
    while i < count:
        g = target_q28[i]
        if g != before_q28[i]:
            if before_q28[i] == 0:
                risen[found] = i + 128 if w_q28[i] < 0x100000 else i
                found += 1
            before_q28[i] = g
        i += 1
    return found


@micropython.viper
def _warp(
    playing: ptr8,
    found: int,
    offset_q28: ptr32,
    warp_q26: ptr32,
    tempo_q16: ptr32,
    master_tempo_q16: int,
    rate_hz: int,
):
    """Let every offset shrink by its share `warp`, but by no more than half of what the nominal phase advances.

    Half the advance, `r * T / (2 * F)`, is computed from two limbs of `r` (10 bits each): sums stay below 2^29. The
    product with `warp` is that of `weights.integrate`.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        o = offset_q28[i] - 0x10000000
        if o:
            high = o >> 15
            low = o & 0x7FFF
            a_high = warp_q26[i] >> 13
            a_low = warp_q26[i] & 0x1FFF
            step = ((high * a_high) << 2) + (
                (((high * a_low) << 2) + low * a_high + ((low * a_low) >> 13) + 0x1000) >> 13
            )
            upper = (tempo_q16[i] >> 10) * master_tempo_q16
            whole = upper // rate_hz
            rest = ((upper - whole * rate_hz) << 10) + (tempo_q16[i] & 0x3FF) * master_tempo_q16
            most = (whole << 5) + rest // (rate_hz << 5)
            if step > most:
                step = most
            if step < 0 - most:
                step = 0 - most
            offset_q28[i] = o - step + 0x10000000
        n += 1


class Actions:
    """The state of all actions: targets, weights, tempos and phases, by index."""

    def __init__(self):
        self.found = 0  # how many play, and which
        self.playing = bytearray(ACTIONS_MAX)
        self.target_q28 = words(ACTIONS_MAX)
        self.x_q28 = words(ACTIONS_MAX)
        self.w_q28 = words(ACTIONS_MAX)
        self.cycle = halves(ACTIONS_MAX)
        self.fraction_q24 = words(ACTIONS_MAX)
        self.wanted_tempo_q16 = words(ACTIONS_MAX)  # what cues asked for; in force from `follow_tempos` on
        self.tempo_q16 = words(ACTIONS_MAX)
        self.before_q28 = words(ACTIONS_MAX)
        self.kept_cycle = halves(ACTIONS_MAX)
        self.offset_q28 = words(ACTIONS_MAX)
        self.start_q18 = words(ACTIONS_MAX)
        self.risen = bytearray(ACTIONS_MAX)
        self._one = bytearray(1)

    def rest(self, tables):
        """Set all to what holds before frame 0: no targets, no weights, the tables' tempos."""
        self.found = 0
        for i in range(ACTIONS_MAX):
            self.target_q28[i] = self.x_q28[i] = self.w_q28[i] = self.before_q28[i] = 0
            self.tempo_q16[i] = self.wanted_tempo_q16[i] = tables.tempo_q16[i]
            self.kept_cycle[i] = 0
            self.offset_q28[i] = ZERO_OFFSET_Q28

    def compute_phases(self, tables, master, rate_hz):
        """List who plays and compute their phases, at the tempos of the frame before."""
        self.found = _select(tables.actions, self.target_q28, self.x_q28, self.w_q28, self.playing)
        self._phases(self.playing, self.found, master, rate_hz)

    def follow_tempos(self, tables, master, rate_hz):
        """Put the tempos into force that cues asked for; the phases of those who play go on from where they are."""
        for i in range(tables.actions):
            if self.wanted_tempo_q16[i] != self.tempo_q16[i]:
                cycle = self.cycle[i]
                fraction_q24 = self.fraction_q24[i]
                self.tempo_q16[i] = self.wanted_tempo_q16[i]
                self._place(i, cycle, fraction_q24, master, rate_hz)

    def end_gestures(self, tables):
        """Let gestures end that have played their cycles."""
        # fmt: off
        _end_gestures(
            self.playing, self.found, tables.cycles, self.target_q28, self.before_q28, self.cycle, self.fraction_q24,
            self.start_q18,
        )
        # fmt: on

    def enter(self, tables, master, rate_hz):
        """Let actions enter whose target has risen from 0 in this frame and whose weight is faint.

        Returns how many targets have risen; `risen` lists them, 128 added for those that enter.
        """
        count = _risen(tables.actions, self.target_q28, self.before_q28, self.w_q28, self.risen)
        for n in range(count):
            i = self.risen[n] & 127
            if self.risen[n] >= 128:
                if tables.entry[i] == _ENTRY_START:
                    self._place(i, 0, 0, master, rate_hz)
                else:
                    self._nominal(i, master, rate_hz)
            self.start_q18[i] = self.cycle[i] << 18 | self.fraction_q24[i] >> 6
        return count

    def warp(self, tables, master_tempo_q16, rate_hz):
        """Bring offsets nearer to 0, at the end of a frame."""
        # fmt: off
        _warp(
            self.playing, self.found, self.offset_q28, tables.warp_q26, self.tempo_q16, master_tempo_q16, rate_hz
        )
        # fmt: on

    def nominal_phases(self, master, rate_hz, zero_offset_q28, cycle, fraction_q24):
        """Write the phases of those who play without their offsets: `N + c`, of which `zero_offset` is the offset of each."""
        # fmt: off
        _phases(
            self.playing, self.found, master, rate_hz, self.tempo_q16, self.kept_cycle, zero_offset_q28,
            cycle, fraction_q24,
        )
        # fmt: on

    def _phases(self, playing, found, master, rate_hz):
        # fmt: off
        _phases(
            playing, found, master, rate_hz, self.tempo_q16, self.kept_cycle, self.offset_q28,
            self.cycle, self.fraction_q24,
        )
        # fmt: on

    def _nominal(self, i, master, rate_hz):
        """Let action `i` have its nominal phase."""
        self.kept_cycle[i] = 0
        self.offset_q28[i] = ZERO_OFFSET_Q28
        self._one[0] = i
        self._phases(self._one, 1, master, rate_hz)

    def _place(self, i, cycle, fraction_q24, master, rate_hz):
        """Let action `i` have a phase."""
        self._nominal(i, master, rate_hz)
        _rebase(self.cycle, self.fraction_q24, self.kept_cycle, self.offset_q28, i, cycle, fraction_q24)
