"""Captures: all bytes that went over a link, with their times, in a text file.

    carrier = CapturingCarrier(SerialCarrier("/dev/ttyACM0"), "run.capture")
    for packet in packets(read_capture("run.capture")):
        print(packet.at_us, packet.message)

Format: docs/link.md. Nothing in it depends on how the bytes fall into packets, so what is damaged is there as it came.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from marotte.errors import MarotteError
from marotte.link import Carrier, Message, unpack
from marotte.session import DICTIONARY
from shared import codec, messages

MAGIC = "marotte-capture"
VERSION = 1
STANDARD_INPUT = "-"
TO_MCU = ">"
FROM_MCU = "<"

_HEADER = re.compile(rf"{MAGIC} (\d{{1,9}}) protocol (\d{{1,9}}) dictionary ([0-9a-f]{{8}})")
_RECORD = re.compile(r"(\d{1,15}) ([<>]) ((?:[0-9a-f]{2})+)")
_LINE_MAX = 1 << 17
_PIECE_MAX = 4 * codec.WIRE_MAX
"""What has gone on for so long without a zero is no packet, and is told in pieces."""

_SHOWN_MAX = 40


class CaptureError(MarotteError):
    """A capture cannot be read or written."""


@dataclass(frozen=True)
class Record:
    """Bytes that were sent or had come at one time."""

    at_us: int
    """Since the capture began."""
    to_mcu: bool
    data: bytes


@dataclass(frozen=True)
class Packet:
    """What stood between two zeros: a packet, or something damaged."""

    at_us: int
    """When its last byte passed."""
    to_mcu: bool
    wire: bytes
    """Its bytes without the zero."""
    seq: int = -1
    """Its number, -1 for what is damaged."""
    message: Message | None = None
    """None: damaged, or no message of this version."""

    @property
    def is_damaged(self) -> bool:
        """Whether it is no packet at all."""
        return self.seq < 0


class CapturingCarrier:
    """Carries for another carrier, and writes down what passes.

    Raises CaptureError if the file cannot be written; once, and from then on it only carries: whoever stops a puppet then has to
    be heard.
    """

    def __init__(self, carrier: Carrier, path: str | Path) -> None:
        self._carrier = carrier
        self._path = path
        self._begin_us = carrier.now_us()
        self._has_failed = False
        try:
            self._file = Path(path).open("w", encoding="ascii", buffering=1)  # noqa: SIM115
        except OSError as error:
            raise self._failure(error) from error
        self._note(f"{MAGIC} {VERSION} protocol {messages.PROTOCOL} dictionary {DICTIONARY:08x}")

    def now_us(self) -> int:
        return self._carrier.now_us()

    def write(self, data: bytes) -> None:
        at_us = self._age_us()
        self._carrier.write(data)
        self._note(f"{at_us} {TO_MCU} {data.hex()}")

    def read(self, wait_us: int) -> bytes:
        data = self._carrier.read(wait_us)
        if data:
            self._note(f"{self._age_us()} {FROM_MCU} {data.hex()}")
        return data

    def close(self) -> None:
        """Close the capture, and the carrier."""
        self._carrier.close()
        with contextlib.suppress(OSError):  # of a full disk it has been told
            self._file.close()

    def _age_us(self) -> int:
        return self._carrier.now_us() - self._begin_us

    def _note(self, line: str) -> None:
        if self._has_failed:
            return
        try:
            self._file.write(line + "\n")
        except OSError as error:
            self._has_failed = True
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> CaptureError:
        return CaptureError(f"{self._path}: cannot be written: {(error.strerror or str(error)).lower()}")


def read_capture(path: str | Path) -> Iterator[Record]:
    """Yield the records of a capture as they are read; `-` is standard input. Raises CaptureError."""
    try:
        with _opened(path) as file:
            yield from _records(str(path), file)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from error
    except ValueError:  # a null character in the name, or bytes that are no text
        raise CaptureError(f"{path}: cannot be read: expected a capture, a text file") from None


def packets(records: Iterable[Record]) -> Iterator[Packet]:
    """Yield the packets of both directions, and what is none, in the order of their ends."""
    partial = {True: b"", False: b""}
    for record in records:
        *pieces, rest = (partial[record.to_mcu] + record.data).split(b"\0")
        while len(rest) > _PIECE_MAX:
            pieces.append(rest[:_PIECE_MAX])
            rest = rest[_PIECE_MAX:]
        partial[record.to_mcu] = rest
        for piece in pieces:
            if piece:
                yield _packet(record, piece)


def _packet(record: Record, wire: bytes) -> Packet:
    body = bytearray(wire)
    length = codec.decode(body, len(body))
    if length < 0 or not codec.is_sealed(body, length) or (body[0] < 128) != record.to_mcu:
        return Packet(record.at_us, record.to_mcu, wire)
    message = unpack(body[0], bytes(body[2 : length - 4]))
    return Packet(record.at_us, record.to_mcu, wire, body[1], message)


def _opened(path: str | Path) -> contextlib.AbstractContextManager[IO[str]]:
    if str(path) == STANDARD_INPUT:
        return contextlib.nullcontext(sys.stdin)
    return Path(path).open(encoding="ascii")


def _records(path: str, file: IO[str]) -> Iterator[Record]:
    header = file.readline(_LINE_MAX).rstrip("\n")
    match = _HEADER.fullmatch(header)
    if not match:
        raise _mistake(path, 1, header, f"a capture: {MAGIC} {VERSION} ...")
    if int(match[1]) != VERSION:
        raise CaptureError(f"{path}:1: is a capture of format {match[1]}, expected format {VERSION}")
    theirs, ours = (int(match[2]), int(match[3], 16)), (messages.PROTOCOL, DICTIONARY)
    if theirs != ours:
        raise CaptureError(
            f"{path}:1: was captured with protocol {theirs[0]}, dictionary {theirs[1]:08x}, "
            f"expected those of this program: protocol {ours[0]}, dictionary {ours[1]:08x}"
        )
    last_us = 0
    for number in range(2, sys.maxsize):
        line = file.readline(_LINE_MAX)
        if not line:
            return
        match = _RECORD.fullmatch(line.rstrip("\n"))
        if not match or len(line) == _LINE_MAX:
            raise _mistake(path, number, line, f"TIME_US {TO_MCU} HEX or TIME_US {FROM_MCU} HEX")
        at_us = int(match[1])
        if at_us < last_us:
            raise _mistake(path, number, match[1], f"a time that is not before {last_us}, that of the line before")
        last_us = at_us
        yield Record(at_us, match[2] == TO_MCU, bytes.fromhex(match[3]))


def _mistake(path: str, line: int, found: str, expected: str) -> CaptureError:
    text = found.rstrip("\n")
    shown = repr(text if len(text) <= _SHOWN_MAX else text[:_SHOWN_MAX] + " ...")
    return CaptureError(f"{path}:{line}: found {shown}, expected {expected}")
