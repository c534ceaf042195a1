"""The emulator's process: one JSON object a line to its standard input, one line of answer each (`emulator/protocol.mjs`)."""

from __future__ import annotations

import contextlib
import json
import select
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

from marotte.errors import MarotteError

ANSWER_TIMEOUT_S = 120.0
"""Longest time for an answer: a second of virtual time takes one or two, on a slow machine with the slow core perhaps thirty."""

STDERR_TAIL_LINES = 20


class EmulatorProcess:
    """Starts `command` and waits until it is ready.

    Raises MarotteError, here or from `ask`, with the end of its standard error if it dies, reports an error or does not answer.
    """

    def __init__(self, command: Sequence[str | Path]):
        self._errors = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115
        words = [str(word) for word in command]
        self._process = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C is for us: we still have a puppet to stop
        )
        assert self._process.stdin and self._process.stdout
        self._requests, self._answers = self._process.stdin, self._process.stdout
        self._turn = threading.Lock()
        self._last_id = 0
        self._read()

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    def ask(self, **request: object) -> dict:
        """Send one request and return its answer; threads take turns."""
        with self._turn:
            self._last_id += 1
            try:
                self._requests.write(json.dumps({"id": self._last_id, **request}).encode() + b"\n")
                self._requests.flush()
            except (OSError, ValueError):
                raise self._failed("it has ended") from None
            return self._read()

    def close(self) -> None:
        """End the process; calling it twice does no harm."""
        if self.alive:
            self._process.kill()
        self._process.wait()
        self._answers.close()
        self._errors.close()
        with contextlib.suppress(OSError):  # of a request that the dead process did not take
            self._requests.close()

    def _read(self) -> dict:
        """Return the answer to the last request, passing over those that nobody waited for after a Ctrl-C."""
        while True:
            ready, _, _ = select.select([self._answers], [], [], ANSWER_TIMEOUT_S)
            if not ready:
                raise self._failed(f"it has not answered for {ANSWER_TIMEOUT_S:.0f} s")
            line = self._answers.readline()
            if not line.endswith(b"\n"):
                raise self._failed("it has ended")
            answer = json.loads(line)
            if "error" in answer:
                raise self._failed(answer["error"])
            if answer.pop("id") == self._last_id:
                return answer

    def _failed(self, what: str) -> MarotteError:
        tail = []
        if not self._errors.closed:
            self._process.kill()
            self._process.wait()
            self._errors.seek(0)
            tail = self._errors.read().splitlines()[-STDERR_TAIL_LINES:]
        return MarotteError("\n".join([f"the emulated RP2040 failed: {what}", *(f"    {line}" for line in tail)]))
