"""The firmware under CPython as an emulated MCU, with every integer of kernels and of per-frame code checked."""

from collections import deque

from marotte.mcu.base import VirtualMcu
from tests.checked import load_checked

TICKS_MODULUS = 1 << 30
SMALL_INT_FUNCTIONS = (
    "ticks_diff",
    *(f"FrameClock.{name}" for name in ("start", "until_us", "begin")),
    *(f"Cues.{name}" for name in ("clear", "put", "apply", "renumber")),
    *(
        f"Actions.{name}"
        for name in (
            "compute_phases",
            "follow_tempos",
            "end_gestures",
            "enter",
            "warp",
            "_phases",
            "_nominal",
            "_place",
        )
    ),
    *(f"Blinks.{name}" for name in ("enter", "evaluate", "exchange")),
    "Programs.evaluate",
    *(f"Exchange.{name}" for name in ("carry_over", "_swap")),
    *(f"Motor.{name}" for name in ("load", "move", "stand", "arm", "kill", "_write")),
    *(f"Puppet.{name}" for name in ("start", "stop", "prepare", "step", "_synthesise", "_rest")),
    *(
        f"Link.{name}"
        for name in ("poll", "_packet", "_carry_out", "_queue", "report", "_pack_frame", "_answer", "_send")
    ),
    *(f"Link._on_{name}" for name in ("weight_targets", "live_targets", "tempo", "telemetry", "start", "stop", "ping")),
    "seal",
    "is_sealed",
)
"""What runs while a puppet plays: a larger integer would allocate on a 32-bit port."""


class CheckedMcu(VirtualMcu):
    """Computes in no time and has no pins. Its timer stands `before_wrap_us` before its wrap at power on."""

    kind = "checked"

    def __init__(self, before_wrap_us=2_000_000):
        firmware = load_checked("firmware/main.py", bytecode=SMALL_INT_FUNCTIONS)
        self._board = _Board(TICKS_MODULUS - before_wrap_us)
        self._puppet = firmware.Puppet(self._board)
        self._link = firmware.Link(self._board, self._puppet)

    @property
    def now_us(self):
        return self._board.now_us

    def send(self, data, at_us=None):
        assert at_us is None, "bytes at later instants are not looked after"
        self._board.arriving.extend(data)

    def run_until(self, t_us):
        """Go through `firmware.main.perform`, which would not return before the REPL is called for."""
        board, puppet, link = self._board, self._puppet, self._link
        while True:
            assert not link.poll(), "nothing here calls for the REPL"
            if board.arriving:
                continue
            due_us = t_us
            if puppet.frame >= 0:
                until_us = puppet.clock.until_us(board.ticks_us())
                if until_us <= 0:
                    puppet.step(link.silent)
                    link.report()
                    continue
                if puppet.prepare():
                    continue
                due_us = board.now_us + until_us
            board.now_us = min(due_us, t_us)
            if due_us >= t_us:
                return

    def receive(self):
        sent, self._board.sent = self._board.sent, []
        return sent

    def report(self):
        return {"kind": self.kind, "now_us": self.now_us, "image": "", "image_sha256": ""}

    def close(self):
        """Nothing is open."""

    def edges(self, pin):
        raise NotImplementedError("it has no pins")

    clear_edges = set_pin = edges


class _Board:
    """What the firmware asks of a board."""

    def __init__(self, start_ticks):
        self.now_us = 0
        self.arriving = deque()
        self.sent = []
        self._start_ticks = start_ticks

    def ticks_us(self):
        return (self._start_ticks + self.now_us) % TICKS_MODULUS

    def receive(self, buffer):
        count = min(len(buffer), len(self.arriving))
        for i in range(count):
            buffer[i] = self.arriving.popleft()
        return count

    def send(self, buffer, length):
        self.sent.append((self.now_us, bytes(buffer[:length])))

    def quiet(self):
        """No pin has pulses."""

    def heap_free(self):
        return 0
