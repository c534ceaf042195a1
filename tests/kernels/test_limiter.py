"""Limits of range, speed and acceleration: they hold whatever is asked for, and cost no time beyond what they must."""

import itertools
import math
import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import integers, words
from tests.reference_motor import least_ticks

MODULE = load_checked("firmware/limiter.py")
ONE = formats.POSITION_ONE
STILL = ONE // 2
ZERO = MODULE._ZERO
WANTED_MOST = 4 * ONE
"""What a character's output saturates at."""

positions = integers(0, ONE, STILL)
speeds = integers(1, ONE, 1000)
accels = integers(2, ONE, 150, 5000, 83_000)
wanteds = integers(-WANTED_MOST, WANTED_MOST, 0, ONE, STILL, -1, ONE + 1)
corrections = integers(-ONE, ONE, 0)


class Limited:
    """One DOF behind the limiter, at rest at first. Everything is Q24."""

    def __init__(self, position, low=0, high=ONE, speed=ONE, accel=ONE, relative=False):
        self.limits = low, high, speed, accel
        self.relative = relative
        self.place(position, position, 0)

    @property
    def position(self):
        return self._state[1][0]

    @property
    def velocity(self):
        return self._state[2][0] - ZERO

    def place(self, reference, position, velocity):
        self._state = [words([reference + ZERO]), words([position]), words([velocity + ZERO])]
        self._force = words([0])  # the acceleration in force: what the limits say

    def tick(self, wanted, correction=0, held=False, standing=False, calm=ONE):
        """Take a tick and return (position, velocity, change of the velocity) after it."""
        before = self.velocity
        limits = [words([limit]) for limit in self.limits]
        wanted, correction = words([wanted + ZERO]), words([correction + ZERO])
        kinds = bytes([held]), bytes([self.relative])
        MODULE.limit(wanted, correction, *self._state, 1, *kinds, *limits, self._force, int(standing), calm)
        return self.position, self.velocity, self.velocity - before


@st.composite
def limits(draw):
    """(low, high, speed, accel)."""
    low, high = sorted((draw(positions), draw(positions)))
    return low, high, draw(speeds), draw(accels)


def far_apart(rng):
    """Return limits as files give them: a tick of 1/50 s or 1/333 s, speeds of 0.05..50 a second, accelerations of 1..1000."""
    tick_s = rng.choice((0.02, 0.003008, 0.01))
    low, high = sorted(rng.choice((0, ONE, rng.randint(0, ONE))) for _ in range(2))
    speed = 0.05 * 1000 ** rng.random() * tick_s
    accel = 1000 ** rng.random() * tick_s * tick_s
    return low, high, max(1, min(ONE, round(speed * ONE))), max(2, min(ONE, round(accel * ONE)))


def whims(rng, low, high):
    """Yield what a DOF is asked for: steps, ramps, sines, noise at the ends, for ever."""
    value = rng.randint(0, ONE)
    while True:
        kind = rng.choice(("step", "ramp", "sine", "noise", "reverse", "jitter"))
        length = rng.randint(1, 120)
        goal = rng.choice((0, ONE, low, high, rng.randint(0, ONE), rng.randint(-WANTED_MOST, WANTED_MOST)))
        rate, phase = rng.uniform(0.001, 3), rng.uniform(0, 6)
        begin = value
        for n in range(length):
            if kind == "step":
                value = goal
            elif kind == "ramp":
                value = begin + (goal - begin) * n // length
            elif kind == "sine":
                value = STILL + round(STILL * 1.2 * math.sin(rate * n + phase))
            elif kind == "noise":
                value = rng.randint(-ONE // 8, ONE + ONE // 8)
            elif kind == "reverse":
                value = (low, high)[n % 2]
            else:
                value = begin + rng.randint(-3, 3)
            yield max(-WANTED_MOST, min(WANTED_MOST, value))


def assert_within(dof, found):
    low, high, speed, accel = dof.limits
    position, velocity, change = found
    assert low <= position <= high and abs(velocity) <= speed and abs(change) <= accel


@given(limits(), st.data())
@example((0, ONE, ONE, 2), None)
@example((0, ONE, 1, ONE), None)
@example((STILL, STILL, 1, 2), None)
def test_limits_hold_whatever_is_wanted(limits, data):
    low, high, *_ = limits
    if data is None:
        start, wanted = low, [WANTED_MOST] * 20 + [-WANTED_MOST] * 60 + [WANTED_MOST] * 60
        asked = [(value, 0) for value in wanted]
    else:
        start = data.draw(st.integers(low, high))
        asked = data.draw(st.lists(st.tuples(wanteds, corrections), max_size=60))
    dof = Limited(start, *limits)
    for wanted, correction in asked:
        assert_within(dof, dof.tick(wanted, correction))


@pytest.mark.parametrize("seed", range(30))
def test_limits_hold_over_thousands_of_ticks(seed):
    rng = random.Random(seed)
    limits = far_apart(rng)
    dof = Limited(rng.randint(*limits[:2]), *limits)
    asked = whims(rng, *limits[:2])
    for _ in range(2000):
        assert_within(dof, dof.tick(next(asked), rng.choice((0, 0, rng.randint(-ONE // 8, ONE // 8)))))


@pytest.mark.parametrize("seed", range(30))
def test_motion_within_the_limits_is_followed_exactly(seed):
    # What one limiter has made of anything is within its limits, and able to brake before the ends.
    rng = random.Random(1000 + seed)
    limits = far_apart(rng)
    start = rng.randint(*limits[:2])
    first, second = Limited(start, *limits), Limited(start, *limits)
    asked = whims(rng, *limits[:2])
    for _ in range(1500):
        position, *_ = first.tick(next(asked))
        assert second.tick(position)[0] == position


def test_motion_within_the_limits_is_followed_with_its_correction():
    dof = Limited(STILL, 0, ONE, 100_000, 4_000)
    for n in range(500):
        wanted = STILL + round(ONE / 4 * math.sin(n / 40) * math.sin(n / 500) ** 2)
        correction = round(ONE / 10 * math.sin(n / 500) ** 2)
        assert dof.tick(wanted, correction)[0] == wanted + correction


@given(limits(), st.data())
def test_resting_target_is_reached_without_overshoot_in_the_least_time(limits, data):
    low, high, speed, accel = limits
    start, goal = (data.draw(st.integers(low, high)) for _ in range(2))
    # Ways that would take longer than the test likes are made shorter: all that counts is how they compare with the limits.
    longest = round(min(500 * speed, accel * 250**2))
    goal = max(start - longest, min(start + longest, goal))
    assert_reaches(Limited(start, *limits), goal, 0)


def assert_reaches(dof, goal, velocity):
    """Let a DOF go to a target at rest, and stay."""
    _, _, speed, accel = dof.limits
    sign = 1 if goal >= dof.position else -1
    way, approach = abs(goal - dof.position), sign * velocity
    # What it cannot avoid: braking to a stand first if it moves off, or cannot stop in time.
    braking = approach * approach / (2 * accel)
    if approach < 0:
        least = -approach / accel + least_ticks(way + braking, speed, accel)
    elif braking > way:
        least = approach / accel + least_ticks(braking - way, speed, accel)
    else:
        # As from rest, begun earlier.
        least = least_ticks(way + braking, speed, accel) - approach / accel
    may_pass = approach < 0 or braking + approach + accel > way
    ticks = 0
    first = dof.position
    while (dof.position, dof.velocity) != (goal, 0):
        before = dof.position
        assert_within(dof, dof.tick(goal))
        ticks += 1
        if not may_pass:
            assert sign * (dof.position - before) >= 0 and sign * (goal - dof.position) >= 0
        # The turns from speeding up to braking, or to top speed and from it, fall into ticks: each may cost one.
        assert ticks <= math.ceil(least) + 2, (
            f"from {first} at {velocity} to {goal}: at {dof.position} by {dof.velocity}"
        )
    for _ in range(3):
        assert dof.tick(goal) == (goal, 0, 0)
    return ticks


@pytest.mark.parametrize("seed", range(40))
def test_target_that_comes_to_rest_while_the_dof_moves_is_reached_in_the_least_time(seed):
    rng = random.Random(seed)
    low, high, speed, accel = limits = far_apart(rng)
    if speed * 3000 < high - low or high - low < 1000:
        limits = low, high, speed, accel = 0, ONE, max(speed, ONE // 3000), accel
    dof = Limited(rng.randint(low, high), *limits)
    asked = whims(rng, low, high)
    for _ in range(10):
        for _ in range(rng.randint(1, 200)):
            dof.tick(next(asked))
        goal = rng.choice((low, high, rng.randint(low, high)))
        dof.tick(goal)  # the target still moves in this tick: it comes here
        assert_reaches(dof, goal, dof.velocity)


@pytest.mark.parametrize("accel", [2, 3, 7])
def test_slowest_braking_takes_thousands_of_ticks_and_is_exact(accel):
    # The greatest velocity from which the whole range is enough to stop: n ticks of braking cover A * n * (n + 1) / 2.
    ticks = math.isqrt(2 * ONE // accel) - 1
    dof = Limited(0, 0, ONE, ONE, accel)
    dof.place(0, 0, accel * ticks)
    for _ in range(ticks + 50):
        assert_within(dof, dof.tick(ONE))
    assert dof.position <= ONE and dof.velocity < accel * 60


def test_step_takes_the_time_of_the_trapezoid():
    # 10 a second and 200 a second squared at 50 Hz: 0.05 s to full speed and again to brake; 0.1 s in all for half the range.
    dof = Limited(0, 0, ONE, ONE // 5, ONE * 200 // 2500)
    found = [dof.tick(STILL)[0] for _ in range(10)]
    assert found[-1] == STILL and found == sorted(found)
    assert sum(position < STILL for position in found) <= 7


def test_limits_that_are_tightened_while_a_dof_moves_are_kept_as_soon_as_the_acceleration_allows():
    dof = Limited(0, 0, ONE, ONE // 20, ONE // 200)
    while dof.position < ONE // 2:
        dof.tick(ONE)
    assert dof.velocity == ONE // 20
    accel = ONE // 400
    dof.limits = 0, ONE // 2, ONE // 50, accel
    places = []
    for _ in range(400):
        position, _, change = dof.tick(ONE)
        assert abs(change) <= ONE // 200, "it brakes with the acceleration that it had"
        places.append(position)
    overshoot = (ONE // 20) ** 2 / (2 * ONE // 200)
    assert max(places) <= ONE // 2 + overshoot + ONE // 20
    assert places[-1] == ONE // 2
    velocities = [b - a for a, b in itertools.pairwise(places)]
    assert max(abs(velocity) for velocity in velocities[40:]) <= ONE // 50
    assert max(abs(b - a) for a, b in itertools.pairwise(velocities[40:])) <= accel


@given(limits(), st.data())
def test_dof_that_is_held_stands_and_goes_on_from_there(limits, data):
    low, high, *_ = limits
    position = data.draw(st.integers(low, high))
    dof = Limited(position, *limits)
    for wanted in data.draw(st.lists(wanteds, max_size=5)):
        assert dof.tick(wanted, held=True) == (position, 0, 0)
    for wanted in data.draw(st.lists(wanteds, max_size=10)):
        assert_within(dof, dof.tick(wanted))


@given(limits(), st.lists(st.tuples(wanteds, corrections, st.booleans()), max_size=40), integers(2, ONE, 200_000))
def test_relative_dof_changes_its_speed_by_the_acceleration_at_most(limits, asked, calm):
    low, high, _, accel = limits
    low, high = min(low, STILL), max(high, STILL)
    dof = Limited(STILL, low, high, ONE, accel, relative=True)
    for wanted, correction, standing in asked:
        before = dof.position
        position, *_ = dof.tick(wanted, correction, standing=standing, calm=calm)
        assert low <= position <= high and abs(position - before) <= (min(accel, calm) if standing else accel)
        target = STILL if standing else max(low, min(high, wanted + correction))
        assert abs(target - position) == max(0, abs(target - before) - (min(accel, calm) if standing else accel))


@pytest.mark.parametrize("tick_us", [20_000, 10_000, 3_008])
def test_relative_dof_comes_to_a_stand_within_250_ms_of_full_speed(tick_us):
    calm = 4 * STILL * tick_us // 1_000_000
    dof = Limited(ONE, relative=True)
    ticks = 0
    while dof.position != STILL:
        dof.tick(ONE, standing=True, calm=calm)
        ticks += 1
    assert ticks * tick_us <= 250_000 + 2 * tick_us  # one tick is begun, one is for what rounding leaves


def test_dofs_do_not_touch_each_other():
    rng = random.Random(3)
    count = formats.DOFS_MAX
    chosen = [far_apart(rng) for _ in range(count)]
    kinds = bytes(rng.random() < 0.3 for _ in range(count))
    starts = [STILL if kind else rng.randint(low, high) for kind, (low, high, *_) in zip(kinds, chosen, strict=True)]
    alone = [Limited(start, *one, relative=bool(kind)) for start, one, kind in zip(starts, chosen, kinds, strict=True)]
    state = [words([start + ZERO for start in starts]), words(starts), words([ZERO] * count)]
    columns = [words(column) for column in zip(*chosen, strict=True)]
    force = words([0] * count)
    for _ in range(300):
        wanted = [rng.randint(-ONE // 4, ONE * 5 // 4) for _ in range(count)]
        MODULE.limit(
            words([value + ZERO for value in wanted]),
            words([ZERO] * count),
            *state,
            count,
            bytes(count),
            kinds,
            *columns,
            force,
            0,
            ONE,
        )
        assert list(state[1]) == [dof.tick(value)[0] for dof, value in zip(alone, wanted, strict=True)]


def test_lower_acceleration_is_taken_up_by_braking_with_the_old_one():
    rng = random.Random(11)
    for _ in range(200):
        low, high, speed, accel = far_apart(rng)
        dof = Limited((low + high) // 2, low, high, speed, accel)
        for _ in range(100):
            dof.tick(rng.choice((low, high)) if rng.random() < 0.1 else high)
        lower = max(2, accel // rng.randint(2, 200))
        dof.limits = (low, high, speed, lower)
        for _ in range(400):
            position, velocity, change = dof.tick(rng.choice((low, high)) if rng.random() < 0.05 else high)
            assert low <= position <= high, "it stays in its range whatever its speed was"
            assert abs(change) <= max(accel, lower) and abs(velocity) <= speed
        for _ in range(20_000):
            if dof.tick(low)[1] == 0:
                break
        dof.tick(high)
        for _ in range(200):
            assert abs(dof.tick(rng.choice((low, high)))[2]) <= lower, "from a stand on the new one holds"
