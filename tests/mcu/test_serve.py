"""The emulated RP2040 live on a port, used by the programs that people use: mpremote and pyserial."""

import os
import socket
import subprocess
import sys

import pytest
import serial

from marotte.errors import MarotteError
from marotte.mcu.serve import serve_rp2040


def mpremote(live, *words):
    command = [sys.executable, "-m", "mpremote", "connect", live.url, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def address_of(live):
    host, port = live.url.removeprefix("socket://").split(":")
    return host, int(port)


@pytest.fixture(params=["tcp", "pty"])
def live(request, rp2040_image_path):
    """A live RP2040 on a TCP port, and on a pseudo-terminal."""
    with serve_rp2040(0 if request.param == "tcp" else None, image=rp2040_image_path) as live:
        yield live


def test_mpremote_executes_copies_lists_and_resets(live, tmp_path):
    score = tmp_path / "score.txt"
    score.write_text("wave\n" * 300)
    assert mpremote(live, "exec", "print(1 + 1)") == "2\n"
    mpremote(live, "cp", str(score), ":score.txt")
    assert "1500 score.txt" in mpremote(live, "ls")
    back = tmp_path / "back.txt"
    mpremote(live, "cp", ":score.txt", str(back))
    assert back.read_text() == score.read_text()
    mpremote(live, "reset")
    assert "score.txt" in mpremote(live, "exec", "import os; print(os.listdir())")
    assert live.mcu.report()["resets"] == 1


def test_pyserial_opens_the_port(live):
    with serial.serial_for_url(live.url, timeout=5) as port:
        port.write(b"\r\x03\x03\r\x01")
        assert port.read_until(b"raw REPL; CTRL-B to exit\r\n>").endswith(b">")
        port.write(b"print('here')\x04")
        assert port.read_until(b"\x04>") == b"OKhere\r\n\x04\x04>"


def test_second_client_is_told_that_the_port_is_in_use(rp2040_image_path):
    with serve_rp2040(0, image=rp2040_image_path) as live, socket.create_connection(address_of(live), 10) as first:
        first.sendall(b"\r\x03\x03\r\x01")
        assert first.recv(10)
        with socket.create_connection(address_of(live), 10) as second:
            said = second.makefile().read()
        assert (
            said
            == f"marotte: this emulated MCU is in use by 127.0.0.1:{first.getsockname()[1]}; one client at a time\n"
        )
        first.sendall(b"print('still here')\x04")
        answers = first.makefile("rb")
        while b"still here" not in answers.readline():
            pass


def test_port_that_is_taken_is_refused_with_its_number(rp2040_image_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(MarotteError, match=f"TCP port {port} cannot be used"),
            serve_rp2040(port, image=rp2040_image_path),
        ):
            pass


def test_emulator_that_dies_ends_the_service_with_its_error(rp2040_image_path):
    with serve_rp2040(0, image=rp2040_image_path) as live:
        os.kill(live.mcu._process.pid, 9)
        with pytest.raises(MarotteError, match="it has ended"):
            live.wait(5)
