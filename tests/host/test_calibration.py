"""Calibrating by hand: one output alone has pulses, it goes slowly where it is told, and its ends move while it does."""

import io
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import pairwise

import pytest

import marotte
from marotte import cli
from marotte.calibration import Calibration, CalibrationError
from marotte.link import LinkSilent, VirtualCarrier
from marotte.mcu.serve import serve
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses

ROBOT = """
[output.NECK]
pin = 2
pulse_us = [1000, 2000]
range = [0.1, 1.0]
[output.JAW]
pin = 4
[output.WHEEL]
driver = "bridge"
pwm = 6
direction = 7
dead_band = 0.1
"""


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return marotte.load_robot(path)


@pytest.fixture
def mcu():
    with UnixMcu() as mcu:
        yield mcu


def opened(mcu):
    session = marotte.Session(VirtualCarrier(mcu))
    session.open()
    return session


def widths_us(mcu, pin):
    return [pulse.width_ns / 1000 for pulse in pulses(mcu.edges(pin))]


def settle(session, mcu, seconds=4.0):
    for _ in range(round(seconds * 50)):
        session.pump(20_000)
    mcu.clear_edges()
    for _ in range(10):
        session.pump(20_000)


def test_calibration_moves_one_output_and_leaves_the_others_off(robot, mcu):
    session = opened(mcu)
    with Calibration(session, robot, robot.outputs["NECK"]) as calibration:
        assert calibration.commands == "VALUE (0.1 to 1), low US, high US, trim US, invert, show, done"
        assert calibration.do("1\n") == "NECK goes to 1"
        settle(session, mcu)
        assert widths_us(mcu, 2)[-1] == pytest.approx(2000, abs=0.5)
        assert calibration.do("high 1900") == "pulse_us = [1000, 1900], trim_us = 0, invert = false"
        settle(session, mcu)
        assert widths_us(mcu, 2)[-1] == pytest.approx(1900, abs=0.5)
        calibration.do("trim 12.5")
        calibration.do("low 900")
        assert calibration.do("invert") == "pulse_us = [900, 1900], trim_us = 12.5, invert = true"
        settle(session, mcu, 8)
        assert widths_us(mcu, 2)[-1] == pytest.approx(912.5, abs=0.5)
        assert mcu.edges(4) == [] and mcu.edges(6) == []
    mcu.clear_edges()
    mcu.run_for(200_000)
    assert mcu.edges(2) == []
    assert calibration.text() == "[output.NECK]\npulse_us = [900, 1900]\ntrim_us = 12.5\ninvert = true"


def test_calibration_goes_gently(robot, mcu):
    session = opened(mcu)
    with Calibration(session, robot, robot.outputs["NECK"]) as calibration:
        settle(session, mcu, 0.5)
        calibration.do("1")
        mcu.clear_edges()
        for _ in range(50):
            session.pump(20_000)
        speeds = [(after - before) / 20 for before, after in pairwise(widths_us(mcu, 2))]  # in us a millisecond
    assert 0.4 < max(speeds) <= 0.5 + 0.05  # half of 1000 us in a second


def test_calibration_of_a_wheel(robot, mcu):
    with Calibration(opened(mcu), robot, robot.outputs["WHEEL"]) as calibration:
        assert calibration.commands == "VALUE (-1 to 1), dead SHARE, top SHARE, invert, show, done"
        calibration.do("-0.5")
        calibration.do("dead 0.2")
        calibration.do("top 0.9")
    assert calibration.text() == "[output.WHEEL]\ndead_band = 0.2\ntop_speed = 0.9\ninvert = false"


def test_calibration_of_a_wheel_keeps_its_top_speed_above_its_dead_band(robot, mcu):
    with Calibration(opened(mcu), robot, robot.outputs["WHEEL"]) as calibration:
        for line in ("top 0.1", "top 0.100001"):
            with pytest.raises(
                CalibrationError, match=r"as top speed, expected more than the dead band of 0\.1, by 1/32768"
            ):
                calibration.do(line)
        calibration.do("top 0.2")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("fly", "found 'fly', expected VALUE (0.1 to 1), low US, high US"),
        ("low", "found 'low', expected"),
        ("low x", "found 'low x', expected"),
        ("nan", "found 'nan', expected"),
        ("dead 0.1", "found 'dead 0.1', expected"),
        ("0", "found 0 as the value, expected a number in 0.1..1"),
        ("low 299", "found 299 as a pulse, expected a number in 300..3000"),
        ("low 2000.01", "found 2000.01 and 2000 us as the pulses' ends, expected two that are 1/16 us apart at least"),
        ("trim 301", "found 301 as the trim, expected a number in -300..300"),
    ],
)
def test_calibration_refuses_what_it_does_not_understand(robot, mcu, line, expected):
    with Calibration(opened(mcu), robot, robot.outputs["NECK"]) as calibration:
        before = calibration.text()
        with pytest.raises(CalibrationError) as error:
            calibration.do(line)
        assert str(error.value).startswith(expected)
        assert calibration.do("") == before


def is_off(mcu):
    mcu.clear_edges()
    mcu.run_for(500_000)
    return mcu.edges(2) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, LinkSilent, RuntimeError])
def test_calibration_that_cannot_begin_kills_the_output(robot, mcu, monkeypatch, error):
    session = opened(mcu)

    def fail():
        session.pump(200_000)
        assert widths_us(mcu, 2)
        raise error

    monkeypatch.setattr(session, "wait_attached", fail)
    with pytest.raises(error), Calibration(session, robot, robot.outputs["NECK"]):
        pytest.fail("began")
    assert is_off(mcu)


@contextmanager
def calibrating(tmp_path, mcu, *wrapper):
    """Yield a process that calibrates NECK of an MCU in real time; afterwards the MCU may be looked at."""
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    with serve(mcu, tcp=0) as live:
        command = [*wrapper, sys.executable, "-u", "-m", "marotte", "calibrate", str(path), "NECK", "--port", live.url]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        with subprocess.Popen(command, **pipes, text=True) as process:
            try:
                assert process.stdout.readline().startswith("NECK at GP2 has its pulses")
                time.sleep(0.2)  # for some of them
                yield process
            finally:
                process.kill()
        live.stop()
        assert widths_us(mcu, 2)
        assert is_off(mcu)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_calibrate_command_ends_with_its_output_off(tmp_path, mcu, number):
    with calibrating(tmp_path, mcu) as process:
        os.kill(process.pid, number)
        assert process.wait(10) == 130
        assert process.stderr.read() == ""


def test_calibrate_command_respects_that_a_signal_is_ignored(tmp_path, mcu):
    with calibrating(tmp_path, mcu, "nohup") as process:
        os.kill(process.pid, signal.SIGHUP)
        print("0.5", "done", sep="\n", file=process.stdin, flush=True)
        assert process.wait(10) == 0
        assert process.stdout.readline() == "NECK goes to 0.5\n"


def test_calibrate_command_reads_standard_input(tmp_path, monkeypatch, capsys):
    path = tmp_path / "robot.toml"
    path.write_text("[kill]\npin = 22\n" + ROBOT)
    monkeypatch.setattr("sys.stdin", io.StringIO("1\nhigh 1950\nlow 5\n"))
    assert cli.main(["calibrate", str(path), "NECK", "--mcu", "unix"]) == 0
    first, *answers, _, pulse, _, _ = capsys.readouterr().out.splitlines()
    assert first.startswith("NECK at GP2 has its pulses. Commands: VALUE (0.1 to 1), low US")
    assert answers[:3] == [
        "NECK goes to 1",
        "pulse_us = [1000, 1950], trim_us = 0, invert = false",
        "found 5 as a pulse, expected a number in 300..3000",
    ]
    assert pulse == "pulse_us = [1000, 1950]"
