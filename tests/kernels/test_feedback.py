"""Error correction: its kernels against plain floats, and the loop closed over simulated servos (`tests.plant`)."""

import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.checked import load_checked
from tests.kernels.values import halves, integers, words
from tests.plant import Converter, Servo

TICKED = ("Feedback.tick", "Feedback._begin", "Feedback.measured", "Feedback.start", "Feedback.forgive", "_clamped")
MODULE = load_checked("firmware/feedback.py", bytecode=TICKED)
ONE = 1 << 24
ZERO = 1 << 28
ZERO_Q28 = 1 << 29
PIN = 26
DEAD, FAST = 1 / 512, 1 / 64
LAG_S, FADE_S = 0.1, 0.5
GAIN, RATE_HZ, MOST = 0.1, 0.5, 0.1
"""A gentle correction: the time constant of what is left is `(1 + GAIN) / RATE_HZ`, 2.2 s."""
PERIODS_US = [20000, 3008]


def table(period_us, *channels):
    """Return tables with one DOF for each dict of settings."""
    tables = SimpleNamespace(dofs=len(channels), motor_period_us=period_us)
    defaults = {
        "feedback_pin": PIN,
        "feedback_at0_q15": round(0.1 * 32768),
        "feedback_at1_q15": round(0.9 * 32768),
        "feedback_gain_q15": round(GAIN * 32768),
        "feedback_integral_q24": round(RATE_HZ * period_us * 1e-6 * ONE),
        "feedback_most_q15": round(MOST * 32768),
        "stall_q15": 0,
        "stall_ticks": 0,
    }
    for name, value in defaults.items():
        setattr(tables, name, [channel.get(name, value) for channel in channels])
    return tables


class Loop:
    """Motor ticks over servos: the command is the reference and its correction, limited in range, and nothing else.

    One tick's commands are on their way until the next one.
    """

    def __init__(self, period_us, servos, settings=None, low=0.0, high=1.0):
        settings = settings or [{}] * len(servos)
        channels = [{"feedback_pin": PIN + place} | own for place, own in enumerate(settings)]
        self.period_s = period_us * 1e-6
        self.servos = servos
        self.board = Converter({PIN + place: servo for place, servo in enumerate(servos)})
        self.feedback = MODULE.Feedback(self.board)
        self.tables = table(period_us, *channels)
        self.feedback.load(self.tables)
        self.attached = (1 << len(servos)) - 1
        self.correction_q24 = words([0] * 16)
        self.position_q24 = words([ONE // 2] * 16)
        self.low, self.high = low, high

    def correction(self, dof=0):
        return (self.correction_q24[dof] - ZERO) / ONE

    def tick(self, *references):
        for dof, reference in enumerate(references):
            if self.attached >> dof & 1:
                correction = self.correction(dof) if self.correction_q24[dof] else 0
                command = max(self.low, min(reference + correction, self.high))
                self.position_q24[dof] = round(command * ONE)
        self.feedback.tick(self.attached, self.position_q24, self.correction_q24)
        for stored in (self.feedback._settings, self.feedback._state, self.feedback._masks, self.correction_q24):
            assert min(stored) >= 0  # a 64-bit port reads words without their sign
        for dof, servo in enumerate(self.servos):
            servo.run(self.period_s, self.position_q24[dof] / ONE if self.attached >> dof & 1 else None)

    def run(self, seconds, *references):
        """Let time pass; references are numbers or functions of the time. Return [(time, places)], tick by tick."""
        places = []
        for n in range(round(seconds / self.period_s)):
            now_s = n * self.period_s
            self.tick(*(reference(now_s) if callable(reference) else reference for reference in references))
            places.append((now_s, [servo.place for servo in self.servos]))
        return places


def settled_s(course, reference, within):
    """Return when the first servo has come within so much of a place, for good."""
    outside = [now_s for now_s, places in course if abs(places[0] - reference) > within]
    return max(outside, default=0.0)


# ---- kernels


def scaled(at0_q15, at1_q15):
    return round((1 << 29) / (at1_q15 - at0_q15)) + ZERO


@st.composite
def channels(draw):
    """Settings and state of a channel, anything that can be."""
    at0 = draw(integers(0, 32768))
    at1 = draw(integers(0, 32768).filter(lambda at1: abs(at1 - at0) >= 512))
    least, most, margin = min(at0, at1), max(at0, at1), abs(at1 - at0) >> 2
    limit_q15 = draw(integers(0, 32768))
    stall_q24 = draw(st.sampled_from([1 << 27]) | integers(1, 32768).map(lambda q15: q15 << 9))
    settings = [3, at0, scaled(at0, at1), max(0, least - margin), most + margin]
    settings += [512 if least >= 512 else 0, 32256 if most <= 32256 else 32768]
    settings += [draw(integers(0, 32768)), draw(integers(0, ONE)), limit_q15 << 9, stall_q24]
    settings += [draw(integers(1, 65535)), draw(st.integers(1, 3)), draw(st.integers(0, 32768)), PIN, at1]
    integral_q28 = draw(integers(-limit_q15 << 13, limit_q15 << 13, 0))
    correction_q24 = draw(integers(-limit_q15 << 9, limit_q15 << 9, 0))
    lagged_q24 = draw(integers(-ONE, 2 * ONE, 0, ONE))
    return settings, [lagged_q24, 0, integral_q28, draw(st.integers(0, settings[11]))], correction_q24


@given(
    channels(), st.booleans(), integers(0, ONE), integers(0, 32768), st.sampled_from([0, 8]), st.sampled_from([0, 8])
)
def test_correction_is_the_definition_s(channel, is_slow, position_q24, ratio_q15, attached, stalled):
    settings, (lagged_q24, _, integral_q28, run), correction_q24 = channel
    if is_slow:
        lagged_q24 = max(-ONE, min(position_q24 - correction_q24 + lagged_q24 % 1000, 2 * ONE))
    position, correction = words([0] * 16), words([0] * 16)
    position[3], correction[3] = position_q24, correction_q24 + ZERO
    state = words([lagged_q24 + ZERO, ZERO, integral_q28 + ZERO_Q28, run])
    masks = words([8, 0, stalled, 0, 1, 0, 0, 1, 1])
    MODULE._correct(position, correction, words(settings), state, masks, attached, ratio_q15)
    found = (correction[3] - ZERO) / ONE
    found_integral = (state[2] - ZERO_Q28) / (1 << 28)

    at0, at1, limit = settings[1], settings[15], settings[9] / ONE
    integral = integral_q28 / (1 << 28)
    unit = 2.0**-23
    assert abs(found) <= limit
    if not settings[5] <= ratio_q15 <= settings[6]:
        left = 1 - settings[13] / 32768
        assert (masks[0], masks[1], masks[2], state[3]) == (0, 8, stalled, 0)
        faded = left * correction_q24 / ONE
        assert abs(found - faded) < 2**-11 and (abs(faded) < 2**-11 or abs(found_integral - left * integral) < 2**-11)
        return
    assert (masks[0], masks[1]) == (8, 0)
    measured = max(-0.25, min((ratio_q15 - at0) / (at1 - at0), 1.25))
    # the scale's rounding, and the clamp at whole ratios
    inexact = 2.0**-13 + 2 / abs(at1 - at0) * (measured in (-0.25, 1.25))
    assert abs((state[1] - ZERO) / ONE - measured) <= inexact
    if not attached:
        assert found_integral == integral and abs(found - max(-limit, min(integral, limit))) <= unit
        assert (masks[2], state[3]) == (0, 0)
        return
    measured = (state[1] - ZERO) / ONE  # from here on to the bit
    error = max(-1.0, min(lagged_q24 / ONE - measured, 1.0))
    is_large = abs(error) > settings[10] / ONE
    expected_run = min(run + settings[12], settings[11]) if is_large else 0
    assert state[3] == expected_run
    assert masks[2] == (8 if is_large and expected_run == settings[11] else stalled)
    ahead = abs((position_q24 - correction_q24 - lagged_q24) / ONE)
    error = math.copysign(max(abs(error) - DEAD, 0), error)
    share = error * settings[7] / 32768
    total = share + integral
    grown = integral
    if ahead <= FAST and not is_large and abs(total - math.copysign(limit, error)) > unit:
        if total * math.copysign(1, error) < limit:
            grown = max(-limit, min(integral + error * settings[8] / ONE, limit))
        assert abs(found_integral - grown) <= unit
    elif ahead > FAST or is_large:
        assert found_integral == integral
    assert abs(found - max(-limit, min(share + found_integral, limit))) <= 2 * unit


@given(
    st.sampled_from([0, 8]),
    st.sampled_from([0, 8]),
    integers(0, ONE),
    integers(-ONE, ONE, 0),
    integers(-ONE, 2 * ONE, 0, ONE),
    integers(1, 32768, 970),
)
def test_command_passes_the_low_pass_without_its_correction(before, attached, position, correction, lagged, lag_q15):
    arrays = words([0] * 16), words([ZERO] * 16)
    arrays[0][3], arrays[1][3] = position, correction + ZERO
    settings, state, masks = (
        words([3] + [0] * 13 + [PIN, 0]),
        words([lagged + ZERO, 1, 2, 3]),
        words([0, 0, 0, before, 1, lag_q15, 0, 0, 9]),
    )
    assert MODULE._follow(*arrays, settings, state, masks, attached) == PIN
    wanted = position - correction
    expected = lagged + (wanted - lagged) * lag_q15 / 32768 if before and attached else wanted
    assert abs(state[0] - ZERO - expected) <= 1.5
    assert list(state[1:]) == [1, 2, 3] and list(masks) == [0, 0, 0, attached, 1, lag_q15, 0, 1, 0]


# ---- readings


@pytest.mark.parametrize("ends", [(0.1, 0.9), (0.9, 0.1), (0.4, 0.45), (0.0, 1.0)])
def test_measured_value_is_the_potentiometer_s(ends):
    own = {"feedback_at0_q15": round(ends[0] * 32768), "feedback_at1_q15": round(ends[1] * 32768)}
    servo = Servo(at0=ends[0], at1=ends[1], noise=0)
    loop = Loop(20000, [servo], [own])
    loop.attached = 0
    assert (loop.feedback.measured(0), loop.feedback.start(0), loop.feedback.valid) == (-1, -1, 0)
    for place in (0.0, 0.1, 0.5, 0.9, 1.0):
        servo.place = place
        loop.run(0.06, place)
        step = 1 / 4096 / abs(ends[1] - ends[0])
        assert abs(loop.feedback.measured(0) / ONE - place) <= 0.6 * step + 3e-3 * (abs(ends[1] - ends[0]) < 0.1) + 3e-4
        assert loop.feedback.valid == 1
    assert loop.feedback.measured(1) == -1


def test_potentiometers_take_turns():
    loop = Loop(20000, [Servo(place=place) for place in (0.2, 0.5, 0.8)])
    loop.run(0.22, 0.2, 0.5, 0.8)  # the first tick begins
    assert loop.board.started == [26, 27, 28, 26, 27, 28, 26, 27, 28, 26]
    assert [round(loop.feedback.measured(dof) / ONE, 1) for dof in range(3)] == [0.2, 0.5, 0.8]


def test_broken_wire_is_reported_and_the_correction_fades():
    servo = Servo(load=-0.05)
    loop = Loop(20000, [servo], [{"stall_q15": 1 << 13, "stall_ticks": 50}])
    loop.run(20, 0.5)
    before = loop.correction()
    assert before > 0.045
    servo.is_broken = True
    corrections = []
    for _ in range(250):
        loop.tick(0.5)
        corrections.append(loop.correction())
    assert (loop.feedback.lost, loop.feedback.valid, loop.feedback.stalled) == (1, 0, 0)
    assert loop.feedback.measured(0) == -1
    steps = [a - b for a, b in zip([before, *corrections], corrections, strict=False)]
    assert min(steps) >= 0 and max(steps) < 1.05 * before * 0.02 / FADE_S
    assert corrections[-1] == 0
    assert corrections[24] == pytest.approx(before * math.exp(-0.48 / FADE_S), rel=0.03)
    servo.is_broken = False
    loop.run(20, 0.5)
    assert loop.feedback.lost == 0 and abs(servo.place - 0.5) < 0.005


@pytest.mark.parametrize("ends", [(0.0, 0.9), (0.9, 0.0)])
def test_ratio_that_an_end_reaches_is_plausible(ends):
    own = {"feedback_at0_q15": round(ends[0] * 32768), "feedback_at1_q15": round(ends[1] * 32768)}
    servo = Servo(at0=ends[0], at1=ends[1], place=0.0 if ends[0] == 0 else 1.0, noise=0)
    loop = Loop(20000, [servo], [own])
    loop.run(0.1, servo.place)
    assert (loop.feedback.lost, loop.feedback.valid) == (0, 1)


# ---- the loop


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize("load", [-0.05, 0.05])
@pytest.mark.parametrize("count", [1, 3])
def test_slow_offset_is_corrected(period_us, load, count):
    servos = [Servo(load=load, seed=seed) for seed in range(count)]
    loop = Loop(period_us, servos)
    course = loop.run(20, *[0.5] * count)
    # what is left is within 1/512, the servo's dead band of 1/1000 and the converter's noise
    assert settled_s(course, 0.5, 0.005) < 8
    for place in zip(*(places for _, places in course), strict=True):
        assert max((at - 0.5) * -math.copysign(1, load) for at in place) < 0.005  # overshoot


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize("count", [1, 3])
def test_integral_is_per_motor_tick_however_many_take_turns(period_us, count):
    servos = [Servo(noise=0) for _ in range(count)]
    own = {"feedback_gain_q15": 0, "feedback_most_q15": 16384}
    loop = Loop(period_us, servos, [own] * count)
    for servo in servos:
        servo.is_blocked = True
    loop.run(2, *[0.6] * count)
    before = loop.correction()
    ticks = 300
    loop.run(ticks * loop.period_s, *[0.6] * count)
    growth = (0.1 - DEAD) * RATE_HZ * ticks * loop.period_s
    assert loop.correction() - before == pytest.approx(growth, rel=0.005)  # what the converter resolves of 0.1


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_noise_does_not_make_a_servo_tremble(period_us):
    loop = Loop(period_us, [Servo(load=0.03, seed=7)])
    loop.run(30, 0.5)
    seen = []
    for _ in range(round(10 / loop.period_s)):
        loop.tick(0.5)
        seen.append(loop.correction())
    assert max(seen) - min(seen) < 0.0005  # the noise is +-0.002, four standard deviations


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_motion_is_not_taken_for_an_error(period_us):
    servo = Servo()
    loop = Loop(period_us, [servo])
    worst = 0.0
    for n in range(round(20 / loop.period_s)):
        loop.tick(0.5 + 0.3 * math.sin(2 * math.pi * 0.5 * n * loop.period_s))
        worst = max(worst, abs(loop.correction()))
    # at 0.94 per second; 30 ms of lag that the low-pass has too much make an error of 0.03, a tenth of which is added
    assert worst < 0.006


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_offset_is_corrected_in_slow_motion_too(period_us):
    servo = Servo(load=0.05)
    loop = Loop(period_us, [servo])
    course = loop.run(30, lambda now_s: 0.5 + 0.1 * math.sin(2 * math.pi * 0.1 * now_s))
    late = [places[0] - 0.5 for now_s, places in course if now_s >= 20]
    assert abs(sum(late) / len(late)) < 0.005


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_end_of_the_range_winds_nothing_up(period_us):
    servo = Servo(place=0.95, load=-0.05)
    loop = Loop(period_us, [servo])
    loop.run(60, 1.0)
    course = loop.run(10, 0.5)
    assert max(0.5 - places[0] for _, places in course) < 0.01
    assert settled_s(course, 0.5, 0.005) < 1


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize(("stall_q15", "recovery_s"), [(0, 8), (1 << 11, 1)])
def test_servo_that_was_blocked_recovers(period_us, stall_q15, recovery_s):
    servo = Servo()
    loop = Loop(period_us, [servo], [{"stall_q15": stall_q15, "stall_ticks": 60000}])
    servo.is_blocked = True
    loop.run(30, 0.7)
    assert abs(loop.correction()) <= MOST + 2**-15
    servo.is_blocked = False
    course = loop.run(20, 0.7)
    assert max(places[0] for _, places in course) < 0.7 + MOST + 0.005
    assert settled_s(course, 0.7, 0.005) < recovery_s


def test_correction_is_held_without_pulses():
    servo = Servo(load=-0.05)
    loop = Loop(20000, [servo])
    loop.run(30, 0.5)
    held = loop.correction()
    loop.attached = 0
    servo.place = 0.3
    loop.run(60, 0.5)
    assert abs(loop.correction() - held) < 0.0005
    assert loop.feedback.start(0) / ONE == pytest.approx(0.3 + held, abs=0.002)
    loop.position_q24[0] = loop.feedback.start(0)  # attached where it is
    loop.attached = 1
    reference = loop.position_q24[0] / ONE - loop.correction()
    course = loop.run(5, reference)
    assert max(abs(places[0] - 0.3) for _, places in course) < 0.005


# ---- stalls


@pytest.mark.parametrize("period_us", PERIODS_US)
@pytest.mark.parametrize("count", [1, 3])
def test_stall_is_found_in_time(period_us, count):
    ticks = round(0.5e6 / period_us)
    servos = [Servo(seed=seed) for seed in range(count)]
    loop = Loop(period_us, servos, [{"stall_q15": 32768 // 16, "stall_ticks": ticks}] * count)
    loop.run(1, *[0.5] * count)
    servos[0].is_blocked = True
    n = 0
    while not loop.feedback.stalled:
        loop.tick(*[0.7] + [0.5] * (count - 1))
        n += 1
        assert n * loop.period_s < 1
    # the command passes the level after 0.1 s * ln(0.2 / (0.2 - 1/16)) = 38 ms; then the stall's ticks, two turns at most
    expected = LAG_S * math.log(0.2 / (0.2 - 1 / 16)) / loop.period_s + ticks
    assert expected - count - 2 <= n <= expected + 2 * count + 2
    assert loop.feedback.stalled == 1
    loop.feedback.forgive(0)
    assert loop.feedback.stalled == 0
    loop.run(0.3, *[0.7] + [0.5] * (count - 1))
    assert loop.feedback.stalled == 0  # it counts from the beginning
    loop.run(0.4, *[0.7] + [0.5] * (count - 1))
    assert loop.feedback.stalled == 1
    loop.attached = 0
    loop.run(0.1, *[0.7] * count)
    assert loop.feedback.stalled == 0


@pytest.mark.parametrize("period_us", PERIODS_US)
def test_fast_moves_are_no_stalls(period_us):
    servo = Servo()
    loop = Loop(period_us, [servo], [{"stall_q15": 32768 // 16, "stall_ticks": round(0.3e6 / period_us)}])
    for to in (0.9, 0.1, 0.6, 0.05, 0.95, 0.5):  # from end to end at the servo's top speed
        start = loop.position_q24[0] / ONE
        way = to - start
        seconds = abs(way) / 3.0
        loop.run(0.7, lambda now, start=start, way=way, s=seconds: start + way * min(now / s, 1))
    assert loop.feedback.stalled == 0
    assert servo.place == pytest.approx(0.5, abs=0.01)


# ---- tables


def test_exchange_keeps_what_a_potentiometer_has_taught():
    loop = Loop(20000, [Servo(load=-0.05), Servo(load=0.05)])
    loop.run(30, 0.5, 0.5)
    taught = loop.correction(0), loop.correction(1)
    assert taught[0] > 0.045 and taught[1] < -0.045
    none = {"feedback_pin": 255}
    loop.feedback.load(table(20000, {"feedback_pin": 27}, none, {"feedback_pin": 26}, {"feedback_pin": 28}))
    loop.feedback.tick(0, loop.position_q24, loop.correction_q24)
    assert loop.correction(0) == pytest.approx(taught[1], abs=0.001)
    assert [loop.correction(dof) for dof in (1, 3, 4, 15)] == [0, 0, 0, 0]
    assert loop.correction(2) == pytest.approx(taught[0], abs=0.001)
    loop.feedback.load(table(20000, {"feedback_pin": 26, "feedback_at0_q15": 4000}, none))
    loop.feedback.tick(0, loop.position_q24, loop.correction_q24)
    assert [loop.correction(dof) for dof in range(3)] == [0, 0, 0]


def test_without_potentiometers_nothing_is_converted():
    loop = Loop(20000, [Servo()], [{"feedback_pin": 255}])
    loop.run(0.1, 0.5)
    assert loop.board.started == [] and loop.correction() == 0
    assert halves(loop.correction_q24[dof] >> 16 for dof in range(16)) == halves([ZERO >> 16] * 16)
