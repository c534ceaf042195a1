"""The PC as an emulated MCU: MicroPython's unix port runs the firmware's sources in virtual time.

    with UnixMcu(bits=32) as mcu:
        mcu.send(b"...")
        mcu.run_for(100_000)
        print(mcu.receive())

Computing takes no time here. The pins follow a model of the Pico's PWM: periods of 20 ms that begin when a pin is first
used, and a new pulse width takes effect with the next period.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import struct
import subprocess
import tempfile
from pathlib import Path

from marotte.errors import MarotteError
from marotte.images import unix_binary
from marotte.mcu.base import VirtualMcu

ROOT = Path(__file__).resolve().parents[3]
PERIOD_NS = 20_000_000
MAX_STRETCH_US = 1 << 28
ANSWER_TIMEOUT_S = 300.0
"""Longest time for an answer: a stretch of virtual time of 268 s has 16000 frames at most."""

HEAP_BYTES = 16 << 20
STDERR_TAIL_LINES = 20
_RECORD = struct.Struct("<cIH")
_ARRIVAL = struct.Struct("<IH")
_ARRIVAL_MAX = 0xFFFF


class UnixMcu(VirtualMcu):
    """MicroPython's unix port with the firmware of this checkout.

    Its words have 64 or 32 `bits`; `binary` names another `micropython` than the one that is built for them.
    `folder` is its working directory, which stands in for the flash; default is an empty one that goes with the MCU.
    Raises MarotteError if there is no binary, and later if the firmware fails.
    """

    def __init__(self, bits: int = 64, binary: Path | None = None, folder: Path | None = None):
        self.kind = "unix" if bits == 64 else "unix32"
        self._binary = Path(binary) if binary else unix_binary(bits)
        self._folder = tempfile.TemporaryDirectory(prefix="marotte-") if folder is None else None
        self._now_us = 0
        self._waiting: list[tuple[int, bytes]] = []
        self._sent: list[tuple[int, bytes]] = []
        self._pins: dict[int, _PwmPin] = {}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        command_read, self._commands = os.pipe()
        self._records, record_write = os.pipe()
        words = [self._binary, "-X", f"heapsize={HEAP_BYTES}", "-m", "firmware.unix_main"]
        words += [f"/dev/fd/{command_read}", f"/dev/fd/{record_write}"]
        try:
            self._process = subprocess.Popen(
                [str(word) for word in words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                pass_fds=(command_read, record_write),
                cwd=folder or (self._folder.name if self._folder else None),
                env={**os.environ, "MICROPYPATH": str(ROOT)},
                start_new_session=True,  # Ctrl-C is for us: we still have a puppet to stop
            )
        except OSError as error:
            raise MarotteError(f"{self._binary}: cannot be started: {error.strerror}") from error
        finally:
            os.close(command_read)
            os.close(record_write)
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._buffer = b""
        self._read_records()

    @property
    def now_us(self) -> int:
        return self._now_us

    def send(self, data: bytes, at_us: int | None = None) -> None:
        at_us = self._now_us if at_us is None else at_us
        if at_us < self._now_us:
            raise ValueError(f"{at_us} us has passed, it is {self._now_us} us")
        place = len(self._waiting)
        while place and self._waiting[place - 1][0] > at_us:
            place -= 1
        self._waiting.insert(place, (at_us, bytes(data)))

    def run_until(self, t_us: int) -> None:
        while self._now_us < t_us:
            self._run(min(t_us - self._now_us, MAX_STRETCH_US))

    def receive(self) -> list[tuple[int, bytes]]:
        sent, self._sent = self._sent, []
        return sent

    def edges(self, pin: int) -> list[tuple[int, int]]:
        model = self._pins.get(pin)
        return model.edges_until(self._now_us * 1000) if model else []

    def clear_edges(self) -> None:
        for model in self._pins.values():
            model.edges_until(self._now_us * 1000).clear()

    def set_pin(self, pin: int, level: int | None) -> None:
        """Inputs are not modelled on the PC: the firmware has none yet that works without an RP2040."""
        raise MarotteError(f"pin {pin}: the PC's emulated MCU has no inputs; use rp2040")

    def report(self) -> dict:
        return {
            "kind": self.kind,
            "now_us": self._now_us,
            "image": str(self._binary),
            "image_sha256": hashlib.sha256(self._binary.read_bytes()).hexdigest(),
        }

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        if self._process.stdout:
            self._process.stdout.close()
        for descriptor in (self._commands, self._records):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._commands = self._records = -1
        self._errors.close()
        if self._folder:
            self._folder.cleanup()

    def _run(self, length_us: int) -> None:
        end_us = self._now_us + length_us
        arrivals = []
        while self._waiting and self._waiting[0][0] <= end_us:
            at_us, data = self._waiting.pop(0)
            for start in range(0, len(data), _ARRIVAL_MAX):
                part = data[start : start + _ARRIVAL_MAX]
                arrivals.append(_ARRIVAL.pack(at_us - self._now_us, len(part)) + part)
        body = b"".join(arrivals)
        try:
            _write_all(self._commands, struct.pack("<II", length_us, len(body)) + body)
        except OSError:
            raise self._failed("it has ended") from None
        self._read_records()
        self._now_us = end_us

    def _read_records(self) -> None:
        """Read records up to the end of the stretch, and what was printed in it."""
        while True:
            while len(self._buffer) >= _RECORD.size:
                kind, offset_us, count = _RECORD.unpack_from(self._buffer)
                end = _RECORD.size + count
                if len(self._buffer) < end:
                    break
                data, self._buffer = self._buffer[_RECORD.size : end], self._buffer[end:]
                if kind == b"D":
                    self._read_printed(self._now_us + offset_us)
                    return
                self._take(kind, self._now_us + offset_us, data)
            self._buffer += self._read_some()

    def _take(self, kind: bytes, at_us: int, data: bytes) -> None:
        if kind == b"S":
            self._read_printed(at_us)
            self._sent.append((at_us, data))
        elif kind == b"Q":
            for model in self._pins.values():
                model.quiet(at_us * 1000)
        elif kind == b"R":
            if data[0] in self._pins:
                self._pins[data[0]].quiet(at_us * 1000)
        else:
            for pin, pulse_q4us in struct.iter_unpack("<BH", data):
                model = self._pins.setdefault(pin, _PwmPin(at_us * 1000))
                model.pulse(at_us * 1000, pulse_q4us * 1000 // 16)

    def _read_printed(self, at_us: int) -> None:
        assert self._process.stdout is not None
        printed = self._process.stdout.read()
        if printed:
            self._sent.append((at_us, printed))

    def _read_some(self) -> bytes:
        ready, _, _ = select.select([self._records], [], [], ANSWER_TIMEOUT_S)
        if not ready:
            raise self._failed(f"it has not answered for {ANSWER_TIMEOUT_S:.0f} s")
        data = os.read(self._records, 1 << 16)
        if not data:
            raise self._failed("it has ended")
        return data

    def _failed(self, what: str) -> MarotteError:
        self._process.kill()
        self._process.wait()
        self._errors.seek(0)
        tail = self._errors.read().decode(errors="replace").splitlines()[-STDERR_TAIL_LINES:]
        return MarotteError(
            "\n".join([f"the firmware on {self._binary} failed: {what}", *(f"    {line}" for line in tail)])
        )


class _PwmPin:
    """One PWM output: the level's changes, worked out period by period."""

    def __init__(self, start_ns: int):
        self._next_ns = start_ns + PERIOD_NS
        self._width_ns = 0
        self._fall_ns = -1  # when the pulse under way ends, -1 if the level is low
        self._edges: list[tuple[int, int]] = []

    def pulse(self, at_ns: int, width_ns: int) -> None:
        """Set the width of the pulses from the next period on."""
        self.edges_until(at_ns)
        self._width_ns = width_ns

    def quiet(self, at_ns: int) -> None:
        """Drive the pin low, now and from now on."""
        self.edges_until(at_ns)
        self._width_ns = 0
        if self._fall_ns >= 0:
            self._edges.append((at_ns, 0))
            self._fall_ns = -1

    def edges_until(self, end_ns: int) -> list[tuple[int, int]]:
        """Let time pass; return the list of all edges that are remembered."""
        while True:
            if 0 <= self._fall_ns <= end_ns:
                self._edges.append((self._fall_ns, 0))
                self._fall_ns = -1
            if self._next_ns > end_ns:
                return self._edges
            if self._width_ns:
                self._edges.append((self._next_ns, 1))
                self._fall_ns = self._next_ns + self._width_ns
            self._next_ns += PERIOD_NS


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
