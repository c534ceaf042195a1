"""Prediction of live channels: the kernel against the textbook's filter in float64, and what it gains on synthetic sticks."""

import itertools
import math
import random
import re
from pathlib import Path
from types import SimpleNamespace

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.kalman import AGILITY_RANGE, FADE_RANGE_S, NOISE_RANGE, Kalman, kalman_fields
from shared import formats
from tests import sticks
from tests.checked import load_checked
from tests.kernels.values import halves, integers, rates_hz, words

MODULE = load_checked("firmware/kalman.py", bytecode=("Kalman.step",))
EXCHANGE = load_checked("firmware/exchange.py")
ONE = formats.WEIGHT_ONE
FADE_ONE = formats.VALUE_ONE
REST = 0.5

ESTIMATE_ERROR = 1 / 512
"""Of position, and of velocity per frame: gains are right to 2^-13, innovations are 1 at most, and covariances are rounded.
Seldom more than 1/5000, but for readings without noise at 60 Hz with a fade of a second, where the process has 11 bits.
"""


def transition(fade=1.0):
    """Return how position (off the last target, where it fades) and velocity go on without being driven."""
    return fade * numpy.array([[1.0, 1.0], [0.0, 1.0]])


def textbook(process, noise, fade, readings):
    """Return the states [position, velocity] of a Kalman filter of constant velocity, and the greatest covariances on the way.

    Acceleration is white noise that adds `process` to the velocity's variance in a frame; None stands for a frame without a
    reading, in which everything that is not the last target fades.
    """
    driven = process * numpy.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    observation = numpy.array([1.0, 0.0])
    state, covariance, target = numpy.array([REST, 0.0]), numpy.zeros((2, 2)), REST
    states, greatest = [], 0.0
    for reading in readings:
        if reading is None:
            step, origin = transition(fade), target * observation
        else:
            step, origin, target = transition(), numpy.zeros(2), reading
        state = origin + step @ (state - origin)
        covariance = step @ covariance @ step.T + driven
        greatest = max(greatest, covariance.max())
        if reading is not None:
            gain = covariance @ observation / (observation @ covariance @ observation + noise)
            state = state + gain * (reading - observation @ state)
            covariance = (numpy.eye(2) - numpy.outer(gain, observation)) @ covariance
        state = numpy.clip(state, [0, -1], [1, 1])
        states.append(state)
    return numpy.array(states), greatest


def tables_of(*channels):
    """Return tables with a live channel for each dict of the message's fields; None stands for one whose target is held."""
    held = {"process_q16": 0, "noise_q16": 0, "fade_q15": 0}
    fields = [channel or held for channel in channels]
    return SimpleNamespace(
        lives=len(channels),
        live_rest_q28=words([round(REST * ONE)] * len(channels)),
        live_predict=bytes(channel is not None for channel in channels),
        live_process_q16=words(channel["process_q16"] for channel in fields),
        live_noise_q16=words(channel["noise_q16"] for channel in fields),
        live_fade_q15=halves(channel["fade_q15"] for channel in fields),
    )


def at_rest(tables):
    """Return a filter whose channels stand."""
    kalman = MODULE.Kalman()
    kalman.rest(tables)
    return kalman


def state_of(kalman, live=0):
    """Return [position, velocity] of a channel, after a look at what is stored."""
    stored = (*kalman._position_q28, *kalman.velocity_q28, *kalman._covariance_q16)
    assert all(0 <= word < 1 << 30 for word in stored)
    return [kalman._position_q28[live] / ONE, kalman.velocity_q28[live] / ONE - 1]


def follow(fields, readings):
    """Return the states of a channel with these readings, None in frames without one."""
    tables = tables_of(fields)
    kalman = at_rest(tables)
    target = words(tables.live_rest_q28)
    states = []
    for reading in readings:
        if reading is not None:
            target[0] = round(reading * ONE)
        kalman.step(tables, int(reading is not None), target)
        states.append(state_of(kalman))
    return numpy.array(states)


def logarithmic(least, most):
    """Floats of a range by their order of magnitude, its ends often."""
    return st.sampled_from([least, most]) | st.floats(math.log(least), math.log(most)).map(math.exp)


parameters = st.builds(
    kalman_fields,
    st.builds(Kalman, logarithmic(*NOISE_RANGE), logarithmic(*AGILITY_RANGE), logarithmic(*FADE_RANGE_S)),
    rates_hz,
)
CORNERS = [
    kalman_fields(Kalman(*corner), rate_hz)
    for *corner, rate_hz in itertools.product(NOISE_RANGE, AGILITY_RANGE, FADE_RANGE_S, (10, 60))
]


def random_readings(rng, frames):
    """Return readings that jump or wander, in all frames or in few of them, with a pause."""
    share, wanders, value = rng.choice([0.1, 0.5, 0.9, 1]), rng.random() < 0.5, rng.random()
    readings = []
    for _ in range(frames):
        value = min(max(value + rng.gauss(0, 0.05), 0), 1) if wanders else rng.random()
        readings.append(round(value * ONE) / ONE if rng.random() < share else None)
    pause = rng.randrange(frames)
    return [None if pause <= frame < pause + 10 else reading for frame, reading in enumerate(readings)]


@pytest.mark.parametrize("fields", CORNERS)
def test_estimate_is_the_textbooks_at_corners(fields):
    assert_is_the_textbooks(fields, random.Random(3))


@given(parameters, st.randoms(use_true_random=False))
def test_estimate_is_the_textbooks(fields, rng):
    assert_is_the_textbooks(fields, rng)


def assert_is_the_textbooks(fields, rng):
    readings = random_readings(rng, 60)
    expected, greatest = textbook(*in_reals(fields), readings)
    assert greatest < 1 << 28, "the host's unit leaves room for every covariance"
    assert abs(follow(fields, readings) - expected).max() < ESTIMATE_ERROR


def in_reals(fields):
    """Return the three numbers of the message as the textbook has them; the variances in the unit of the message."""
    return fields["process_q16"], fields["noise_q16"], fields["fade_q15"] / FADE_ONE


@given(
    integers(0, formats.VARIANCE_MAX_Q16, 1, 2, 3, 5, 8),
    integers(1, formats.VARIANCE_MAX_Q16, 2, 32767, 32768),
    integers(0, FADE_ONE - 1),
    st.lists(st.tuples(integers(0, ONE), st.booleans()), min_size=1, max_size=60),
    st.integers(1, 60),
)
def test_estimate_stays_in_range_whatever_the_tables_say(process_q16, noise_q16, fade_q15, frames, repeats):
    tables = tables_of({"process_q16": process_q16, "noise_q16": noise_q16, "fade_q15": fade_q15})
    kalman = at_rest(tables)
    for target_q28, arrived in frames:
        for _ in range(1 if arrived else repeats):
            kalman.step(tables, int(arrived), words([target_q28]))
            position, velocity = state_of(kalman)
            assert 0 <= position <= 1 and -1 < velocity < 1


@pytest.mark.parametrize("process_q16", [0, 1, 1000, formats.VARIANCE_MAX_Q16])
@pytest.mark.parametrize("noise_q16", [1, 1000, formats.VARIANCE_MAX_Q16])
@pytest.mark.parametrize("fade_q15", [0, 16384, FADE_ONE - 1])
def test_estimate_stays_in_range_after_long_silence_between_ends(process_q16, noise_q16, fade_q15):
    tables = tables_of({"process_q16": process_q16, "noise_q16": noise_q16, "fade_q15": fade_q15})
    kalman = at_rest(tables)
    for silence in (0, 0, 0, 1, 2, 500, 0, 0, 3000, 0):
        for target_q28 in (0, ONE):
            for arrived in (1, *[0] * silence):
                kalman.step(tables, arrived, words([target_q28]))
            position, velocity = state_of(kalman)
            assert 0 <= position <= 1 and -1 < velocity < 1


@pytest.mark.parametrize("rate_hz", [10, 30, 60])
@pytest.mark.parametrize("speed_s", [0.05, -0.3, 0.3])
def test_estimate_finds_the_velocity_of_a_ramp(rate_hz, speed_s):
    per_frame = speed_s / rate_hz
    states = follow(kalman_fields(Kalman(), rate_hz), [REST + per_frame * frame for frame in range(1, rate_hz + 1)])
    assert states[-1, 1] == pytest.approx(per_frame, rel=0.01)
    assert states[-1, 0] == pytest.approx(REST + speed_s, abs=0.001)


@pytest.mark.parametrize("fields", CORNERS)
def test_velocity_dies_out_in_silence_as_quickly_as_it_fades(fields):
    moving = [REST + 0.04 * frame for frame in range(10)]
    silence = math.ceil(22 / -math.log(fields["fade_q15"] / FADE_ONE))  # to below 1 in Q28, from 1
    states = follow(fields, moving + [None] * silence)
    speeds = states[len(moving) - 1 :, 1]
    fades = (fields["fade_q15"] / FADE_ONE) ** numpy.arange(len(speeds))
    assert speeds[0] > 0.0001
    assert speeds == pytest.approx(speeds[0] * fades, abs=silence / ONE)
    assert speeds[-1] == 0
    assert states[-1, 0] == pytest.approx(moving[-1], abs=1e-5), "the stick is where it said last"


@pytest.mark.parametrize("fields", CORNERS)
def test_gains_settle_where_process_and_noise_balance(fields):
    """From P being the same again: `K2^2 / (1 - K1) = q / r` and `K1^2 + K1 K2 + K2^2 / 6 = 2 K2`."""
    process, noise, _ = in_reals(fields)
    still = [REST] * 600
    before, after = follow(fields, [*still, REST + 0.25])[-2:]
    k1, k2 = (after - before - [before[1], 0]) / (REST + 0.25 - before.sum())
    assert k2 * k2 * noise == pytest.approx((1 - k1) * process, rel=0.03, abs=2**-12 * process)
    assert k1 * k1 + k1 * k2 + k2 * k2 / 6 == pytest.approx(2 * k2, rel=0.01)


def test_each_channel_has_its_own_state_and_bit():
    rng = random.Random(7)
    channels = [*rng.sample(CORNERS, 12), None, kalman_fields(Kalman(), 30), None, kalman_fields(Kalman(), 60)]
    readings = [random_readings(rng, 40) for _ in channels]
    tables = tables_of(*channels)
    kalman = at_rest(tables)
    target = words(tables.live_rest_q28)
    for frame in range(40):
        arrived = 0
        for live, own in enumerate(readings):
            if own[frame] is not None:
                target[live] = round(own[frame] * ONE)
                arrived |= 1 << live
        kalman.step(tables, arrived, target)
    for live, (fields, own) in enumerate(zip(channels, readings, strict=True)):
        if fields is None:
            assert state_of(kalman, live) == [target[live] / ONE, 0]
        else:
            assert state_of(kalman, live) == list(follow(fields, own)[-1])


def test_channels_keep_their_state_under_other_tables():
    fields = kalman_fields(Kalman(), 30)
    tables = tables_of(fields, fields, fields)
    kalman = at_rest(tables)
    for frame in range(5):
        kalman.step(tables, 7, words([round(ONE * (0.5 + slope * frame)) for slope in (0.01, -0.02, 0.03)]))
    states = [state_of(kalman, live) for live in range(3)]
    assert states[1][1] == pytest.approx(-0.02, abs=0.005)
    others = tables_of(fields, fields, fields)
    others.live_rest_q28[1] = ONE // 4
    kalman.rearrange(EXCHANGE.gather_words, bytes([2, formats.NEW, 0]), words([0] * 16), others)
    assert [state_of(kalman, live) for live in range(3)] == [states[2], [0.25, 0], states[0]]
    kalman.step(others, 5, words([round(ONE * 0.65), ONE // 4, round(ONE * 0.55)]))
    assert state_of(kalman, 0) != states[2]
    assert state_of(kalman, 1) == [0.25, 0]


# --- what it gains over holding


HORIZONS = (1, 3, 5, 10, 15, 30)
ALL, TURNS, JUMPS = "all of these", "of these, 1 to 5 frames before a turn", "jumps of a score"


@pytest.fixture(scope="module")
def wrong():
    """Errors by kind of synthetic recording: {kind: (of holding, of the filter)}, each [frames ahead, frames]."""
    made = {kind: sticks.recordings(make) for kind, make in sticks.KINDS.items()}
    found = {kind: sticks.compared(MODULE, recordings) for kind, recordings in made.items()}
    turns = numpy.concatenate([sticks.turning(recordings) for recordings in made.values()])
    found[ALL] = tuple(numpy.concatenate(errors, axis=1) for errors in zip(*found.values(), strict=True))
    found[TURNS] = tuple(errors[:, turns] for errors in found[ALL])
    found[JUMPS] = sticks.compared(MODULE, sticks.recordings(sticks.jumps))
    return found


def figures(held, filtered):
    """Return the errors, of holding and of the filter, at the horizons and over all that is foretold."""
    rows = [*[slice(ahead - 1, ahead) for ahead in HORIZONS], slice(None)]
    return [sticks.rms(which[row]) for row in rows for which in (held, filtered)]


def test_filter_foretells_synthetic_sticks_better_than_holding(wrong):
    for kind in sticks.KINDS:
        held, filtered = wrong[kind]
        for ahead in range(5):
            assert sticks.rms(filtered[ahead]) < 0.95 * sticks.rms(held[ahead]), f"{kind}, {ahead + 1} frames ahead"
        assert sticks.rms(filtered) < 1.03 * sticks.rms(held), kind
    held, filtered = wrong[ALL]
    assert sticks.rms(filtered[0]) < 0.7 * sticks.rms(held[0])
    assert sticks.rms(filtered[4]) < 0.9 * sticks.rms(held[4])
    assert sticks.rms(filtered) < sticks.rms(held)


def test_filter_overshoots_where_a_stick_turns_or_jumps(wrong):
    """What it costs, as the documentation says."""
    held, filtered = wrong[TURNS]
    assert held.shape[1] > 1000
    assert sticks.rms(held[4]) < sticks.rms(filtered[4]) < 2 * sticks.rms(held[4])
    held, filtered = wrong[JUMPS]
    assert sticks.rms(held) < sticks.rms(filtered) < 1.1 * sticks.rms(held)


def test_documentation_shows_what_the_filter_gains(wrong):
    text = (Path(__file__).resolve().parents[2] / "docs" / "motion.md").read_text("utf-8")
    for kind, errors in wrong.items():
        row = figures(*errors)
        cells = [f"{held:.3f} to {filtered:.3f}" for held, filtered in zip(row[::2], row[1::2], strict=True)]
        expected = f"| {kind} | {' | '.join(cells)} |"
        print(expected)
        found = re.search(rf"^\| {re.escape(kind)} \|(.*)\|$", text, re.MULTILINE)
        assert found, f"missing: {expected}"
        numbers = [float(number) for number in re.findall(r"[\d.]+", found[1])]
        assert numbers == pytest.approx(row, abs=0.001), f"expected: {expected}"
