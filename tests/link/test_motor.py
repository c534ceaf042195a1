"""The motor layer through the link: when pulses flow and when they stop, what silence does, and that limits hold."""

import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.tables import build_tables
from shared import formats
from tests.link.stage import open_session

PUPPET = """
frame_rate = 50
[dof.WHEEL]
kind = "relative"
[dof.NECK]
[dof.JAW]
limits = [0.25, 0.625]
[action.DRIVE]
tau = 0.03
map = [["WHEEL", 1, 1, "const(1)"]]
[action.LOOK]
tau = 0.03
map = [["NECK", 0, 1, "rsin"], ["JAW", 0, 1, "rsin"]]
"""
ROBOT = "".join(
    f"[output.{name}]\npin = {pin}\npulse_us = [1000, 2000]\n" for name, pin in [("WHEEL", 4), ("NECK", 5), ("JAW", 6)]
)
WHEEL, NECK, JAW = 4, 5, 6
PINS = (WHEEL, NECK, JAW)
FRAME_US = 20_000
PERIOD_US = 20_000
STAND_US = 1500
FULL_US = 2000
LINK_TIMEOUT_US = 500_000
STOP_US = 300_000
KILL_US = 20_000
KINDS = ("unix", pytest.param("rp2040", marks=pytest.mark.images))


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motor")
    for name, text in (("puppet", PUPPET), ("robot", ROBOT)):
        (folder / f"{name}.toml").write_text(text)
    puppet = marotte.load_puppet(folder / "puppet.toml")
    return build_tables(puppet, marotte.load_robot(folder / "robot.toml", puppet))


@pytest.fixture(params=KINDS)
def playing(request, tables):
    """An MCU on which the wheel drives and the head looks about, HOLD having gone; not armed; and its session."""
    make = UnixMcu if request.param == "unix" else request.getfixturevalue("rp2040_mcu")
    with make() as mcu:
        session = open_session(VirtualCarrier(mcu))
        session.upload(tables)
        session.telemetry(formats.TAP_BASE | formats.TAP_MOTOR, 1, 0)
        session.weight_targets(0, {0: formats.WEIGHT_MAX, 1: formats.WEIGHT_MAX})
        session.start()
        play(session, 18 * 250_000)
        yield mcu, session


def play(session, for_us):
    """Let time pass, the host talking."""
    end_us = session.carrier.now_us() + for_us
    while session.carrier.now_us() < end_us:
        session.pump(min(FRAME_US, end_us - session.carrier.now_us()))


def widths_us(mcu, pin, after_us=0):
    """The pulses of a pin that begin after an instant: `(t_us, width_us)`, to whole us; a count of the RP2040 is 0.32 us."""
    return [
        (pulse.start_ns / 1000, round(pulse.width_ns / 1000))
        for pulse in pulses(mcu.edges(pin))
        if pulse.start_ns > after_us * 1000
    ]


def drive(session):
    """Arm, and let a few pulses pass."""
    session.arm()
    play(session, 200_000)


def test_pins_have_no_pulse_before_they_are_armed(playing):
    mcu, session = playing
    assert all(mcu.edges(pin) == [] for pin in range(30))
    assert not session.status()["armed"]
    drive(session)
    assert session.status()["armed"]
    for pin in PINS:
        found = widths_us(mcu, pin)
        assert len(found) >= 8, pin
        assert all(1000 <= width_us <= 2000 for _, width_us in found)
    assert [pin for pin in range(30) if mcu.edges(pin)] == list(PINS)


def test_kill_stops_all_pulses_and_arm_brings_them_back(playing):
    mcu, session = playing
    drive(session)
    session.kill()
    session.flush()
    killed_us = mcu.now_us
    assert all(mcu.edges(pin)[-1][1] == 0 for pin in PINS)
    play(session, 300_000)
    assert all(widths_us(mcu, pin, killed_us) == [] for pin in PINS)
    assert not session.status()["armed"] and session.status()["frame"] > 0
    drive(session)
    assert all(len(widths_us(mcu, pin, killed_us)) >= 8 for pin in PINS)


def test_kill_ends_a_pulse_that_is_under_way(playing):
    mcu, session = playing
    drive(session)
    delays_us, cut = [], 0
    for number in range(24):
        rise_us = max(t_ns for t_ns, level in mcu.edges(WHEEL) if level) / 1000
        at_us = int(rise_us) + 2 * PERIOD_US - 2400 + 200 * number  # about the beginning of a pulse
        play(session, at_us - mcu.now_us)
        session.kill()
        play(session, 60_000)
        falls_us = [mcu.edges(pin)[-1][0] / 1000 for pin in PINS]
        assert all(mcu.edges(pin)[-1][1] == 0 for pin in PINS)
        delays_us.append(max(falls_us) - at_us)
        cut += widths_us(mcu, WHEEL)[-1][1] < FULL_US
        drive(session)
    assert cut >= 3, "some kills have to come in the middle of a pulse"
    assert max(delays_us) < 5000


def test_silence_stops_relative_dofs_and_lets_absolute_ones_go_on(playing):
    mcu, session = playing
    drive(session)
    session.flush()
    heard_us = mcu.now_us
    mcu.run_for(2_000_000)
    driving = widths_us(mcu, WHEEL, heard_us + 2 * PERIOD_US)
    ramp = [width for t_us, width in driving if t_us > heard_us + LINK_TIMEOUT_US - 100_000]
    assert all(width == FULL_US for t_us, width in driving if t_us < heard_us + LINK_TIMEOUT_US - 100_000)
    assert ramp == sorted(ramp, reverse=True)
    assert len(set(ramp)) > 10, "it eases to a stand"
    still_us = heard_us + LINK_TIMEOUT_US + STOP_US + FRAME_US + PERIOD_US
    assert {width for t_us, width in driving if t_us > still_us} == {STAND_US}
    assert len({width for _, width in widths_us(mcu, NECK, still_us)}) > 20, "the neck goes on"
    mcu.receive()
    back_us = mcu.now_us
    play(session, STOP_US + 4 * FRAME_US)
    speeding = [width for _, width in widths_us(mcu, WHEEL, back_us)]
    assert speeding == sorted(speeding) and speeding[0] < FULL_US - 400 and speeding[-1] == FULL_US


def test_stop_makes_relative_dofs_stand_and_absolute_ones_stay(playing):
    mcu, session = playing
    drive(session)
    session.stop()
    session.flush()
    stopped_us = mcu.now_us + PERIOD_US
    play(session, 300_000)
    assert {width for _, width in widths_us(mcu, WHEEL, stopped_us)} == {STAND_US}
    assert len({width for _, width in widths_us(mcu, NECK, stopped_us)}) == 1
    assert session.status()["frame"] == -1 and session.status()["armed"]


def test_limits_hold_whatever_the_compositor_says(playing):
    mcu, session = playing
    drive(session)
    play(session, 2_000_000)
    dofs = len(PINS)
    bases, motors = ([values[start : start + dofs] for _, _, values in session.taps] for start in (0, dofs))
    low, high = (round(limit * formats.VALUE_ONE) for limit in (0.25, 0.625))
    jaw_base, jaw_motor = ([values[2] for values in taps] for taps in (bases, motors))
    assert min(jaw_base) < low and max(jaw_base) > high
    assert jaw_motor == [min(max(value, low), high) for value in jaw_base]
    found = [width for _, width in widths_us(mcu, JAW)]
    assert min(found) >= 1250 and max(found) <= 1625


def test_tables_that_are_loaded_anew_take_the_pulses_away(playing, tables):
    mcu, session = playing
    drive(session)
    session.upload(tables)
    loaded_us = mcu.now_us
    play(session, 200_000)
    assert all(widths_us(mcu, pin, loaded_us) == [] for pin in PINS)
    assert not session.status()["armed"]


def test_kill_acts_within_20_ms_whatever_else_is_under_way(playing):
    mcu, session = playing
    for number in range(8):
        drive(session)
        play(session, 1000 * number + 137)
        for target in range(16):
            items = [{"action": 0, "target_q28": 1000 * target}] * 48
            session.link.post("weight_targets", {"frame": formats.FRAME_NOW}, items, on_refused=lambda *_: None)
        session.arm()
        session.kill()
        mcu.run_for(KILL_US)
        mcu.clear_edges()
        play(session, 200_000)
        assert all(mcu.edges(pin) == [] for pin in PINS)
        session.flush()
        assert not session.status()["armed"]
