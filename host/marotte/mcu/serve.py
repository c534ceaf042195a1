"""An emulated MCU in real time on a port, for mpremote, `marotte run`, or any serial program.

with serve_rp2040(tcp=4000) as live:
    print(live.url)         # socket://127.0.0.1:4000
    live.wait()             # until it fails or the user interrupts
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from marotte.errors import MarotteError
from marotte.mcu.base import VirtualMcu
from marotte.mcu.endpoints import Endpoint, PtyEndpoint, TcpEndpoint
from marotte.mcu.rp2040 import Rp2040Mcu

BUSY_STEP_S = 0.0005
"""Time between two looks at an MCU that computes; one that sleeps is looked at when it wakes."""

IDLE_STEP_S = 0.05
"""Longest time between two looks: how soon a client of a pseudo-terminal is noticed."""

MAX_STEP_US = 20_000
"""Longest stretch of virtual time at once, so that what the MCU sends is passed on meanwhile."""

MAX_LAG_US = 50_000
"""An MCU that is further behind real time than this stays behind: it runs slowly, and does not hurry afterwards."""

MAX_WAITING_BYTES = 65536
"""When the client is this much behind, the MCU finds that the host does not read. Linux keeps as much for a serial port."""


class LiveMcu:
    """Runs a `VirtualMcu` at `speed` times real time (above 0), with its link on an endpoint, in a thread of its own."""

    def __init__(self, mcu: VirtualMcu, endpoint: Endpoint, speed: float = 1.0):
        if speed <= 0:
            raise ValueError(f"speed must be above 0, not {speed!r}")
        self.mcu = mcu
        self.url = endpoint.url
        self.lag_us = 0
        self.error: MarotteError | None = None
        self._endpoint = endpoint
        self._speed = speed
        self._start_s = time.monotonic()
        self._waiting = b""
        self._host_reads = True
        self._ended = threading.Event()
        self._stop_receiver, self._stop_sender = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="live MCU", daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until the MCU fails or is closed, or for so long. Raises MarotteError if it has failed."""
        # Not by joining the thread: a join that Ctrl-C interrupts makes the next one believe that the thread has ended.
        self._ended.wait(timeout_s)
        if self.error:
            raise self.error

    def stop(self) -> None:
        """Let no more time pass: from now on `mcu` may be looked at from this thread. Calling it twice does no harm."""
        self._stop_sender.close()
        self._thread.join()

    def close(self) -> None:
        """Stop, and close the MCU and the port."""
        self.stop()
        self._stop_receiver.close()
        self._endpoint.close()
        self.mcu.close()

    def _run(self) -> None:
        try:
            while not self._wait_for_something():
                self._advance()
                data = self._endpoint.read()
                if data:
                    self.mcu.send(data)
        except MarotteError as error:
            self.error = error
            self._endpoint.close()
        finally:
            self._ended.set()

    def _real_us(self) -> int:
        return int((time.monotonic() - self._start_s) * 1e6 * self._speed) - self.lag_us

    def _wait_for_something(self) -> bool:
        """Sleep until the client has sent something or the MCU acts; return whether it is time to stop."""
        readable = [self._stop_receiver, *self._endpoint.waitable()]
        writable = self._endpoint.writable() if self._waiting else []
        ready, _, _ = select.select(readable, writable, [], self._idle_s())
        return self._stop_receiver in ready

    def _idle_s(self) -> float:
        next_us = self.mcu.next_action_us
        if next_us is None:
            return IDLE_STEP_S
        return min(max((next_us - self._real_us()) / 1e6 / self._speed, BUSY_STEP_S), IDLE_STEP_S)

    def _advance(self) -> None:
        """Let virtual time catch up with real time, and pass on what the MCU sends."""
        lag_us = self._real_us() - self.mcu.now_us - MAX_LAG_US - int(IDLE_STEP_S * 1e6 * self._speed)
        if lag_us > 0:
            self.lag_us += lag_us
        until_us = self._real_us()
        while self.mcu.now_us < until_us:
            self.mcu.run_until(min(until_us, self.mcu.now_us + MAX_STEP_US))
            self._pass_on()

    def _pass_on(self) -> None:
        self._waiting += b"".join(data for _, data in self.mcu.receive())
        if self._waiting:
            self._waiting = self._waiting[self._endpoint.write(self._waiting) :]
        reads = len(self._waiting) < MAX_WAITING_BYTES
        if reads != self._host_reads:
            self._host_reads = reads
            self.mcu.set_host_reading(reads)


@contextlib.contextmanager
def serve(mcu: VirtualMcu, tcp: int | None = None, speed: float = 1.0) -> Iterator[LiveMcu]:
    """Serve an emulated MCU in real time on TCP port `tcp` (0: any), or on a pseudo-terminal if it is None.

    Closes the MCU at the end. Raises MarotteError if the port cannot be used.
    """
    try:
        live = LiveMcu(mcu, PtyEndpoint() if tcp is None else TcpEndpoint(tcp), speed)
    except BaseException:
        mcu.close()
        raise
    try:
        yield live
    finally:
        live.close()


@contextlib.contextmanager
def serve_rp2040(
    tcp: int | None = None,
    *,
    image: Path | str | None = None,
    link: str = "usb",
    flash: Path | str | None = None,
    speed: float = 1.0,
) -> Iterator[LiveMcu]:
    """Serve an emulated RP2040 in real time: see `Rp2040Mcu` for what it is made of, `serve` for where it is reached."""
    with serve(Rp2040Mcu(image, link, flash), tcp, speed) as live:
        yield live
