"""Serial ports: the only file that knows pyserial.

    print(*available(), sep="\\n")
    carrier = SerialCarrier("/dev/ttyACM0")

A port is anything that pyserial opens: a device (`/dev/ttyACM0`, `COM3`) or a URL (`socket://127.0.0.1:4000`, `rfc2217://...`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from marotte.errors import MarotteError

T = TypeVar("T")

BAUD = 115_200
OPEN_TIMEOUT_S = 1.5
WRITE_TIMEOUT_S = 0.5
READ_BYTES = 4096
POLL_S = 0.001
"""Time between two looks at a port that cannot be waited on (on Windows, and some URLs)."""

SAID_BYTES = 200
"""What a port has said last is kept: one that is served may say why it closes."""

_IN_USE = b"this emulated MCU is in use by"
_MISSING = {errno.ENOENT, errno.ENODEV, errno.ENXIO}
_BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
_DENIED = {errno.EACCES, errno.EPERM}


class PortError(MarotteError):
    """A port cannot be used."""


class PortMissing(PortError):
    """There is no such port, or nobody listens there."""


class PortBusy(PortError):
    """Another program has the port."""


class PortDenied(PortError):
    """The user may not open the port."""


class PortVanished(PortError):
    """The port was there and is gone, or takes no more data."""


@dataclass(frozen=True)
class Port:
    """A serial port of this machine."""

    device: str
    """What to give to `--port`."""
    description: str

    def __str__(self) -> str:
        return f"{self.device}  {self.description}" if self.description else self.device


def available() -> list[Port]:
    """Return the serial ports of this machine, by name."""
    found = sorted(list_ports.comports(), key=lambda port: port.device)
    return [Port(port.device, _description(port)) for port in found]


class SerialCarrier:
    """An open port, as a carrier of a session's bytes.

    Raises PortError, of the kind that fits, within 2 s if the port cannot be opened, and PortVanished from `read` and `write`
    when it is gone.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        """Open `port` for this program alone."""
        self.port = port
        self._serial = _within(OPEN_TIMEOUT_S, port, lambda: _open(port, baud))
        self._said = b""
        self._can_wait = os.name == "posix" and _has_descriptor(self._serial)

    def now_us(self) -> int:
        """Return the time in microseconds, from any beginning."""
        return time.monotonic_ns() // 1000

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException as error:
            raise PortVanished(f"{self.port}: takes no data any more (is the MCU still running?)") from error
        except (serial.SerialException, OSError) as error:
            raise PortVanished(_gone(self.port)) from error

    def read(self, wait_us: int) -> bytes:
        """Return what has arrived, waiting for it at most so long; empty if nothing has."""
        deadline_s = time.monotonic() + wait_us / 1e6
        try:
            if self._can_wait:
                select.select([self._serial.fileno()], [], [], wait_us / 1e6)
                return self._read()
            while True:
                data = self._read()
                left_s = deadline_s - time.monotonic()
                if data or left_s <= 0:
                    return data
                time.sleep(min(POLL_S, left_s))
        except (serial.SerialException, OSError, ValueError) as error:
            if _IN_USE in self._said:
                raise PortBusy(f"{self.port}: another program uses this port; close it first") from error
            raise PortVanished(_gone(self.port)) from error

    def _read(self) -> bytes:
        data = bytes(self._serial.read(READ_BYTES))
        if data:
            self._said = (self._said + data)[-SAID_BYTES:]
        return data

    def close(self) -> None:
        """Close the port; calling it twice does no harm."""
        with contextlib.suppress(serial.SerialException, OSError):  # it is gone: closed enough
            self._serial.close()


def _open(port: str, baud: int) -> Any:
    try:
        # `exclusive` is known to devices on POSIX only; URLs refuse or ignore it.
        options: dict[str, Any] = {"exclusive": True} if os.name == "posix" and "://" not in port else {}
        return serial.serial_for_url(port, baud, timeout=0, write_timeout=WRITE_TIMEOUT_S, **options)
    except (serial.SerialException, OSError, ValueError) as error:
        raise _open_error(port, error) from error


def _open_error(port: str, error: Exception) -> PortError:
    number = getattr(error, "errno", None)
    if "://" in port:
        return _url_error(port, error)
    if number in _MISSING or (os.name == "posix" and not _exists(port)):
        return PortMissing(f"{port}: there is no such port; {_those_available()}")
    if number in _BUSY:
        return PortBusy(f"{port}: another program uses this port; close it first")
    if number in _DENIED:
        return PortDenied(f"{port}: no permission to open this port{_permission_hint(port)}")
    if (os.name == "posix" and not stat.S_ISCHR(Path(port).stat().st_mode)) or "configure port" in str(error):
        return PortMissing(f"{port}: is no serial port; {_those_available()}")
    return PortError(f"{port}: cannot be opened: {_reason(error)}")


def _url_error(port: str, error: Exception) -> PortError:
    text = _reason(error)
    if port.startswith("socket://") and not _names_tcp_port(port):
        return PortMissing(f"{port}: expected socket://HOST:PORT")
    if "refused" in text.lower():
        return PortMissing(f"{port}: nobody listens there (is `marotte mcu` running?)")
    return PortMissing(f"{port}: cannot be opened: {text}")


def _names_tcp_port(url: str) -> bool:
    try:
        return bool(urlsplit(url).port)
    except ValueError:
        return False


def _within(limit_s: float, port: str, call: Callable[[], T]) -> T:
    """Return what `call` returns or raise what it raises; raise PortMissing if it takes longer than `limit_s`."""
    outcome: list[T] = []
    failure: list[Exception] = []

    def work() -> None:
        try:
            outcome.append(call())
        except Exception as error:  # handed to the caller's thread
            failure.append(error)

    thread = threading.Thread(target=work, daemon=True, name="opening a port")
    thread.start()
    thread.join(limit_s)
    if failure:
        raise failure[0]
    if not outcome:
        raise PortMissing(f"{port}: does not answer within {limit_s:g} s")
    return outcome[0]


def _exists(port: str) -> bool:
    try:
        return Path(port).exists()
    except ValueError:  # a null character in the name
        return False


def _has_descriptor(port: Any) -> bool:
    try:
        return isinstance(port.fileno(), int)
    except (AttributeError, OSError):  # io.UnsupportedOperation is an OSError
        return False


def _description(port: Any) -> str:
    text = port.description or ""
    parts = [] if text in ("n/a", port.device) else [text]
    if port.vid is not None:
        parts.append(f"USB {port.vid:04x}:{port.pid:04x}")
    return ", ".join(parts)


def _those_available() -> str:
    ports = available()
    if not ports:
        return "this machine has no serial port now (is the robot plugged in?)"
    return "there are " + ", ".join(port.device for port in ports)


def _permission_hint(port: str) -> str:
    try:
        import grp  # here, as Windows lacks it

        group = grp.getgrgid(Path(port).stat().st_gid).gr_name
    except (ImportError, OSError, KeyError):
        return ""
    return f"; join its group and log in again: sudo usermod -aG {group} $USER"


def _gone(port: str) -> str:
    return f"{port}: the connection is gone (unplugged, or the MCU was reset?)"


def _reason(error: Exception) -> str:
    """Return the cause in one line, without pyserial's repetition of the port."""
    cause = error.__context__ if isinstance(error.__context__, OSError) else None
    text = (cause.strerror if cause else None) or str(error)
    return text.splitlines()[0] if text else type(error).__name__
