"""The outlook against what it foresees: the frames of `actions` and `weights` one by one, and filters and phases in float64."""

import math
import random
from fractions import Fraction
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import (
    ALPHA_LAST,
    HALF_CYCLE_Q28,
    alphas_q26,
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

MODULE = load_checked("firmware/outlook.py")
ACTIONS = MODULE.actions
CYCLE_Q28 = ACTIONS.ZERO_OFFSET_Q28
UNIT = 1 << formats.PHASE_BITS
KNOTS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 162, 254)
STRIDES = bytes([0] + [KNOTS[b] - KNOTS[b - 1] for b in range(1, 16)])
NEVER = 255


@pytest.mark.parametrize(
    ("copy", "array"), [("_copy_words", words), ("_copy_halves", halves), ("_copy_bytes", bytearray)]
)
def test_copy_takes_so_many_and_no_more(copy, array):
    for count in (0, 1, 4):
        source, target = array([9, 0, 200, 77, 5]), array([1, 2, 3, 4, 6])
        getattr(MODULE, copy)(source, target, count)
        assert list(source) == [9, 0, 200, 77, 5]
        assert list(target) == [9, 0, 200, 77][:count] + [1, 2, 3, 4, 6][count:]


# --- phases


def master_at(place, rate_hz):
    """Return the words of a master phase of `place / (65536 * F)` periods."""
    sixteenths, remainder = divmod(place, rate_hz)
    return words([sixteenths >> 16 & (1 << 28) - 1, sixteenths & 0xFFFF, remainder])


@st.composite
def players(draw, warps_q26=alphas_q26):
    """Up to four actions that play, in an order of their own, with one that does not before them."""
    count = draw(st.integers(1, 4))
    kinds = tempos_q16, warps_q26, cycles, offsets_q28
    columns = [draw(st.lists(kind, min_size=count + 1, max_size=count + 1)) for kind in kinds]
    return draw(st.permutations(range(1, count + 1))), *columns


class Played:
    """Actions of which some play, moved on by `actions` itself from a place of the master phase."""

    def __init__(self, players, master_tempo_q16, rate_hz, place):
        order, tempos, self.warps, kept, offsets = players
        self.playing, self.found = bytes(order), len(order)
        self.tempos, self.warps, self.kept = words(tempos), words(self.warps), halves(kept)
        self.offsets = words(offset + CYCLE_Q28 for offset in offsets)
        self.master_tempo_q16, self.rate_hz, self.place = master_tempo_q16, rate_hz, place

    def phases(self, offsets=None):
        """Return the phases of those who play, two arrays by number."""
        count = len(self.tempos)
        cycle, fraction = halves([0] * count), words([0] * count)
        master = master_at(self.place, self.rate_hz)
        offsets = self.offsets if offsets is None else offsets
        ACTIONS._phases(
            self.playing, self.found, master, self.rate_hz, self.tempos, self.kept, offsets, cycle, fraction
        )
        return cycle, fraction

    def nominal(self):
        """Return the phases without offsets."""
        return self.phases(words([CYCLE_Q28] * len(self.offsets)))

    def move(self):
        """Let a frame pass."""
        ACTIONS._warp(
            self.playing, self.found, self.offsets, self.warps, self.tempos, self.master_tempo_q16, self.rate_hz
        )
        self.place += self.master_tempo_q16


places = integers(0, (1 << 44) - 1)
FOREGONE = Fraction(254, 1 << 30) + Fraction(2, UNIT)
"""What a step in Q30 lacks of `r T / F` in 254 frames, and the rounding of two phases in Q24."""


@given(players(), master_tempos_q16, rates_hz, places, st.lists(integers(1, 16), min_size=1, max_size=4))
@example(([1], [1, formats.TEMPO_MAX_Q16], [1, 1 << 25], [0, 4095], [0, HALF_CYCLE_Q28]), 65535, 10, 12345, [16] * 15)
@example(([1], [1, formats.TEMPO_MIN_Q16], [1, 1 << 20], [0, 9], [0, -HALF_CYCLE_Q28]), 65535, 59, 12345, [16] * 15)
def test_phases_to_come_are_those_of_so_many_frames(players, master_tempo_q16, rate_hz, place, blocks):
    played = Played(players, master_tempo_q16, rate_hz, place)
    count = len(played.tempos)
    cycle, nominal_q24 = played.nominal()
    fraction_q30 = words([0] * count)
    MODULE._take_phases(played.playing, played.found, nominal_q24, fraction_q30)
    assert list(fraction_q30) == [fraction << 6 for fraction in nominal_q24]
    offset = words(played.offsets)
    for frames in blocks:
        before = cycle[:], fraction_q30[:], offset[:]
        for keep in (0, 1):
            cycle_course, course_q24 = halves([7777] * 16 * played.found), words([-1] * 16 * played.found)
            MODULE._advance_phases(
                played.playing, played.found, frames, keep, rate_hz, master_tempo_q16, played.tempos, played.warps,
                cycle, fraction_q30, offset, cycle_course, course_q24,
            )  # fmt: skip
            if not keep:
                assert (cycle, fraction_q30, offset) == before
                foreseen = cycle_course, course_q24
        assert foreseen == (cycle_course, course_q24)
        for b in range(frames):
            exact_cycle, exact_q24 = played.phases()
            for n, i in enumerate(played.playing):
                at = 16 * n + b
                lacks = exact_cycle[i] - cycle_course[at] + Fraction(exact_q24[i] - course_q24[at], UNIT)
                assert -Fraction(1, UNIT) <= (lacks + 1) % formats.CYCLES - 1 <= FOREGONE
            played.move()
        assert offset == played.offsets
        assert [course_q24[16 * n + b] for n in range(played.found) for b in range(frames, 16)] == [-1] * (
            played.found * (16 - frames)
        )


SKETCHED_NOMINAL = 254 * 2.0**-23 + 2.0**-21
"""Cycles: half a unit of Q22 for each frame, and the fraction's own unit."""
SKETCHED_OFFSET = 200 * 2.0**-15
"""Of an offset: coefficients have 15 bits, and of the 254 units that what is cut off can come to, two thirds are left with the
least warp that files have; and what the powers are rounded by.
"""


def phases_in_floats(offset, share, advance, strides):
    """Return the offset at the knots: it shrinks by its share, or by half of what a frame advances."""
    found = []
    for stride in strides:
        for _ in range(stride):
            offset -= math.copysign(min(abs(offset) * share, advance / 2), offset)
        found.append(offset)
    return found


file_warps_q26 = integers(111_755, ALPHA_LAST)
"""Those of puppet files: 10 s at 60 Hz is the slowest."""


@given(players(file_warps_q26), master_tempos_q16, rates_hz, places, integers(1, 16))
@example(([1], [1, formats.TEMPO_MAX_Q16], [1, 111_755], [0, 4095], [0, HALF_CYCLE_Q28]), 65535, 10, 12345, 16)
@example(([1], [1, formats.TEMPO_MIN_Q16], [1, 1 << 25], [0, 4095], [0, HALF_CYCLE_Q28]), 65536, 60, 12345, 16)
@example(([1], [1, formats.TEMPO_MIN_Q16], [1, 1 << 20], [0, 9], [0, -HALF_CYCLE_Q28]), 65536, 59, 12345, 16)
def test_phases_far_ahead_are_those_of_tempo_and_warp(players, master_tempo_q16, rate_hz, place, knots):
    played = Played(players, master_tempo_q16, rate_hz, place)
    cycle, nominal_q24 = played.nominal()
    before = cycle[:], nominal_q24[:], played.offsets[:]
    cycle_course, course_q24 = halves([7777] * 16 * played.found), words([-1] * 16 * played.found)
    pace_q22 = words([-1] * played.found)
    MODULE._sketch_phases(
        played.playing, played.found, knots, STRIDES, rate_hz, master_tempo_q16, played.tempos, played.warps, cycle,
        nominal_q24, played.offsets, cycle_course, course_q24, pace_q22,
    )  # fmt: skip
    assert before == (cycle, nominal_q24, played.offsets)
    for n, i in enumerate(played.playing):
        advance = Fraction(played.tempos[i] * master_tempo_q16, rate_hz << 32)
        assert abs(Fraction(pace_q22[n], 1 << 22) - advance % 1) <= Fraction(1, 1 << 23) or pace_q22[n] in (0, 1 << 22)
        start = played.offsets[i] / CYCLE_Q28 - 1
        offsets = phases_in_floats(start, played.warps[i] / formats.ALPHA_ONE, float(advance), STRIDES[:knots])
        for b in range(knots):
            nominal = cycle[i] + Fraction(nominal_q24[i], UNIT) + KNOTS[b] * advance
            found = cycle_course[16 * n + b] + Fraction(course_q24[16 * n + b], UNIT)
            error = float((found - nominal - Fraction(offsets[b]) + 1) % formats.CYCLES - 1)
            assert abs(error) <= SKETCHED_NOMINAL + SKETCHED_OFFSET * abs(start) + b * 2.0**-14
        assert list(course_q24[16 * n + knots : 16 * n + 16]) == [-1] * (16 - knots)


# --- gestures


def ends(gestures, courses, frame_of, at_once, less):
    """Return the least end, and those of all gestures: (cycles, target_q28, start_q18), whose courses are phases in Q24."""
    count = len(gestures)
    playing = bytes(range(count, 0, -1))
    columns = zip((0, 0, 0), *reversed(gestures), strict=True)  # none of them is action 0
    counts, targets, starts = columns
    course = [phase for phases in courses for phase in [*phases, *[0] * (16 - len(phases))]]
    found = bytearray([77] * count)
    target = words(targets)
    least = MODULE._ends(
        playing, count, len(frame_of), at_once, less, halves(counts), target, words(starts),
        halves(phase >> 24 & 0xFFF for phase in course), words(phase & UNIT - 1 for phase in course), bytes(frame_of), found,
    )  # fmt: skip
    assert target == words(targets)
    return least, list(found)


def has_ended(start_q18, phase, count):
    """Return whether a gesture has advanced by more than its cycles less 1/1024; phases are Q18 modulo 4096 cycles."""
    return Fraction(((phase >> 6) - start_q18) % (1 << 30), 1 << 18) > count - Fraction(1, 1024)


gestures = st.tuples(integers(1, formats.CYCLES_MAX) | st.just(0), weights_q28, integers(0, (1 << 30) - 1))


@given(
    st.lists(st.tuples(gestures, integers(0, 1 << 25), integers(-40, 300)), min_size=1, max_size=4),
    integers(1, 16),
    st.integers(0, 1),
)
def test_end_of_a_gesture_is_the_first_frame_that_exceeds_its_cycles(pairs, frames, at_once):
    """A gesture advances evenly by up to 2 cycles a frame, from where it ends in some 300 of 16ths of frames."""
    given_, courses = [gesture for gesture, _, _ in pairs], []
    for (count, _, start_q18), advance, ahead in pairs:
        first = (start_q18 << 6) + (count << 24) - (1 << 14) - (advance * ahead >> 4)
        courses.append([first + advance * b for b in range(frames)])
    least, found = ends(given_, courses, range(frames), at_once, 0)
    for (count, target_q28, start_q18), course, end in zip(given_, courses, found, strict=True):
        over = [b for b in range(frames) if has_ended(start_q18, course[b], count) and (b or at_once)]
        assert end == (over[0] if over and count and target_q28 else NEVER)
    assert least == min(found)


@given(gestures, integers(1 << 8, (1 << 25) - 1), integers(0, 253), st.integers(0, 1))
@example((1000, 1 << 28, (1 << 30) - 5), 1 << 25, 250, 0)
def test_end_of_a_gesture_between_knots_is_right_to_a_frame(gesture, advance, end, less):
    count, target_q28, start_q18 = gesture
    last = (start_q18 << 6) + (count << 24) - (1 << 14)
    first = last - advance * end + advance // 2  # half a frame's advance past the margin at `end`
    if (count << 24) < advance * end:
        first = start_q18 << 6  # no longer ago than it began
    exact = [n for n in range(1 - (1 - less), 255) if first + advance * n > last]
    least, (found,) = ends([gesture], [[first + advance * n for n in KNOTS]], KNOTS, 1 - less, less)
    assert least == found
    if not (count and target_q28 and exact):
        assert found == NEVER
    else:
        assert abs(found - (exact[0] - less)) <= 1
        assert found <= 254


@given(st.lists(st.tuples(integers(0, 1000), weights_q28), min_size=1, max_size=64), st.data())
def test_gestures_under_way_are_counted_and_those_end_that_are_due(entries, data):
    playing = bytes(data.draw(st.permutations(range(len(entries)))))
    counts, targets = zip(*entries, strict=True)
    target = words(targets)
    found = MODULE._gestures(playing, len(playing), halves(counts), target)
    assert found == sum(count > 0 and goal > 0 for count, goal in entries)
    ends = bytes(data.draw(st.lists(st.sampled_from([0, 1, 255]), min_size=len(entries), max_size=len(entries))))
    MODULE._end(playing, len(playing) - 1, ends, target)
    ended = {playing[n] for n in range(len(playing) - 1) if ends[n] == 0}
    assert list(target) == [0 if i in ended else goal for i, goal in enumerate(targets)]


@given(
    st.lists(st.tuples(weights_q28, integers(0, 255), st.lists(st.integers(0, 5), max_size=4)), min_size=1, max_size=6),
    st.lists(weights_q28, min_size=6, max_size=6),
)
def test_hold_turns_when_the_last_action_on_its_dof_ends(entries, hold_targets):
    targets, ends, dofs_of = zip(*entries, strict=True)
    firsts = [sum(map(len, dofs_of[:i])) for i in range(len(entries))]
    turn = bytearray([99] * 7)
    order = list(range(len(entries)))[::-1]
    MODULE._turns(
        bytes(order), len(order), halves(firsts), bytes(map(len, dofs_of)), bytes(dof for dofs in dofs_of for dof in dofs),
        words(targets), bytes(ends[i] for i in order), 6, words(hold_targets), turn,
    )  # fmt: skip
    for dof in range(6):
        there = [end for goal, end, dofs in entries if goal and dof in dofs]
        assert turn[dof] == (NEVER if hold_targets[dof] else max(there, default=0))
    assert turn[6] == 99


# --- live channels


def drifted(entries, strides, keep):
    """Return the courses and what is left of (fade, v, target, rise, fall, x, w); x and w stand elsewhere before."""
    columns = list(zip(*entries, strict=True))
    fade, v, target, rise, fall = halves(columns[0]), *(words(column) for column in columns[1:5])
    before_x, before_w = words(columns[5]), words(columns[6])
    x, w, course = words([-1] * len(entries)), words([-1] * len(entries)), words([-1] * 16 * len(entries))
    velocity = words(number + CYCLE_Q28 for number in v)
    count = MODULE._drift(
        len(entries), len(strides), bytes(strides), keep, fade, velocity, target, rise, fall, before_x, before_w, x, w, course,
    )  # fmt: skip
    assert count == sum(number != 0 for number in v)
    assert (list(before_x), list(before_w)) == (list(columns[5]), list(columns[6]))
    return course, [(velocity[i] - CYCLE_Q28, target[i], x[i], w[i]) for i in range(len(entries))]


lives_q28 = integers(0, formats.WEIGHT_ONE)
channels = st.tuples(
    integers(0, 32767),
    integers(-formats.WEIGHT_ONE, formats.WEIGHT_ONE - 1, 0),
    lives_q28,
    alphas_q26,
    alphas_q26,
    lives_q28,
    lives_q28,
)


def channel_in_floats(channel, strides):
    """Return `w` at the knots and all that is left: v, target, x, w."""
    fade, v, target, rise, fall, x, w = (float(number) for number in channel)
    found = []
    for stride in strides:
        for _ in range(stride):
            v *= fade / formats.VALUE_ONE
            target = min(max(target + v, 0), formats.WEIGHT_ONE)
            share = (rise if target > x else fall) / formats.ALPHA_ONE
            x += (target - x) * share
            w += (x - w) * share
        found.append(w)
    return found, (v, target, x, w)


@given(
    st.lists(channels, min_size=1, max_size=3),
    st.sampled_from([[1] * 16, [1, *STRIDES[1:]], [0, 5]]),
    st.integers(0, 1),
)
@example([(32767, 3, formats.WEIGHT_ONE // 2, 111_000, 111_000, 0, formats.WEIGHT_ONE)], [1, *STRIDES[1:]], 1)
def test_live_channels_drift_as_they_are_known_to_move(entries, strides, keep):
    entries = [
        (*entry[:4], entry[3], *entry[5:]) for entry in entries
    ]  # where x meets its target the two filters may differ
    course, left = drifted(entries, strides, keep)
    frames = sum(strides)
    for i, entry in enumerate(entries):
        expected, (v, target, x, w) = channel_in_floats(entry, strides)
        places = course[16 * i : 16 * i + 16]
        if entry[1] == 0:
            assert list(places) == [-1] * 16
            assert left[i] == (0, entry[2], -1, -1)
            continue
        # Velocities lose a unit per frame, which adds up in the target; two filters lose up to a unit of Q15 of their
        # coefficients per frame.
        sway = frames * frames / 2 + frames + 4
        error = 2 * frames * 2.0**-15 * formats.WEIGHT_ONE + sway
        for found, exact in zip(places, expected, strict=False):
            assert abs(found - exact) <= error
        assert list(places[len(strides) :]) == [-1] * (16 - len(strides))
        if keep:
            assert abs(left[i][0] - v) <= frames + 1
            assert abs(left[i][1] - target) <= sway
            assert abs(left[i][2] - x) <= error
            assert abs(left[i][3] - w) <= error
            assert left[i][3] == places[len(strides) - 1]
        else:
            assert left[i] == (entry[1], entry[2], -1, -1)


# --- the outlook

ACTORS, DOFS, LIVES = 5, 3, 2
MAPPED = ((0,), (0, 1), (1,), (2,), (2,))
BASE_Q15 = halves([1000, 2000, 3000])


class Company:
    """What `Outlook` wants to know of a puppet and its tables, at random, and what follows from it frame by frame.

    Actions 0..2 are gestures, and two that go on; some fade, and the live channels stand or drift.
    """

    def __init__(self, seed, has_gestures=True):
        draw = random.Random(seed)
        shares = [draw.randrange(1 << 21, 1 << 25) for _ in range(ACTORS)]
        self.tables = SimpleNamespace(
            actions=ACTORS,
            frame_rate_hz=draw.choice([10, 30, 60]),
            cycles=halves([draw.randint(1, 4) if has_gestures and i < 3 else 0 for i in range(ACTORS)]),
            rise_q26=words(shares),
            fall_q26=words(shares[::-1]),
            warp_q26=words(shares),
            first_mapping=halves([sum(map(len, MAPPED[:i])) for i in range(ACTORS)]),
            mapping_count=bytes(map(len, MAPPED)),
            mapped_dof=bytes(dof for dofs in MAPPED for dof in dofs),
            dofs=DOFS,
            relative=bytes(DOFS),
            hold_q26=words(shares[:DOFS]),
            lives=LIVES,
            live_rise_q26=words(shares[:LIVES]),
            live_fall_q26=words(shares[:LIVES]),
            live_fade_q15=halves([32000] * LIVES),
        )
        count = formats.ACTIONS_MAX
        self.actions = a = ACTIONS.Actions()
        self.tempo_q16 = words([draw.randint(formats.MASTER_TEMPO_MIN_Q16, formats.MASTER_TEMPO_MAX_Q16)])
        self.place = draw.randrange(1 << 40)
        a.rest(SimpleNamespace(tempo_q16=words([draw.randint(formats.TEMPO_MIN_Q16, 1 << 17) for _ in range(count)])))
        for i in range(ACTORS):
            a.target_q28[i] = a.before_q28[i] = draw.choice([0, draw.randrange(1, formats.WEIGHT_MAX)])
            a.x_q28[i] = draw.randrange(formats.WEIGHT_MAX)
            a.w_q28[i] = draw.choice([a.x_q28[i], a.x_q28[i] // 2])
            a.kept_cycle[i] = draw.randrange(formats.CYCLES)
            a.offset_q28[i] = CYCLE_Q28 + draw.randint(-HALF_CYCLE_Q28, HALF_CYCLE_Q28)
        a.compute_phases(self.tables, self.master, self.tables.frame_rate_hz)
        for i in range(ACTORS):
            a.start_q18[i] = (a.cycle[i] << 18 | a.fraction_q24[i] >> 6) - draw.randrange(1 << 18) & (1 << 30) - 1
        self.hold_q15 = halves([5000, 6000, 7000])
        wanted = [not any(a.target_q28[i] for i in range(ACTORS) if dof in MAPPED[i]) for dof in range(DOFS)]
        self.hold_state = words(formats.WEIGHT_ONE * want for want in wanted), *(words([0, 1 << 27, 1]) for _ in "xw")
        self.live_state = words([1 << 28, 1 << 27]), words([0, 1 << 27]), words([1 << 26, 1 << 27])
        self.kalman = SimpleNamespace(velocity_q28=words([CYCLE_Q28, CYCLE_Q28 - draw.choice([0, 1 << 20])]))

    @property
    def master(self):
        return master_at(self.place, self.tables.frame_rate_hz)

    def frame(self):
        """Let a frame pass; return its (weights, phases in Q24, weights of HOLD, what HOLD holds)."""
        a, t, rate_hz = self.actions, self.tables, self.tables.frame_rate_hz
        a.compute_phases(t, self.master, rate_hz)
        a.end_gestures(t)
        MODULE.compositor.hold_targets(
            ACTORS, a.target_q28, t.first_mapping, t.mapping_count, t.mapped_dof, DOFS, t.relative, BASE_Q15,
            self.hold_state[0], self.hold_state[2], self.hold_q15, bytearray(DOFS),
        )  # fmt: skip
        MODULE.weights.integrate(ACTORS, a.target_q28, a.x_q28, a.w_q28, t.rise_q26, t.fall_q26)
        MODULE.weights.integrate(DOFS, *self.hold_state, t.hold_q26, t.hold_q26)
        a.warp(t, self.tempo_q16[0], rate_hz)
        self.place += self.tempo_q16[0]
        phases = [a.cycle[i] << 24 | a.fraction_q24[i] for i in range(ACTORS)]
        return list(a.w_q28[:ACTORS]), phases, list(self.hold_state[2]), list(self.hold_q15)


@pytest.mark.parametrize("seed", range(12))
def test_outlook_foresees_frames_and_ends_of_gestures(seed):
    company = Company(seed)
    drifting = list(zip(*(list(column) for column in company.live_state), strict=True))[1]
    velocity_q28 = company.kalman.velocity_q28[1] - CYCLE_Q28
    outlook = MODULE.Outlook(KNOTS)
    outlook.take(70, company.tables, company)
    playing = list(outlook.playing[: outlook.found])
    assert playing == list(company.actions.playing[: company.actions.found])
    frames = 0
    lives = []
    while frames < 260:
        written = outlook.write(company.tables, 16, BASE_Q15)
        assert 1 <= written <= 16
        frames += written
        assert outlook.frame == 70 + frames
        lives += outlook.live_course_q28[16 : 16 + written]
        for b in range(written):
            weights, phases, holds, held = company.frame()
            for n, i in enumerate(playing):
                at = 16 * n + b
                assert outlook.weight_course_q28[at] == weights[i] <= outlook.weight_peak_q28[n]
                if weights[i]:  # those that are silent stop counting
                    found = outlook.cycle_course[at] << 24 | outlook.fraction_course_q24[at]
                    assert -1 <= (phases[i] - found + 16) % (1 << 36) - 16 <= 6
            assert [outlook.hold_course_q28[16 * dof + b] for dof in range(DOFS)] == holds
            assert list(outlook.hold_q15[:DOFS]) == held
    share = company.tables.live_rise_q26[1]
    expected, _ = channel_in_floats((32000, velocity_q28, drifting[0], share, share, *drifting[1:]), [1] * frames)
    assert max(abs(found - exact) for found, exact in zip(lives, expected, strict=True)) <= 1 << 16


@pytest.mark.parametrize("is_behind", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_sketch_is_what_the_frames_will_be_about(seed, is_behind):
    """Gestures may end a frame sooner or later; weights are right to 1/50, phases to 1/200 of a cycle."""
    company = Company(seed)
    before = company.actions.w_q28[:], company.actions.offset_q28[:], company.live_state, company.hold_state
    before = [list(map(list, part)) if isinstance(part, tuple) else list(part) for part in before]
    outlook = MODULE.Outlook(KNOTS)
    outlook.sketch(company.tables, company, is_behind, 16)
    after = company.actions.w_q28[:], company.actions.offset_q28[:], company.live_state, company.hold_state
    assert [list(map(list, part)) if isinstance(part, tuple) else list(part) for part in after] == before
    playing = list(outlook.playing[: outlook.found])
    frames = [company.frame() for _ in range(256)]
    for b in range(1, 16):
        at = KNOTS[b] - is_behind
        near = frames[max(at - 1, 0) : at + 2]
        for n, i in enumerate(playing):
            assert_between([frame[0][i] for frame in near], outlook.weight_course_q28[16 * n + b])
            if frames[at][0][i]:
                found = outlook.cycle_course[16 * n + b] << 24 | outlook.fraction_course_q24[16 * n + b]
                assert abs((found - frames[at][1][i] + (1 << 35)) % (1 << 36) - (1 << 35)) <= UNIT // 200
        for dof in range(DOFS):
            assert_between([frame[2][dof] for frame in near], outlook.hold_course_q28[16 * dof + b])


def assert_between(near_q28, found_q28):
    error = formats.WEIGHT_MAX // 50
    assert min(near_q28) - error <= found_q28 <= max(near_q28) + error
