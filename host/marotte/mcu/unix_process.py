"""One process of MicroPython's unix port, from power on or reset to the next, and its files of commands and records.

The formats are described in `firmware/unix_time.py`.
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from marotte.errors import MarotteError

ROOT = Path(__file__).resolve().parents[3]
ANSWER_TIMEOUT_S = 300.0
"""Longest time for an answer: a stretch of virtual time of 268 s has 16000 frames at most."""

HEAP_BYTES = 16 << 20
STDERR_TAIL_LINES = 20

SENT, ATTACHED, WRITTEN, ENDED, DRIVEN, LET_GO, QUIET, I2C, RESET, DONE = b"SAPELZQIWD"
"""Kinds of records."""

BYTES, LEVEL, ANALOG, DEVICE, BLOCK = range(5)
"""Kinds of arrivals."""

ARRIVAL_MAX = 0xFFFF
_RECORD = struct.Struct("<BIH")
_ARRIVAL = struct.Struct("<IBH")
_STRETCH = struct.Struct("<II")


class UnixProcess:
    """`binary` runs `program` (its words of the command line) in `folder`, with the board's four arguments.

    It waits for its first stretch at once. Raises MarotteError if it cannot be started, and later if it fails.
    """

    def __init__(self, binary: Path, program: list[str], folder: str, kept: Path, resets: int):
        self._binary = binary
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        command_read, self._commands = os.pipe()
        self._records, record_write = os.pipe()
        words = [str(binary), "-X", f"heapsize={HEAP_BYTES}", *program]
        words += [f"/dev/fd/{command_read}", f"/dev/fd/{record_write}", str(kept), str(resets)]
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                pass_fds=(command_read, record_write),
                cwd=folder,
                env={**os.environ, "MICROPYPATH": str(ROOT)},
                start_new_session=True,  # Ctrl-C is for us: we still have a puppet to stop
            )
        except OSError as error:
            self._close_files()
            raise MarotteError(f"{binary}: cannot be started: {error.strerror}") from error
        finally:
            os.close(command_read)
            os.close(record_write)
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._buffer = b""
        for _ in self.records():
            pass

    def begin(self, length_us: int, arrivals: list[tuple[int, int, bytes]]) -> None:
        """Let it run through a stretch of time; an arrival is its offset, its kind, and its bytes. `records` follows."""
        body = b"".join(_ARRIVAL.pack(offset_us, kind, len(data)) + data for offset_us, kind, data in arrivals)
        try:
            _write_all(self._commands, _STRETCH.pack(length_us, len(body)) + body)
        except OSError:
            raise self._failed("it has ended") from None

    def records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the records of a stretch as they come: kind, offset, bytes. The last one is DONE or RESET."""
        place = 0
        while True:
            buffer = self._buffer
            while len(buffer) - place >= _RECORD.size:
                kind, offset_us, count = _RECORD.unpack_from(buffer, place)
                start = place + _RECORD.size
                if len(buffer) - start < count:
                    break
                place = start + count
                if kind in (DONE, RESET):
                    self._buffer = buffer[place:]
                    yield kind, offset_us, b""
                    return
                yield kind, offset_us, buffer[start:place]
            self._buffer = buffer[place:] + self._read_some()
            place = 0

    def printed(self) -> bytes:
        """Return what it has printed since the last call."""
        assert self._process.stdout is not None
        return self._process.stdout.read() or b""

    def close(self) -> None:
        """End it; doing that twice does no harm."""
        self._process.kill()
        self._process.wait()
        if self._process.stdout:
            self._process.stdout.close()
        self._close_files()

    def _close_files(self) -> None:
        for descriptor in (self._commands, self._records):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._commands = self._records = -1
        self._errors.close()

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
        self.close()
        return MarotteError(
            "\n".join([f"the firmware on {self._binary} failed: {what}", *(f"    {line}" for line in tail)])
        )


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
