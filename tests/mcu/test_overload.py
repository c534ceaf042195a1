"""More than there is time for, on the RP2040: the largest puppet, 60 frames a second, all telemetry, a line full of commands.

The frame clock holds as long as frames leave time, what is too much is refused and counted, and kills act in their time. A host
that does not read, or a line that is too slow for what is asked for, delays no frame.
"""

import random

import pytest

from marotte.link import VirtualCarrier, wire_packet
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.session import Session
from shared import formats, messages
from tests.link.safety import KILL_PIN, KILL_US, PUMP_US, last_fall_us, play, tables_of
from tests.link.stage import ALL_TAPS, open_session

pytestmark = pytest.mark.images

FRAME_RATE = 60
PERIODS_US = {50: 20_000, 333: 3_008}
HANDLED_US = 500
"""What the RP2040 takes at most from a tick's instant to driving pins low."""

DOFS, ACTIONS, EACH = formats.DOFS_MAX, formats.ACTIONS_MAX, formats.MAPPINGS_MAX // formats.ACTIONS_MAX
PINS = list(range(2, 2 + DOFS))
FUNCTIONS = ("rsin", "noise1", "noise7", "rcos")
EVERYTHING = ALL_TAPS | formats.TAP_DERIVATIVES
SMOOTH_US = 10_000
"""By so much a frame may begin late under a full line."""
LATE_FRAMES = 50
"""One of so many may come too late for its tick at 333 Hz, where ticks take half of the time and come ten times as often."""

LOADS = [
    ("usb", 6, 50, False),
    ("uart", 6, 50, False),
    ("usb", 16, 50, False),
    ("usb", ACTIONS, 50, False),
    ("uart", ACTIONS, 50, False),
    ("usb", 16, 333, False),
    ("usb", 16, 50, True),
    ("usb", ACTIONS, 50, True),
]
"""Line, how many actions play, rate of the motor layer, whether all DOFs go through signal processing."""


def largest(rate, signal):
    """Return the tables of a puppet that has as much of everything as there may be, each DOF with a servo."""
    names = [f"D{dof}" for dof in range(DOFS)]
    lines = [f"frame_rate = {FRAME_RATE}", *(f"[dof.{name}]\nsignal = {str(signal).lower()}" for name in names)]
    for action in range(ACTIONS):
        places = [(action, place, names[(5 * action + 2 * place + place // 8) % DOFS]) for place in range(EACH)]
        entries = [f'["{dof}", 0.1, 0.9, "{FUNCTIONS[(a + place) % 4]}"]' for a, place, dof in places]
        lines += [f"[action.A{action}]", f"tempo = {0.3 + action / 50}", f"map = [{', '.join(entries)}]"]
    robot = [f"rate = {rate}", "attach_interval = 0", "[kill]", f"pin = {KILL_PIN}", 'switch = "open"']
    robot += [f"[output.{name}]\npin = {pin}" for name, pin in zip(names, PINS, strict=True)]
    return tables_of("\n".join(lines), "\n".join(robot))


class Overload:
    """The largest puppet, armed, with `active` actions that play, and a host that always has something to say."""

    def __init__(self, mcu, active, rate, signal=False):
        self.mcu = mcu
        self.refused = 0
        self.commands = 0
        self._active = active
        mcu.set_pin(KILL_PIN, 1)
        self.session: Session = open_session(VirtualCarrier(mcu))
        self.session.upload(largest(rate, signal))
        self.session.telemetry(EVERYTHING, 1, 1)
        for first in range(0, active, 8):
            self.session.weight_targets(0, dict.fromkeys(range(first, min(first + 8, active)), formats.WEIGHT_ONE))
        self.arm()
        self.session.start()
        self.session.flush()
        play(self.session, 500_000)

    def arm(self):
        self.session.arm()
        self.session.wait_attached()

    def go_on(self, for_us):
        """Let time pass, the line full of commands: targets for now, and for so late that they fill the queue."""
        end_us = self.mcu.now_us + for_us
        while self.mcu.now_us < end_us:
            while self.session.link.pending < 6:
                self._command()
            self.session.pump(PUMP_US)

    def _command(self):
        self.commands += 1
        if self.commands % 8 == 0:
            self.session.link.post("status_request")
            return
        stamp = formats.FRAME_NOW if self.commands % 2 else 1_000_000
        targets = dict.fromkeys(range(min(self._active, 15)), formats.WEIGHT_ONE - self.commands)

        def note(status, _):
            assert status == messages.FULL
            self.refused += min(self._active, 15)

        self.session.weight_targets(stamp, targets, note)

    def kill(self, killer):
        """Kill in the midst of it, by "pin" or "host"; return after what time the last pulse ended."""
        self.mcu.clear_edges()
        called_us = self.mcu.now_us
        if killer == "pin":
            self.mcu.set_pin(KILL_PIN, 0)
        else:
            self.session.kill()
        self.go_on(100_000)
        took_us = last_fall_us(self.mcu, PINS, called_us) - called_us
        self.mcu.clear_edges()
        self.mcu.set_pin(KILL_PIN, 1)
        self.go_on(60_000)
        assert all(self.mcu.edges(pin) == [] for pin in PINS)
        self.session.flush(5.0)
        return took_us


def overload(mcu, active, rate, signal, for_us, kills):
    """Hold all that is demanded for so long, then kill so many times either way; print the figures."""
    rng = random.Random(f"{active} {rate}")
    load = Overload(mcu, active, rate, signal)
    before, begun_us = load.session.status(), mcu.now_us
    load.go_on(for_us)
    load.session.flush(5.0)
    after, lasted_us = load.session.status(), mcu.now_us - begun_us
    late = after["late_frames"] - before["late_frames"]
    frames = after["frame"] - before["frame"]
    took_us = {"host": [], "pin": []}
    for _ in range(kills):
        for killer, taken_us in took_us.items():
            load.go_on(rng.randrange(100_000))
            taken_us.append(load.kill(killer))
            load.arm()
    print(
        f"{mcu.link}, {active} of {ACTIONS} actions, {rate} Hz, signal {signal}: {load.commands} commands; frames: {frames}, "
        f"{late} late, begun {after['late_max_us']} us late at most, up to {after['frame_max_us']} us long; "
        f"{load.refused} targets refused; kill to the last edge: host {max(took_us['host']) / 1000:.1f} ms, "
        f"pin {max(took_us['pin']) / 1000:.1f} ms at most"
    )
    assert abs(frames - lasted_us * FRAME_RATE / 1e6) <= 2, "the frame clock keeps to its instants"
    assert after["late_max_us"] <= SMOOTH_US
    assert late <= (frames // LATE_FRAMES if rate == 333 else 0)
    assert after["damaged"] == before["damaged"]
    assert load.refused > 0
    assert load.session.status()["refused_targets"] == load.refused
    assert max(took_us["host"]) <= KILL_US + PERIODS_US[rate]
    assert max(took_us["pin"]) <= PERIODS_US[rate] + HANDLED_US


@pytest.mark.parametrize("line, active, rate, signal", LOADS)
def test_frame_clock_holds_and_kills_act_under_overload(rp2040_image_path, line, active, rate, signal):
    with Rp2040Mcu(rp2040_image_path, line, timed_flash=False) as mcu:
        overload(mcu, active, rate, signal, 1_000_000, 3)


@pytest.mark.soak
@pytest.mark.parametrize("line, active, rate, signal", LOADS)
def test_frame_clock_holds_and_kills_act_under_overload_for_a_minute(rp2040_image_path, line, active, rate, signal):
    with Rp2040Mcu(rp2040_image_path, line, timed_flash=False) as mcu:
        overload(mcu, active, rate, signal, 60_000_000, 60)


NOT_READ_US = 1_500_000


@pytest.mark.parametrize("line", ["usb", "uart"])
def test_host_that_does_not_read_delays_no_frame(rp2040_image_path, line):
    """It goes on talking, and the MCU answering. A UART sends whether anybody reads or not, but not all that is asked for."""
    with Rp2040Mcu(rp2040_image_path, line, timed_flash=False) as mcu:
        load = Overload(mcu, 8, 50)
        session = load.session
        before = session.status()
        repeated = wire_packet(messages.STATUS_REQUEST, (session.link._seq - 1) & 255, b"")
        mcu.set_host_reading(False)
        for _ in range(NOT_READ_US // 20_000):
            mcu.send(repeated)  # is answered again each time
            mcu.run_for(20_000)
        mcu.receive()
        mcu.set_host_reading(True)
        session.taps.clear()
        play(session, 200_000, PUMP_US)
        after = session.status()
        frames = [frame for frame, _, _ in session.taps]
        print(
            f"{line}: not read for {NOT_READ_US / 1e6:g} s: {after['late_frames'] - before['late_frames']} frames late, "
            f"begun {after['late_max_us']} us late at most; {len(frames)} frames told in 0.2 s behind it"
        )
        assert after["late_frames"] == before["late_frames"]
        assert after["late_max_us"] <= SMOOTH_US
        assert after["frame"] - before["frame"] >= NOT_READ_US * FRAME_RATE // 1_000_000
        assert frames == sorted(frames) and len(frames) >= 5
        assert session.link.counters.damaged <= 1, "one that was not read to its end"
