"""Where a live emulated MCU can be reached by a serial program: a TCP port or a pseudo-terminal. One client at a time."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from abc import ABC, abstractmethod

from marotte.errors import MarotteError

READ_BYTES = 4096
MUTE_S = 5.0
"""A client that has sent nothing for so long gives way to another one: it may have gone without a word, as behind a tunnel."""

TOLD_S = 0.3
"""A client that is refused is told after this: pyserial forgets what has come before it had opened the port."""

REFUSED_MAX = 8
"""Clients that were refused and are kept until they have read it."""


class Endpoint(ABC):
    """A port with at most one client. Nothing blocks; what is sent without a client is dropped, as by an unplugged cable."""

    url: str
    """What to give to pyserial or mpremote."""

    @abstractmethod
    def waitable(self) -> list:
        """The descriptors to wait on until `read` may have something."""

    @abstractmethod
    def read(self) -> bytes:
        """What the client has sent; empty if nothing or if there is no client."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Send as much of `data` as the client takes now and return how many bytes that was; all of it without a client."""

    @abstractmethod
    def writable(self) -> list:
        """The descriptors to wait on until `write` may take more."""

    @abstractmethod
    def close(self) -> None:
        """Close the port and the connection; calling it twice does no harm."""


class TcpEndpoint(Endpoint):
    """A TCP port of this machine (127.0.0.1). A second client is told that it is in use, and let go, unless the first is mute.

    Raises MarotteError if the port (0: any) is taken or not allowed.
    """

    def __init__(self, port: int):
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise MarotteError(f"TCP port {port} cannot be used: {error}") from error
        self._listener.listen()
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._client_name = ""
        self._heard_s = 0.0
        self._refused: list[tuple[socket.socket, float]] = []  # and when they are told, 0 if they have been
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def waitable(self) -> list:
        return [self._listener, self._client] if self._client else [self._listener]

    def writable(self) -> list:
        return [self._client] if self._client else []

    def read(self) -> bytes:
        data = self._read_client()
        self._tell_refused()
        with contextlib.suppress(BlockingIOError):
            self._accept()
        return data

    def _read_client(self) -> bytes:
        if not self._client:
            return b""
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if data:
            self._heard_s = time.monotonic()
        else:
            self._drop_client()
        return data

    def _accept(self) -> None:
        client, address = self._listener.accept()
        if self._client and time.monotonic() - self._heard_s < MUTE_S:
            self._refused.append((client, time.monotonic() + TOLD_S))
            return
        self._drop_client()
        self._heard_s = time.monotonic()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self._client_name = f"{address[0]}:{address[1]}"

    def _tell_refused(self) -> None:
        """Tell clients that the port is in use. They are closed later: what they have sent meanwhile would cut it short."""
        refusal = f"marotte: this emulated MCU is in use by {self._client_name}; one client at a time\r\n"
        for place, (client, told_s) in enumerate(self._refused):
            if told_s and time.monotonic() >= told_s:
                self._refused[place] = (client, 0.0)
                with contextlib.suppress(OSError):
                    client.sendall(refusal.encode())
                    client.shutdown(socket.SHUT_WR)
        while len(self._refused) > REFUSED_MAX:
            self._refused.pop(0)[0].close()

    def write(self, data: bytes) -> int:
        if not self._client:
            return len(data)
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._drop_client()
            return len(data)

    def _drop_client(self) -> None:
        if self._client:
            self._client.close()
        self._client = None

    def close(self) -> None:
        self._drop_client()
        for client, _ in self._refused:
            client.close()
        self._refused.clear()
        self._listener.close()


class PtyEndpoint(Endpoint):
    """A pseudo-terminal, which every serial program takes for a port. Programs that lock their port keep others out of it."""

    def __init__(self) -> None:
        import pty  # here, as Windows lacks both
        import tty

        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.url = os.ttyname(slave)
        os.close(slave)  # from now on the terminal reports a hang-up whenever no client has it open
        os.set_blocking(self._master, False)

    def _has_client(self) -> bool:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def waitable(self) -> list:
        return [self._master] if self._has_client() else []

    def writable(self) -> list:
        return self.waitable()

    def read(self) -> bytes:
        try:
            return os.read(self._master, READ_BYTES)
        except OSError:  # nothing there, or no client
            return b""

    def write(self, data: bytes) -> int:
        if not self._has_client():
            return len(data)
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0
        except OSError:
            return len(data)

    def close(self) -> None:
        if self._master >= 0:
            os.close(self._master)
        self._master = -1
