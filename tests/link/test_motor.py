"""The motor layer through the link: when pulses flow and stop, where they begin, what silence does, what can be changed live."""

import dataclasses
import itertools
import math

import pytest

import marotte
from marotte.limits import Limits
from marotte.link import LinkRefused, VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.tables import build_tables, keeps
from shared import formats
from tests.link.stage import begin_performance, open_session, pet_tables

PUPPET = """
frame_rate = 50
when_silent = "{when_silent}"
[dof.WHEEL]
kind = "relative"
[dof.NECK]
rest = 0.25
[dof.JAW]
limits = [0.25, 0.625]
[action.DRIVE]
tau = 0.03
map = [["WHEEL", 1, 1, "const(1)"]]
[action.LOOK]
tau = 0.03
map = [["NECK", 0, 1, "rsin"], ["JAW", 0, 1, "rsin"]]
"""
WHEEL, NECK, JAW = 4, 6, 8
PINS = {"WHEEL": WHEEL, "NECK": NECK, "JAW": JAW}
KILL_PIN = 22
ROBOT = f'rate = {{rate}}\n[kill]\npin = {KILL_PIN}\nswitch = "{{switch}}"\n' + "".join(
    f"[output.{name}]\npin = {pin}\npulse_us = [1000, 2000]\n" for name, pin in PINS.items()
)
FRAME_US = 20_000
STAND_US = 1500
FULL_US = 2000
LINK_TIMEOUT_US = 500_000
STOP_US = 300_000
KILL_US = 20_000
ATTACH_US = 100_000
WRITE_US = 1_000
"""A servo's period begins so long after the tick that wrote its pulse."""

COUNT_US = 0.32
SETTLED_US = 4_000_000
"""By then a change of source, critically damped with 0.25 s, has died out: 17 * exp(-16) of half the range is 2^-20 or less."""

HANDLED_US = 500
"""What the RP2040 takes at most from a tick's instant, or a packet's last byte, to driving pins low."""

KINDS = ("unix", pytest.param("rp2040", marks=pytest.mark.images))


def tables_of(folder, when_silent="idle", rate=50, switch="open"):
    texts = {"puppet": PUPPET.format(when_silent=when_silent), "robot": ROBOT.format(rate=rate, switch=switch)}
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text)
    puppet = marotte.load_puppet(folder / "puppet.toml")
    return build_tables(puppet, marotte.load_robot(folder / "robot.toml", puppet))


@pytest.fixture(params=KINDS)
def mcu(request):
    """An emulated MCU that has just been switched on."""
    make = UnixMcu if request.param == "unix" else request.getfixturevalue("rp2040_mcu")
    with make() as mcu:
        yield mcu


@pytest.fixture
def playing(mcu, tmp_path):
    """An MCU on which the wheel drives and the head looks about, HOLD having gone; not armed; and its session."""
    return mcu, begin(mcu, tables_of(tmp_path))


def begin(mcu, tables):
    session = open_session(VirtualCarrier(mcu))
    session.upload(tables)
    session.telemetry(formats.TAP_BASE | formats.TAP_MOTOR, 1, 0)
    session.weight_targets(0, {0: formats.WEIGHT_MAX, 1: formats.WEIGHT_MAX})
    session.start()
    play(session, 18 * 250_000)
    return session


def play(session, for_us):
    """Let time pass, the host talking."""
    end_us = session.carrier.now_us() + for_us
    while session.carrier.now_us() < end_us:
        session.pump(min(FRAME_US, end_us - session.carrier.now_us()))


def widths_us(mcu, pin, after_us=0):
    """The pulses of a pin that begin after an instant: `(t_us, width_us)`, to whole us; a count of the RP2040 is 0.32 us."""
    return [(t_us, round(width_us)) for t_us, width_us in exact_widths_us(mcu, pin, after_us)]


def exact_widths_us(mcu, pin, after_us=0):
    found = pulses(mcu.edges(pin))
    return [(pulse.start_ns / 1000, pulse.width_ns / 1000) for pulse in found if pulse.start_ns > after_us * 1000]


def drive(session, for_us=200_000):
    """Arm, and let a few pulses pass once all outputs have them; it takes SETTLED_US until a DOF is where it should be."""
    session.arm()
    session.wait_attached()
    play(session, for_us)


def last_fall_us(mcu):
    """Return when the last pulse of any output ended, or was cut."""
    assert all(mcu.edges(pin)[-1][1] == 0 for pin in PINS.values())
    return max(mcu.edges(pin)[-1][0] for pin in PINS.values()) / 1000


def beginning_of_pulse_us(session, mcu):
    """Let time pass until the wheel's next pulse is 2.4 ms away, and return when it will begin."""
    rise_us = max(t_ns for t_ns, level in mcu.edges(WHEEL) if level) / 1000
    at_us = rise_us + 2 * FRAME_US
    play(session, int(at_us - 2400) - mcu.now_us)
    return at_us


def test_pins_have_no_pulse_before_they_are_armed(playing):
    mcu, session = playing
    assert all(mcu.edges(pin) == [] for pin in range(30) if pin != KILL_PIN)
    assert not session.status()["armed"]
    drive(session)
    assert session.status()["armed"]
    for pin in PINS.values():
        found = widths_us(mcu, pin)
        assert len(found) >= 8, pin
        assert all(1000 <= width_us <= 2000 for _, width_us in found)
    assert [pin for pin in range(30) if mcu.edges(pin)] == list(PINS.values())


def test_outputs_are_attached_one_after_the_other(playing):
    mcu, session = playing
    session.arm()
    armed_us = mcu.now_us
    play(session, 1_000_000)
    first_us = [exact_widths_us(mcu, pin)[0][0] for pin in PINS.values()]
    # The first one at once: its first pulse comes with the next tick. What attaches the others wakes with ticks and frames.
    assert 0 < first_us[0] - armed_us < 2 * FRAME_US + 5_000
    assert [b - a for a, b in itertools.pairwise(first_us)] == pytest.approx([ATTACH_US] * 2, abs=FRAME_US + HANDLED_US)
    assert session.status()["attached"] == 0b111
    for pin in PINS.values():
        starts = [t_us for t_us, _ in exact_widths_us(mcu, pin)]
        gaps_us = [b - a for a, b in itertools.pairwise(starts)]
        assert gaps_us == pytest.approx([FRAME_US] * len(gaps_us), abs=0.001)


def test_motion_begins_where_the_dofs_rest_and_eases_in(playing):
    mcu, session = playing
    drive(session, SETTLED_US)
    neck = [width for _, width in exact_widths_us(mcu, NECK)]
    assert neck[0] == pytest.approx(1250, abs=3)
    wheel = [width for _, width in exact_widths_us(mcu, WHEEL)]
    # The way is critically damped with 0.25 s: 500 us at 1 / 0.25 s / e at most, and the spline may be quicker by a half.
    assert wheel[0] == pytest.approx(STAND_US, abs=3) and wheel[-1] == pytest.approx(FULL_US, abs=COUNT_US)
    assert max(b - a for a, b in itertools.pairwise(wheel)) <= 1.5 * 500 * 4 / math.e * FRAME_US / 1e6


def test_dofs_that_are_not_attached_stand_still_and_their_tap_says_so(playing):
    _, session = playing
    frames = [values for _, _, values in session.taps]
    base, motor = ([values[start : start + 3] for values in frames[100:]] for start in (0, 3))
    rest = {(round(formats.VALUE_ONE / 2), round(formats.VALUE_ONE / 4), round(formats.VALUE_ONE / 2))}
    assert {tuple(values) for values in motor} == rest
    assert len({tuple(values) for values in base}) > 50


def test_kill_stops_all_pulses_and_arm_brings_them_back_from_where_they_were(playing):
    mcu, session = playing
    drive(session)
    session.kill()
    session.flush()
    killed_us = mcu.now_us
    pose = {pin: exact_widths_us(mcu, pin)[-2][1] for pin in (NECK, JAW)}
    assert last_fall_us(mcu) <= killed_us
    play(session, 3_300_000)
    assert all(widths_us(mcu, pin, killed_us) == [] for pin in PINS.values())
    status = session.status()
    assert not status["armed"] and status["attached"] == 0 and status["frame"] > 0
    assert status["killed_by"] == formats.KILLED_BY_HOST
    drive(session)
    assert session.status()["killed_by"] == formats.KILLED_BY_NOBODY
    for pin, width in pose.items():
        again = [found for _, found in exact_widths_us(mcu, pin, killed_us)]
        assert len(again) >= 8
        # The last pulse before may have been cut. From the one before that, and to this one, it went on for two ticks at most:
        # 0.2 Hz and 1 us in a thousandth of the range, pi * 1000 us * 1 Hz * 20 ms each.
        assert again[0] == pytest.approx(width, abs=3 * 63 + 2)


def test_kill_ends_a_pulse_that_is_under_way(playing):
    mcu, session = playing
    drive(session)
    delays_us, cut = [], 0
    for number in range(24):
        at_us = int(beginning_of_pulse_us(session, mcu)) - 2400 + 200 * number
        play(session, at_us - mcu.now_us)
        session.kill()
        play(session, 60_000)
        delays_us.append(last_fall_us(mcu) - at_us)
        cut += widths_us(mcu, WHEEL)[-1][1] < FULL_US
        drive(session)
    print(f"{mcu.kind}: kill to the last edge {max(delays_us) / 1000:.2f} ms at most")
    assert cut >= 3, "some kills have to come in the middle of a pulse"
    assert max(delays_us) < 5000


def test_kill_acts_within_20_ms_and_a_tick_whatever_else_is_under_way(playing):
    mcu, session = playing
    latest_us = 0
    for number in range(8):
        drive(session)
        play(session, 1000 * number + 137)
        for target in range(16):
            items = [{"action": 0, "target_q28": 1000 * target}] * 48
            session.link.post("weight_targets", {"frame": formats.FRAME_NOW}, items, on_refused=lambda *_: None)
        session.arm()
        session.kill()
        begun_us = mcu.now_us
        mcu.run_for(KILL_US + FRAME_US)
        latest_us = max(latest_us, last_fall_us(mcu) - begun_us)
        mcu.clear_edges()
        play(session, 200_000)
        assert all(mcu.edges(pin) == [] for pin in PINS.values())
        session.flush()
        assert not session.status()["armed"]
    print(f"{mcu.kind}: kill among 16 long packets to the last edge {latest_us / 1000:.2f} ms at most")


@pytest.mark.parametrize("rate_hz", [50, 333])
def test_kill_acts_within_20_ms_and_a_tick_while_tables_are_exchanged(mcu, rate_hz):
    """The pet with its ten servos is exchanged for itself; the kill comes early or late in that, or with the commit."""
    pet = pet_tables()
    tables = build_tables(pet.puppet, dataclasses.replace(pet.robot, rate_hz=rate_hz))
    pins = [output.drive.pin for output in tables.robot.outputs.values()]
    mcu.set_pin(KILL_PIN, 1)
    session = begin_performance(mcu, 0)
    session.upload(tables)
    session.start()
    first, *parts = tables.messages()
    commit = parts.pop()
    parts = [first, *parts, *keeps(tables.puppet, tables.puppet), commit]
    delays_us = []
    for number in range(12):
        session.arm()
        session.wait_attached()
        for name, fields, items in parts:
            session.link.post(name, fields, items, on_refused=lambda *_: None)
        play(session, 12_000 + 27_000 * number)
        session.kill()
        begun_us = mcu.now_us
        play(session, 1_500_000)
        assert all(mcu.edges(pin)[-1][1] == 0 for pin in pins)
        delays_us.append(max(mcu.edges(pin)[-1][0] / 1000 for pin in pins) - begun_us)
        mcu.clear_edges()
        assert not session.status()["armed"]
    print(f"{mcu.kind}: kill while tables are exchanged to the last edge {max(delays_us) / 1000:.2f} ms at most")
    assert max(delays_us) <= KILL_US + (20_000 if rate_hz == 50 else 3_008)


@pytest.mark.parametrize("rate", [50, 333])
@pytest.mark.parametrize("switch", ["open", "closed"])
def test_kill_pin_stops_all_pulses_within_a_tick(mcu, tmp_path, rate, switch):
    tick_us = 8 * math.ceil(1e6 / rate / 8)
    well, pressed = (1, 0) if switch == "open" else (0, 1)
    mcu.set_pin(KILL_PIN, well)
    session = begin(mcu, tables_of(tmp_path, rate=rate, switch=switch))
    delays_us = []
    # Just before and behind the tick, which is 1 ms before the pulse, in the pulse, and behind it.
    for after_us in (-1_100, -900, -300, 300, 1_100, 1_900, 3_500):
        drive(session)
        at_us = int(beginning_of_pulse_us(session, mcu)) + after_us
        play(session, at_us - mcu.now_us)
        mcu.set_pin(KILL_PIN, pressed)
        play(session, 100_000)
        delays_us.append(last_fall_us(mcu) - at_us)
        assert (session.status()["armed"], session.status()["killed_by"]) == (0, formats.KILLED_BY_PIN)
        session.arm()
        with pytest.raises(LinkRefused, match="arm"):
            session.flush()
        mcu.set_pin(KILL_PIN, well)
        mcu.clear_edges()
        play(session, 200_000)
        assert all(mcu.edges(pin) == [] for pin in PINS.values()), "it does not come back by itself"
    print(f"{mcu.kind}, {rate} Hz: kill pin to the last edge {max(delays_us) / 1000:.2f} ms at most")
    assert max(delays_us) <= tick_us + HANDLED_US


def test_kill_pin_acts_while_the_main_loop_is_busy(tmp_path):
    with UnixMcu() as mcu:
        mcu.set_pin(KILL_PIN, 1)
        session = begin(mcu, tables_of(tmp_path))
        drive(session)
        mcu.block(400_000)
        play(session, 50_000)
        mcu.set_pin(KILL_PIN, 0)
        pressed_us = mcu.now_us
        mcu.run_for(300_000)
        assert last_fall_us(mcu) - pressed_us <= FRAME_US


def test_silence_stops_relative_dofs_and_lets_absolute_ones_go_on(playing):
    mcu, session = playing
    drive(session, SETTLED_US)
    session.status()  # its request has been heard just now
    heard_us = mcu.now_us
    mcu.run_for(2_000_000)
    driving = exact_widths_us(mcu, WHEEL, heard_us + 2 * FRAME_US)
    early_us = heard_us + LINK_TIMEOUT_US - FRAME_US
    ramp = [width for t_us, width in driving if t_us > early_us]
    assert all(width == pytest.approx(FULL_US, abs=COUNT_US) for t_us, width in driving if t_us < early_us)
    assert ramp == sorted(ramp, reverse=True)
    assert len(set(ramp)) > 10, "it eases to a stand"
    still_us = min(t_us for t_us, width in driving if width == pytest.approx(STAND_US, abs=COUNT_US))
    print(f"{mcu.kind}: last packet to standing wheel {(still_us - heard_us) / 1000:.0f} ms")
    assert still_us <= heard_us + LINK_TIMEOUT_US + STOP_US + FRAME_US + WRITE_US
    assert {width for t_us, width in widths_us(mcu, WHEEL) if t_us > still_us} == {STAND_US}
    assert len({width for _, width in widths_us(mcu, NECK, still_us)}) > 20, "the neck goes on"
    mcu.receive()
    back_us = mcu.now_us
    play(session, STOP_US + 4 * FRAME_US)
    speeding = [width for _, width in widths_us(mcu, WHEEL, back_us)]
    assert speeding == sorted(speeding) and speeding[0] < FULL_US - 250 and speeding[-1] == FULL_US


def test_silence_with_rest_leads_to_rest_and_back(mcu, tmp_path):
    session = begin(mcu, tables_of(tmp_path, when_silent="rest"))
    drive(session)
    session.flush()
    heard_us = mcu.now_us
    mcu.run_for(4_000_000)
    neck = exact_widths_us(mcu, NECK, heard_us)
    # A critically damped way of 0.25 s: after two more seconds 9 * exp(-8) of at most the whole range is left.
    resting = [width for t_us, width in neck if t_us > heard_us + LINK_TIMEOUT_US + 2_200_000]
    assert resting == pytest.approx([1250] * len(resting), abs=5)
    assert session.status()["attached"] == 0b111
    play(session, 3_000_000)
    again = [width for t_us, width in exact_widths_us(mcu, NECK, heard_us) if t_us > heard_us + 4_100_000]
    assert max(again) - min(again) > 800
    both = [width for _, width in neck] + again
    # Going there and back it is no quicker than the motion itself, pi ranges a second, and what the way of 0.25 s adds, 2.
    assert max(abs(b - a) for a, b in itertools.pairwise(both)) < 6 * 1000 * FRAME_US / 1e6


def test_silence_with_relax_lets_go_of_what_stands_and_takes_it_again(mcu, tmp_path):
    session = begin(mcu, tables_of(tmp_path, when_silent="relax"))
    drive(session)
    session.flush()
    heard_us = mcu.now_us
    mcu.run_for(6_000_000)
    for pin, rest_us in ((WHEEL, STAND_US), (NECK, 1250), (JAW, 1500)):
        found = exact_widths_us(mcu, pin, heard_us)
        assert heard_us + LINK_TIMEOUT_US < found[-1][0] < heard_us + LINK_TIMEOUT_US + 4_500_000
        assert found[-1][1] == pytest.approx(rest_us, abs=3), "nothing is let go in mid-move"
    mcu.receive()
    back_us = mcu.now_us
    play(session, 1_000_000)
    status = session.status()
    assert (status["armed"], status["attached"], status["released"], status["silent"]) == (1, 0b111, 0, 0)
    for pin, rest_us in ((NECK, 1250), (JAW, 1500)):
        first_us, first = exact_widths_us(mcu, pin, back_us)[0]
        assert first == pytest.approx(rest_us, abs=3 * 63) and first_us < back_us + 500_000


def test_silence_is_counted_while_the_main_loop_is_busy(tmp_path):
    """The host talks, but nobody listens: for the wheels that is silence."""
    with UnixMcu() as mcu:
        session = begin(mcu, tables_of(tmp_path))
        drive(session, SETTLED_US)
        session.flush()
        mcu.block(990_000)
        blocked_us = mcu.now_us
        mcu.run_for(985_000)
        wheel = exact_widths_us(mcu, WHEEL, blocked_us)
        stands = [t_us for t_us, width in wheel if width == pytest.approx(STAND_US, abs=COUNT_US)]
        assert stands and min(stands) < blocked_us + LINK_TIMEOUT_US + STOP_US + 2 * FRAME_US


def test_stop_makes_relative_dofs_stand_and_absolute_ones_settle(playing):
    mcu, session = playing
    drive(session, SETTLED_US)
    session.stop()
    session.flush()
    stopped_us = mcu.now_us
    play(session, SETTLED_US + 400_000)
    wheel = [width for _, width in exact_widths_us(mcu, WHEEL, stopped_us + FRAME_US)]
    standing = [width for _, width in exact_widths_us(mcu, WHEEL, stopped_us + STOP_US + FRAME_US)]
    assert wheel == sorted(wheel, reverse=True) and wheel[0] > STAND_US + 300
    assert standing == pytest.approx([STAND_US] * len(standing), abs=COUNT_US)
    neck = exact_widths_us(mcu, NECK, stopped_us + SETTLED_US)
    assert max(width for _, width in neck) - min(width for _, width in neck) < 2
    status = session.status()
    assert status["frame"] == -1 and status["armed"] and status["attached"] == 0b111


def test_motion_begins_anew_from_where_it_stopped(playing):
    mcu, session = playing
    drive(session)
    session.stop()
    play(session, SETTLED_US)
    stood = exact_widths_us(mcu, NECK)[-1][1]
    session.weight_targets(0, {0: formats.WEIGHT_MAX, 1: formats.WEIGHT_MAX})
    session.start()
    begun_us = mcu.now_us
    play(session, 1_000_000)
    going = [width for _, width in exact_widths_us(mcu, NECK, begun_us)]
    assert going[:2] == pytest.approx([stood] * 2, abs=3)
    assert max(abs(b - a) for a, b in itertools.pairwise(going)) < 6 * 1000 * FRAME_US / 1e6
    assert max(going) - min(going) > 400


def test_limits_hold_whatever_the_compositor_says(playing):
    mcu, session = playing
    drive(session)
    play(session, 2_000_000)
    session.taps.clear()
    play(session, 2_000_000)
    bases, motors = ([values[start + 2] for _, _, values in session.taps] for start in (0, 3))
    low, high = (round(limit * formats.VALUE_ONE) for limit in (0.25, 0.625))
    assert min(bases) < low - 1000 and max(bases) > high + 1000
    assert min(motors) == low and max(motors) == high
    found = [width for _, width in exact_widths_us(mcu, JAW)]
    assert min(found) >= 1250 - COUNT_US and max(found) <= 1625 + COUNT_US


def test_limits_can_be_changed_live(playing):
    mcu, session = playing
    drive(session)
    session.limit("NECK", Limits((0.25, 0.5), 1.0, 20.0))
    session.flush()
    changed_us = mcu.now_us
    play(session, 4_000_000)
    # Back into the new range it takes no longer than 0.5 at 1 a second, and 1 / 20 s each to start and to brake.
    neck = [width for t_us, width in exact_widths_us(mcu, NECK, changed_us) if t_us > changed_us + 1_000_000]
    assert min(neck) == pytest.approx(1250, abs=COUNT_US) and max(neck) == pytest.approx(1500, abs=COUNT_US)
    steps = [b - a for a, b in itertools.pairwise(neck)]
    assert max(map(abs, steps)) <= 20 + 2 * COUNT_US
    assert max(abs(b - a) for a, b in itertools.pairwise(steps)) <= 8 + 4 * COUNT_US
    session.limit("NECK", Limits())
    play(session, 3_000_000)
    assert max(width for _, width in exact_widths_us(mcu, NECK, mcu.now_us - 2_000_000)) > 1900


def test_calibration_can_be_changed_live_and_glides(playing):
    mcu, session = playing
    drive(session)
    session.stop()
    play(session, SETTLED_US)
    stood = exact_widths_us(mcu, NECK)[-1][1]
    share = (stood - 1000) / 1000
    output = tables_robot(session).outputs["NECK"]
    session.calibrate(dataclasses.replace(output, pulse_us=(1200.0, 1800.0), invert=True))
    session.flush()
    changed_us = mcu.now_us
    play(session, 6_000_000)
    neck = exact_widths_us(mcu, NECK, changed_us)
    assert neck[-1][1] == pytest.approx(1800 - 600 * share, abs=2 * COUNT_US)
    # Each end moves by 200 us a second, so does what lies between.
    assert max(abs(b - a) for (_, a), (_, b) in itertools.pairwise(neck)) <= 200 * FRAME_US / 1e6 + 2 * COUNT_US


def tables_robot(session):
    return session._tables.robot


def test_tables_that_are_loaded_anew_take_the_pulses_away(playing, tmp_path):
    mcu, session = playing
    drive(session)
    session.upload(tables_of(tmp_path))
    loaded_us = mcu.now_us
    play(session, 200_000)
    assert all(widths_us(mcu, pin, loaded_us) == [] for pin in PINS.values())
    assert not session.status()["armed"]


def test_dofs_start_from_their_last_pose_after_a_reset(playing, tmp_path):
    mcu, session = playing
    drive(session)
    play(session, 370_000)
    session.flush()
    pose = {pin: exact_widths_us(mcu, pin)[-1][1] for pin in (NECK, JAW)}
    assert abs(pose[NECK] - 1250) > 50, "it is not at rest"
    if mcu.kind == "rp2040":
        RawRepl(mcu).start("import machine; machine.reset()")
        mcu.receive()
    else:
        mcu.reset()
    again_us = mcu.now_us
    session = open_session(VirtualCarrier(mcu))
    session.upload(tables_of(tmp_path))
    session.arm()
    session.wait_attached()
    play(session, 100_000)
    for pin, width in pose.items():
        # It begins at its last pose, kept to Q15 in each tick. On the way to the reset it moved on, for 60 ms at most.
        first = exact_widths_us(mcu, pin, again_us)[0][1]
        assert first == pytest.approx(width, abs=3 * 63 + 2)
        found = [width for _, width in exact_widths_us(mcu, pin, again_us)]
        assert max(found) - min(found) < 2, "and stays there while nothing plays"
    assert exact_widths_us(mcu, WHEEL, again_us)[0][1] == pytest.approx(STAND_US, abs=COUNT_US)


def test_dofs_start_from_rest_with_another_robot(playing, tmp_path):
    mcu, session = playing
    drive(session)
    play(session, 370_000)
    tables = tables_of(tmp_path)
    output = dataclasses.replace(tables.robot.outputs["NECK"], pulse_us=(1100.0, 1900.0))
    robot = dataclasses.replace(tables.robot, outputs={**tables.robot.outputs, "NECK": output})
    session.upload(build_tables(tables.puppet, robot))
    session.arm()
    session.wait_attached()
    loaded_us = mcu.now_us
    play(session, 100_000)
    assert exact_widths_us(mcu, NECK, loaded_us)[0][1] == pytest.approx(1300, abs=COUNT_US)
    assert exact_widths_us(mcu, JAW, loaded_us)[0][1] == pytest.approx(1500, abs=COUNT_US)
