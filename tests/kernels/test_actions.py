"""Tempo matching and gestures: a phase that is placed, warped back and counted, in 32 bits and against exact fractions."""

from fractions import Fraction
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import (
    HALF_CYCLE_Q28,
    alphas_q26,
    cycles,
    fractions_q24,
    halves,
    integers,
    master_tempos_q16,
    offsets_q28,
    rates_hz,
    tempos_q16,
    weights_q28,
    words,
)

MODULE = load_checked("firmware/actions.py")
UNIT = 1 << formats.PHASE_BITS
CYCLE_Q28 = MODULE.ZERO_OFFSET_Q28
MARGIN = Fraction(1, 1024)
COUNTED_Q18 = 1 << 18


def rebase(nominal, wanted):
    """Return (kept cycles, offset_q28, phase) after an action whose nominal phase is given has been put elsewhere."""
    cycle, fraction_q24, kept, offset = halves([1, nominal[0]]), words([2, nominal[1]]), halves([3, 4]), words([5, 6])
    MODULE._rebase(cycle, fraction_q24, kept, offset, 1, *wanted)
    assert (cycle[0], fraction_q24[0], kept[0], offset[0]) == (1, 2, 3, 5)
    return kept[1], offset[1] - CYCLE_Q28, (cycle[1], fraction_q24[1])


@given(cycles, fractions_q24, cycles, fractions_q24)
@example(0, 0, 0, UNIT // 2 + UNIT // 1024 - 1)
@example(0, 0, 0, UNIT // 2 + UNIT // 1024)
@example(0, UNIT // 2 + UNIT // 1024, 0, 0)
@example(4095, UNIT - 1, 0, 0)
def test_phase_is_split_into_kept_cycles_and_the_smallest_offset(n_cycle, n_q24, p_cycle, p_q24):
    kept, offset_q28, phase = rebase((n_cycle, n_q24), (p_cycle, p_q24))
    offset = Fraction(offset_q28, CYCLE_Q28)
    assert phase == (p_cycle, p_q24)
    assert -Fraction(1, 2) - MARGIN <= offset < Fraction(1, 2) - MARGIN
    assert 0 <= kept < formats.CYCLES
    difference = p_cycle - n_cycle + Fraction(p_q24 - n_q24, UNIT)
    assert (kept + offset - difference) % formats.CYCLES == 0


class Played:
    """An `Actions` with one action, its tables, and a clock that is set by hand."""

    def __init__(self, tempo_q16=formats.TEMPO_ONE, entry=formats.ENTRY_SYNC, cycles=0):
        self.actions = MODULE.Actions()
        tempos = words([tempo_q16] * formats.ACTIONS_MAX)
        warps = words([1] * formats.ACTIONS_MAX)
        self.tables = SimpleNamespace(
            actions=1, tempo_q16=tempos, entry=bytes([entry]), cycles=halves([cycles]), warp_q26=warps
        )
        self.actions.rest(self.tables)

    def frame(self, master, target_q28=formats.WEIGHT_ONE, tempo_q16=None):
        """Take one frame's steps at a master phase; return the action's phase in periods."""
        actions, tables, rate_hz = self.actions, self.tables, 30
        actions.target_q28[0] = target_q28
        if tempo_q16 is not None:
            actions.wanted_tempo_q16[0] = tempo_q16
        actions.compute_phases(tables, words(master), rate_hz)
        actions.follow_tempos(tables, words(master), rate_hz)
        actions.end_gestures(tables)
        actions.enter(tables, words(master), rate_hz)
        return actions.cycle[0] + Fraction(actions.fraction_q24[0], UNIT)


@pytest.mark.parametrize(("entry", "expected"), [(formats.ENTRY_SYNC, Fraction(29, 4)), (formats.ENTRY_START, 0)])
def test_action_enters_in_step_or_at_its_own_beginning(entry, expected):
    played = Played(entry=entry)
    played.frame([6, 0, 0], target_q28=0)
    assert played.frame([7, 1 << 14, 0]) == expected
    assert played.frame([8, 1 << 14, 0]) == expected + 1


@given(integers(0, (1 << 28) - 1), integers(0, 65535), tempos_q16, tempos_q16)
def test_phase_goes_on_when_the_tempo_changes(whole, sixteenth, before_q16, after_q16):
    played = Played(before_q16)
    master = [whole, sixteenth, 0]
    phase = played.frame(master)
    assert played.frame(master, tempo_q16=after_q16) == phase
    after = played.frame([whole, sixteenth ^ 1, 0])  # the tempo is in force; half a period at most is to be warped away
    advance = Fraction(after_q16, 65536) * Fraction((sixteenth ^ 1) - sixteenth, 65536)
    assert abs((after - phase - advance + 1) % formats.CYCLES - 1) <= Fraction(3, UNIT)
    assert played.actions.tempo_q16[0] == after_q16


def end_gesture(count, start, now, target_q28=formats.WEIGHT_ONE, before_q28=formats.WEIGHT_ONE):
    """Return the target after the ends of gestures; `start` and `now` are phases in Q24."""
    target = words([9, target_q28])
    cycle, fraction_q24 = halves([0, now >> 24 & 0xFFF]), words([0, now & 0xFFFFFF])
    start_q18 = words([0, (start & (1 << 36) - 1) >> 6])
    before = words([9, before_q28])
    MODULE._end_gestures(b"\1", 1, halves([0, count]), target, before, cycle, fraction_q24, start_q18)
    assert target[0] == 9
    return target[1]


@given(integers(1, formats.CYCLES_MAX), integers(0, (1 << 36) - 1), integers(0, (1 << 34) - 1), st.data())
def test_gesture_ends_when_its_cycles_less_the_margin_are_exceeded(count, start, advance, data):
    near = (count << 24) - (1 << 14)
    advance = data.draw(st.just(advance) | st.integers(max(near - 200, 0), near + 200))
    ended = end_gesture(count, start, start + advance) == 0
    # phases are compared in Q18: a unit of difference either way
    assert ended == (advance > near) or abs(advance - near) <= 64


@pytest.mark.parametrize(("start_q18", "count"), [(0, 1), (77, 2), ((1 << 30) - 5, 1000)])
def test_gesture_ends_not_one_unit_early(start_q18, count):
    last = start_q18 + count * COUNTED_Q18 - 256
    assert end_gesture(count, start_q18 << 6, last << 6) != 0
    assert end_gesture(count, start_q18 << 6, last + 1 << 6) == 0


def test_gesture_that_rises_in_this_frame_and_what_is_no_gesture_do_not_end():
    late = 5 << 24
    assert end_gesture(2, 0, late) == 0
    assert end_gesture(2, 0, late, before_q28=0) != 0
    assert end_gesture(0, 0, late) != 0


def test_gesture_called_again_while_it_fades_goes_on_for_its_cycles():
    played = Played(entry=formats.ENTRY_START, cycles=2)
    targets = []
    wanted = formats.WEIGHT_ONE
    for sixteenth in range(80):  # sixteen frames a period
        played.actions.w_q28[0] = formats.WEIGHT_ONE // 2  # never faint: it enters with the first target only
        wanted = formats.WEIGHT_ONE if sixteenth in (0, 40) else played.actions.target_q28[0]
        played.frame([sixteenth >> 4, (sixteenth & 15) << 12, 0], wanted)
        targets.append(played.actions.target_q28[0] > 0)
    assert [n for n in range(1, 80) if targets[n] != targets[n - 1]] == [32, 40, 72]


@given(st.lists(st.tuples(weights_q28 | st.just(0), weights_q28 | st.just(0), weights_q28), max_size=64))
def test_actions_whose_target_rises_are_listed_and_the_faint_ones_marked(entries):
    target, before, w = (words(column) for column in (zip(*entries, strict=True) if entries else ((), (), ())))
    risen = bytearray(64)
    found = MODULE._risen(len(entries), target, before, w, risen)
    assert list(risen[:found]) == [
        i + 128 * (weight < formats.FAINT_Q28) for i, (g, was, weight) in enumerate(entries) if g > 0 == was
    ]
    assert before == target


def warp(offset_q28, warp_q26, tempo_q16=formats.TEMPO_ONE, master_q16=formats.TEMPO_ONE, rate_hz=30):
    """Return an offset after one frame."""
    offsets = words([5, offset_q28 + CYCLE_Q28])
    MODULE._warp(b"\1", 1, offsets, words([1, warp_q26]), words([1, tempo_q16]), master_q16, rate_hz)
    assert offsets[0] == 5
    return offsets[1] - CYCLE_Q28


@given(offsets_q28, alphas_q26, tempos_q16, master_tempos_q16, rates_hz)
@example(HALF_CYCLE_Q28, formats.ALPHA_ONE // 2, formats.TEMPO_ONE, formats.TEMPO_ONE, 30)
@example(-HALF_CYCLE_Q28, formats.ALPHA_ONE // 2, formats.TEMPO_ONE, formats.TEMPO_ONE, 30)
def test_offset_shrinks_by_its_share_and_no_more_than_half_the_advance(offset, share_q26, tempo, master_tempo, rate):
    half = Fraction(tempo * master_tempo * CYCLE_Q28, 2 * rate * 65536 * 65536)
    step = min(abs(offset) * Fraction(share_q26, formats.ALPHA_ONE), half)
    expected = offset - step if offset > 0 else offset + step
    found = warp(offset, share_q26, tempo, master_tempo, rate)
    assert abs(found - expected) <= Fraction(3, 2)
    assert abs(offset - found) <= half  # never runs back, never by more than half
    assert abs(found) <= abs(offset)


@pytest.mark.parametrize("start_q28", [-HALF_CYCLE_Q28, HALF_CYCLE_Q28])
def test_offset_dies_out_and_stays_out(start_q28):
    offset, frames = start_q28, 0
    while abs(offset) > 16 and frames < 700:
        offset, frames = warp(offset, 2163434), frames + 1  # warp 1 s at 30 Hz
    assert abs(offset) <= 16
    assert warp(0, formats.ALPHA_ONE - 1) == 0
