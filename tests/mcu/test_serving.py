"""The firmware live on a port, shared by Marotte's host and mpremote: each gets it at the first try, and the other afterwards."""

import contextlib
import subprocess
import sys
import time

import pytest
import serial

from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.serve import serve
from marotte.mcu.unix import UnixMcu
from marotte.ports import SerialCarrier
from marotte.pulses import pulses
from marotte.session import LinkForeign, Session
from tests.link.stage import pet_tables

PIN = 2
PATIENCE_S = 8


@pytest.fixture(
    params=[
        "unix-tcp",
        "unix-pty",
        *(pytest.param(name, marks=pytest.mark.images) for name in ("rp2040-tcp", "rp2040-pty")),
    ]
)
def live(request):
    """A live MCU of either kind, on a TCP port and on a pseudo-terminal; the firmware has booted."""
    kind, port = request.param.split("-")
    image = request.getfixturevalue("rp2040_image_path") if kind == "rp2040" else None
    mcu = Rp2040Mcu(image, timed_flash=False) if image else UnixMcu()
    with serve(mcu, 0 if port == "tcp" else None) as live:
        yield live


def mpremote(live, *words):
    command = [sys.executable, "-m", "mpremote", "connect", live.url, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.replace("\r\n", "\n")


@contextlib.contextmanager
def session_on(live):
    """A session over the port, as `marotte run --port` has it."""
    with contextlib.closing(Session(SerialCarrier(live.url))) as session:
        session.open()
        yield session


def perform(session):
    """Upload the pet, arm it and let it play for a moment of real time."""
    session.upload(pet_tables())
    session.arm()
    session.telemetry(7, 1, 0)
    session.start()
    while len(session.taps) < 8:
        session.pump(10_000)


def rises_us(live):
    return [pulse.start_ns // 1000 for pulse in pulses(live.mcu.edges(PIN))]


def test_host_and_mpremote_share_the_firmware(live, tmp_path):
    with session_on(live) as session:
        perform(session)
    assert mpremote(live, "exec", "print(6 * 7)") == "42\n"
    called_us = live.mcu.now_us
    (tmp_path / "pose.txt").write_text("0.25\n" * 200)
    mpremote(live, "resume", "fs", "cp", str(tmp_path / "pose.txt"), ":pose.txt")
    assert " pose.txt\n" in mpremote(live, "resume", "fs", "ls")
    assert mpremote(live, "resume", "fs", "cat", ":pose.txt") == "0.25\n" * 200
    reset_us = live.mcu.now_us
    mpremote(live, "reset")
    with session_on(live) as session:
        assert session.welcome["frame"] == -1 and not session.welcome["armed"]
        perform(session)
        session.kill()
        session.flush()
    live.stop()
    rises = rises_us(live)
    assert rises[0] < called_us and rises[-1] > reset_us
    assert not [t_us for t_us in rises if called_us <= t_us <= reset_us], "the REPL has no pulses"


def test_firmware_performs_again_after_ctrl_d(live):
    assert mpremote(live, "exec", "print('here')") == "here\n"
    with pytest.raises(LinkForeign, match="MicroPython's REPL answers at this port"), session_on(live):
        pass
    with serial.serial_for_url(live.url, timeout=2) as port:
        port.write(b"\r\x03\x02")
        assert port.read_until(b">>> ").endswith(b">>> ")
        port.write(b"\x04")
        assert b"soft reboot" in port.read_until(b"soft reboot\r\n")
    with session_on(live) as session:
        perform(session)


def test_mpremote_takes_an_unarmed_firmware_that_nobody_has_greeted(live):
    begun_s = time.monotonic()
    assert mpremote(live, "exec", "print('first try')") == "first try\n"
    assert time.monotonic() - begun_s < PATIENCE_S
    live.stop()
    assert rises_us(live) == []
