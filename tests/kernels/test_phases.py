"""Time and phases: exact rationals at every frame, in 32 bits for phases and small integers for the clock."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.formats import CYCLES, PHASE_BITS
from tests.checked import load_checked
from tests.kernels.values import (
    cycles,
    halves,
    integers,
    master_tempos_q16,
    offsets_q28,
    rates_hz,
    tempos_q16,
    weights_q28,
    words,
)

CLOCK = load_checked(
    "firmware/clock.py",
    bytecode=("ticks_diff", "FrameClock.start", "FrameClock.begin", "FrameClock.until_us"),
)
ACTIONS = load_checked("firmware/actions.py")

WHOLE_MODULUS = 1 << 28
TICKS_MODULUS = 1 << 30
UNIT = 1 << PHASE_BITS
NO_OFFSET_Q28 = ACTIONS.ZERO_OFFSET_Q28


@st.composite
def masters(draw):
    """A frame rate and a master phase as the firmware keeps it: whole, 1/65536ths, and those divided by the rate."""
    rate_hz = draw(rates_hz)
    whole = draw(integers(0, WHOLE_MODULUS - 1, (1 << 14) - 1, 1 << 14))
    return rate_hz, [whole, draw(integers(0, 65535)), draw(integers(0, rate_hz - 1))]


def master_phase(rate_hz, master):
    """Return the number of periods that a master phase stands for."""
    whole, sixteenth, remainder = master
    return whole + (sixteenth + Fraction(remainder, rate_hz)) / 65536


@given(masters(), master_tempos_q16)
def test_master_phase_advances_by_exactly_tempo_over_rate(state, tempo_q16):
    rate_hz, master = state
    after = words(master)
    CLOCK.advance(after, tempo_q16, rate_hz)
    assert 0 <= after[0] < WHOLE_MODULUS and 0 <= after[1] < 65536 and 0 <= after[2] < rate_hz
    expected = master_phase(rate_hz, master) + Fraction(tempo_q16, 65536 * rate_hz)
    assert master_phase(rate_hz, after) == expected % WHOLE_MODULUS


def phases(rate_hz, master, tempos, kept, offsets_q28):
    """Return the phases of actions that all play, a list of (cycle, fraction_q24)."""
    count = len(tempos)
    cycle, fraction_q24 = halves([7] * count), words([7] * count)
    arrays = words(tempos), halves(kept), words(NO_OFFSET_Q28 + offset for offset in offsets_q28), cycle, fraction_q24
    ACTIONS._phases(bytes(range(count)), count, words(master), rate_hz, *arrays)
    assert all(0 <= whole < CYCLES for whole in cycle) and all(0 <= part < UNIT for part in fraction_q24)
    return list(zip(cycle, fraction_q24, strict=True))


@given(masters(), st.lists(tempos_q16, min_size=1, max_size=64))
def test_phases_are_the_exact_ones_to_2_to_the_minus_24(state, tempos):
    rate_hz, master = state
    found = phases(rate_hz, master, tempos, [0] * len(tempos), [0] * len(tempos))
    for (cycle, fraction_q24), tempo_q16 in zip(found, tempos, strict=True):
        exact = Fraction(tempo_q16, 65536) * master_phase(rate_hz, master)
        assert 0 <= (exact - cycle - Fraction(fraction_q24, UNIT)) % CYCLES < Fraction(1, UNIT)


@given(masters(), st.lists(st.tuples(tempos_q16, cycles, offsets_q28), min_size=1, max_size=64))
def test_phases_have_the_kept_cycles_and_the_offset_added(state, actions):
    rate_hz, master = state
    found = phases(rate_hz, master, *zip(*actions, strict=True))
    for (cycle, fraction_q24), (tempo_q16, kept, offset_q28) in zip(found, actions, strict=True):
        exact = Fraction(tempo_q16, 65536) * master_phase(rate_hz, master) + kept + Fraction(offset_q28, NO_OFFSET_Q28)
        # below by less than a unit from the nominal phase; the offset is rounded by half a unit
        excess = (exact - cycle - Fraction(fraction_q24, UNIT) + Fraction(1, 2 * UNIT)) % CYCLES
        assert excess < Fraction(2, UNIT)


def test_phases_are_those_of_the_playing_actions_alone():
    cycle, fraction_q24 = halves([9] * 4), words([9] * 4)
    tempos = words([1 << 16, 1 << 17, 1 << 16, 1 << 15])
    arrays = tempos, halves([0] * 4), words([NO_OFFSET_Q28] * 4), cycle, fraction_q24
    ACTIONS._phases(bytes([1, 3]), 2, words([3, 0, 0]), 30, *arrays)
    assert (list(cycle), list(fraction_q24)) == ([9, 6, 9, 1], [9, 0, 9, 1 << 23])


@given(st.lists(st.tuples(*[weights_q28 | st.just(0)] * 3), max_size=64))
def test_actions_play_with_a_target_or_a_weight_above_zero(entries):
    target, x, w = (words(column) for column in (zip(*entries, strict=True) if entries else ((), (), ())))
    playing = bytearray(64)
    found = ACTIONS._select(len(entries), target, x, w, playing)
    assert list(playing[:found]) == [i for i, entry in enumerate(entries) if any(entry)]


ticks = integers(0, TICKS_MODULUS - 1, TICKS_MODULUS // 2)


@given(ticks, integers(-(TICKS_MODULUS // 2), TICKS_MODULUS // 2 - 1, 0))
def test_ticks_difference_is_right_across_the_wrap(earlier, difference):
    assert CLOCK.ticks_diff((earlier + difference) % TICKS_MODULUS, earlier) == difference


@pytest.mark.parametrize("rate_hz", [10, 29, 60])
def test_frame_clock_is_within_a_tick_of_every_instant(rate_hz):
    """Forty minutes, across three wraps of the timer; every frame begins late by something."""
    start_us = TICKS_MODULUS - 1
    clock = CLOCK.FrameClock()
    clock.start(start_us, rate_hz)
    for n in range(2400 * rate_hz):
        exact_us = start_us + Fraction(n * 1_000_000, rate_hz)
        assert (exact_us - clock.due_us) % TICKS_MODULUS < 1
        clock.begin((clock.due_us + n % 977) % TICKS_MODULUS)
    assert clock.late_max_us == 976


@pytest.mark.parametrize("rate_hz", [30, 49, 59])
def test_frame_clock_does_not_drift_in_days(rate_hz):
    """After each whole second the clock stands where it stood before, so a second says what days bring."""
    clock = CLOCK.FrameClock()
    clock.start(123, rate_hz)
    for second in range(1, 4):
        for _ in range(rate_hz):
            clock.begin(clock.due_us)
        assert (clock.due_us, clock._remainder) == (123 + second * 1_000_000, 0)


@given(rates_hz, st.lists(integers(0, 3_000_000, 16_665, 33_332, 33_333, 33_334), max_size=50))
def test_frame_clock_notes_how_late_frames_begin(rate_hz, latenesses_us):
    clock = CLOCK.FrameClock()
    clock.start(TICKS_MODULUS - 5, rate_hz)
    for late_us in latenesses_us:
        now_us = (clock.due_us + late_us) % TICKS_MODULUS
        assert clock.until_us(now_us) == -late_us
        clock.begin(now_us)
    assert clock.late_max_us == max(latenesses_us, default=0)
