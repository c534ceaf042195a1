"""Running live: the score is played and told, and whatever ends the run, the outputs are off afterwards."""

import io
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest
from rich.console import Console

import marotte
from marotte.link import LinkRefused, LinkSilent, VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.pulses import measure, pulses
from marotte.run import perform
from marotte.view import Scene, View

PUPPETS = Path(__file__).parents[2] / "puppets"
PET = [str(PUPPETS / "pet.toml"), "--score", str(PUPPETS / "pet-score.toml")]
ROBOT = ["--robot", str(PUPPETS / "pet-robot.toml"), "--arm"]


class Watch(View):
    """A view that remembers what it is shown, and calls `then(scene)` each time."""

    def __init__(self, puppet, then=lambda scene: None):
        super().__init__(puppet, None, "here", 1, Console(file=io.StringIO()))
        self.then = then
        self.notes = []
        self.told = []
        self.frames = []
        self.last = Scene()

    def note(self, text):
        self.notes.append(text)

    def show(self, scene):
        self.frames.append(scene.frame)
        self.last = replace(scene, values=dict(scene.values), weights=dict(scene.weights))
        self.then(scene)

    def cue(self, at_s, text):
        self.told.append((at_s, text))


@pytest.fixture(scope="module")
def pet():
    puppet = marotte.load_puppet(PUPPETS / "pet.toml")
    score = marotte.load_score(PUPPETS / "pet-score.toml", puppet)
    return puppet, score, marotte.load_robot(PUPPETS / "pet-robot.toml", puppet)


@pytest.fixture
def mcu():
    with UnixMcu() as mcu:
        yield mcu


def is_off(mcu, robot):
    """Return whether no output gives pulses any more: half a second brings no edge."""
    mcu.clear_edges()
    mcu.run_for(500_000)
    return all(mcu.edges(output.drive.pulse_pin) == [] for output in robot.outputs.values())


def test_run_plays_tells_and_stops(pet, mcu):
    puppet, score, robot = pet
    watch = Watch(puppet)
    performance = perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(4))
    assert not performance.is_interrupted
    assert 120 <= performance.frames <= 125
    assert re.fullmatch(r"pet uploaded in \d+ ms, on here", "".join(watch.notes))
    assert [text for _, text in watch.told] == [
        "TIRED, mood WEARY",
        "CALM, mood EVEN",
        "LOOK 2, GAZE_YAW 0.8, GAZE_PITCH 0.6",
    ]
    assert watch.frames == sorted(watch.frames)
    assert watch.last.weights["NEUTRAL_HEAD"] == pytest.approx(1, abs=0.01)
    assert watch.last.values["HEAD_YAW"] > 0.6
    assert (performance.status["armed"], performance.status["late_targets"]) == (0, 0)
    assert {summary.dof for summary in measure(mcu, robot)} == set(puppet.dofs)
    assert is_off(mcu, robot)


def test_run_without_arming_gives_no_pulse(pet, mcu):
    puppet, score, robot = pet
    perform(puppet, score, VirtualCarrier(mcu), Watch(puppet), robot=robot, seconds=Fraction(1))
    assert measure(mcu, robot) == []


def test_run_lasts_a_little_longer_than_the_score(pet, mcu):
    puppet, _, _ = pet
    score = marotte.Score((marotte.Cue(Fraction(1), weights={"DANCE": 1.0}),))
    performance = perform(puppet, score, VirtualCarrier(mcu), Watch(puppet))
    assert 90 <= performance.frames <= 95


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_run_kills_the_outputs_whatever_ends_it(pet, mcu, error):
    puppet, score, robot = pet

    def end(scene):
        if scene.frame > 30:
            raise error

    carrier = VirtualCarrier(mcu)
    watch = Watch(puppet, end)
    if error is KeyboardInterrupt:
        assert perform(puppet, score, carrier, watch, robot=robot, arm=True).is_interrupted
    else:
        with pytest.raises(error):
            perform(puppet, score, carrier, watch, robot=robot, arm=True)
    assert all(pulses(mcu.edges(output.drive.pulse_pin)) for output in robot.outputs.values())
    assert is_off(mcu, robot)


def test_run_on_an_mcu_that_falls_silent_ends_with_an_error(pet, mcu):
    puppet, score, robot = pet
    carrier = VirtualCarrier(mcu)

    def unplug(scene):
        if scene.frame > 10:
            carrier.write = lambda data: None

    with pytest.raises(LinkSilent, match="can be heard, but has answered no command"):
        perform(puppet, score, carrier, Watch(puppet, unplug), robot=robot, arm=True)


def test_run_again_on_a_puppet_that_is_still_moving(pet, mcu):
    puppet, score, _ = pet
    first = marotte.Session(VirtualCarrier(mcu))
    first.open()
    first.upload(marotte.build_tables(puppet))
    first.start()
    first.flush()
    mcu.run_for(3_000_000)
    performance = perform(puppet, score, VirtualCarrier(mcu), Watch(puppet), seconds=Fraction(1))
    assert 30 <= performance.frames <= 35


def robot_of(tmp_path, puppet, text):
    (tmp_path / "robot.toml").write_text(text)
    return marotte.load_robot(tmp_path / "robot.toml", puppet)


def test_run_tells_that_the_kill_pin_has_acted(pet, mcu):
    puppet, score, robot = pet

    def press(scene):
        if scene.frame > 30:
            mcu.set_pin(robot.kill.pin, 0)

    watch = Watch(puppet, press)
    performance = perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(3))
    assert watch.notes[1:] == ["all pulses are off: killed by the kill pin"]
    assert watch.last.alert == "killed by the kill pin"
    assert performance.frames >= 90
    assert is_off(mcu, robot)


def test_run_cannot_arm_while_the_kill_switch_is_open(pet, mcu, tmp_path):
    puppet, score, _ = pet
    robot = robot_of(tmp_path, puppet, "[kill]\npin=22\n[output.NECK]\npin=2\n")
    with pytest.raises(LinkRefused, match=r"refused 'arm'.*is its kill switch where it should be"):
        perform(puppet, score, VirtualCarrier(mcu), Watch(puppet), robot=robot, arm=True, seconds=Fraction(1))
    mcu.set_pin(22, 0)
    perform(puppet, score, VirtualCarrier(mcu), Watch(puppet), robot=robot, arm=True, seconds=Fraction(1))
    assert pulses(mcu.edges(2))


def test_run_tells_that_a_chip_is_gone_and_back(pet, mcu, tmp_path):
    puppet, score, _ = pet
    robot = robot_of(
        tmp_path,
        puppet,
        '[chip.FACE]\nsda=4\nscl=5\noe=6\n[output.NECK]\ndriver="pca9685"\nchip="FACE"\nchannel=3\n',
    )
    chip = mcu.add_pca9685(0, 0x40, 6)
    alerts = []
    later = [(30, chip.remove), (75, chip.put_back)]

    def pull(scene):
        alerts.append(scene.alert)
        if later and scene.frame >= later[0][0]:
            later.pop(0)[1]()

    watch = Watch(puppet, pull)
    performance = perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(5))
    assert watch.notes[1:] == ["the chip FACE does not answer", "the chip FACE answers again"]
    assert "FACE does not answer" in alerts and alerts[-1] == ""
    assert performance.status["bus_errors"] > 0
    assert pulses(chip.edges(3))


def test_run_tells_of_a_stall(pet, mcu, tmp_path):
    puppet, score, _ = pet
    feedback = "{ pin = 26, at = [0, 1], gain = 0, integral = 0 }"
    robot = robot_of(tmp_path, puppet, f"[output.NECK]\npin=2\nfeedback={feedback}\n")
    mcu.set_adc(26, 0.65)

    def block(scene):
        if scene.frame > 20:
            mcu.set_adc(26, 0.05)

    watch = Watch(puppet, block)
    perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(4))
    assert watch.notes[1:] == ["NECK has stalled: it is without pulses until it is armed again"]
    assert watch.last.stalled == {"NECK"}


def test_run_shows_what_has_been_released(pet, mcu, tmp_path):
    puppet, _, _ = pet
    robot = robot_of(tmp_path, puppet, "[output.NECK]\npin=2\nrelease=0.5\n[output.BACK]\npin=4\n")
    score = marotte.Score((marotte.Cue(Fraction(3), weights={"NEUTRAL_BODY": 1.0}),))
    seen = []
    watch = Watch(puppet, lambda scene: seen.append(scene.released))
    perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(5))
    assert {"NECK"} in seen and seen[-1] == frozenset()
    assert len(watch.notes) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_command_ends_with_its_outputs_off(number):
    command = [sys.executable, "-u", "-m", "marotte", "run", *PET, *ROBOT, "--mcu", "unix", "--no-view"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert re.match(r"pet uploaded in \d+ ms, on emulated unix at /dev/\S+\n", process.stdout.readline())
            assert process.stdout.readline() == "   0.00 s  TIRED, mood WEARY\n"
            assert process.stdout.readline().endswith("CALM, mood EVEN\n")
            os.kill(process.pid, number)
            out, err = process.communicate(timeout=10)
        finally:
            process.kill()
    assert (process.returncode, err) == (130, "")
    assert re.search(r"stopped by hand: \d+ frames, 0 late, at most \d+ us; outputs are off", out)
    assert re.search(r"HEAD_YAW +GP6 +\d+ +1[45]\d\d\.\d us", out)


def test_run_command_plays_on_a_port_served_by_the_mcu_command():
    serve = [sys.executable, "-u", "-m", "marotte", "mcu", "unix", "--tcp", "0"]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
        url = re.search(r"socket://\S+", server.stdout.readline())[0]
        command = [sys.executable, "-m", "marotte", "run", *PET, "--port", url, "--seconds", "1"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=20)
            os.kill(server.pid, signal.SIGINT)
            _, err = server.communicate(timeout=10)
        finally:
            server.kill()
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"played: 3\d frames, 0 late", done.stdout)
    assert (server.returncode, err) == (130, "")
