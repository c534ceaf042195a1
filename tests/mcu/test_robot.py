"""A whole robot on the emulated RP2040: servos at a PCA9685, wheels on bridges, and a main loop that is busy.

The oracle is the same firmware on the PC, whose recorder keeps what the motor layer writes at full resolution, and the
definitions.
"""

import itertools

import numpy
import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.session import Session
from marotte.tables import build_tables
from shared import formats

PUPPET = """
frame_rate = 30
seed = 7
[dof.A]
[dof.B]
character = { f = 2.0, zeta = 0.4, r = 0.5 }
[dof.C]
limits = { range = [0.2, 0.7], speed = 1.5, accel = 8.0 }
[dof.WHEEL]
kind = "relative"
[action.LOOK]
tempo = 0.8
map = [["A", 0, 1, "noise1"], ["B", 0, 1, "noise2"], ["C", 0, 1, "noise3"], ["WHEEL", -1, 1, "noise4"]]
"""
SCORE = "[[cue]]\nat = 0\nweights = { LOOK = 2.0 }\n"
ROBOT = """
rate = {rate}
attach_interval = 0.02
[chip.X]
sda = 4
scl = 5
oe = 6
baud = 400000
[output.A]
driver = "pca9685"
chip = "X"
channel = 0
pulse_us = [600, 2400]
[output.B]
driver = "pca9685"
chip = "X"
channel = 7
invert = true
[output.C]
driver = "pca9685"
chip = "X"
channel = 15
trim_us = 12.5
[output.WHEEL]
driver = "bridge"
wiring = "two-pwm"
forward = 10
backward = 11
dead_band = 0.2
top_speed = 0.9
"""
PINS = "".join(f"[output.{name}]\npin = {pin}\n" for name, pin in (("A", 2), ("B", 3), ("C", 4)))
CHANNELS = {"A": 0, "B": 7, "C": 15}
SECONDS = 4
COUNT_US = 0.32
SERVO_PINS = {"A": 2, "B": 3, "C": 4}
WHEEL_PINS = (10, 11)


def load(folder, robot):
    for name, text in (("puppet", PUPPET), ("score", SCORE), ("robot", robot)):
        (folder / f"{name}.toml").write_text(text)
    puppet = marotte.load_puppet(folder / "puppet.toml")
    return puppet, marotte.load_score(folder / "score.toml", puppet), marotte.load_robot(folder / "robot.toml", puppet)


def asked_for(tmp_path, rate):
    """Return what the motor layer writes to servos on pins in the same motion, by DOF: instants and widths in us."""
    calibrated = "".join(
        f"[output.{name}]\npin = {SERVO_PINS[name]}\n{keys}\n"
        for name, keys in (("A", "pulse_us = [600, 2400]"), ("B", "invert = true"), ("C", "trim_us = 12.5"))
    )
    puppet, score, robot = load(tmp_path, f"rate = {rate}\nattach_interval = 0.02\n{calibrated}")
    with UnixMcu(bits=32) as mcu:
        rendering = marotte.render(puppet, score, SECONDS, mcu=mcu, robot=robot)
        drives = {name: mcu.drives()[pin] for name, pin in SERVO_PINS.items()}
        return rendering.motor, {
            name: (list(drive.t_us), [value / 2**18 for value in drive.value]) for name, drive in drives.items()
        }


@pytest.mark.images
@pytest.mark.parametrize("rate", [50, 200])
def test_chip_gives_the_pulses_that_the_motor_layer_asks_for_within_a_count(tmp_path, rate):
    motor, expected = asked_for(tmp_path, rate)
    puppet, score, robot = load(tmp_path, ROBOT.format(rate=rate))
    servo = robot.outputs["A"]
    count_us = servo.drive.period_us(robot.written_us(servo), robot.chips) / 4096
    with Rp2040Mcu() as mcu:
        chip = mcu.add_pca9685(0, 0x40, 6, 25e6)
        rendering = marotte.render(puppet, score, SECONDS, mcu=mcu, robot=robot)
        seen = {name: pulses(chip.edges(channel)) for name, channel in CHANNELS.items()}
    assert rendering.status["bus_errors"] == 0 and rendering.status["late_frames"] == 0
    for name in CHANNELS:
        assert rendering.motor[name] == motor[name]
        times_us, widths_us = expected[name]
        starts_us = [pulse.start_ns / 1000 for pulse in seen[name]]
        found_us = [pulse.width_ns / 1000 for pulse in seen[name]]
        assert len(found_us) > SECONDS * 0.9 * 1e6 / (4096 * count_us)
        assert max(found_us) - min(found_us) > 100, "it moves"
        shift_us = likeliest_shift_us(starts_us, found_us, times_us, widths_us)
        # A pulse is as old as a period of the chip and one of the ticks at most; the shift has an average of both in it.
        slack_us = 2 * (4096 * count_us + servo_period_us(robot))
        at = compared = 0
        for start_us, width_us in zip(starts_us, found_us, strict=True):
            while at < len(times_us) and times_us[at] < start_us - shift_us - slack_us:
                at += 1
            end = at
            while end < len(times_us) and times_us[end] <= start_us - shift_us + slack_us:
                end += 1
            if at > 0 and end < len(times_us):
                compared += 1
                assert min(abs(width_us - asked) for asked in widths_us[at:end]) <= count_us, (name, start_us)
        assert compared > 0.9 * SECONDS * 1e6 / (4096 * count_us)


def servo_period_us(robot):
    return robot.written_us(robot.outputs["A"])


def likeliest_shift_us(starts_us, found_us, times_us, widths_us):
    """Return by how much the pulses of one run come later than what was written in another, which began at another instant."""
    starts_us, found_us = numpy.array(starts_us), numpy.array(found_us)
    begin_us = starts_us[numpy.argmax(abs(found_us - found_us[0]) > 20)]
    moved_us = times_us[numpy.argmax(abs(numpy.array(widths_us) - widths_us[0]) > 20)]
    shifts_us = begin_us - moved_us + numpy.arange(-100_000, 100_000, 500)
    inside = (starts_us > begin_us - 200_000) & (starts_us < begin_us + 1_500_000)
    return min(
        shifts_us,
        key=lambda shift_us: abs(
            found_us[inside] - numpy.interp(starts_us[inside] - shift_us, times_us, widths_us)
        ).mean(),
    )


@pytest.mark.images
def test_bridge_has_the_duty_that_the_motor_layer_asks_for_within_a_count(tmp_path):
    puppet, score, robot = load(tmp_path, ROBOT.format(rate=50))
    written, found = {}, {}
    with UnixMcu(bits=32) as mcu:
        mcu.add_pca9685(0, 0x40, 6, 25e6)
        marotte.render(puppet, score, SECONDS, mcu=mcu, robot=robot)
        for pin in WHEEL_PINS:
            drive = mcu.drives()[pin]
            written[pin] = sorted({round(value / 2**18 * 125) for value in drive.value})
    with Rp2040Mcu() as mcu:
        mcu.add_pca9685(0, 0x40, 6, 25e6)
        rendering = marotte.render(puppet, score, SECONDS, mcu=mcu, robot=robot)
        for pin in WHEEL_PINS:
            found[pin] = {round(pulse.width_ns / 8) for pulse in pulses(mcu.edges(pin))}
    assert min(rendering.motor["WHEEL"]) < -0.2 and max(rendering.motor["WHEEL"]) > 0.2
    for pin in WHEEL_PINS:
        assert len(found[pin]) > 20
        for counts in found[pin]:
            assert min(abs(counts - other) for other in written[pin]) <= 1


BUSY = """
import time
from firmware import puppet
from firmware.board_rp2040 import Board
from firmware.main import perform

step = puppet.Puppet.step
def busy(self):
    if self.frame == {frame}:
        time.sleep_ms({busy_ms})
    step(self)
puppet.Puppet.step = busy
perform(Board())
"""
BUSY_FRAME = 60
BUSY_MS = 200
FRAMES = 120


def perform(mcu, puppet, score, robot, block_ms):
    """Play FRAMES frames, the synthesis of frame BUSY_FRAME beginning `block_ms` late; return pulses by DOF, taps, status."""
    repl = RawRepl(mcu)
    repl.start(BUSY.format(frame=BUSY_FRAME, busy_ms=block_ms))
    session = Session(VirtualCarrier(mcu))
    session.open()
    session.upload(build_tables(puppet, robot))
    session.telemetry(formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR, 1, 0)
    session.arm()
    session.wait_attached()
    mcu.clear_edges()
    session.weight_targets(0, {0: formats.WEIGHT_ONE})
    session.start()
    motors = []
    while len(motors) < FRAMES:
        session.pump(20_000)
        while session.taps:
            frame, _, values = session.taps.popleft()
            assert frame == len(motors)
            motors.append(values[2 * len(puppet.dofs) :])
    seen = {name: pulses(mcu.edges(pin)) for name, pin in SERVO_PINS.items()}
    return seen, motors, session.status()


@pytest.mark.images
def test_synthesis_that_is_200_ms_late_neither_stops_the_servos_nor_makes_them_jump(tmp_path):
    puppet, score, robot = load(tmp_path, "rate = 50\nattach_interval = 0.02\n" + PINS)
    runs = {}
    for block_ms in (0, BUSY_MS):
        with Rp2040Mcu() as mcu:
            runs[block_ms] = perform(mcu, puppet, score, robot, block_ms)
    assert runs[0][2]["late_frames"] == 0
    # Frame n is late if it is not there 10 ms after n / 30: frame 60 + k is ready 200 ms after frame 60's instant.
    late = sum(1 for k in range(10) if k / 30 + 0.010 < BUSY_MS / 1000)
    assert late <= runs[BUSY_MS][2]["late_frames"] <= late + 1, "a tick's rounding, and the frames' own computing"
    undisturbed, disturbed = runs[0][1], runs[BUSY_MS][1]
    assert disturbed[:BUSY_FRAME] == undisturbed[:BUSY_FRAME]
    assert disturbed[BUSY_FRAME + 8] != undisturbed[BUSY_FRAME + 8], "it has gone on by guesses"
    for dof, (name, seen) in enumerate(runs[BUSY_MS][0].items()):
        starts = [pulse.start_ns for pulse in seen]
        assert {b - a for a, b in itertools.pairwise(starts)} == {20_000_000}, "a pulse each 20 ms, whatever happens"
        low_us, high_us = robot.outputs[name].ends_us
        span_us = abs(high_us - low_us)
        accel = build_tables(puppet, robot).limits(puppet.dofs[name]).accel
        most_us = accel * 0.02**2 * span_us + 2 * COUNT_US  # second differences of counts round by up to two
        widths = [pulse.width_ns / 1000 for pulse in seen]
        bends = [abs(a - 2 * b + c) for a, b, c in zip(widths, widths[1:], widths[2:], strict=False)]
        assert max(bends) <= most_us, name
        # The end: back on the undisturbed course.
        assert abs(disturbed[-1][dof] - undisturbed[-1][dof]) <= 32768 // 100, name
    moving = [pulse.width_ns for pulse in runs[BUSY_MS][0]["A"]]
    at = 100 + 1  # pulse of frame 60, 20 ms apart
    assert len({*moving[at + 2 : at + 9]}) > 3, "it does not stop"
