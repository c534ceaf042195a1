"""The terminal's picture, and the lines where there is no terminal."""

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from marotte.puppet_file import load_puppet
from marotte.view import Scene, View, bar_text, centred_text
from marotte.wiring import load_robot

PUPPETS = Path(__file__).parents[2] / "puppets"


@pytest.mark.parametrize(
    ("share", "text"),
    [(0, "    "), (1, "████"), (0.5, "██  "), (0.125, "▌   "), (0.53125, "██▏ "), (-1, "    "), (2, "████")],
)
def test_bar_fills_to_an_eighth(share, text):
    assert bar_text(share, 4) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "········"), (1, "····████"), (-1, "████····"), (-0.5, "··██····"), (0.25, "····█···"), (-9, "████····")],
)
def test_centred_bar_grows_from_the_middle(value, text):
    assert centred_text(value, 8) == text


@given(value=st.floats(-2, 2), width=st.integers(1, 40))
def test_bars_keep_their_width(value, width):
    assert len(bar_text(value, width)) == width
    assert len(centred_text(value, 2 * width)) == 2 * width


def picture(view, scene):
    console = Console(width=80, file=io.StringIO(), color_system=None)
    console.print(view.picture(scene))
    return console.file.getvalue()


@pytest.fixture
def view():
    puppet = load_puppet(PUPPETS / "pet.toml")
    return View(
        puppet, load_robot(PUPPETS / "pet-robot.toml", puppet), "emulated rp2040", 20, Console(file=io.StringIO())
    )


def test_view_shows_dofs_weights_pulses_and_time(view):
    scene = Scene(45, {"NECK": 0.25, "WHEEL_LEFT": -0.5}, {"HAPPY_FACE": 0.75}, "HAPPY, mood EVEN", late_frames=2)
    text = picture(view, scene)
    for expected in (
        "pet  on  emulated rp2040",
        "1.5 of 20.0 s",
        "0.250",
        "-0.500",
        "GP8 1250.0 us",
        "0.75",
        "HAPPY, mood EVEN",
    ):
        assert expected in text
    assert "2 late frames" in text
    assert all(name in text for name in [*view.puppet.dofs, *view.puppet.actions])
    assert max(map(len, text.splitlines())) <= 80
    assert len(text.splitlines()) <= 24


def test_view_shows_mood_gains_and_clipping_where_there_is_something_to_say(view):
    plain = picture(view, Scene(45))
    assert not any(word in plain for word in ("mood", "gains", "clipped"))
    assert "\nmood EVEN ─" in picture(view, Scene(45, mood="EVEN"))
    text = picture(view, Scene(45, mood="NERVOUS", gains=(2.5, 2.0, 1.4, 1.0, 1.0, -0.5, 0.0), clipped=12))
    assert "\nmood NERVOUS, gains 2.5 2 1.4 1 1 -0.5 0 ─" in text
    assert "12 values clipped" in text
    assert len(text.splitlines()) == len(plain.splitlines())


def test_view_shows_the_beginning_and_silence(view):
    assert "no word from the MCU" in picture(view, Scene(is_silent=True))


def test_view_shows_what_is_wrong_with_the_robot(view):
    scene = Scene(
        45,
        {"NECK": 0.25, "BACK": 0.5},
        stalled=frozenset({"NECK"}),
        released=frozenset({"BACK"}),
        alert="killed by the kill pin",
    )
    text = picture(view, scene)
    assert "GP8 stalled" in text and "GP11 released" in text
    assert "killed by the kill pin" in text
    assert "GP8 1250.0" not in text


def test_view_shows_channels_and_bridges():
    puppet = load_puppet(PUPPETS / "pet.toml")
    robot = load_robot(PUPPETS / "pet-robot-pca9685.toml", puppet)
    scene = Scene(45, {"NECK": 0.25, "WHEEL_LEFT": -0.5, "WHEEL_RIGHT": 0.0})
    slow = Scene(45, {"WHEEL_LEFT": 1 / 128})
    text = picture(View(puppet, robot, "here", 20, Console(file=io.StringIO())), scene)
    assert "SERVOS 6 1250.0 us" in text
    assert "GP10/11  -54.0%" in text  # half of the way from the dead band of 18 % to the top of 90 %
    assert "GP12/13   +0.0%" in text
    assert "GP10/11   +9.6%" in picture(View(puppet, robot, "here", 20, Console(file=io.StringIO())), slow)
    assert max(map(len, text.splitlines())) <= 80


def test_view_without_a_terminal_prints_a_line_a_cue(view):
    with view:
        view.show(Scene(3))
        view.cue(1.5, "HAPPY")
    assert view.console.file.getvalue() == "   1.50 s  HAPPY\n"


def test_view_in_a_terminal_draws_in_place():
    puppet = load_puppet(PUPPETS / "pet.toml")
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=30)
    with View(puppet, None, "here", 20, console) as view:
        view.show(Scene(30))
        view.cue(1.0, "not printed")
    assert "1.0 of 20.0 s" in console.file.getvalue().replace("\x1b[2m", "").replace("\x1b[0m", "")
    assert "not printed" not in console.file.getvalue()
