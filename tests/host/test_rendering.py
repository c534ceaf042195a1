"""Rendering: what it writes, that it repeats itself, and that cues act in their frames."""

import csv
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import pytest

import marotte
from marotte import cli
from marotte.errors import MarotteError
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.rendering import RenderError, frame_count

PUPPETS = Path(__file__).parents[2] / "puppets"


@pytest.fixture(scope="module")
def pet():
    return marotte.load_puppet(PUPPETS / "pet.toml")


@pytest.fixture(scope="module")
def pet_score(pet):
    return marotte.load_score(PUPPETS / "pet-score.toml", pet)


def files(tmp_path, puppet_text, score_text, robot_text=""):
    for name, text in (("puppet", puppet_text), ("score", score_text), ("robot", robot_text)):
        (tmp_path / f"{name}.toml").write_text(text)
    puppet = marotte.load_puppet(tmp_path / "puppet.toml")
    return (
        puppet,
        marotte.load_score(tmp_path / "score.toml", puppet),
        marotte.load_robot(tmp_path / "robot.toml", puppet),
    )


def test_rendering_of_the_pet_is_whole_and_in_range(pet, pet_score):
    seen = []
    rendering = marotte.render(pet, pet_score, 20, progress=lambda done, of: seen.append((done, of)))
    assert rendering.frames == range(600)
    assert rendering.time_s[-1] == 599 / 30
    for taps in (rendering.base, rendering.signal, rendering.motor):
        assert list(taps) == list(pet.dofs)
        for name, values in taps.items():
            assert len(values) == 600
            assert all(-1 <= value <= 1 if pet.dofs[name].is_relative else 0 <= value <= 1 for value in values)
    assert seen[-1] == (600, 600)
    assert seen == sorted(seen)
    assert rendering.report["kind"] == "unix" and len(rendering.report["image_sha256"]) == 64
    assert rendering.status["late_targets"] == 0
    for name, values in rendering.motor.items():
        low, high = pet.dofs[name].limits
        assert all(low - 1e-4 <= value <= high + 1e-4 for value in values)


def test_rendering_repeats_to_the_bit(tmp_path, pet, pet_score):
    for name in ("one.csv", "two.csv"):
        marotte.render(pet, pet_score, 4).write_csv(tmp_path / name)
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_rendering_is_the_same_on_every_mcu(tmp_path, pet, pet_score, rp2040_image_path):
    for kind in ("unix", "unix32", "rp2040"):
        marotte.render(pet, pet_score, 4, kind).write_csv(tmp_path / kind)
    assert (tmp_path / "unix").read_bytes() == (tmp_path / "unix32").read_bytes() == (tmp_path / "rp2040").read_bytes()


def test_rendering_is_the_same_with_armed_outputs(tmp_path, pet, pet_score):
    alone = marotte.render(pet, pet_score, 2)
    path = tmp_path / "robot.toml"
    path.write_text(
        "attach_interval = 0.4\n[output.HEAD_YAW]\npin = 2\n[output.NECK]\npin = 3\n[output.BACK]\npin = 4\n"
    )
    assert marotte.render(pet, pet_score, 2, robot=marotte.load_robot(path, pet)).motor == alone.motor
    for name in ("pet-robot.toml", "pet-robot-pca9685.toml"):  # whose limits are narrower
        armed = marotte.render(pet, pet_score, 2, robot=marotte.load_robot(PUPPETS / name, pet))
        assert (armed.base, armed.signal) == (alone.base, alone.signal)


def test_rendering_ignores_the_potentiometers_that_an_emulated_mcu_lacks(tmp_path, pet, pet_score):
    path = tmp_path / "robot.toml"
    path.write_text("[output.NECK]\npin = 2\nfeedback = { pin = 26, at = [0.1, 0.9] }\n")
    rendering = marotte.render(pet, pet_score, 2, robot=marotte.load_robot(path, pet))
    assert rendering.motor == marotte.render(pet, pet_score, 2).motor


def test_rendering_holds_speed_and_acceleration(tmp_path):
    puppet = """
    frame_rate = 50
    [dof.A]
    limits = { range = [0.1, 0.8], speed = 2.0, accel = 10.0 }
    [dof.W]
    kind = "relative"
    limits = { range = [-0.5, 1], accel = 5 }
    [action.SHAKE]
    tempo = 2
    tau = 0.03
    map = [["A", -0.0, 1, "rsin"], ["W", -1, 1, "rsin"]]
    """
    score = "[[cue]]\nat=0\nweights={SHAKE=4}\n"
    rendering = marotte.render(*files(tmp_path, puppet, score)[:2], 4)
    a, w = rendering.motor["A"], rendering.motor["W"]
    speeds = [50 * (after - before) for before, after in pairwise(a)]
    unit = 50 / 32768  # what rounding of the taps adds to a difference
    assert min(a) >= 0.1 - 1e-4 and max(a) <= 0.8 + 1e-4
    assert 1.5 < max(map(abs, speeds)) <= 2 + unit
    assert max(abs(after - before) for before, after in pairwise(speeds)) * 50 <= 10 + 2 * 50 * unit
    assert min(w) >= -0.5 - 1e-4 and max(w) <= 1
    assert 4 < max(abs(after - before) for before, after in pairwise(w)) * 50 <= 5 + 2 * unit


def test_rendering_writes_the_columns_of_the_documentation(tmp_path, pet, pet_score):
    marotte.render(pet, pet_score, Fraction("1.5")).write_csv(tmp_path / "pet.csv")
    with (tmp_path / "pet.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    assert header == ["frame", "time", *(f"{name}.{tap}" for name in pet.dofs for tap in ("base", "signal", "motor"))]
    assert [int(line[0]) for line in lines] == list(range(45))
    assert all(len(text.split(".")[1]) >= 6 for line in lines for text in line[1:])
    assert [float(line[1]) for line in lines] == pytest.approx([frame / 30 for frame in range(45)], abs=1e-9)


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "count"),
    [(20, 30, 600), (Fraction("0.0333"), 30, 1), (Fraction("1.1"), 60, 66), (0.5, 25, 12), (0.01, 30, 0)],
)
def test_rendering_has_the_frames_of_its_seconds(seconds, rate_hz, count):
    assert frame_count(seconds, rate_hz) == count


def test_cue_acts_in_its_frame_and_not_before(tmp_path):
    puppet = "frame_rate=60\n[dof.A]\nrest=0.25\n[action.UP]\ntau=0.03\nmap=[['A',1,1,'const(1)']]\n"
    for at, frame in (("0", 0), ("0.0001", 1), ("0.5", 30), ("1.1", 66)):
        score = f"[[cue]]\nat={at}\nweights={{UP=1}}\n"
        base = marotte.render(*files(tmp_path, puppet, score)[:2], 2).base["A"]
        assert base[:frame] == [0.25] * frame
        assert base[frame] > 0.25


def test_rendering_follows_live_channels_and_the_master_tempo(tmp_path):
    puppet = """
    frame_rate = 30
    [dof.WHEEL]
    kind = "relative"
    [dof.NECK]
    [action.DRIVE]
    tau = 0.03
    map = [["WHEEL", -1, 1, "live(SPEED)"]]
    [action.SWING]
    tau = 0.03
    map = [["NECK", 0, 1, "rsin"]]
    """
    score = "[[cue]]\nat=0\nweights={DRIVE=1, SWING=4}\n[[cue]]\nat=1\nlive={SPEED=0}\ntempo={global=0.25}\n"
    rendering = marotte.render(*files(tmp_path, puppet, score)[:2], 6)
    assert rendering.base["WHEEL"][:30] == [0.0] * 30
    assert rendering.base["WHEEL"][-1] == -1.0
    neck = rendering.base["NECK"]
    assert neck[52:60] == pytest.approx(neck[172:180], abs=1e-3)  # a period of 120 frames at a quarter of the tempo
    assert neck[52:60] == pytest.approx([1 - value for value in neck[112:120]], abs=1e-3)


def test_rendering_of_a_dense_score_never_overflows_the_queue(tmp_path):
    actions = "".join(f"[action.A{i}]\nmap=[['D',0,1,'noise{i % 16 + 1}']]\n" for i in range(64))
    names = [", ".join(f"A{i}={(i + frame) % 3}" for i in range(64)) for frame in range(40)]
    score = "".join(f"[[cue]]\nat={frame / 10}\nweights={{{names[frame]}}}\n" for frame in range(40))
    rendering = marotte.render(*files(tmp_path, f"frame_rate=10\n[dof.D]\n{actions}", score)[:2], 4)
    assert len(rendering.frames) == 40


def test_rendering_on_an_mcu_of_the_callers_leaves_its_pins_to_look_at(tmp_path):
    puppet = "frame_rate=50\n[dof.A]\nrest=0.75\n[dof.B]\nkind='relative'\n"
    robot = (
        "[output.A]\npin=4\npulse_us=[1000,2000]\n[output.B]\npin=5\npulse_us=[1100,1900]\ninvert=true\ntrim_us=10\n"
    )
    loaded = files(tmp_path, f"{puppet}[mood.M]\n", "[[cue]]\nat=0\nmood='M'\n", robot)
    with UnixMcu() as mcu:
        marotte.render(*loaded[:2], 2, mcu, loaded[2])
        assert {pulse.width_ns for pulse in pulses(mcu.edges(4))} == {1_750_000}
        assert {pulse.width_ns for pulse in pulses(mcu.edges(5))} == {1_510_000}
        assert mcu.edges(6) == []


def test_rendering_has_the_weights_of_every_frame_if_they_are_asked_for(tmp_path):
    puppet = """
    frame_rate = 60
    [dof.A]
    [action.IDLE]
    map = [["A", 0, 1, "rsin"]]
    [action.UP]
    tau = 0.03
    map = [["A", 0, 1, "rsin"]]
    """
    score = "[[cue]]\nat=0.5\nweights={UP=4}\n[[cue]]\nat=1.5\nweights={UP=0}\n"
    loaded = files(tmp_path, puppet, score)[:2]
    rendering = marotte.render(*loaded, 3, weights=True)
    assert rendering.weights["IDLE"] == [0.0] * 180
    up = rendering.weights["UP"]
    assert up[:30] == [0.0] * 30 and 0 < up[30] < 4
    assert up[70:90] == [4.0] * 20
    assert 0 < up[90] < 4 and up[135:] == [0.0] * 45
    without = marotte.render(*loaded, 3)
    assert (without.weights, without.motor) == ({}, rendering.motor)


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_rendering_is_drawn_by_the_command_line(tmp_path, capsys, suffix):
    arguments = [str(PUPPETS / "pet.toml"), "--score", str(PUPPETS / "pet-score.toml"), "--seconds", "1"]
    robot = ["--robot", str(PUPPETS / "pet-robot.toml")]
    out = tmp_path / f"pet.{suffix}"
    assert cli.main(["plot", *arguments, *robot, "--dof", "NECK", "EYEBROW", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 30 frames\n"
    begin = {"png": b"\x89PNG\r\n\x1a\n", "svg": b"<?xml"}[suffix]
    assert out.read_bytes().startswith(begin) and out.stat().st_size > 10_000


def test_rendering_sends_gains_that_leave_the_base_as_it_is(tmp_path):
    """Whatever becomes of the signal: a score's gains arrive, and change nothing before signal processing."""
    puppet = "[dof.A]\n[action.SWAY]\nmap=[['A',0.4,0.6,'noise1']]\n[mood.NERVOUS]\ngains=[4,-4,2,0,1,1,1]\n"
    calm = "[[cue]]\nat=0\nweights={SWAY=1}\n"
    nervous = f"{calm}mood='NERVOUS'\n[[cue]]\nat=0.5\ngains=[1,1,1,1,1,1,1]\n"
    one, two = (marotte.render(*files(tmp_path, puppet, score)[:2], 1) for score in (calm, nervous))
    assert one.base == two.base
    assert one.signal["A"] == pytest.approx(one.base["A"], abs=1 / 32768), "all gains are 1"
    assert two.status["late_targets"] == 0 and one.status["packets"] < two.status["packets"]


def test_rendering_that_holds_no_frame_is_refused(pet, pet_score):
    with pytest.raises(RenderError, match=r"0\.01 s hold no frame at 30 frames a second"):
        marotte.render(pet, pet_score, 0.01)


def test_rendering_on_an_unknown_mcu_is_refused(pet, pet_score):
    with pytest.raises(MarotteError, match='unknown MCU "avr", expected one of unix, unix32, rp2040'):
        marotte.render(pet, pet_score, 1, "avr")


def test_rendering_that_cannot_be_written_says_so(tmp_path, pet, pet_score):
    rendering = marotte.render(pet, pet_score, 1)
    with pytest.raises(MarotteError, match="cannot be written: is a directory"):
        rendering.write_csv(tmp_path)
