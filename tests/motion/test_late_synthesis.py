"""The synthesis is busy with something else: motors neither jump nor stop, late frames are counted, and all comes right again."""

import itertools
import math
from fractions import Fraction
from typing import NamedTuple

import numpy
import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.prompter import Prompter
from marotte.session import Session
from shared import formats
from tests.motion.playing import Case, load
from tests.reference_motor import first_tick_of_frame, knots_of_targets, lag_s, tapped, trajectory

REST = 0.5
SWING = 0.4
TEMPO = 0.25
PIN = 2
WHEEL_PIN = 4
END0_US, END1_US = 500, 2500
BLOCK_US = 200_000
Q15 = 2.0**-15
ALL_TAPS = formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR
RATES = [(10, 50), (30, 50), (60, 50), (30, 333), (47, 100), (60, 333)]
WIDE = {"range": [0.0, 1.0], "speed": 50, "accel": 1000}


class Blocked(NamedTuple):
    """What came of a performance: taps [frames], the frames that have to be late, the status, and what the servo was told."""

    signal: numpy.ndarray
    motor: numpy.ndarray
    late: list[int]
    status: dict
    times_us: numpy.ndarray
    """Instants of what was written to the servo, from that of frame 0 on."""
    positions: numpy.ndarray


def case(frame_rate, rate_hz, limits):
    """Return a puppet that nods once in four seconds, and drives, and a robot for it."""
    puppet = {
        "frame_rate": frame_rate,
        "dof": {"NECK": {"rest": REST, "limits": limits}, "WHEEL": {"kind": "relative"}},
        "action": {
            "NOD": {"tempo": TEMPO, "map": [["NECK", REST - SWING, REST + SWING, "rsin"], ["WHEEL", 0, 1, "const(1)"]]}
        },
    }
    outputs = {
        "NECK": {"pin": PIN, "pulse_us": [END0_US, END1_US]},
        "WHEEL": {"pin": WHEEL_PIN, "pulse_us": [END0_US, END1_US]},
    }
    score = {"cue": [{"at": 0, "weights": {"NOD": 4.0}}]}
    return Case("blocked", puppet, score, {"rate": rate_hz, "output": outputs})


def period_us(rate_hz):
    return math.ceil(Fraction(1_000_000, rate_hz) / 8) * 8


def next_frame(session):
    """Let time pass until a frame has just been computed; return the next one's number, which is nearly a frame away."""
    before = session.status()["frame"]
    while (frame := session.status()["frame"]) == before:
        pass
    return frame


def perform(frame_rate, rate_hz, at_s, block_us=BLOCK_US, limits=WIDE, seconds=9):
    """Play, with the main loop blocked at these times; return `Blocked`."""
    puppet, score, robot = load(case(frame_rate, rate_hz, limits))
    tick_us = period_us(rate_hz)
    late, signal, motor = [], [], []
    with UnixMcu() as mcu:
        session = Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet, robot))
        session.telemetry(ALL_TAPS, 1, 0)
        prompter = Prompter(session, score.steps(puppet), session.welcome["queue_max"])
        prompter.reached(-1)
        session.arm()
        session.wait_attached()
        session.start()
        session.flush()

        def play_until(frame):
            while len(signal) < frame:
                session.pump(5_000)
                while session.taps:
                    number, _, values = session.taps.popleft()
                    assert number == len(signal)
                    signal.append(values[2] * Q15)
                    motor.append(values[4] * Q15)

        for time_s in at_s:
            play_until(round(time_s * frame_rate))
            first = next_frame(session)
            mcu.block(block_us)
            # The block begins with the instant of that frame, and a tick in its last microsecond comes before the main loop.
            until_us = first * 1_000_000 // frame_rate + block_us
            late += [
                n
                for n in range(first, first + 1 + block_us * frame_rate // 1_000_000)
                if first_tick_of_frame(n, tick_us, frame_rate) * tick_us <= until_us
            ]
        play_until(seconds * frame_rate)
        status = session.status()
        drive = mcu.drives()[PIN]
    written_us, pulses = (numpy.array(column) for column in drive)
    positions = (pulses / 2**18 - END0_US) / (END1_US - END0_US)
    moving = numpy.flatnonzero(numpy.diff(positions))[0]
    return Blocked(numpy.array(signal), numpy.array(motor), late, status, written_us - written_us[moving], positions)


def expected_taps(blocked, frame_rate, tick_us):
    """Return the motor taps that the late frames lead to, and those that would be without any."""
    frames = len(blocked.signal) - 4  # for the last ones the ticks behind them would be needed
    ticks = math.floor((len(blocked.signal) - 1) * 1e6 / frame_rate / tick_us)
    found = []
    for late in (blocked.late, ()):
        course = trajectory(knots_of_targets(blocked.signal, REST, frame_rate, late), frame_rate, tick_us, ticks)
        found.append(tapped(numpy.concatenate(([REST], course)), tick_us, frame_rate, frames))
    return found


@pytest.mark.parametrize(("frame_rate", "rate_hz"), RATES)
def test_late_frames_are_counted_and_guessed_as_the_definition_says(frame_rate, rate_hz):
    # Half a second before the blocks the start is over; the sine is steepest at 4 s, where it goes up.
    blocked = perform(frame_rate, rate_hz, (2.5, 3.9, 5.2))
    assert blocked.status["late_frames"] == len(blocked.late) >= 3
    assert blocked.status["late_max_us"] >= BLOCK_US - 1_000_000 / frame_rate
    expected, undisturbed = expected_taps(blocked, frame_rate, period_us(rate_hz))
    motor = blocked.motor[: len(expected)]
    # The course is cut to 2^-15 of a frame's slope, of 0.63 a second; an offset below 2^-18 is dropped; its factors and the
    # guesses', off by 2^-16 of themselves, count for a quarter of a second of frames; the tap is rounded to Q15.
    slope = 2 * math.pi * TEMPO * SWING / frame_rate
    bound = slope * 2 * Q15 + 2.0**-18 + 0.3 * (2.0**-16 * 2 * 0.3 * frame_rate) + 0.51 * Q15
    assert numpy.abs(motor - expected).max() < bound
    # Guesses are off by what velocity is lost in a fifth of a second, and by its change: that is what has to die out.
    assert 0.01 < numpy.abs(motor - undisturbed).max() < 0.1
    # Eight time constants after the offset begins nine times exp(-8) of it is left. It begins with the first frame that is in
    # time again; the block began up to two frames after it was asked for, and the course is up to two frames behind.
    back = round((5.2 + BLOCK_US / 1e6 + 2) * frame_rate) + 5
    assert numpy.abs(motor - undisturbed)[back:].max() < 1 / 1000


@pytest.mark.parametrize(("frame_rate", "rate_hz"), RATES)
def test_motors_go_on_while_the_synthesis_is_busy(frame_rate, rate_hz):
    blocked = perform(frame_rate, rate_hz, (3.8,), seconds=6)
    tick_us = period_us(rate_hz)
    assert (numpy.diff(blocked.times_us) == tick_us).all(), "every tick is written, blocked or not"
    motor = blocked.motor
    speeds = numpy.diff(motor) * frame_rate
    before = speeds[blocked.late[0] - 1]
    assert before > 0.5, "it moves when the block begins"
    # By the end of 0.2 s, and the lag of the course, exp(-(0.2 + lag) / 0.3) of the velocity is left.
    least = before * math.exp(-(BLOCK_US / 1e6 + float(lag_s(frame_rate)) + 1 / frame_rate) / 0.3)
    during = speeds[blocked.late[0] : blocked.late[-1] + 2]
    assert during.min() > 0.95 * least and during.max() < 1.05 * before


@pytest.mark.parametrize(("frame_rate", "rate_hz"), RATES)
def test_motors_do_not_jump_when_frames_come_again(frame_rate, rate_hz):
    accel = 8
    limits = {"range": [0.0, 1.0], "speed": 2, "accel": accel}
    blocked = perform(frame_rate, rate_hz, (2.3, 3.9, 5.5), limits=limits, seconds=8)
    tick_s = period_us(rate_hz) / 1e6
    velocities = numpy.diff(numpy.concatenate((blocked.positions[:1], blocked.positions))) / tick_s
    steps = numpy.abs(numpy.diff(velocities)) / tick_s
    assert steps.max() <= accel and numpy.abs(velocities).max() <= 2
    # The limits bind at the start alone: the guesses themselves are that smooth. A change of source bends by at most
    # 2 * 0.63 / 0.25 + 0.1 / 0.25^2 per s^2, of which the spline makes up to twice as much.
    later = blocked.times_us[1:-1] > 2_000_000
    assert steps[1:][later[: len(steps) - 1]].max() < 2 * (2 * 0.63 / 0.25 + 0.1 / 0.0625)


def test_frames_that_are_late_from_the_start_leave_the_dofs_where_they_are():
    puppet, score, robot = load(case(30, 100, WIDE))
    with UnixMcu() as mcu:
        session = Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet, robot))
        session.telemetry(ALL_TAPS, 1, 0)
        Prompter(session, score.steps(puppet)).reached(-1)
        session.arm()
        session.wait_attached()
        mcu.block(300_000)
        session.start()
        mcu.run_for(290_000)
        drive = mcu.drives()[PIN]
        assert set(drive.value[-25:]) == {round((END0_US + (END1_US - END0_US) * REST) * 2**18)}
        for _ in range(200):
            session.pump(20_000)
        motor = numpy.array([values[4] * Q15 for _, _, values in session.taps])
        signal = numpy.array([values[2] * Q15 for _, _, values in session.taps])
        assert 8 <= session.status()["late_frames"] <= 9
    assert [frame for frame, _, _ in session.taps] == list(range(len(motor)))
    steps = numpy.abs(numpy.diff(motor, 2))
    assert steps[:60].max() * 900 < 20
    lagged = numpy.interp(numpy.arange(90, 115) - 30 * float(lag_s(30)), numpy.arange(len(signal)), signal)
    assert numpy.abs(motor[90:115] - lagged).max() < 1 / 500


@pytest.mark.parametrize("block_us", [450_000, 900_000])
def test_long_blocks_are_survived(block_us):
    """The watchdog barks after a second; the ring of frames has room for 16, so some taps are lost, but no motion."""
    puppet, score, robot = load(case(60, 200, WIDE))
    with UnixMcu() as mcu:
        session = Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet, robot))
        Prompter(session, score.steps(puppet)).reached(-1)
        session.arm()
        session.wait_attached()
        session.start()
        for _ in range(100):
            session.pump(20_000)
        mcu.clear_drives()
        mcu.block(block_us)
        for _ in range(150):
            session.pump(20_000)
        status = session.status()
        drive = mcu.drives()[PIN]
    assert abs(status["late_frames"] - block_us * 60 // 1_000_000) <= 1
    assert (status["resets"], status["armed"], status["killed_by"]) == (0, 1, formats.KILLED_BY_NOBODY)
    assert {b - a for a, b in itertools.pairwise(drive.t_us)} == {5_000}
    positions = (numpy.array(drive.value) / 2**18 - END0_US) / (END1_US - END0_US)
    assert numpy.abs(numpy.diff(positions, 2)).max() / 0.005**2 < 40
    assert numpy.ptp(positions[-200:]) > 0.1, "it goes on"
