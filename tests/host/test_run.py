"""Running live: the score is played and told, and whatever ends the run, the outputs are off afterwards."""

import io
import os
import re
import signal
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest
from rich.console import Console

import marotte
from marotte.link import LinkSilent, VirtualCarrier
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
        self.told = []
        self.frames = []
        self.last = Scene()

    def note(self, text):
        self.notes = text

    def show(self, scene):
        self.frames.append(scene.frame)
        self.last = Scene(scene.frame, dict(scene.values), dict(scene.weights), scene.cue)
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
    return all(mcu.edges(output.pin) == [] for output in robot.outputs.values())


def test_run_plays_tells_and_stops(pet, mcu):
    puppet, score, robot = pet
    watch = Watch(puppet)
    performance = perform(puppet, score, VirtualCarrier(mcu), watch, robot=robot, arm=True, seconds=Fraction(4))
    assert not performance.is_interrupted
    assert 120 <= performance.frames <= 125
    assert re.fullmatch(r"pet uploaded in \d+ ms, on here", watch.notes)
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
    assert all(pulses(mcu.edges(output.pin)) for output in robot.outputs.values())
    assert is_off(mcu, robot)


def test_run_on_an_mcu_that_falls_silent_ends_with_an_error(pet, mcu):
    puppet, score, robot = pet
    carrier = VirtualCarrier(mcu)

    def unplug(scene):
        if scene.frame > 10:
            carrier.write = lambda data: None

    with pytest.raises(LinkSilent, match="has not answered"):
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
