"""Nothing allocates while a puppet plays: the heap of an RP2040 with the real image is locked, and the host goes on talking.

A small program on the raw REPL performs with the heap locked from the first frame that reaches the motor layer until so many
have. Whatever asks for memory in between raises MemoryError there: in the main loop that ends the firmware, in the motor tick it
ends the ticks, as an exception in a timer's handler does.
"""

import dataclasses
import random

import pytest

import marotte
from marotte.emulated import connected
from marotte.limits import Limits
from marotte.link import LinkSilent, VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from shared import formats
from tests.link.stage import ALL_TAPS, PUPPETS, Parts, open_session
from tests.link.test_damaged import Noise

FRAMES, QUICK_FRAMES, CHIP_FRAMES = 10_000, 1500, 2000
FRAME_RATE_HZ = 60
QUICK_TICKS_HZ, QUICK_FRAME_RATE_HZ = 333, 40
STEP_US = 25_000
RECONNECT_STEPS = 2500
LATE_MAX_US = 7_000
"""How long link and motor layer may keep a frame waiting: 32 bytes at up to 50 us, the answers to the packets that end among
them, an output that is attached, and some ticks.
"""

PROGRAM = """
import micropython
from firmware.board_rp2040 import Board
from firmware.main import perform
from firmware.motor import Motor

micropython.alloc_emergency_exception_buf(500)

class WatchedBoard(Board):
    def servo_write(self, count, pin, due, pulse_q18us):
        {in_tick}
        Board.servo_write(self, count, pin, due, pulse_q18us)

class Lock:
    frames = 0
    locked = False

def put(motor, frame, signal_q15):
    if Lock.frames == 0:
        micropython.heap_lock()
        Lock.locked = True
    Lock.frames += 1
    if Lock.locked:
        {in_frame}
    original(motor, frame, signal_q15)
    if Lock.frames == {frames}:
        micropython.heap_unlock()
        Lock.locked = False

original = Motor.put
Motor.put = put
try:
    perform(WatchedBoard())
finally:
    if Lock.locked:
        micropython.heap_unlock()
    Motor.put = original
print(Lock.frames, Lock.locked)
"""


class TailCarrier(VirtualCarrier):
    """Remembers the last bytes that the MCU has sent: should it fail, its traceback."""

    tail = b""

    def read(self, wait_us):
        data = super().read(wait_us)
        self.tail = (self.tail + data)[-20000:]
        return data

    def fail(self, what):
        """Fail the test with the traceback that has come."""
        pytest.fail(f"{what}: " + self.tail[max(0, self.tail.find(b"Traceback")) :].decode(errors="replace"))


class FastTables(Parts):
    """A puppet's tables, at another frame rate."""

    def __init__(self, tables, frame_rate_hz):
        super().__init__(tables.messages())
        assert self._parts[0][0] == "begin"
        self._parts[0][1]["frame_rate_hz"] = self.frame_rate_hz = frame_rate_hz
        self.puppet, self.robot, self.outputs_mask = tables.puppet, tables.robot, tables.outputs_mask
        self.tick_s, self.limits = tables.tick_s, tables.limits


def pet_and_robot(mcu, robot_name="pet-robot", rate_hz=50.0, frame_rate_hz=FRAME_RATE_HZ):
    """Return the tables of the pet and one of its robots, connected to an MCU; its servos get a value so often."""
    puppet = marotte.load_puppet(PUPPETS / "pet.toml")
    assert any(dof.character for dof in puppet.dofs.values())
    robot = connected(mcu, marotte.load_robot(PUPPETS / f"{robot_name}.toml", puppet))
    if not robot.chips:
        robot = dataclasses.replace(robot, rate_hz=rate_hz)
    return FastTables(marotte.build_tables(puppet, robot), frame_rate_hz)


def converse(mcu, session, tables, frames):
    """Let the pet play for so many frames; send it everything that a host may send during a performance, and damaged packets."""
    rng = random.Random(1)
    noise = Noise(rng, 0)
    puppet, robot = tables.puppet, tables.robot
    known = session.status(), session.carrier.now_us()
    for step in range(frames * 1_000_000 // tables.frame_rate_hz // STEP_US + 8):
        if step % 2 == 0:
            noise.seq = session.link._seq
            mcu.send(noise.next())
        if step % 4 == 1:
            action = rng.randrange(len(puppet.actions))
            session.weight_targets(formats.FRAME_NOW, {action: rng.choice((0, formats.WEIGHT_ONE))})
        if step % 8 == 2:
            live = rng.randrange(len(puppet.lives))
            session.live_targets(formats.FRAME_NOW, {live: rng.randrange(formats.WEIGHT_ONE)})
        if step % 8 == 4:
            targets = {action: rng.randrange(formats.WEIGHT_MAX) for action in range(len(puppet.actions))}
            session.weight_targets(session.weights[0] + 10, targets)
        if step % 40 == 8:
            tempo_q16 = rng.randrange(formats.TEMPO_ONE // 2, 2 * formats.TEMPO_ONE)
            session.tempo(formats.FRAME_NOW, rng.choice((0, 1, 2, formats.MASTER)), tempo_q16)
        if step % 40 == 12:
            gains4_q16 = {band: rng.randrange(formats.GAIN4_MAX + 1) for band in range(formats.BANDS)}
            session.gains(formats.FRAME_NOW, gains4_q16)
        if step % 20 == 5:
            output = rng.choice(list(robot.outputs.values()))
            ends_us = tuple(rng.uniform(1000, 2000) for _ in range(2))
            session.calibrate(dataclasses.replace(output, pulse_us=ends_us, trim_us=0))
        if step % 20 == 15:
            dof = rng.choice(list(puppet.dofs.values()))
            session.limit(dof.name, Limits(range=dof.limits, accel=rng.uniform(5, 200)))
        if step % 40 == 9:
            known = check_ticks(session, known)
        if step % 200 == 10:
            session.telemetry(ALL_TAPS | formats.TAP_DERIVATIVES, 1, 1)
            session.kill()
            session.arm()
        if step % RECONNECT_STEPS == 1000:
            session.welcome = {}
            session.open()
            session.telemetry(ALL_TAPS | formats.TAP_DERIVATIVES, 1, 1)
        session.pump(STEP_US)


def check_ticks(session, known):
    """Check that ticks have come since the status and the instant that are known, and frames in time; return those of now."""
    status, now_us = session.status(), session.carrier.now_us()
    before, then_us = known
    ticks = status["ticks"] - before["ticks"]
    expected = (now_us - then_us) / session._tables.robot.motor_period_us
    if status["killed_by"] == formats.KILLED_BY_STOPPED_TICKS or abs(ticks - expected) > 0.1 * expected + 2:
        session.carrier.fail(f"{ticks} ticks have come, expected {expected:.0f}")
    assert (status["bus_errors"], status["bus_gone"], status["resets"]) == (0, 0, 0)
    assert (status["late_frames"], status["late_targets"]) == (0, 0)
    assert status["late_max_us"] < LATE_MAX_US
    return status, now_us


def perform_locked(mcu, tables, frames, in_frame="pass", in_tick="pass"):
    """Perform with the heap locked over so many frames; return what the program printed, the session, and its last status.

    Fails the test with the program's traceback.
    """
    repl = RawRepl(mcu)
    repl.start(PROGRAM.format(frames=frames, in_frame=in_frame, in_tick=in_tick))
    carrier = TailCarrier(mcu)
    session = open_session(carrier)
    session.upload(tables)
    session.telemetry(ALL_TAPS | formats.TAP_DERIVATIVES, 1, 1)
    session.flush()
    try:
        session.arm()
        session.start()
        converse(mcu, session, tables, frames)
        status = session.status()
        session.stop()
        session.flush()
    except LinkSilent:
        carrier.fail("the firmware has ended")
    mcu.send(b"\r\x03")
    return repl.finish(), session, status


def assert_nothing_allocates(mcu, tables, frames):
    told, session, status = perform_locked(mcu, tables, frames)
    found, locked = told.split()
    assert int(found) > frames and locked == "False"
    taps = [frame for frame, _, _ in session.taps]
    assert taps[-1] >= frames
    assert taps == sorted(set(taps))
    assert len(taps) > taps[-1] * 0.99, "only a host that comes back misses some"
    assert status["attached"] == tables.outputs_mask
    print(status)


@pytest.mark.images
def test_nothing_allocates_over_ten_thousand_frames_with_traffic(pico):
    assert_nothing_allocates(pico, pet_and_robot(pico), FRAMES)


@pytest.mark.images
def test_nothing_allocates_with_quick_ticks(pico):
    assert_nothing_allocates(
        pico, pet_and_robot(pico, rate_hz=QUICK_TICKS_HZ, frame_rate_hz=QUICK_FRAME_RATE_HZ), QUICK_FRAMES
    )


@pytest.mark.images
def test_nothing_allocates_with_chips_and_bridges(pico):
    assert_nothing_allocates(pico, pet_and_robot(pico, "pet-robot-pca9685"), CHIP_FRAMES)


@pytest.mark.images
@pytest.mark.parametrize("extra", ["[frame]", "frame / 2"])
def test_locked_heap_finds_what_a_frame_allocates(pico, extra):
    with pytest.raises(pytest.fail.Exception, match=r"(?s)in put.*MemoryError"):
        perform_locked(pico, pet_and_robot(pico), 20, in_frame=extra)


@pytest.mark.images
@pytest.mark.parametrize("extra", ["[count]", "count / 2"])
def test_locked_heap_finds_what_a_tick_allocates(pico, extra):
    with pytest.raises(pytest.fail.Exception, match=r"(?s)in servo_write.*MemoryError"):
        perform_locked(pico, pet_and_robot(pico), 60, in_tick=extra)
