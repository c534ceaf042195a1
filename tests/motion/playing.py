"""Puppets and scores as dicts, loaded and played on an emulated MCU, with the taps as arrays."""

import random
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy

import marotte
from marotte.emulated import connected
from tests.generate import add_random_dynamics, add_random_gains, random_puppet, random_score, to_toml

TAPS = ("base", "signal", "motor")


class Case(NamedTuple):
    """A puppet, a score and, where pins are looked at, a robot, as `tomllib` gives them."""

    name: str
    puppet: dict
    score: dict
    robot: dict | None = None


def random_case(seed, seconds, draw=0, **options):
    """Return the random case that a seed stands for: all that the motion has, but band gains other than 1.

    `draw` numbers the cases of one seed, `options` are those of `random_puppet`.
    """
    rng = random.Random(f"{seed}.{draw}")
    puppet = random_puppet(rng, level="full", gains=False, **options)
    score = random_score(rng, puppet, seconds, level="full", gains=False)
    add_random_dynamics(rng, puppet)
    return Case(f"seed {seed}.{draw}", puppet, score)


def random_gains_case(seed, seconds, reach, draw=0, **options):
    """Return the random case that a seed stands for, with band gains within -reach..reach and no dynamics."""
    rng = random.Random(f"gains {seed}.{draw}")
    puppet = random_puppet(rng, level="full", gains=False, **options)
    score = random_score(rng, puppet, seconds, level="full", gains=False)
    add_random_gains(rng, puppet, score, seconds, reach)
    return Case(f"seed {seed}.{draw} within {reach}", puppet, score)


def load(case):
    """Return the case's puppet, score and robot, read by the host from TOML files."""
    with tempfile.TemporaryDirectory(prefix="marotte-test-") as folder:
        paths = [Path(folder) / name for name in ("puppet.toml", "score.toml", "robot.toml")]
        for path, document in zip(paths, (case.puppet, case.score, case.robot or {}), strict=True):
            path.write_text(to_toml(document), "utf-8")
        puppet = marotte.load_puppet(paths[0])
        return puppet, marotte.load_score(paths[1], puppet), marotte.load_robot(paths[2], puppet)


def play(case, seconds, mcu="unix"):
    """Return the rendering of a case: `mcu` and the result are those of `marotte.render`.

    To an emulated MCU is connected what the robot has beside its outputs.
    """
    puppet, score, robot = load(case)
    if not isinstance(mcu, str):
        robot = connected(mcu, robot)
    return marotte.render(puppet, score, seconds, mcu, robot=robot)


def tap(rendering, name):
    """Return a tap of a rendering, an array [frames, dofs]."""
    return numpy.array(list(getattr(rendering, name).values())).T
