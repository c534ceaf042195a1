"""Prediction of live channels gives the same bits on every MCU as in checked integers."""

import subprocess
from pathlib import Path

import pytest

from marotte.images import unix_binary
from marotte.kalman import Kalman, kalman_fields
from tests.checked import load_checked

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 100
PARAMETERS = [
    kalman_fields(Kalman(noise, agility, fade_s), rate_hz)
    for noise, agility, fade_s in ((0.005, 3, 0.08), (0.0005, 20, 1), (0.1, 0.1, 0.02), (0.02, 20, 0.3))
    for rate_hz in (10, 30, 60)
] + [
    {"process_q16": process, "noise_q16": noise, "fade_q15": fade}
    for process, noise, fade in ((1 << 27, 1, 32767), (0, 1 << 27, 0), (1 << 27, 1 << 27, 32767), (5, 1, 32767))
]

PLAY = f"""
from array import array
class Tables:
    lives = {len(PARAMETERS)}
    live_rest_q28 = array("i", [1 << 27] * lives)
    live_predict = bytearray([1] * lives)
    live_process_q16 = array("i", {[fields["process_q16"] for fields in PARAMETERS]})
    live_noise_q16 = array("i", {[fields["noise_q16"] for fields in PARAMETERS]})
    live_fade_q15 = array("H", {[fields["fade_q15"] for fields in PARAMETERS]})
def play():
    kalman = Kalman()
    kalman.rest(Tables)
    target = array("i", [1 << 27] * Tables.lives)
    draw = 1
    found = 0
    for frame in range({FRAMES}):
        arrived = 0
        for live in range(Tables.lives):
            draw = (draw * 16807) % 2147483647
            if draw >> 5 & 3 and frame % 40 < 25:
                arrived |= 1 << live
                target[live] = draw >> 2 if draw >> 8 & 1 else draw >> 5
                target[live] %= (1 << 28) + 1
        kalman.step(Tables, arrived, target)
        for live in range(Tables.lives):
            found = (found * 31 + kalman.velocity_q28[live]) % 1000000007
    return found
"""


@pytest.mark.parametrize("bits", [64, pytest.param(32, marks=pytest.mark.images)])
def test_estimate_is_the_same_on_the_pc(bits):
    program = (
        f"import sys\nsys.path.insert(0, {str(ROOT)!r})\nfrom firmware.kalman import Kalman\n{PLAY}\nprint(play())"
    )
    done = subprocess.run([unix_binary(bits), "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == in_checked_integers()


@pytest.mark.images
def test_estimate_is_the_same_on_the_rp2040(repl):
    told = repl.exec(f"from firmware.kalman import Kalman\n{PLAY}\nprint(play())", timeout_us=60_000_000)
    assert int(told) == in_checked_integers()


def in_checked_integers():
    """Return what the program finds where every integer is checked."""
    names = {"Kalman": load_checked("firmware/kalman.py").Kalman}
    exec(PLAY, names)
    return names["play"]()
