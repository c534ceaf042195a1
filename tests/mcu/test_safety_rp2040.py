"""What must never happen, where only a real main loop, real interrupts and real lines can show it: on the emulated RP2040."""

import dataclasses
import itertools
import random

import pytest

from marotte.link import VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.tables import build_tables
from shared import formats
from tests.link.safety import (
    KILL_PIN,
    KILL_US,
    PUMP_US,
    begin,
    drive,
    exchange_parts,
    last_fall_us,
    play,
    post,
    puppet_text,
    tables_of,
    widths_us,
)
from tests.link.stage import ALL_TAPS, open_session, pet_tables

pytestmark = pytest.mark.images

PERIODS_US = {50: 20_000, 333: 3_008}
HANDLED_US = 500
"""What the RP2040 takes at most from a tick's instant, or a packet's last byte, to driving pins low."""


@pytest.fixture
def mcu_of(rp2040_image_path):
    """Makes an emulated RP2040 on one of its two lines."""
    made = []

    def make(line):
        made.append(Rp2040Mcu(rp2040_image_path, line, timed_flash=False))
        return made[-1]

    yield make
    for mcu in made:
        mcu.close()


# ---- the kill pin while tables are exchanged


MARK_PIN, OE_PIN = 28, 6
MARKED = f"""
from machine import Pin
from firmware.exchange import Exchange
mark = Pin({MARK_PIN}, Pin.OUT, value=0)
def marked(self, carry_over=Exchange.carry_over):
    mark(1)
    carry_over(self)
    mark(0)
Exchange.carry_over = marked
import main
"""
"""The firmware with a pin that is high while other tables are put into force."""

LOOK_US = 100
NAMES = list("ABCDEFGH")
PRESSES = 16


def servos(rate, names=NAMES, clock_mhz=25):
    """Return a robot with a channel of a chip for each DOF, by its place in the alphabet, whatever their order."""
    outputs = "".join(
        f'[output.{name}]\ndriver = "pca9685"\nchip = "X"\nchannel = {NAMES.index(name)}\n' for name in names
    )
    chip = f"[chip.X]\nsda = 4\nscl = 5\noe = {OE_PIN}\nclock = {clock_mhz}\n"
    return f'rate = {rate}\nattach_interval = 0\n[kill]\npin = {KILL_PIN}\nswitch = "open"\n{chip}{outputs}'


TURNED = NAMES[::-1]
CHIPS = {
    "another order": [(NAMES, servos(333)), (TURNED, servos(333))],
    "another period of the chip": [(NAMES, servos(333)), (TURNED, servos(333, clock_mhz=27))],
    "fewer channels": [(NAMES, servos(333)), (TURNED, servos(333, NAMES[2:5]))],
}
"""DOFs and robot that are exchanged for each other, to and fro."""


@pytest.mark.parametrize("change", CHIPS)
def test_kill_pin_at_any_instant_of_an_exchange_silences_a_chip_for_good(mcu_of, change):
    """Ticks, in which the pin is looked at, come each 3 ms; other tables take four of them or more to come into force."""
    mcu = mcu_of("usb")
    chip = mcu.add_pca9685(0, 0x40, OE_PIN)
    mcu.set_pin(KILL_PIN, 1)
    RawRepl(mcu).start(MARKED)
    session = open_session(VirtualCarrier(mcu))
    tables = [tables_of(puppet_text(names, frame_rate=30), robot) for names, robot in CHIPS[change]]
    begin(session, tables[0])
    delays_us, lengths_us = [], []
    for number in range(PRESSES):
        playing, new = tables[number % len(tables)], tables[(number + 1) % len(tables)]
        session._tables = playing
        mcu.clear_edges()
        drive(session, 40_000 + 1370 * number)
        parts, commit = exchange_parts(new, playing)
        post(session, parts)
        session.flush(5.0)
        post(session, [commit])
        session.flush()
        while not mcu.edges(MARK_PIN):
            mcu.run_for(LOOK_US)
        begun_us = mcu.edges(MARK_PIN)[0][0] // 1000
        mcu.run_until(begun_us + LOOK_US + number * 1000)
        mcu.set_pin(KILL_PIN, 0)
        pressed_us = mcu.now_us
        play(session, 150_000)
        lengths_us.append(mcu.edges(MARK_PIN)[-1][0] / 1000 - begun_us)
        high_us = [t_ns / 1000 for t_ns, level in mcu.edges(OE_PIN) if level][-1]
        assert mcu.edges(OE_PIN)[-1][1] == 1 and high_us <= pressed_us + PERIODS_US[333] + HANDLED_US, number
        delays_us.append(high_us - pressed_us)
        late = [edge for c in range(16) for edge in chip.edges(c) if edge[0] / 1000 > high_us + 1]
        assert late == [], number
        status = session.status()
        assert (status["armed"], status["attached"], status["killed_by"]) == (0, 0, formats.KILLED_BY_PIN)
        mcu.set_pin(KILL_PIN, 1)
        play(session, 60_000)
        assert mcu.edges(OE_PIN)[-1][1] == 1, "it does not come back by itself"
    print(
        f"{change}: the tables come into force in {max(lengths_us) / 1000:.1f} ms at most, "
        f"kill pin to OE {max(delays_us) / 1000:.2f} ms at most"
    )


FREE_PIN = 7
TWO = puppet_text(["A", "B"])
SERVO = f"[output.A]\npin = {FREE_PIN}\n"
KILL = f'[kill]\npin = {KILL_PIN}\nswitch = "open"\n'
BRINGS = {
    "pin was free": SERVO,
    "pin was a servo": SERVO + f"[output.B]\npin = {KILL_PIN}\n",
    "another pin killed": KILL.replace("22", "20") + SERVO,
}
"""What a robot was before a kill pin came to it, normally open, with only its pull-up to hold it."""


@pytest.mark.parametrize("rate", PERIODS_US)
@pytest.mark.parametrize("brings", BRINGS)
def test_exchange_that_brings_a_kill_pin_does_not_kill(mcu_of, brings, rate):
    mcu = mcu_of("usb")
    old, new = (tables_of(TWO, f"rate = {rate}\n{robot}") for robot in (BRINGS[brings], KILL + SERVO))
    session = open_session(VirtualCarrier(mcu))
    for number in range(4):
        mcu.set_pin(KILL_PIN, None)
        begin(session, old)
        drive(session, 60_000 + 1370 * number)
        session.exchange(new, old.puppet)
        play(session, 100_000)
        assert (session.status()["armed"], session.status()["attached"]) == (1, 1), number
        mcu.set_pin(KILL_PIN, 0)
        pressed_us = mcu.now_us
        mcu.clear_edges()
        play(session, 60_000)
        assert last_fall_us(mcu, [FREE_PIN], pressed_us) - pressed_us <= PERIODS_US[rate] + HANDLED_US
        assert session.status()["killed_by"] == formats.KILLED_BY_PIN


# ---- kills from the host


KILLS = 12
KILL_BYTES = 10
"""A zero, and the packet with its own."""
CHARACTER_US = 10 / 115_200 * 1e6


def pet_at_333_hz():
    """The pet at 333 Hz, where pulses come so close that a last edge tells when they were taken away."""
    pet = pet_tables()
    return build_tables(pet.puppet, dataclasses.replace(pet.robot, rate_hz=333, attach_interval_s=0))


class Show:
    """The pet, armed, with all telemetry there is, on one of the two lines."""

    def __init__(self, mcu):
        self.mcu = mcu
        self.tables = pet_at_333_hz()
        self.pins = [output.drive.pin for output in self.tables.robot.outputs.values()]
        mcu.set_pin(KILL_PIN, 1)
        self.session = open_session(VirtualCarrier(mcu))
        begin(self.session, self.tables, ALL_TAPS | formats.TAP_DERIVATIVES, 5)

    def upload(self):
        """An upload while the puppet stands, its outputs having pulses until the commit."""
        self.session.stop()
        self.session.flush()
        post(self.session, self.tables.messages())

    def exchange(self):
        """An exchange while it plays, and what asks whether it has been carried out."""
        parts, commit = exchange_parts(self.tables, self.tables)
        post(self.session, [*parts, commit, parts[0]])

    def commit(self):
        """The end of an exchange: other tables are prepared and put into force, and nothing is on the way."""
        parts, commit = exchange_parts(self.tables, self.tables)
        post(self.session, parts)
        self.session.flush(5.0)
        post(self.session, [commit])

    def targets(self):
        """More weight targets than the line can take, of all actions and channels."""
        puppet = self.tables.puppet
        for number in range(12):
            level = formats.WEIGHT_ONE - number
            for name, index, count in (
                ("weight_targets", "action", len(puppet.actions)),
                ("live_targets", "live", len(puppet.lives)),
            ):
                items = [{index: place, "target_q28": level} for place in range(count)]
                for start in range(
                    0, count, 15
                ):  # each by itself: a session would leave out what a later one supersedes
                    part = (name, {"frame": formats.FRAME_NOW}, items[start : start + 15])
                    post(self.session, [part])

    def lost(self):
        """A packet that was lost, and others behind it, which the MCU refuses."""
        write, self.session.carrier.write = self.session.carrier.write, lambda _: None
        self.session.link.post("ping")
        self.session.carrier.write = write
        self.targets()

    def kill_after(self, wait_us):
        """Kill in the midst of it; return after what time the last pulse ended."""
        play(self.session, wait_us, PUMP_US)
        self.mcu.clear_edges()
        called_us = self.mcu.now_us
        self.session.kill()
        play(self.session, 60_000, PUMP_US)
        took_us = last_fall_us(self.mcu, self.pins, called_us) - called_us
        self.mcu.clear_edges()
        self.session.flush(5.0)
        play(self.session, 100_000)
        assert all(self.mcu.edges(pin) == [] for pin in self.pins)
        assert self.session.status()["armed"] == 0
        return took_us

    def again(self):
        if self.session.status()["frame"] < 0:
            self.session.start()
        self.session.arm()
        self.session.wait_attached()


LASTS_US = {"upload": 500_000, "exchange": 600_000, "commit": 150_000, "targets": 150_000, "lost": 60_000}
"""How long each keeps the line busy, more or less."""


@pytest.mark.parametrize("doing", LASTS_US)
@pytest.mark.parametrize("line", ["usb", "uart"])
def test_kill_from_the_host_acts_within_20_ms_and_a_tick(mcu_of, line, doing):
    rng = random.Random(f"{line} {doing}")
    show = Show(mcu_of(line))
    took_us = []
    for number in range(KILLS):
        show.again()
        getattr(show, doing)()
        took_us.append(show.kill_after(round((number + rng.random()) / KILLS * LASTS_US[doing])))
    late_us = show.session.status()["tick_late_max_us"]
    print(
        f"{line}, {doing}: call of kill to the last edge {max(took_us) / 1000:.1f} ms at most; ticks {late_us} us late"
    )
    # Its own bytes have to get there; then it has as long as on USB.
    line_us = 0 if line == "usb" else KILL_BYTES * CHARACTER_US
    assert max(took_us) <= KILL_US + PERIODS_US[333] + line_us


# ---- a host that does not read


NOT_READ_US = (400_000, 1_000_000)


@pytest.mark.parametrize("not_read_us", NOT_READ_US)
def test_ticks_go_on_while_the_host_does_not_read(mcu_of, not_read_us):
    mcu = mcu_of("usb")
    mcu.set_pin(KILL_PIN, 1)
    session = open_session(VirtualCarrier(mcu))
    begin(session, tables_of(TWO, "rate = 333\n" + KILL + SERVO), ALL_TAPS | formats.TAP_DERIVATIVES, 1)
    drive(session, 500_000)
    session.flush()
    mcu.set_host_reading(False)
    mcu.clear_edges()
    mcu.run_for(not_read_us)
    starts = [t_us for t_us, _ in widths_us(mcu, FREE_PIN)]
    assert len(starts) >= not_read_us // PERIODS_US[333] - 2
    assert all(b - a == pytest.approx(PERIODS_US[333], abs=0.01) for a, b in itertools.pairwise(starts))
    mcu.set_host_reading(True)
    play(session, 60_000, PUMP_US)
    mcu.clear_edges()
    called_us = mcu.now_us
    session.kill()
    play(session, 100_000, PUMP_US)
    took_us = last_fall_us(mcu, [FREE_PIN], called_us) - called_us
    print(f"not read for {not_read_us / 1000:.0f} ms, then read: kill to the last edge {took_us / 1000:.1f} ms")
    assert took_us <= KILL_US + PERIODS_US[333]
    assert session.status()["armed"] == 0


@pytest.mark.parametrize("not_read_us", NOT_READ_US)
def test_kills_act_while_the_host_does_not_read(mcu_of, not_read_us):
    """As ever, since the main loop drops what it cannot send."""
    mcu = mcu_of("usb")
    mcu.set_pin(KILL_PIN, 1)
    session = open_session(VirtualCarrier(mcu))
    begin(session, tables_of(TWO, "rate = 333\n" + KILL + SERVO), ALL_TAPS | formats.TAP_DERIVATIVES, 1)
    took_us = {}
    for killer in ("pin", "host"):
        drive(session, 500_000)
        session.flush()
        mcu.set_host_reading(False)
        mcu.run_for(not_read_us)
        mcu.clear_edges()
        called_us = mcu.now_us
        if killer == "pin":
            mcu.set_pin(KILL_PIN, 0)
        else:
            session.kill()
        mcu.run_for(200_000)
        took_us[killer] = last_fall_us(mcu, [FREE_PIN], called_us) - called_us
        mcu.set_host_reading(True)
        mcu.set_pin(KILL_PIN, 1)
        play(session, 1_000_000, PUMP_US)
        assert session.status()["armed"] == 0
    print(
        f"not read for {not_read_us / 1000:.0f} ms: kill to the last edge "
        + ", ".join(f"{k} {v / 1000:.1f} ms" for k, v in took_us.items())
    )
    assert took_us["pin"] <= PERIODS_US[333] + HANDLED_US
    assert took_us["host"] <= KILL_US + PERIODS_US[333]


# ---- exchanges on a slow line


DOFS = [f"D{number}" for number in range(16)]
EXCHANGES = 4
CAUGHT_UP_US = 3_000
"""By so much a tick may come late: what it may wait for is shorter than what a UART can hold until the next looks after it."""


def test_exchanges_of_16_dofs_at_333_hz_over_a_uart_lose_nothing(mcu_of):
    mcu = mcu_of("uart")
    robot = "rate = 333\nattach_interval = 0\n" + "".join(
        f"[output.{name}]\npin = {2 + n}\n" for n, name in enumerate(DOFS)
    )
    tables = [
        tables_of(
            puppet_text(names, frame_rate=30).replace("]\n[", "]\ncharacter = { f = 2.0, zeta = 0.5 }\n[", 16), robot
        )
        for names in (DOFS, DOFS[1:] + DOFS[:1])
    ]
    session = open_session(VirtualCarrier(mcu))
    begin(session, tables[0])
    drive(session)
    repeated = session.link.counters.repeated
    for number in range(EXCHANGES):
        playing, new = tables[number % 2], tables[(number + 1) % 2]
        parts, commit = exchange_parts(new, playing)
        post(session, parts)
        session.flush(5.0)
        post(session, [commit])
        for level in range(40):
            session.weight_targets(formats.FRAME_NOW, {0: formats.WEIGHT_ONE - level}, lambda *_: None)
            session.weight_targets(formats.FRAME_NOW, {0: formats.WEIGHT_MAX}, lambda *_: None)
            play(session, 10_000)
        session._tables = new
    status = session.status()
    lost = mcu.report()["uart_lost"]
    print(
        f"{EXCHANGES} exchanges: {lost} characters lost, {status['damaged']} packets damaged, ticks at most "
        f"{status['tick_late_max_us']} us late and {status['tick_max_us']} us long, {status['late_frames']} frames late"
    )
    assert (lost, status["damaged"], session.link.counters.repeated) == (0, 0, repeated)
    assert status["tick_late_max_us"] < PERIODS_US[333] + CAUGHT_UP_US
    assert status["attached"] == 0xFFFF
