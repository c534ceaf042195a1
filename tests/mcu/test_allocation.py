"""Nothing allocates while a puppet plays: the heap of an RP2040 with the real image is locked, and the host goes on talking.

A small program on the raw REPL performs with a board of its own, which locks the heap at the first frame that it drives
and unlocks it after so many. Whatever asks for memory in between raises MemoryError there.
"""

import random

import pytest

from marotte.link import LinkSilent, VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from shared import formats
from tests.link.stage import ALL_TAPS, Parts, open_session, pet_tables
from tests.link.test_damaged import Noise

FRAMES = 10_000
FRAME_RATE_HZ = 60
STEP_US = 25_000
RECONNECT_STEPS = 2500
LATE_MAX_US = 5_000
"""How long the link may keep a frame waiting: 32 bytes at up to 50 us, and the answers to the packets that end among
them. A frame counts as late after half a frame, 8.3 ms.
"""

PROGRAM = """
import micropython
from firmware.board_rp2040 import Board
from firmware.main import perform

micropython.alloc_emergency_exception_buf(500)

class LockedBoard(Board):
    def __init__(self):
        Board.__init__(self)
        self.frames = 0
        self.locked = False

    def pulses(self, count, pin, pulse_q4us):
        if self.frames == 0:
            micropython.heap_lock()
            self.locked = True
        self.frames += 1
        {extra}
        Board.pulses(self, count, pin, pulse_q4us)
        if self.frames == {frames}:
            micropython.heap_unlock()
            self.locked = False

board = LockedBoard()
try:
    perform(board)
finally:
    if board.locked:
        micropython.heap_unlock()
print(board.frames, board.locked)
"""


class TailCarrier(VirtualCarrier):
    """Remembers the last bytes that the MCU has sent: should it fail, its traceback."""

    tail = b""

    def read(self, wait_us):
        data = super().read(wait_us)
        self.tail = (self.tail + data)[-20000:]
        return data


def fast_pet():
    """The pet's tables, at the highest frame rate."""
    parts = list(pet_tables().messages())
    assert parts[0][0] == "begin"
    parts[0][1]["frame_rate_hz"] = FRAME_RATE_HZ
    return Parts(parts)


def converse(mcu, session, frames):
    """Let the pet play for so many frames; send it everything that a host may send during a performance, and damaged packets."""
    rng = random.Random(1)
    noise = Noise(rng, 0)
    puppet = pet_tables().puppet
    for step in range(frames * 1_000_000 // FRAME_RATE_HZ // STEP_US + 8):
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
        if step % 40 == 9:
            assert session.status()["late_max_us"] < LATE_MAX_US
        if step % 200 == 10:
            session.telemetry(ALL_TAPS, 1, 1)
            session.kill()
            session.arm()
        if step % RECONNECT_STEPS == 1000:
            session.welcome = {}
            session.open()
            session.telemetry(ALL_TAPS, 1, 1)
        session.pump(STEP_US)


def perform_locked(mcu, frames, extra="pass"):
    """Perform with the heap locked over so many frames; return what the program printed, and the session.

    Fails the test with the program's traceback.
    """
    repl = RawRepl(mcu)
    repl.start(PROGRAM.format(frames=frames, extra=extra))
    carrier = TailCarrier(mcu)
    session = open_session(carrier)
    session.upload(fast_pet())
    session.telemetry(ALL_TAPS, 1, 1)
    session.flush()
    try:
        session.arm()
        session.start()
        converse(mcu, session, frames)
        session.stop()
        session.flush()
    except LinkSilent:
        pytest.fail(
            "the firmware has ended: " + carrier.tail[carrier.tail.find(b"Traceback") :].decode(errors="replace")
        )
    mcu.send(b"\r\x03")
    return repl.finish(), session


@pytest.mark.images
def test_nothing_allocates_over_ten_thousand_frames_with_traffic(pico):
    told, session = perform_locked(pico, FRAMES)
    frames, locked = told.split()
    assert int(frames) > FRAMES and locked == "False"
    taps = [frame for frame, _, _ in session.taps]
    assert taps[-1] >= FRAMES
    assert taps == sorted(set(taps))
    assert len(taps) > taps[-1] * 0.99, "only a host that comes back misses some"


@pytest.mark.images
@pytest.mark.parametrize("extra", ["[count]", "count / 2"])
def test_locked_heap_finds_what_a_frame_allocates(pico, extra):
    with pytest.raises(pytest.fail.Exception, match=r"(?s)in pulses.*MemoryError"):
        perform_locked(pico, 20, extra)
