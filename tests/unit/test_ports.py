"""Ports: what is said when one cannot be used, how soon, and what happens when one goes away."""

import contextlib
import errno
import os
import socket
import threading
import time

import pytest
import serial

from marotte import ports
from marotte.errors import MarotteError
from marotte.ports import PortBusy, PortDenied, PortError, PortMissing, PortVanished, SerialCarrier

pytestmark = pytest.mark.skipif(os.name != "posix", reason="uses pseudo-terminals")


@pytest.fixture
def terminal():
    """The two ends of a pseudo-terminal: a descriptor for the MCU's side, the name of the host's."""
    import pty
    import tty

    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        with contextlib.suppress(OSError):  # closed by the test
            os.close(descriptor)


@pytest.fixture
def server():
    """A TCP port of this machine: the listening socket and its URL."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener, f"socket://127.0.0.1:{listener.getsockname()[1]}"


UNUSABLE = [
    ("/dev/ttyNOSUCH7", PortMissing, "/dev/ttyNOSUCH7: there is no such port; "),
    ("COM77", PortMissing, "COM77: there is no such port; "),
    ("", PortMissing, ": there is no such port; "),
    ("with\0null", PortMissing, "there is no such port; "),
    ("/dev/null", PortMissing, "/dev/null: is no serial port; "),
    ("/", PortMissing, "/: is no serial port; "),
    (__file__, PortMissing, "is no serial port; "),
    ("socket://127.0.0.1:1", PortMissing, "socket://127.0.0.1:1: nobody listens there"),
    ("socket://127.0.0.1", PortMissing, "expected socket://HOST:PORT"),
    ("socket://127.0.0.1:port", PortMissing, "expected socket://HOST:PORT"),
    ("xyz://somewhere", PortMissing, "protocol 'xyz' not known"),
]


@pytest.mark.parametrize(("port", "error", "text"), UNUSABLE)
def test_carrier_says_why_a_port_cannot_be_used(port, error, text):
    start_s = time.monotonic()
    with pytest.raises(error) as raised:
        SerialCarrier(port)
    assert text in str(raised.value)
    assert "\n" not in str(raised.value)
    assert time.monotonic() - start_s < 2


@pytest.mark.parametrize(
    ("number", "error", "text"),
    [
        (
            errno.EACCES,
            PortDenied,
            "no permission to open this port; join its group and log in again: sudo usermod -aG ",
        ),
        (errno.EBUSY, PortBusy, "another program uses this port; close it first"),
        (errno.ENXIO, PortMissing, "there is no such port"),
        (errno.EIO, PortError, "cannot be opened: "),
    ],
)
def test_carrier_tells_the_systems_reasons_apart(monkeypatch, terminal, number, error, text):
    def refuse(*_, **__):
        raise serial.SerialException(number, f"could not open port: {os.strerror(number)}")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(error) as raised:
        SerialCarrier(terminal[1])
    assert text in str(raised.value)


def test_carrier_gives_up_on_a_port_that_does_not_open(monkeypatch):
    never = threading.Event()
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: never.wait())
    monkeypatch.setattr(ports, "OPEN_TIMEOUT_S", 0.05)
    with pytest.raises(PortMissing, match=r"does not answer within 0\.05 s"):
        SerialCarrier("socket://127.0.0.1:1")
    never.set()


def test_carrier_keeps_a_port_for_itself(terminal):
    carrier = SerialCarrier(terminal[1])
    with pytest.raises(PortBusy, match="another program uses this port"):
        SerialCarrier(terminal[1])
    carrier.close()
    SerialCarrier(terminal[1]).close()


def test_carrier_carries_bytes_both_ways_over_a_terminal(terminal):
    master, name = terminal
    carrier = SerialCarrier(name)
    everything = bytes(range(256))
    carrier.write(everything)
    assert os.read(master, 1000) == everything
    os.write(master, everything)
    assert carrier.read(1_000_000) == everything
    assert carrier.read(0) == b""
    carrier.close()
    carrier.close()


def test_carrier_carries_bytes_both_ways_over_tcp(server):
    listener, url = server
    carrier = SerialCarrier(url)
    peer, _ = listener.accept()
    with peer:
        carrier.write(b"hello\0")
        assert peer.recv(100) == b"hello\0"
        peer.sendall(b"welcome\0")
        assert carrier.read(1_000_000) == b"welcome\0"
    carrier.close()


def test_carrier_reads_no_longer_than_it_is_told(terminal):
    carrier = SerialCarrier(terminal[1])
    start_us = carrier.now_us()
    assert carrier.read(20_000) == b""
    assert 19_000 <= carrier.now_us() - start_us < 500_000
    carrier.close()


def test_carrier_without_a_descriptor_is_polled():
    carrier = SerialCarrier("loop://")
    carrier.write(b"abc")
    assert carrier.read(1_000_000) == b"abc"
    assert carrier.read(3000) == b""
    carrier.close()


def test_carrier_says_that_a_terminal_has_gone(terminal):
    master, name = terminal
    carrier = SerialCarrier(name)
    os.close(master)
    with pytest.raises(PortVanished, match="the connection is gone"):
        for _ in range(100):
            carrier.write(b"x")
            carrier.read(1000)
    carrier.close()


def test_carrier_says_that_a_tcp_peer_has_gone(server):
    listener, url = server
    carrier = SerialCarrier(url)
    listener.accept()[0].close()
    with pytest.raises(PortVanished, match="the connection is gone"):
        for _ in range(100):
            carrier.read(10_000)
    carrier.close()


def test_carrier_says_that_nobody_takes_its_bytes(monkeypatch, terminal):
    monkeypatch.setattr(ports, "WRITE_TIMEOUT_S", 0.05)
    carrier = SerialCarrier(terminal[1])
    with pytest.raises(PortVanished, match="takes no data any more"):
        for _ in range(1000):
            carrier.write(bytes(1000))
    carrier.close()


def test_ports_available_are_described(monkeypatch):
    class Found:
        def __init__(self, device, description, vid=None, pid=None):
            self.device, self.description, self.vid, self.pid = device, description, vid, pid

    found = [Found("/dev/ttyS0", "n/a"), Found("/dev/ttyACM0", "Board in FS mode", 0x2E8A, 5)]
    monkeypatch.setattr(ports.list_ports, "comports", lambda: found)
    assert [str(port) for port in ports.available()] == ["/dev/ttyACM0  Board in FS mode, USB 2e8a:0005", "/dev/ttyS0"]
    with pytest.raises(PortMissing, match="there are /dev/ttyACM0, /dev/ttyS0"):
        SerialCarrier("/dev/ttyNOSUCH7")
    monkeypatch.setattr(ports.list_ports, "comports", list)
    with pytest.raises(PortMissing, match="this machine has no serial port now"):
        SerialCarrier("/dev/ttyNOSUCH7")


def test_port_errors_are_for_people():
    assert all(
        issubclass(error, MarotteError) for error in (PortError, PortMissing, PortBusy, PortDenied, PortVanished)
    )
