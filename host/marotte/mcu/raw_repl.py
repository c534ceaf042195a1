"""MicroPython's raw REPL on an emulated MCU in virtual time: run a piece of Python there and get what it prints."""

from __future__ import annotations

from marotte.errors import MarotteError
from marotte.mcu.base import VirtualMcu

STEP_US = 1_000
INTERRUPT = b"\r\x03"
INTERRUPT_US = 100_000
"""What firmware may take to stop in good order; what is sent meanwhile may be lost."""

ENTER = b"\r\x01"
PROMPT = b"raw REPL; CTRL-B to exit\r\n>"
END = b"\x04"


class RawRepl:
    """Stops whatever runs on the MCU and enters its raw REPL, by the MCU's own link.

    Raises MarotteError if no raw REPL answers within `timeout_us` of virtual time.
    """

    def __init__(self, mcu: VirtualMcu, timeout_us: int = 3_000_000):
        self.mcu = mcu
        self._received = b""
        self.enter(timeout_us)

    def enter(self, timeout_us: int = 3_000_000) -> None:
        """Enter the raw REPL (again, for example after a reset)."""
        self._received = b""
        self.mcu.send(INTERRUPT)
        self.mcu.run_for(INTERRUPT_US)
        self.mcu.receive()
        self.mcu.send(ENTER)
        self._until(PROMPT, timeout_us)

    def start(self, code: str) -> None:
        """Run `code` without waiting for its end."""
        self.mcu.send(code.encode() + END)
        self._until(b"OK", 1_000_000)

    def finish(self, timeout_us: int = 3_000_000) -> str:
        """Wait for the end of what was started and return what it has printed. Raises MarotteError if it raised."""
        printed = self._until(END, timeout_us)
        error = self._until(END + b">", timeout_us)
        if error:
            raise MarotteError(f"the code on the MCU failed: {error.decode()}")
        return printed.decode()

    def exec(self, code: str, timeout_us: int = 3_000_000) -> str:
        """Run `code` to its end and return what it has printed. Raises MarotteError if it raised."""
        self.start(code)
        return self.finish(timeout_us)

    def _until(self, end: bytes, timeout_us: int) -> bytes:
        deadline_us = self.mcu.now_us + timeout_us
        while end not in self._received:
            if self.mcu.now_us >= deadline_us:
                sent = self._received[-200:]
                raise MarotteError(f"the MCU's raw REPL sent {sent!r} in {timeout_us} us: expected {end!r}")
            self.mcu.run_for(STEP_US)
            self._received += b"".join(data for _, data in self.mcu.receive())
        before, self._received = self._received.split(end, 1)
        return before
