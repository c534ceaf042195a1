"""A performance begun again in the same session: the same puppet and targets give the same numbers as the first time."""

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.prompter import Prompter
from shared.formats import TAP_BASE, TAP_MOTOR, TAP_SIGNAL, VALUE_ONE
from tests.motion.playing import load, random_case

FRAMES = 60
EARLY_FRAME = 5
"""One in which a wheel that eases still has less than its speed."""


def test_motion_begun_again_repeats_to_the_bit():
    puppet, score, _ = load(random_case(20, 2, dofs=10))
    wheels = [place for place, dof in enumerate(puppet.dofs.values()) if dof.is_relative]
    assert wheels and puppet.lives
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet))
        session.telemetry(TAP_BASE | TAP_SIGNAL | TAP_MOTOR, 1, 0)
        first, second = (taps_of_one_performance(session, score.steps(puppet)) for _ in range(2))
    assert len(first) == FRAMES
    motor_q15 = first[EARLY_FRAME][2][-len(puppet.dofs) :]
    assert any(motor_q15[place] != VALUE_ONE // 2 for place in wheels)
    assert second == first


def taps_of_one_performance(session, steps):
    """Play from frame 0 and stop in the middle of the motion; return the taps messages."""
    prompter = Prompter(session, steps)
    prompter.reached(-1)
    session.start()
    taps = []
    while len(taps) < FRAMES:
        session.pump(20_000)
        while session.taps:
            taps.append(session.taps.popleft())
        prompter.reached(len(taps) - 1)
    session.stop()
    session.flush()
    session.taps.clear()
    return taps[:FRAMES]
