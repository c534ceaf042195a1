"""A performance begun again in the same session: the same puppet and targets give the same base and signal as the first time.

The motors begin where they are, not at rest; the difference dies out.
"""

import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.prompter import Prompter
from shared.formats import TAP_BASE, TAP_MOTOR, TAP_SIGNAL
from tests.motion.playing import load, random_case, random_gains_case

FRAMES = 60


@pytest.mark.parametrize(
    "case", [random_case(20, 2, dofs=10), random_gains_case(1, 2, 4, dofs=10)], ids=["plain", "gains"]
)
def test_motion_begun_again_repeats_to_the_bit(case):
    puppet, score, _ = load(case)
    wheels = [place for place, dof in enumerate(puppet.dofs.values()) if dof.is_relative]
    assert wheels and puppet.lives
    first, second = two_performances(puppet, score, FRAMES)
    asked = 2 * len(puppet.dofs)
    assert [(frame, values[:asked]) for frame, _, values in first] == [
        (frame, values[:asked]) for frame, _, values in second
    ]


def test_motors_of_a_motion_begun_again_begin_where_they_are_and_come_to_the_same():
    """Without characters, which remember for long, the difference is gone to the bit after sixteen of its time constants."""
    case = random_case(20, 2, dofs=10)
    for dof in case.puppet["dof"].values():
        dof.pop("character", None)
        dof.pop("limits", None)
    puppet, score, _ = load(case)
    frames = round(4.5 * puppet.frame_rate_hz)
    first, second = two_performances(puppet, score, frames)
    motors = [[values[-len(puppet.dofs) :] for _, _, values in taps] for taps in (first, second)]
    assert motors[0][0] != motors[1][0]
    assert motors[0][-5:] == motors[1][-5:]


def two_performances(puppet, score, frames):
    """Return the taps messages of a performance and of the one that follows it."""
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet))
        session.telemetry(TAP_BASE | TAP_SIGNAL | TAP_MOTOR, 1, 0)
        return [taps_of_one_performance(session, score.steps(puppet), frames) for _ in range(2)]


def taps_of_one_performance(session, steps, frames):
    """Play from frame 0 and stop in the middle of the motion; return the taps messages."""
    prompter = Prompter(session, steps)
    prompter.reached(-1)
    session.start()
    taps = []
    while len(taps) < frames:
        session.pump(20_000)
        while session.taps:
            taps.append(session.taps.popleft())
        prompter.reached(len(taps) - 1)
    session.stop()
    session.flush()
    session.taps.clear()
    return taps[:frames]
