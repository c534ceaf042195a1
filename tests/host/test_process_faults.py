"""What becomes of the puppet when programs and connections fail: real processes, real ports, an emulated MCU in real time.

How long anything takes is read from the MCU's own time; of the machine's, only that it comes at all within PATIENCE_S.
"""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from functools import partial

import pytest

from marotte.link import LinkRefused, LinkSilent, LinkTaken, VirtualCarrier
from marotte.mcu import endpoints
from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.serve import serve
from marotte.mcu.unix import UnixMcu
from marotte.ports import PortVanished, SerialCarrier
from marotte.session import Session
from shared import formats
from tests.link.safety import play, puppet_text
from tests.link.stage import open_session, pet_tables

PATIENCE_S = 60
PIN, WHEEL_PIN = 2, 4
STAND_US = 1500
LINK_TIMEOUT_US = 500_000
STOP_US = 300_000
TICK_US = 20_000
MOMENT_US = 2_000_000
"""Of virtual time: in so much, everything that is to happen after a fault has happened."""

PUPPET = puppet_text(["A", "W"], ['["A", 0, 1, "rsin"]', '["W", 1, 1, "const(1)"]'], frame_rate=30).replace(
    "[dof.W]", '[dof.W]\nkind = "relative"'
)
ROBOT = f"attach_interval = 0\n[output.A]\npin = {PIN}\n[output.W]\npin = {WHEEL_PIN}\n"
SCORE = "[[cue]]\nat = 0.0\nweights = { LOOK = 4.0 }\n"


@pytest.fixture
def files(tmp_path):
    """The arguments of `marotte run` for a puppet with a head that nods and a wheel that turns."""
    for name, text in (("puppet", PUPPET), ("robot", ROBOT), ("score", SCORE)):
        (tmp_path / f"{name}.toml").write_text(text)
    return [
        str(tmp_path / "puppet.toml"),
        "--score",
        str(tmp_path / "score.toml"),
        "--robot",
        str(tmp_path / "robot.toml"),
    ]


@contextlib.contextmanager
def host(files, url, seconds=1000):
    """`marotte run` on a port, playing."""
    command = [sys.executable, "-u", "-m", "marotte", "run", *files, "--arm", "--no-view", "--port", url]
    command += ["--seconds", str(seconds)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert re.match(r"puppet uploaded in \d+ ms, on ", process.stdout.readline())
            assert process.stdout.readline() == "   0.00 s  LOOK 4\n"
            yield process
        finally:
            process.kill()


def wait_for(live, condition):
    """Let real time pass until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, "it does not come"
        live.wait(0.02)


def let_pass(live, for_us):
    """Let so much of the MCU's time pass."""
    end_us = live.mcu.now_us + for_us
    wait_for(live, lambda: live.mcu.now_us >= end_us)


def turned_us(live):
    """The instants at which the wheel was told to do anything but stand."""
    drive = live.mcu.drives()[WHEEL_PIN]
    return [t_us for t_us, q18us in zip(drive.t_us, drive.value, strict=True) if abs(q18us / (1 << 18) - STAND_US) > 1]


def widths_after(live, t_us):
    """What the head was told after an instant."""
    drive = live.mcu.drives()[PIN]
    return {q18us for at_us, q18us in zip(drive.t_us, drive.value, strict=True) if at_us > t_us}


def check_silence(live, there_us, gone_us):
    """The host was there at one instant and gone at another: the wheel has stopped in time, and the head lives on.

    Returns what that took, in milliseconds.
    """
    live.stop()
    turned = [t_us for t_us in turned_us(live) if t_us <= gone_us + MOMENT_US]
    assert there_us < turned[-1] <= gone_us + LINK_TIMEOUT_US + STOP_US + TICK_US
    assert len(widths_after(live, gone_us + LINK_TIMEOUT_US + STOP_US)) > 10
    return (turned[-1] - gone_us) / 1000


@pytest.mark.parametrize("port", ["tcp", "pty"])
def test_host_killed_with_9_leaves_a_puppet_whose_wheels_stand(files, port):
    with serve(UnixMcu(), 0 if port == "tcp" else None) as live:
        with host(files, live.url) as process:
            let_pass(live, MOMENT_US)
            there_us = live.mcu.now_us
            process.kill()
            process.wait(PATIENCE_S)
            gone_us = live.mcu.now_us
            let_pass(live, MOMENT_US)
        # Another host has the port at once, and plays.
        with contextlib.closing(Session(SerialCarrier(live.url))) as session:
            session.open()
            assert session.welcome["armed"] == 1 and session.welcome["frame"] > 0
            session.kill()
            session.flush(5.0)
        print(f"{port}: the wheel stands {check_silence(live, there_us, gone_us):.0f} ms after the host's end")


def test_host_that_was_suspended_plays_on(files):
    with serve(UnixMcu(), 0) as live, host(files, live.url, seconds=8) as process:
        let_pass(live, 1_000_000)
        os.kill(process.pid, signal.SIGSTOP)
        stopped_us = live.mcu.now_us
        let_pass(live, MOMENT_US)
        os.kill(process.pid, signal.SIGCONT)
        continued_us = live.mcu.now_us
        out, err = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, err) == (0, "")
        assert int(re.search(r"played: (\d+) frames, 0 late", out)[1]) >= 240
        live.stop()
        turned = turned_us(live)
        before = [t_us for t_us in turned if t_us < continued_us]
        # Signals take a moment to act, so the last packet came a little after `stopped_us`.
        assert before[-1] <= stopped_us + 2 * LINK_TIMEOUT_US + STOP_US + TICK_US
        assert turned[-1] > continued_us, "and the wheel turns again"
        print(f"the wheel stands {(before[-1] - stopped_us) / 1000:.0f} ms after the host was suspended")


@pytest.mark.parametrize("port", ["tcp", "pty"])
def test_second_host_on_a_port_is_told_that_it_is_in_use(files, port):
    with serve(UnixMcu(), 0 if port == "tcp" else None) as live, host(files, live.url, seconds=6) as first:
        command = [sys.executable, "-m", "marotte", "run", *files, "--port", live.url]
        second = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
        assert second.returncode == 1
        assert second.stderr == f"marotte: {live.url}: another program uses this port; close it first\n"
        out, err = first.communicate(timeout=PATIENCE_S)
        assert (first.returncode, err) == (0, "")
        assert int(re.search(r"played: (\d+) frames, 0 late", out)[1]) >= 180


class Tapped(VirtualCarrier):
    """One of several hosts on one MCU, all of which read all that it sends."""

    def __init__(self, mcu, others):
        super().__init__(mcu)
        self._unread = b""
        self._all = others
        others.append(self)

    def read(self, wait_us):
        data = super().read(wait_us)
        for carrier in self._all:
            carrier._unread += data
        data, self._unread = self._unread, b""
        return data


def test_second_host_that_no_lock_keeps_out_takes_the_mcu_over():
    with UnixMcu() as mcu:
        carriers = []
        first = open_session(Tapped(mcu, carriers))
        first.upload(pet_tables())
        first.start()
        play(first, 500_000)
        second = Session(Tapped(mcu, carriers))
        second.open()
        begun_us = mcu.now_us
        first.weight_targets(formats.FRAME_NOW, {0: formats.WEIGHT_MAX})
        with pytest.raises(LinkTaken, match="does another program use this port"):
            while mcu.now_us < begun_us + MOMENT_US:
                first.pump(10_000)
                second.pump(10_000)
        print(f"the first host gives up {(mcu.now_us - begun_us) / 1000:.0f} ms after the second one's greeting")
        second.telemetry(0, 0, 1)
        second.flush()
        play(second, 200_000)
        assert 0 not in second.weights[1], "what the first host has sent since was not carried out"


RESETTING = """
from machine import Timer, reset
Timer(-1, mode=Timer.ONE_SHOT, period={after_ms}, callback=lambda timer: reset())
import main
"""


def reset_unix():
    mcu = UnixMcu()
    return mcu, mcu.reset


def reset_rp2040(image):
    mcu = Rp2040Mcu(image, timed_flash=False)
    RawRepl(mcu).start(RESETTING.format(after_ms=1000))
    return mcu, partial(mcu.run_for, 1_000_000)


@pytest.mark.parametrize("kind", ["unix", pytest.param("rp2040", marks=pytest.mark.images)])
def test_mcu_that_is_reset_in_the_middle_of_an_upload_fails_it_clearly_and_takes_the_next_one(request, kind):
    mcu, reset = reset_unix() if kind == "unix" else reset_rp2040(request.getfixturevalue("rp2040_image_path"))
    with mcu:
        session = open_session(VirtualCarrier(mcu))
        seen = []

        def cut(done, of):
            seen.append(done)
            if done >= of // 2 and not mcu.report()["resets"]:
                reset()

        begun_us = mcu.now_us
        with pytest.raises(LinkSilent, match=r"has not answered for 1 s \(unplugged, or reset\?\)"):
            session.upload(pet_tables(), progress=cut)
        assert mcu.report()["resets"] == 1
        print(f"{kind}: the upload fails {(mcu.now_us - begun_us) / 1000:.0f} ms after it has begun")
        assert 0 < seen[-1] < len(list(pet_tables().messages()))
        session.open()
        assert (session.welcome["frame"], session.welcome["armed"]) == (-1, 0)
        session.start()
        with pytest.raises(LinkRefused, match="not possible in this state"):
            session.flush()  # of the half there is nothing
        session.upload(pet_tables())
        session.start()
        session.flush()


class Proxy:
    """A TCP port in front of another one that can go mute: the connections stay, and nothing passes any more."""

    def __init__(self, url):
        self._far = socket.create_connection(address_of(url))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self.is_mute = False
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        self._near, _ = self._listener.accept()
        threading.Thread(target=self._pass, args=(self._near, self._far), daemon=True).start()
        self._pass(self._far, self._near)

    def _pass(self, source, sink):
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                if not self.is_mute:
                    sink.sendall(data)

    def close(self):
        for end in (self._near, self._far, self._listener):
            end.close()


def address_of(url):
    name, port = url.removeprefix("socket://").split(":")
    return name, int(port)


def test_connection_that_died_without_a_word_is_noticed_at_both_ends(files, monkeypatch):
    monkeypatch.setattr(endpoints, "MUTE_S", 1.0)
    with serve(UnixMcu(), 0) as live, contextlib.closing(Proxy(live.url)) as proxy:
        with host(files, proxy.url) as process:
            let_pass(live, MOMENT_US)
            there_us = live.mcu.now_us
            proxy.is_mute = True
            gone_us = live.mcu.now_us
            _, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
        assert err == f"marotte: {proxy.url}: the MCU has not answered for 1 s (unplugged, or reset?)\n"
        let_pass(live, MOMENT_US)
        wait_for(live, lambda: takes_a_host(live.url))
        print(f"the wheel stands {check_silence(live, there_us, gone_us):.0f} ms after the connection's end")


def takes_a_host(url):
    """Return whether a port that is held by a connection that died lets a new host in."""
    with contextlib.suppress(PortVanished, LinkSilent), contextlib.closing(Session(SerialCarrier(url))) as session:
        session.open()
        return session.welcome["armed"] == 1
    return False


def test_mute_client_keeps_the_port_for_a_while():
    with serve(UnixMcu(), 0) as live, socket.create_connection(address_of(live.url)), contextlib.suppress(OSError):
        second = socket.create_connection(address_of(live.url), PATIENCE_S)
        with second:
            assert "in use by" in second.makefile().read()
