"""Telemetry: what comes how often, when none comes, and that a host which does not take it does not hold the motion up."""

import itertools
import struct
from types import SimpleNamespace

import pytest

from marotte.link import VirtualCarrier, wire_packet
from marotte.mcu.unix import UnixMcu
from shared import formats, messages
from tests.checked import load_checked
from tests.link.stage import ALL_TAPS, FRAME_US, Parts, begin_performance, open_session, pet_tables

DOFS = len(pet_tables().puppet.dofs)
LINK_TIMEOUT_US = 500_000
BLOCKED_US = 1_100_000
"""A write over USB gives up after half a second without progress, and Python tries the rest of it once more."""


@pytest.fixture
def session():
    """A session with the pet playing on the PC."""
    with UnixMcu() as mcu:
        yield begin_performance(mcu)


def frames_of(session, frames):
    """Let so many frames pass; return those that taps tell of."""
    session.flush()
    session.taps.clear()
    end_us = session.carrier.now_us() + frames * FRAME_US
    while session.carrier.now_us() < end_us:
        session.pump(10_000)
    return [frame for frame, _, _ in session.taps]


@pytest.mark.parametrize("every", [1, 2, 3, 7])
def test_telemetry_comes_every_so_many_frames(session, every):
    session.telemetry(formats.TAP_BASE, every, 0)
    frames = frames_of(session, 60)
    assert all(frame % every == 0 for frame in frames)
    assert {b - a for a, b in itertools.pairwise(frames)} == {every}
    assert len(frames) == pytest.approx(60 / every, abs=1)


@pytest.mark.parametrize("taps", range(8))
def test_telemetry_has_the_values_of_its_taps(session, taps):
    session.telemetry(taps, 1, 0)
    frames_of(session, 3)
    assert all(len(values) == DOFS * taps.bit_count() for _, _, values in session.taps)
    assert all(told == taps for _, told, _ in session.taps)
    assert bool(session.taps) == bool(taps)


def told_by(session, name):
    """Collect the messages of a name that the MCU sends from now on."""
    told = []
    forward = session.link._on_message

    def on_message(message):
        if message.name == name:
            told.append(message)
        forward(message)

    session.link._on_message = on_message
    return told


def rated(frame_rate_hz, motor_period_us):
    """The pet with another frame rate and another motor rate."""
    parts = {"begin": {"frame_rate_hz": frame_rate_hz}, "robot": {"motor_period_us": motor_period_us}}
    return Parts((name, fields | parts.get(name, {}), items) for name, fields, items in pet_tables().messages())


@pytest.mark.parametrize("motor_period_us", [3008, 20000])
@pytest.mark.parametrize("frame_rate_hz", [10, 30, 60])
def test_taps_of_every_frame_come_once_soon_and_in_order(frame_rate_hz, motor_period_us):
    """The course at a frame's instant is known one tick and a half later, and told with the frame after that."""
    with UnixMcu() as mcu:
        session = open_session(VirtualCarrier(mcu))
        session.upload(rated(frame_rate_hz, motor_period_us))
        session.telemetry(ALL_TAPS, 1, 0)
        session.start()
        session.flush()
        frame_us = 1_000_000 / frame_rate_hz
        late = []
        for _ in range(400):
            session.pump(5_000)
            if session.taps:
                late.append(session.status()["frame"] - 1 - session.taps[-1][0])
        assert [frame for frame, _, _ in session.taps] == list(range(len(session.taps)))
        assert len(session.taps) > 1.8e6 / frame_us
        assert max(late) <= 1 + 1.5 * motor_period_us / frame_us + 5_000 / frame_us


def test_derivatives_are_the_differences_of_the_targets(session):
    """In a steady motion: `m = d + s / 2` (told doubled, Q16) and `s` (Q15) of the targets u, `d` their first difference."""
    session.telemetry(ALL_TAPS | formats.TAP_DERIVATIVES, 1, 0)
    frames_of(session, 100)
    told = told_by(session, "derivatives")
    frames_of(session, 60)
    u = {frame: values[DOFS : 2 * DOFS] for frame, _, values in session.taps}
    lags, moved = set(), 0
    for message in told[5:-2]:
        found = [(item["slope_q16"], item["bend_q15"]) for item in message.items]
        for lag in range(4):
            n = message.fields["frame"] - lag
            three = list(zip(u[n - 2], u[n - 1], u[n], strict=True))
            expected = [(2 * (c - b) + c - 2 * b + a, c - 2 * b + a) for a, b, c in three]
            if found == expected:
                lags.add(lag)
                moved += any(slope for slope, _ in found)
                break
        else:
            pytest.fail(f"frame {message.fields['frame']}: {found}")
    assert len(told) > 50 and moved > 40
    assert len(lags) == 1 and max(lags) <= 1, "the targets that have taken effect"


def test_derivatives_come_as_often_as_taps_and_do_not_need_them(session):
    told = told_by(session, "derivatives")
    session.telemetry(formats.TAP_DERIVATIVES, 3, 0)
    assert frames_of(session, 30) == []
    frames = [message.fields["frame"] for message in told]
    assert len(frames) == pytest.approx(10, abs=1) and {frame % 3 for frame in frames} == {0}
    assert all(len(message.items) == DOFS for message in told)
    told.clear()
    session.telemetry(ALL_TAPS, 1, 0)
    assert len(frames_of(session, 10)) >= 9 and told == []


def test_status_is_followed_by_that_of_the_motor_layer(session):
    ticks = [session.status()["ticks"]]
    frames_of(session, 60)
    status = session.status()
    ticks.append(status["ticks"])
    assert ticks[1] - ticks[0] == pytest.approx(2_000_000 / 20_000, abs=2)
    assert (status["attached"], status["released"], status["stalled"], status["killed_by"]) == (0, 0, 0, 0)
    assert (status["bus_errors"], status["bus_gone"], status["resets"]) == (0, 0, 0)
    assert (status["late_frames"], status["tick_max_us"], status["tick_late_max_us"]) == (0, 0, 0), "no time passes"
    assert status["store"] == formats.STORE_NONE
    session.arm()
    frames_of(session, 60)
    outputs = sum(name == "output" for name, _, _ in pet_tables().messages())
    assert session.status()["attached"].bit_count() == outputs
    session.kill()
    status = session.status()
    assert (status["armed"], status["attached"], status["killed_by"]) == (0, 0, formats.KILLED_BY_HOST)


def test_telemetry_tells_the_weights_of_what_plays(session):
    session.telemetry(0, 0, 1)
    frames_of(session, 60)
    frame, before = session.weights
    assert frame > 40 and set(before) == {0, 1, 2, 3}
    frames_of(session, 10)
    frame, after = session.weights
    assert frame > 50 and 0 < after[0] < before[0] and before[3] < after[3] <= 4096


def test_telemetry_ends_with_a_new_greeting(session):
    assert frames_of(session, 5)
    session.open()
    assert session.welcome["frame"] > 0
    assert frames_of(session, 10) == []


def test_telemetry_pauses_while_the_link_is_silent(session):
    mcu = session.carrier.mcu
    session.telemetry(formats.TAP_BASE, 1, 0)
    frames_of(session, 3)
    heard_us = mcu.now_us
    mcu.run_for(2 * LINK_TIMEOUT_US)
    sent_us = [t_us for t_us, _ in mcu.receive()]
    assert len(sent_us) > 10
    assert sent_us[-1] <= heard_us + LINK_TIMEOUT_US + FRAME_US
    assert len(frames_of(session, 10)) >= 9


def test_partial_packet_is_dropped_after_a_pause(session):
    mcu = session.carrier.mcu
    before = session.status()
    mcu.send(wire_packet(messages.PING, session.link._seq, b"")[:5])
    session.pump(30_000)
    session.stop()  # not spoilt by what was left behind
    session.flush()
    assert session.link.counters.repeated == 0
    assert session.status()["damaged"] == before["damaged"] + 1


@pytest.mark.images
def test_host_that_does_not_read_holds_the_motion_up_once(rp2040_mcu):
    with rp2040_mcu() as mcu:
        session = begin_performance(mcu)
        session.pump(300_000)
        begun = session.status()
        begun_us = mcu.now_us
        mcu.set_host_reading(False)
        for _ in range(40):
            mcu.send(wire_packet(messages.PING, session.link._seq, b""))  # alive, but deaf
            mcu.run_for(100_000)
        mcu.set_host_reading(True)
        mcu.run_for(100_000)
        mcu.receive()
        session.link._seq = (session.link._seq + 1) & 255
        status = session.status()
        assert status["frame"] - begun["frame"] == pytest.approx((mcu.now_us - begun_us) / FRAME_US, abs=1)
        assert status["late_max_us"] < BLOCKED_US
        assert status["late_frames"] <= BLOCKED_US / FRAME_US


class Told:
    """Telemetry of a puppet of one DOF whose taps are the frames' numbers, as far as the motor layer has come."""

    def __init__(self):
        self.out = bytearray(250)
        self.frames = []
        rings = [[0] * formats.FRAMES_KEPT * formats.DOFS_MAX for _ in range(2)]
        self.motor = SimpleNamespace(silent=False, tapped=[-1], tap_q15=rings[1])
        tables = SimpleNamespace(dofs=1)
        self.puppet = SimpleNamespace(
            frame=0, tables=tables, motor=self.motor, base_ring_q15=rings[0], signal_ring_q15=rings[0]
        )
        board = SimpleNamespace(heap_free=lambda: 0)
        self.telemetry = load_checked("firmware/telemetry.py").Telemetry(board, self.puppet, self)

    def send(self, message_id, length, is_telemetry):
        frame, taps, *values = struct.unpack(f"<iB{(length - 7) // 2}H", self.out[2:length])
        assert (message_id, is_telemetry, taps, values) == (messages.TAPS, True, 7, [frame, frame, frame])
        self.frames.append(frame)

    def step(self, tapped):
        """Compute a frame, the motor layer having passed the instants up to `tapped`; return the frames then told."""
        place = self.puppet.frame % formats.FRAMES_KEPT * formats.DOFS_MAX
        self.puppet.base_ring_q15[place] = self.puppet.frame
        for frame in range(self.motor.tapped[0] + 1, tapped + 1):
            self.motor.tap_q15[frame % formats.FRAMES_KEPT * formats.DOFS_MAX] = frame
        self.motor.tapped[0] = tapped
        self.puppet.frame += 1
        self.frames = []
        self.telemetry.report()
        return self.frames


def test_taps_wait_for_the_motor_layer_and_catch_up_two_at_a_time():
    told = Told()
    told.telemetry.ask(ALL_TAPS, 1, 0)
    told.telemetry.start()
    assert [told.step(tapped) for tapped in (-1, -1, 0, 0, 4, 4, 5)] == [[], [], [0], [], [1, 2], [3, 4], [5]]


def test_taps_that_were_overwritten_are_never_told():
    told = Told()
    told.telemetry.ask(ALL_TAPS, 1, 0)
    told.telemetry.start()
    assert [told.step(-1) for _ in range(20)] == [[]] * 20
    assert told.step(19)[0] == 20 - 14
    late = Told()  # frames that come when the motor layer has gone on without them
    late.telemetry.ask(ALL_TAPS, 1, 0)
    late.telemetry.start()
    found = [frame for _ in range(40) for frame in late.step(30)]
    assert found == list(range(30 - 14, 31))


def test_taps_of_a_silence_are_not_told_after_it():
    told = Told()
    told.telemetry.ask(ALL_TAPS, 1, 0)
    told.telemetry.start()
    assert told.step(0) == [0]
    told.motor.silent = True
    assert [told.step(frame) for frame in range(1, 6)] == [[]] * 5
    told.motor.silent = False
    assert told.step(6) == [6]


def test_taps_begin_anew_with_frame_0():
    told = Told()
    told.telemetry.ask(ALL_TAPS, 1, 0)
    told.telemetry.start()
    assert [told.step(frame) for frame in range(3)] == [[0], [1], [2]]
    told.puppet.frame, told.motor.tapped[0] = 0, -1
    told.telemetry.start()
    assert [told.step(frame) for frame in range(3)] == [[0], [1], [2]]
