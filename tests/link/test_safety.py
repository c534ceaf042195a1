"""What must never happen, in the situations in which it once did: through the link, on the emulated MCU that computes in no time.

`tests/mcu/test_safety_rp2040.py` has what takes a main loop that is busy, or a line with a rate.
"""

import dataclasses
import itertools

import numpy
import pytest

from marotte.limits import Limits
from marotte.link import RETRY_US, LinkRefused, VirtualCarrier
from marotte.mcu.unix import UnixMcu
from shared import formats, messages
from tests.link.safety import (
    KILL_PIN,
    KILL_US,
    LONGEST_US,
    SHORTEST_US,
    begin,
    drive,
    last_fall_us,
    play,
    puppet_text,
    tables_of,
    widths_us,
)
from tests.link.stage import Parts, open_session

TICK_US = 20_000
PIN, OTHER_PIN = 7, 8
ONE = puppet_text(["A"])
SERVO = f"[output.A]\npin = {PIN}\npulse_us = [{SHORTEST_US}, {LONGEST_US}]\n"
KILL = f'[kill]\npin = {KILL_PIN}\nswitch = "{{}}"\n'
SETTLED_US = 4_000_000
"""A change of source, critically damped with 0.25 s, has died out by then: 17 * exp(-16) of half the range is 2^-20 or less."""


@pytest.fixture
def mcu():
    with UnixMcu() as mcu:
        yield mcu


def connect(mcu):
    return open_session(VirtualCarrier(mcu))


# ---- poses


REORDERED = [
    tables_of(
        puppet_text(names, ['["A", 1, 1, "const(1)"]', '["B", 0.25, 0.25, "const(0)"]']),
        f"[output.A]\npin = {PIN}\npulse_us = [1000, 2000]\n[output.B]\npin = {OTHER_PIN}\npulse_us = [1000, 2000]\n",
    )
    for names in (["A", "B"], ["B", "A"])
]
POSES_US, RESTS_US = {PIN: 2000, OTHER_PIN: 1250}, {PIN: 1500, OTHER_PIN: 1500}
AFTER_US = {"the same tables": (1, POSES_US), "those before": (0, RESTS_US)}
"""Where DOFs begin after a reset. A pose is known as long as the wiring is the same, and the order of DOFs belongs to that."""


@pytest.mark.parametrize("after", AFTER_US)
@pytest.mark.parametrize("reset", ["asked for", "by the watchdog"])
def test_dofs_that_were_reordered_never_begin_at_another_ones_pose(mcu, reset, after):
    session = connect(mcu)
    begin(session, REORDERED[0])
    drive(session, SETTLED_US)
    session.exchange(REORDERED[1], REORDERED[0].puppet)
    play(session, 1_000_000)
    for pin, width_us in POSES_US.items():
        assert widths_us(mcu, pin)[-1][1] == pytest.approx(width_us, abs=0.5)
    if reset == "asked for":
        mcu.reset()
    else:
        mcu.block(3_000_000)
        mcu.run_for(4_000_000)
    assert mcu.report()["resets"] == 1
    mcu.clear_edges()
    session = connect(mcu)
    again, begin_us = AFTER_US[after]
    session.upload(REORDERED[again])
    drive(session)
    for pin, width_us in begin_us.items():
        # The pose is kept to Q15, 0.03 us here.
        assert widths_us(mcu, pin)[0][1] == pytest.approx(width_us, abs=0.5), pin


# ---- limits that become tighter in mid-move


LOWER, UPPER = 0.25, 0.625
OLD_ACCEL, OLD_SPEED = 200.0, 10.0
TIGHTER = {
    "nearly no acceleration": Limits(accel=1.0),
    "less acceleration": Limits(accel=20.0),
    "less acceleration and speed": Limits(speed=0.5, accel=2.0),
    "less acceleration in a narrower range": Limits((0.4, 0.5), accel=2.0),
}
RANGES = {"whole": (0.0, 1.0), "part": (LOWER, UPPER)}
MOMENTS_US = (0, 210_000, 430_000, 640_000, 850_000)
"""Parts of a cycle: among others near its ends, and where it is fastest."""

Q24 = 1 << 24
Q18_US = 1 << 18


def limits_text(limits):
    keys = "".join(
        f"{key} = {value}\n" for key, value in (("speed", limits.speed), ("accel", limits.accel)) if value is not None
    )
    return keys + (f"range = {list(limits.range)}\n" if limits.range else "")


def positions_q24(drive):
    """Return the instants of ticks and where the DOF was led in them, exact: of a unit some 32nd is lost in pulse widths."""
    shares = (numpy.array(drive.value) / Q18_US - SHORTEST_US) / (LONGEST_US - SHORTEST_US)
    return numpy.array(drive.t_us), numpy.round(shares * Q24).astype(numpy.int64)


def steps_and_bends(positions):
    """Return the steps from tick to tick, and the accelerations in ranges a second squared, one less."""
    steps = numpy.diff(positions)
    return steps, numpy.abs(numpy.diff(steps)) / ((TICK_US / 1e6) ** 2 * Q24)


@pytest.mark.parametrize("how", ["limit", "exchange", "exchange that reorders"])
@pytest.mark.parametrize("allowed", RANGES)
@pytest.mark.parametrize("tighter", TIGHTER)
def test_tighter_limits_in_mid_move_are_braked_into(how, allowed, tighter):
    """From the recorder's pulse widths at full resolution: nothing here has a tolerance."""
    low, high = RANGES[allowed]
    narrow = TIGHTER[tighter]
    names = ["A", "B"]
    base = puppet_text(names).replace("[dof.A]", f"[dof.A]\nlimits = {{ range = [{low}, {high}] }}")
    turned = puppet_text(names[::-1]).replace("[dof.A]", f"[dof.A]\nlimits = {{ range = [{low}, {high}] }}")
    if narrow.range:
        # Within what it may already do: an edit narrows it as `limit` does.
        narrow = dataclasses.replace(narrow, range=(max(low, narrow.range[0]), min(high, narrow.range[1])))
    other = f"[output.B]\npin = {OTHER_PIN}\n"
    first = tables_of(base, SERVO + f"accel = {OLD_ACCEL}\n" + other)
    then = tables_of(turned if how == "exchange that reorders" else base, SERVO + limits_text(narrow) + other)
    for moment_us in MOMENTS_US:
        with UnixMcu() as mcu:
            session = connect(mcu)
            begin(session, first)
            drive(session, 2_000_000 + moment_us)
            if how == "limit":
                session.limit("A", narrow)
                session.flush()
            else:
                session.exchange(then, first.puppet)
            changed_us = mcu.now_us
            play(session, 6_000_000)
            times_us, positions = positions_q24(mcu.drives()[PIN])
        assert positions.min() >= round(low * 32768) << 9 and positions.max() <= round(high * 32768) << 9, moment_us
        steps, bends = steps_and_bends(positions)
        assert bends.max() <= OLD_ACCEL, moment_us
        turns = numpy.flatnonzero((times_us[2:] > changed_us) & (steps[1:] * steps[:-1] <= 0))
        assert turns.size, "it comes to rest, if only to turn round"
        assert bends[turns[0] + 1 :].max() <= narrow.accel, moment_us
        if narrow.range:
            late = positions[times_us > times_us[-1] - 2_000_000]
            assert late.min() >= round(narrow.range[0] * 32768) << 9
            assert late.max() <= round(narrow.range[1] * 32768) << 9


def test_limits_that_become_tighter_twice_in_one_move_are_braked_into(mcu):
    session = connect(mcu)
    begin(session, tables_of(ONE, SERVO + f"accel = {OLD_ACCEL}\n"))
    drive(session, 2_000_000)
    for accel in (20.0, 1.0):
        session.limit("A", Limits(accel=accel))
        play(session, 60_000)
    changed_us = mcu.now_us
    play(session, 4_000_000)
    session.limit("A", Limits(accel=OLD_ACCEL))
    session.flush()
    wider_us = mcu.now_us
    play(session, 2_000_000)
    times_us, positions = positions_q24(mcu.drives()[PIN])
    assert positions.min() >= 0 and positions.max() <= Q24
    steps, bends = steps_and_bends(positions)
    assert bends.max() <= OLD_ACCEL
    between = (times_us[2:] > changed_us) & (times_us[2:] < wider_us)
    turn = numpy.flatnonzero(between & (steps[1:] * steps[:-1] <= 0))[0]
    assert bends[turn + 1 :][between[turn + 1 :]].max() <= 1.0
    wide = positions[times_us > wider_us + 1_000_000]
    assert wide.max() - wide.min() > 0.99 * Q24, "it is as quick as before"


# ---- kills from the host


class Faulty:
    """A carrier between a session and an MCU that loses what `lose(packet)` says: returns what arrives of it."""

    def __init__(self, mcu):
        self._carrier = VirtualCarrier(mcu)
        self.lose = lambda packet: packet

    def write(self, data):
        self._carrier.write(self.lose(data))

    def __getattr__(self, name):
        return getattr(self._carrier, name)


LOST = {
    "nothing": lambda packet: packet,
    "all of it": lambda packet: b"",
    "its end": lambda packet: packet[:-1],
    "its beginning": lambda packet: packet[3:],
    "its middle": lambda packet: packet[:2] + packet[4:],
    "its meaning": lambda packet: packet[:3] + bytes([packet[3] ^ 0x41]) + packet[4:],
}
COMMANDS = {
    "ping": lambda session: session.link.post("ping"),
    "weight_targets": lambda session: session.weight_targets(formats.FRAME_NOW, {0: formats.WEIGHT_ONE}),
    "arm": lambda session: session.link.post("arm", on_refused=lambda *_: None),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("pumped", [True, False])
def test_kill_acts_at_once_behind_a_packet_that_was_lost(mcu, lost, command, pumped):
    carrier = Faulty(mcu)
    session = open_session(carrier)
    begin(session, tables_of(ONE, "rate = 333\n" + SERVO))
    drive(session, 300_000)
    mcu.clear_edges()
    carrier.lose = LOST[lost]
    COMMANDS[command](session)
    carrier.lose = LOST["nothing"]
    called_us = mcu.now_us
    session.kill()
    if pumped:
        play(session, 500_000, 1_000)
        assert (session.status()["armed"], session.status()["killed_by"]) == (0, formats.KILLED_BY_HOST)
    else:
        mcu.run_for(500_000)
    assert last_fall_us(mcu, [PIN], called_us) - called_us <= KILL_US + 3_008


def test_kill_that_is_lost_itself_is_repeated(mcu):
    carrier = Faulty(mcu)
    session = open_session(carrier)
    begin(session, tables_of(ONE, "rate = 333\n" + SERVO))
    drive(session, 300_000)
    mcu.clear_edges()
    carrier.lose = LOST["all of it"]
    called_us = mcu.now_us
    session.kill()
    carrier.lose = LOST["nothing"]
    play(session, 500_000, 1_000)
    took_us = last_fall_us(mcu, [PIN], called_us) - called_us
    print(f"a kill that is lost acts after {took_us / 1000:.1f} ms")
    assert took_us <= RETRY_US + KILL_US + 3_008
    assert not session.status()["armed"]


def test_arm_that_waits_behind_a_lost_packet_does_not_undo_a_kill(mcu):
    """The `arm` has gone out before the kill, but gets its turn behind it, when the gap is filled."""
    carrier = Faulty(mcu)
    session = open_session(carrier)
    begin(session, tables_of(ONE, "rate = 333\n" + SERVO))
    drive(session, 300_000)
    carrier.lose = LOST["all of it"]
    session.link.post("ping")
    carrier.lose = LOST["nothing"]
    COMMANDS["arm"](session)
    session.kill()
    mcu.run_for(30_000)
    mcu.clear_edges()
    play(session, 500_000, 1_000)
    assert mcu.edges(PIN) == []
    assert not session.status()["armed"]


# ---- the kill pin


BUS = "[chip.X]\nsda = 4\nscl = 5\noe = 10\n"
CHANNEL = '[output.A]\ndriver = "pca9685"\nchip = "X"\nchannel = 0\n'
WHEEL = puppet_text(["A"], ['["A", -1, 1, "rsin"]']).replace("[dof.A]", '[dof.A]\nkind = "relative"')
BRIDGES = {
    "direction": '[output.A]\ndriver = "bridge"\nwiring = "pwm-direction"\npwm = 12\ndirection = 13\n',
    "two-pwm": '[output.A]\ndriver = "bridge"\nwiring = "two-pwm"\nforward = 14\nbackward = 15\n',
}
FEEDBACK = SERVO + "feedback = { pin = 26, at = [0.1, 0.9] }\n"


def field_to(kind, field, value):
    """Return a change of one field of the messages of a kind."""
    return lambda name, fields, items: (name, fields | {field: value} if name == kind else fields, items)


def setting_to(kind, number, value):
    """Return a change of one setting of the messages of a kind."""

    def change(name, fields, items):
        if name == kind:
            items = [{"setting": value} if place == number else item for place, item in enumerate(items)]
        return name, fields, items

    return change


KILLED = KILL.format("open")
CLASHES = {
    "servo on the kill pin": (ONE, KILLED + SERVO, setting_to("output", 0, KILL_PIN)),
    "kill pin on a servo": (ONE, KILLED + SERVO, field_to("robot", "kill_pin", PIN)),
    "bus data on the kill pin": (ONE, KILLED + BUS + CHANNEL, setting_to("device", 0, KILL_PIN)),
    "bus clock on the kill pin": (ONE, KILLED.replace("22", "21") + BUS + CHANNEL, setting_to("device", 1, 21)),
    "output enable on the kill pin": (ONE, KILLED + BUS + CHANNEL, setting_to("device", 3, KILL_PIN)),
    "kill pin on bus data": (ONE, KILLED + BUS + CHANNEL, field_to("robot", "kill_pin", 4)),
    "kill pin on bus clock": (ONE, KILLED + BUS + CHANNEL, field_to("robot", "kill_pin", 5)),
    "kill pin on output enable": (ONE, KILLED + BUS + CHANNEL, field_to("robot", "kill_pin", 10)),
    "kill pin on a chip that nobody uses": (ONE, KILLED + BUS + SERVO, field_to("robot", "kill_pin", 10)),
    "kill pin on a bridge": (WHEEL, KILLED + BRIDGES["direction"], field_to("robot", "kill_pin", 12)),
    "kill pin on a bridge's direction": (WHEEL, KILLED + BRIDGES["direction"], field_to("robot", "kill_pin", 13)),
    "kill pin on a bridge's other PWM": (WHEEL, KILLED + BRIDGES["two-pwm"], field_to("robot", "kill_pin", 15)),
    "potentiometer on the kill pin": (ONE, KILLED.replace("22", "27") + FEEDBACK, field_to("feedback", "pin", 27)),
    "kill pin on a potentiometer": (ONE, KILLED + FEEDBACK, field_to("robot", "kill_pin", 26)),
}


@pytest.mark.parametrize("clash", CLASHES)
def test_kill_pin_that_has_another_use_is_refused_by_the_mcu(mcu, clash):
    """The host refuses such files; these are messages that no file makes."""
    puppet, robot, change = CLASHES[clash]
    tables = tables_of(puppet, robot)
    session = connect(mcu)
    parts = [change(*part) for part in tables.messages()]
    assert parts != list(tables.messages())
    with pytest.raises(LinkRefused) as refused:
        session.upload(Parts(parts))
    assert refused.value.status == messages.RANGE
    session.arm()
    with pytest.raises(LinkRefused):
        session.flush()
    session.upload(tables)  # as it was, it is accepted


@pytest.mark.parametrize("switch, pressed", [("open", 0), ("closed", 1)])
def test_arm_with_the_kill_switch_active_is_refused_and_says_why(mcu, switch, pressed):
    mcu.set_pin(KILL_PIN, pressed)
    session = connect(mcu)
    begin(session, tables_of(ONE, KILL.format(switch) + SERVO))
    for _ in range(2):
        session.arm()
        with pytest.raises(LinkRefused, match="kill switch"):
            session.flush()
        assert (session.status()["armed"], session.status()["killed_by"]) == (0, formats.KILLED_BY_PIN)
    play(session, 200_000)
    assert mcu.edges(PIN) == []
    mcu.set_pin(KILL_PIN, 1 - pressed)
    drive(session)
    assert (session.status()["armed"], session.status()["killed_by"]) == (1, formats.KILLED_BY_NOBODY)


TWO = puppet_text(["A", "B"])
FAST = "rate = 333\n"
BRINGS = {
    "pin was free": FAST + SERVO,
    "pin was a servo": FAST + SERVO + f"[output.B]\npin = {KILL_PIN}\n",
    "another pin killed": FAST + KILL.format("open").replace("22", "20") + SERVO,
    "pin was a chip's": FAST + BUS.replace("10", "22") + SERVO + CHANNEL.replace("output.A", "output.B"),
}
"""What a robot was before a kill pin came to it, normally open."""


@pytest.mark.parametrize("brings", BRINGS)
def test_exchange_that_brings_a_kill_pin_does_not_kill(mcu, brings):
    old, new = tables_of(TWO, BRINGS[brings]), tables_of(TWO, FAST + KILL.format("open") + SERVO)
    mcu.add_pca9685(0, 0x40, KILL_PIN)
    session = connect(mcu)
    begin(session, old)
    drive(session)
    session.exchange(new, old.puppet)
    play(session, 200_000)
    assert (session.status()["armed"], session.status()["attached"]) == (1, 1)
    mcu.set_pin(KILL_PIN, 0)
    pressed_us = mcu.now_us
    mcu.clear_edges()
    play(session, 100_000)
    assert last_fall_us(mcu, [PIN], pressed_us) - pressed_us <= 3_008
    assert session.status()["killed_by"] == formats.KILLED_BY_PIN


# ---- silence, and a kept puppet that nobody has ever talked to


def kept_tables(when_silent):
    more = f'when_silent = "{when_silent}"\n'
    text = puppet_text(["A"], more=more).replace("[dof.A]", "[dof.A]\nrest = 0.2") + "[behaviour.GO]\nLOOK = 1.0\n"
    return tables_of(text, "autostart = true\n" + SERVO)


@pytest.mark.parametrize("when_silent", ["idle", "rest", "relax"])
def test_kept_puppet_plays_alone_and_is_silent_only_once_a_host_has_gone(tmp_path, when_silent):
    tables = kept_tables(when_silent)
    with UnixMcu(folder=tmp_path) as mcu:
        connect(mcu).save(tables, "GO")
    with UnixMcu(folder=tmp_path) as mcu:
        mcu.run_for(8_000_000)
        alone = [width for t_us, width in widths_us(mcu, PIN) if t_us > SETTLED_US]
        assert max(alone) - min(alone) > 1900, "it plays"
        session = connect(mcu)
        assert session.status()["silent"] == 0
        play(session, 1_000_000)
        left_us = mcu.now_us
        mcu.run_for(8_000_000)
        left = [width for t_us, width in widths_us(mcu, PIN) if t_us > left_us + SETTLED_US]
        if when_silent == "idle":
            assert max(left) - min(left) > 1900, "it goes on"
        elif when_silent == "rest":
            assert (
                left == pytest.approx([SHORTEST_US + 0.2 * (LONGEST_US - SHORTEST_US)] * len(left), abs=1)
                and len(left) > 100
            )
        else:
            assert left == []


def test_host_that_only_makes_noise_has_not_come(tmp_path):
    """Bytes that are no packet neither end a silence nor begin one."""
    tables = kept_tables("rest")
    with UnixMcu(folder=tmp_path) as mcu:
        connect(mcu).save(tables, "GO")
    with UnixMcu(folder=tmp_path) as mcu:
        for _ in range(20):
            mcu.send(b"\0\x07noise\0")
            mcu.run_for(400_000)
        alone = [width for t_us, width in widths_us(mcu, PIN) if t_us > SETTLED_US]
        assert max(alone) - min(alone) > 1900


def test_wheels_of_a_kept_puppet_turn_only_while_there_is_a_host(tmp_path):
    puppet = WHEEL.replace('"rsin"', '"const(1)"') + "[behaviour.GO]\nLOOK = 1.0\n"
    with UnixMcu(folder=tmp_path) as mcu:
        connect(mcu).save(tables_of(puppet, "autostart = true\n" + SERVO), "GO")
    with UnixMcu(folder=tmp_path) as mcu:
        mcu.run_for(4_000_000)
        alone = [width for _, width in widths_us(mcu, PIN)]
        assert alone == pytest.approx([1500] * len(alone), abs=1) and len(alone) > 100
        session = connect(mcu)
        play(session, 1_000_000)
        assert widths_us(mcu, PIN)[-1][1] == pytest.approx(LONGEST_US, abs=1)
        left_us = mcu.now_us
        mcu.run_for(2_000_000)
        found = widths_us(mcu, PIN, left_us)
        widths = [width for _, width in found]
        assert all(b <= a + 0.5 for a, b in itertools.pairwise(widths)), "it slows down"
        standing = [width for t_us, width in found if t_us > left_us + 500_000 + 300_000 + 2 * TICK_US]
        assert standing == pytest.approx([1500] * len(standing), abs=1)
