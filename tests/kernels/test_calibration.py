"""Calibration and the tap: levels, pulse widths, turns and the course between ticks, in 32 bits over all positions and ends."""

import itertools
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, words
from tests.reference_motor import driven, pulse_us, tapped

MODULE = load_checked("firmware/calibration.py")
ONE = formats.POSITION_ONE
STILL = ONE // 2
DOFS = formats.DOFS_MAX
Q18 = 1 << 18
END_LEAST, END_MOST = formats.PULSE_MIN_US << formats.PULSE_BITS, formats.PULSE_MAX_US << formats.PULSE_BITS

positions = integers(0, ONE, STILL, STILL - 1, STILL + 1, STILL + STILL // 64)
ends_q4us = integers(END_LEAST, END_MOST)
shares_q15 = integers(0, formats.VALUE_ONE)


class Outputs:
    """The arrays of some outputs: (position, relative, end0, end1, dead, top, turns) each."""

    def __init__(self, outputs):
        self.count = len(outputs)
        position, relative, end0, end1, dead, top, turns = zip(*outputs, strict=True)
        self.position, self.relative, self.turns = words(position), bytes(relative), bytes(turns)
        self.end0, self.end1, self.dead, self.top = halves(end0), halves(end1), halves(dead), halves(top)
        self.now = halves([0] * (2 * DOFS))
        for d in range(self.count):
            self.now[d], self.now[DOFS + d] = end0[d], end1[d]
        self.turn = bytearray(self.count)
        self.level, self.pulse = words([0] * self.count), words([0] * self.count)

    def tick(self, glide=1):
        """Calibrate once; return the mask of the outputs whose turn it is."""
        return MODULE.calibrate(
            self.position,
            self.level,
            self.pulse,
            self.count,
            self.relative,
            self.now,
            self.end0,
            self.end1,
            glide,
            self.dead,
            self.top,
            self.turn,
            self.turns,
        )


@given(st.lists(st.tuples(positions, ends_q4us, ends_q4us), min_size=1, max_size=DOFS))
def test_pulse_of_a_position_is_exact_to_2_to_the_minus_16_us(outputs):
    found = Outputs([(position, 0, end0, end1, 0, 32768, 1) for position, end0, end1 in outputs])
    found.tick()
    for d, (position, end0, end1) in enumerate(outputs):
        expected = pulse_us(position / ONE, end0 / 16, end1 / 16)
        # Of two products the smaller one is cut off, to 2^-18 us.
        assert found.level[d] == position and abs(found.pulse[d] / Q18 - expected) < 2**-16


@given(positions, shares_q15, shares_q15, ends_q4us, ends_q4us)
def test_wheel_gets_its_drive(position, one, other, end0, end1):
    dead, top = sorted((one, other))
    outputs = Outputs([(position, 1, end0, end1, dead, top, 1)])
    outputs.tick()
    drive = driven((position - STILL) / STILL, dead / 32768, top / 32768)
    # Three products, each cut off to 2^-23 of full drive, towards standing still. On the way to the dead band's end, 64 times as
    # steep, the speed is cut off to 2^-19 before: to 2^-13 of full drive, which is finer than any output.
    lost = (4 + (1024 if abs(position - STILL) < STILL // 64 else 0)) / STILL
    assert -lost < abs(outputs.level[0] - STILL) / STILL - abs(drive) < 1e-9
    assert (outputs.level[0] - STILL) * (position - STILL) >= 0
    expected = pulse_us((drive + 1) / 2, end0 / 16, end1 / 16)
    assert abs(outputs.pulse[0] / Q18 - expected) < 2700 * lost / 2 + 2**-16


@pytest.mark.parametrize(("dead", "top"), [(0, 32768), (6554, 32768), (0, 100), (32768, 32768), (0, 0), (9830, 19661)])
def test_wheel_stands_at_0_ends_at_its_top_speed_and_never_slows_down_on_the_way(dead, top):
    outputs = Outputs([(STILL, 1, 16_000, 32_000, dead, top, 1)])
    outputs.tick()
    assert (outputs.level[0], outputs.pulse[0]) == (STILL, 1500 * Q18)
    levels = []
    for position in sorted({*range(0, ONE + 1, 12_345), *range(STILL - 140_000, STILL + 140_000, 777), STILL, ONE}):
        outputs.position[0] = position
        outputs.tick()
        levels.append(outputs.level[0])
    assert levels == sorted(levels)
    assert levels[0] - STILL == -top << 8 and levels[-1] - STILL == top << 8


@given(st.lists(st.tuples(ends_q4us, ends_q4us, ends_q4us, ends_q4us), min_size=1, max_size=DOFS), st.integers(1, 64))
def test_ends_that_are_set_anew_glide_there(outputs, glide):
    found = Outputs([(STILL, 0, end0, end1, 0, 32768, 1) for end0, end1, *_ in outputs])
    for d, (*_, new0, new1) in enumerate(outputs):
        found.end0[d], found.end1[d] = new0, new1
    for _ in range(5):
        before = list(found.now)
        found.tick(glide)
        for d, (*_, new0, new1) in enumerate(outputs):
            assert found.pulse[d] / Q18 == (found.now[d] + found.now[DOFS + d]) / 32
            for place, new in ((d, new0), (DOFS + d, new1)):
                moved = found.now[place] - before[place]
                assert abs(new - found.now[place]) == max(0, abs(new - before[place]) - glide) and abs(moved) <= glide


@pytest.mark.parametrize("end", [END_LEAST, END_MOST])
def test_ends_arrive(end):
    outputs = Outputs([(ONE // 2, 0, 24_000, 24_000, 0, 32768, 1)])
    outputs.end1[0] = end
    for _ in range(math.ceil(abs(end - 24_000) / 64)):
        outputs.tick(64)
    assert outputs.pulse[0] / Q18 == (24_000 + end) / 32


def test_outputs_of_lower_rates_are_due_in_each_of_their_turns():
    turns = [1, 2, 3, 6]
    outputs = Outputs([(0, 0, 16_000, 32_000, 0, 32768, turn) for turn in turns])
    masks = [outputs.tick() for _ in range(36)]
    for d, turn in enumerate(turns):
        due = [tick for tick, mask in enumerate(masks) if mask >> d & 1]
        assert due == list(range(turn - 1, 36, turn))
    assert max(masks) < 1 << len(turns)


@given(
    st.lists(st.tuples(positions, positions, positions), min_size=1, max_size=DOFS),
    integers(0, 32768),
    st.integers(0, 15),
)
def test_tap_is_the_spline_of_three_ticks(columns, z_q15, frame):
    before = words([0] * (2 * DOFS))
    for d, (oldest, middle, _) in enumerate(columns):
        before[d], before[DOFS + d] = middle, oldest
    ring = halves([7] * (16 * DOFS))
    position = words([newest for *_, newest in columns])
    MODULE.tap(position, before, len(columns), z_q15, ring, frame * DOFS)
    x = z_q15 / 32768 - 0.5
    for d, (oldest, middle, newest) in enumerate(columns):
        expected = oldest * (0.5 - x) ** 2 / 2 + middle * (0.75 - x * x) + newest * (0.5 + x) ** 2 / 2
        # Half of Q15, and what is cut off of two products in Q25.
        assert abs(ring[frame * DOFS + d] - expected / 512) <= 0.5 + 4 / 1024
    others = [value for place, value in enumerate(ring) if not 0 <= place - frame * DOFS < len(columns)]
    assert set(others) <= {7}


def test_tap_of_frames_is_that_of_the_reference():
    rng = random.Random(4)
    place = ONE // 2
    positions_q24 = [place := min(max(place + rng.randint(-90_000, 90_000), 0), ONE) for _ in range(200)]
    expected = tapped([value / ONE for value in positions_q24], 3_008, 60, 30)
    ring, before = halves([0] * DOFS), words([0] * (2 * DOFS))
    for frame, value in enumerate(expected):
        middle = math.floor(frame / 60 * 1e6 / 3_008 + 0.5)
        z_q15 = round((frame / 60 * 1e6 / 3_008 - middle + 0.5) * 32768)
        before[DOFS], before[0], newest = positions_q24[middle : middle + 3]
        MODULE.tap(words([newest]), before, 1, z_q15, ring, 0)
        assert abs(ring[0] / 32768 - value) <= 0.52 / 32768


def test_tap_bends_no_more_than_the_ticks():
    # Sampled at any spacing, the second difference per time squared is a mean of the ticks' own.
    rng = random.Random(9)
    place, speed, positions_q24 = STILL, 0, []
    for _ in range(400):
        speed += rng.choice((-3_000, 3_000))
        if not ONE // 4 < place + 50 * speed < 3 * ONE // 4:
            speed += -3_000 if speed > 0 else 3_000
        place += speed
        positions_q24.append(place)
    values = tapped([value / ONE for value in positions_q24], 10_000, 60, 200)
    bends = [abs(a - 2 * b + c) * 3600 for a, b, c in zip(values, values[1:], values[2:], strict=False)]
    greatest = max(abs(a - 2 * b + c) for a, b, c in zip(*(positions_q24[n:] for n in range(3)), strict=False))
    assert max(bends) <= greatest / ONE * 1e4 * (1 + 1e-9)
    assert all(0 < a < ONE for a, _ in itertools.pairwise(positions_q24))
