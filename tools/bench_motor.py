"""What the motor layer costs, and how punctual it is while the main loop is as busy as a host can make it.

A board of its own notes the chip's timer at the beginning and at the end of every motor tick, in the interrupt. Meanwhile the
puppet plays, sends all telemetry in every frame, and is sent weight targets as fast as they are acknowledged.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from bench_stage import ACTIONS, Stage, start_firmware

from marotte.link import VirtualCarrier
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.session import Session
from shared import formats

TICKS = 1000
ALL_TAPS = formats.TAP_BASE | formats.TAP_SIGNAL | formats.TAP_MOTOR | formats.TAP_DERIVATIVES
PUMP_US = 5_000
WAITING = 8
"""Commands that are always waiting for their acknowledgement."""

FAST_US = 3008
KINDS = (
    ("50 Hz", Stage(ACTIONS)),
    ("50 Hz, with characters", Stage(ACTIONS, has_characters=True)),
    ("332 Hz", Stage(ACTIONS, motor_period_us=FAST_US)),
    ("332 Hz, with characters", Stage(ACTIONS, motor_period_us=FAST_US, has_characters=True)),
)

PROGRAM = """
import array, time
from firmware.board_rp2040 import Board
from firmware.main import perform

class TimedBoard(Board):
    def __init__(self):
        Board.__init__(self)
        self.is_on = False
        self.count = 0
        self.late_us = array.array("H", bytes(2 * {ticks}))
        self.took_us = array.array("H", bytes(2 * {ticks}))
        self.timed = self.time_tick
    def start_ticks(self, period_us, handler):
        self.inner = handler
        self.is_on = period_us == {period_us} and self.count == 0
        Board.start_ticks(self, period_us, self.timed)
    def servo_attach(self, pin, period_us, until_us):
        self.count = 0
        Board.servo_attach(self, pin, period_us, until_us)
    def time_tick(self):
        begun_us = time.ticks_us()
        nominal_us = self.tick_due_us() - self._period_us
        self.inner()
        n = self.count
        if n < {ticks}:
            self.took_us[n] = time.ticks_diff(time.ticks_us(), begun_us)
            self.late_us[n] = time.ticks_diff(begun_us, nominal_us)
            self.count = n + 1

board = TimedBoard()
perform(board)
print(list(board.late_us))
print(list(board.took_us))
"""


@dataclass
class Ticks:
    """How late the ticks of a performance began and how long they took, in microseconds, and the firmware's counters."""

    name: str
    late_us: list[int] = field(default_factory=list)
    took_us: list[int] = field(default_factory=list)
    status: dict[str, int] = field(default_factory=dict)


def measure_ticks(image: str) -> list[Ticks]:
    """Measure each of `KINDS` in a performance of its own."""
    return [_measure(image, name, stage) for name, stage in KINDS]


def percentile(values: list[int], share: float) -> int:
    """Return the value that `share` of the values do not exceed."""
    return sorted(values)[min(len(values) - 1, round(share * len(values)))]


def _measure(image: str, name: str, stage: Stage) -> Ticks:
    with Rp2040Mcu(image, timed_flash=False) as mcu:
        repl = RawRepl(mcu)
        start_firmware(repl, PROGRAM.format(ticks=TICKS, period_us=stage.motor_period_us))
        session = Session(VirtualCarrier(mcu))
        session.open()
        session.upload(stage)  # type: ignore[arg-type]
        session.telemetry(ALL_TAPS, 1, 1)
        session.start()
        session.arm()
        end_us = mcu.now_us + TICKS * stage.motor_period_us + 500_000
        turn = 0
        while mcu.now_us < end_us:
            while session.link.pending < WAITING:
                turn += 1
                targets = {n: formats.WEIGHT_ONE - 1000 * n if n % 5 == turn % 5 else 0 for n in range(ACTIONS)}
                session.weight_targets(formats.FRAME_NOW, targets, _shrug)
            session.pump(PUMP_US)
        status = session.status()
        session.stop()
        session.flush()
        mcu.send(b"\r\x03")
        late, took = repl.finish().strip().splitlines()[-2:]
    numbers = [[int(word) for word in line.strip("[]").split(",")] for line in (late, took)]
    return Ticks(name, *numbers, status)


def _shrug(_status: int, _detail: int) -> None:
    """A full queue is what this is about."""
