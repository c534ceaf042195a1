"""Blinks against the reference's, draw by draw, and their states when tables are exchanged."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shared import formats
from tests import reference_functions as reference
from tests.checked import load_checked
from tests.kernels.values import cycles, fractions_q24, halves, integers, weights_q28, words

MODULE = load_checked("firmware/blinks.py")
SINE = load_checked("firmware/functions.py").sine_table()
ONE = formats.VALUE_ONE
UNIT = 1 << 24
ERROR = 2.0**-14 + math.pi * 2**-18
"""The sine table's, and what half a unit of a time in Q18 makes of it."""
IDLE, BLINKING, LONG_AGO = 0, 1, 2
NEVER, ALWAYS = 65535, 0

words_16 = integers(0, 65535)
starts_q18 = integers(0, (1 << 30) - 1)
flags = st.sampled_from([IDLE, BLINKING, LONG_AGO, BLINKING | LONG_AGO])


class Blink:
    """One action with one mapping that blinks, behind one that does not."""

    def __init__(
        self, code=formats.FUNCTION_BLINK, threshold_q16=NEVER, gap_q18=0, stream=1, start_q18=0, flag=LONG_AGO
    ):
        self.code, self.threshold_q16, self.gap_q18 = code, words([0, threshold_q16]), words([0, gap_q18])
        self.low, self.high = halves([0, stream & 0xFFFF]), halves([0, stream >> 16])
        self.start_q18, self.flags = words([0, start_q18]), bytearray([0, flag])

    @property
    def stream(self):
        return self.high[1] << 16 | self.low[1]

    def frame(self, phase_q24, w_q28=formats.WEIGHT_ONE):
        """Return the value at a phase, Q24 modulo 4096 periods; 7 if the kernel has left it."""
        value = halves([6, 7])
        functions = bytes([formats.FUNCTION_RSIN, self.code])
        phase = halves([phase_q24 >> 24 & 0xFFF]), words([phase_q24 & 0xFFFFFF])
        tables = halves([0]), b"\2", functions, halves([0, 1]), self.threshold_q16, self.gap_q18
        streams = self.low, self.high, self.start_q18, self.flags
        MODULE._evaluate(b"\0", 1, words([w_q28]), *phase, *tables, SINE, *streams, value)
        assert (value[0], self.low[0], self.high[0], self.start_q18[0], self.flags[0]) == (6, 0, 0, 0, 0)
        return value[1]


@given(
    st.sampled_from([formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN]),
    st.integers(1, (1 << 32) - 1),
    integers(0, 1 << 16, 60_000),
    integers(0, 1000 << 18),
    starts_q18,
    flags,
    st.lists(st.tuples(cycles, fractions_q24), min_size=1, max_size=8),
)
def test_any_state_at_any_phase_gives_a_value_in_range(code, stream, threshold, gap, start, flag, phases):
    blink = Blink(code, threshold, gap, stream, start, flag)
    for cycle, fraction_q24 in phases:
        assert 0 <= blink.frame(cycle << 24 | fraction_q24) <= ONE
        stream = reference.xorshift(stream)
        assert blink.stream == stream
        assert 0 <= blink.start_q18[1] < 1 << 30


@pytest.mark.parametrize("code", [formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN])
@given(
    st.integers(1, (1 << 32) - 1),
    st.sampled_from([0.0, 0.5, 0.8, 0.98]),
    st.sampled_from([0.0, 0.5, 1.2, 2.0, 7.75]),
    cycles,
    st.lists(integers(1, 1 << 21, 1 << 20), min_size=50, max_size=120),
)
def test_blinks_are_the_reference_s_frame_by_frame(code, stream, threshold, gap, cycle, advances_q18):
    wave = reference.rcos if code == formats.FUNCTION_BLINK else reference.rsin
    expected = reference.TriggeredSine(wave, threshold, gap, stream)
    blink = Blink(code, math.floor(threshold * 65536), math.floor(gap * (1 << 18) + 0.5), stream)
    phase_q18 = cycle << 18
    for advance_q18 in advances_q18:
        phase_q18 += advance_q18
        value = expected(phase_q18 / 2**18)
        if expected.closest_periods < 2**-17:
            return  # a unit in the time decides: either is right
        assert abs(blink.frame(phase_q18 << 6) / ONE - value) <= ERROR


def test_blink_begins_where_the_random_number_is_above_the_threshold_and_not_at_it():
    drawn = reference.xorshift(1999) >> 16
    for threshold, flag in ((drawn, LONG_AGO), (drawn - 1, BLINKING)):
        blink = Blink(threshold_q16=threshold, stream=1999)
        blink.frame(5 << 24)
        assert blink.flags[1] == flag


@pytest.mark.parametrize(("excess_q18", "begins"), [(256, False), (257, True)])
def test_blink_begins_when_the_gap_is_exceeded_by_1_of_1024(excess_q18, begins):
    gap_q18 = 3 << 18
    blink = Blink(threshold_q16=ALWAYS, gap_q18=gap_q18, start_q18=100, flag=IDLE)
    blink.frame(100 + gap_q18 + excess_q18 << 6)
    assert (blink.flags[1] == BLINKING) == begins


@pytest.mark.parametrize(("since_q18", "blinks"), [((1 << 18) + 256, True), ((1 << 18) + 257, False)])
def test_blink_ends_when_its_period_is_exceeded_by_1_of_1024(since_q18, blinks):
    blink = Blink(start_q18=(1 << 30) - 100, flag=BLINKING)  # the phase wraps on the way
    value = blink.frame(since_q18 - 100 << 6)
    assert blink.flags[1] == (BLINKING if blinks else IDLE)
    assert blinks or value == ONE


@pytest.mark.parametrize("step", [1, 700, 2047])
def test_last_blink_of_long_ago_stays_long_ago_when_phases_repeat(step):
    blink = Blink(threshold_q16=NEVER, gap_q18=1000 << 18, start_q18=0, flag=IDLE)
    for cycle in range(0, 4096 + 900, step):
        blink.frame(cycle << 24)
    assert blink.flags[1] == LONG_AGO
    blink.threshold_q16[1] = ALWAYS
    blink.frame(4096 + 900 << 24)
    assert blink.flags[1] == BLINKING


def test_entered_action_may_blink_at_once():
    blink = Blink(threshold_q16=ALWAYS, gap_q18=1000 << 18)
    assert (blink.frame(77 << 24), blink.flags[1]) == (ONE, BLINKING)


@given(weights_q28)
@example(0)
def test_stream_goes_on_while_the_weight_is_above_0(w_q28):
    blink = Blink(stream=1999)
    assert (blink.frame(0, w_q28) == 7) == (w_q28 == 0)
    assert blink.stream == (reference.xorshift(1999) if w_q28 else 1999)


@pytest.mark.parametrize(("code", "first"), [(formats.FUNCTION_BLINK, ONE), (formats.FUNCTION_RTRIGSIN, ONE // 2)])
def test_blink_goes_down_and_up_again(code, first):
    blink = Blink(code, ALWAYS, gap_q18=1000 << 18)
    values = [blink.frame(n * UNIT // 64) for n in range(66)]
    assert values[0] == first and values[65] == ONE
    assert min(values) == 0 and values.index(0) == (32 if code == formats.FUNCTION_BLINK else 48)


olds = st.lists(st.sampled_from([0, 1, 2, 3, 0xFFFF]), min_size=4, max_size=4)


@given(olds, st.lists(words_16, min_size=4, max_size=4), st.lists(words_16, min_size=4, max_size=4))
def test_streams_of_what_stays_are_carried_and_the_others_begin(old, values, fresh):
    carried = halves(values)
    MODULE._carry(4, halves(old), carried, halves(fresh), words([-1] * 4))
    assert list(carried) == [fresh[m] if k == 0xFFFF else values[k] for m, k in enumerate(old)]


@given(olds, st.lists(starts_q18, min_size=4, max_size=4), st.lists(flags, min_size=4, max_size=4))
def test_states_of_what_stays_are_carried_and_the_others_are_idle(old, starts, before):
    start_q18, carried = words(starts), bytearray(before)
    MODULE._carry_states(4, halves(old), start_q18, carried, words([-1] * 4))
    assert list(carried) == [LONG_AGO if k == 0xFFFF else before[k] for k in old]
    assert list(start_q18) == [0 if k == 0xFFFF else starts[k] for k in old]


def test_streams_begin_as_defined():
    blinks = MODULE.Blinks()
    for seed in (0, 1, 1999, 2**32 - 1):
        for mapping in (0, 1, formats.MAPPINGS_MAX - 1):
            blinks.seed_next(seed, mapping)
            found = blinks._next_high[mapping] << 16 | blinks._next_low[mapping]
            assert found == reference.stream_start(seed, 256 + mapping)


@given(st.lists(words_16, min_size=1, max_size=12), st.data())
def test_streams_are_copied_as_far_as_there_are_mappings(source, data):
    count = data.draw(st.integers(0, len(source)))
    target = halves([7] * len(source))
    MODULE._copy(count, halves(source), target)
    assert list(target) == source[:count] + [7] * (len(source) - count)
