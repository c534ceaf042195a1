"""Blinks: the paper's Random Triggered Sine, and its continuous sister.

While it does not blink the value is 1. In every frame in which its action's weight is above 0 each mapping draws once from
its own xorshift stream; above the threshold, and if the last blink began longer ago than the least gap, it blinks for one
period: `rtrigsin` along the raised sine, as in the paper, which jumps to 1/2 at the beginning, `blink` along the raised
cosine, which does not jump. "Longer" means by more than 1/1024 period; the time since the last blink saturates at 2048 periods.
"""

import micropython
from micropython import const

from firmware.tables import halves, words
from shared.formats import MAPPINGS_MAX

_RTRIGSIN = const(8)
_BLINKING = const(1)  # flags of a mapping
_LONG_AGO = const(2)


@micropython.viper
def _evaluate(
    playing: ptr8,
    found: int,
    w_q28: ptr32,
    cycle: ptr16,
    fraction_q24: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    function: ptr8,
    argument: ptr16,
    threshold_q16: ptr32,
    gap_q18: ptr32,
    sine: ptr16,
    stream_low: ptr16,
    stream_high: ptr16,
    start_q18: ptr32,
    flags: ptr8,
    value_q15: ptr16,
):
    """Write the values of all blinks of the playing actions.

    Times are phases in Q18 modulo 2^30 (4096 periods). The streams are kept in two halves of 16 bits.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        if w_q28[i]:
            now_q18 = (int(cycle[i]) << 18) | (fraction_q24[i] >> 6)
            m = int(first_mapping[i])
            end = m + int(mappings[i])
            while m < end:
                code = int(function[m])
                if code >= 7:
                    low = int(stream_low[m])
                    high = int(stream_high[m])
                    shifted = ((high << 13) | (low >> 3)) & 0xFFFF
                    low = low ^ ((low << 13) & 0xFFFF)
                    high = high ^ shifted
                    low = low ^ (high >> 1)
                    shifted = ((high << 5) | (low >> 11)) & 0xFFFF
                    low = low ^ ((low << 5) & 0xFFFF)
                    high = high ^ shifted
                    stream_low[m] = low
                    stream_high[m] = high
                    flag = int(flags[m])
                    since_q18 = (now_q18 - start_q18[m]) & 0x3FFFFFFF
                    if flag & 2:
                        since_q18 = 0x20000000
                    elif since_q18 >= 0x20000000:
                        since_q18 = 0x20000000
                        flag = flag | 2
                    k = int(argument[m])
                    if (flag & 1) == 0 and high > threshold_q16[k] and since_q18 > gap_q18[k] + 256:
                        flag = 1
                        start_q18[m] = now_q18
                        since_q18 = 0
                    elif since_q18 > 0x40100:
                        flag = flag & 2
                    flags[m] = flag
                    if flag & 1:
                        angle_q18 = since_q18
                        if code != _RTRIGSIN:
                            angle_q18 += 0x10000
                        angle_q18 = angle_q18 & 0x3FFFF
                        k = angle_q18 >> 9
                        a = int(sine[k])
                        value_q15[m] = a + (((int(sine[k + 1]) - a) * (angle_q18 & 511) + 256) >> 9)
                    else:
                        value_q15[m] = 32768
                m += 1
        n += 1


@micropython.viper
def _copy(count: int, source: ptr16, target: ptr16):
    """Copy 16-bit words."""
    m = 0
    while m < count:
        target[m] = source[m]
        m += 1


@micropython.viper
def _carry(count: int, old_mapping: ptr16, values: ptr16, fresh: ptr16, scratch: ptr32):
    """Let `values[m]` be what `values[old_mapping[m]]` was, or `fresh[m]` where that is 0xFFFF."""
    m = 0
    while m < count:
        k = int(old_mapping[m])
        scratch[m] = int(fresh[m]) if k == 0xFFFF else int(values[k])
        m += 1
    m = 0
    while m < count:
        values[m] = scratch[m]
        m += 1


@micropython.viper
def _carry_states(count: int, old_mapping: ptr16, start_q18: ptr32, flags: ptr8, scratch: ptr32):
    """Do the same with starts and flags; what is new is idle, its last blink long ago."""
    m = 0
    while m < count:
        k = int(old_mapping[m])
        scratch[m] = 0 if k == 0xFFFF else start_q18[k]
        m += 1
    m = 0
    while m < count:
        start_q18[m] = scratch[m]
        k = int(old_mapping[m])
        scratch[m] = 2 if k == 0xFFFF else int(flags[k])
        m += 1
    m = 0
    while m < count:
        flags[m] = scratch[m]
        m += 1


class Blinks:
    """The streams and states of all mappings that blink, by index of the mapping."""

    def __init__(self):
        self._next_low = halves(MAPPINGS_MAX)
        self._next_high = halves(MAPPINGS_MAX)
        self._first_low = halves(MAPPINGS_MAX)  # what the streams of the tables that play began with
        self._first_high = halves(MAPPINGS_MAX)
        self._stream_low = halves(MAPPINGS_MAX)
        self._stream_high = halves(MAPPINGS_MAX)
        self._start_q18 = words(MAPPINGS_MAX)
        self._flags = bytearray(MAPPINGS_MAX)

    def seed_next(self, seed, mapping):
        """Prepare the stream of a mapping of the next tables. Allocates large integers."""
        state = (seed * 0x9E3779B1 + (256 + mapping) * 0x85EBCA77) & 0xFFFFFFFF or 1
        self._next_low[mapping] = state & 0xFFFF
        self._next_high[mapping] = state >> 16

    def exchange(self, tables, old_mapping, scratch):
        """Take over the prepared streams, but go on with the state of `old_mapping[m]` where that is not 0xFFFF."""
        count = tables.mappings
        _copy(count, self._next_low, self._first_low)
        _copy(count, self._next_high, self._first_high)
        _carry(count, old_mapping, self._stream_low, self._next_low, scratch)
        _carry(count, old_mapping, self._stream_high, self._next_high, scratch)
        _carry_states(count, old_mapping, self._start_q18, self._flags, scratch)

    def rest(self, tables):
        """Begin all streams anew, all idle."""
        _copy(tables.mappings, self._first_low, self._stream_low)
        _copy(tables.mappings, self._first_high, self._stream_high)
        for mapping in range(tables.mappings):
            self._flags[mapping] = _LONG_AGO

    def enter(self, tables, action):
        """Let an action's blinks be idle, their last one long ago; their streams go on."""
        first = tables.first_mapping[action]
        for mapping in range(first, first + tables.mapping_count[action]):
            self._flags[mapping] = _LONG_AGO

    def evaluate(self, tables, actions, sine, value_q15):
        """Write the values of all blinks of the playing actions to `value_q15`."""
        # fmt: off
        _evaluate(
            actions.playing, actions.found, actions.w_q28, actions.cycle, actions.fraction_q24, tables.first_mapping,
            tables.mapping_count, tables.function, tables.argument, tables.threshold_q16, tables.gap_q18, sine,
            self._stream_low, self._stream_high, self._start_q18, self._flags, value_q15,
        )
        # fmt: on
