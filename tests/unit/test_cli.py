"""The command line: what it prints, its exit status, and that no mistake of the user's ends in a traceback."""

import contextlib
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from marotte import cli, commands
from marotte.errors import MarotteError

ROOT = Path(__file__).parents[2]
PET = str(ROOT / "puppets" / "pet.toml")
SCORE = str(ROOT / "puppets" / "pet-score.toml")
ROBOT = str(ROOT / "puppets" / "pet-robot.toml")
COMMANDS = ("check", "render", "plot", "run", "save", "calibrate", "ports", "mcu", "link")


@pytest.fixture
def run(capsys):
    """Run a command line; return exit status, standard output and standard error."""

    def run_(*arguments):
        try:
            status = cli.main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            status = exit_.code
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return status, captured.out, captured.err

    return run_


@pytest.fixture
def bad(tmp_path):
    """A puppet with three mistakes."""
    path = tmp_path / "bad.toml"
    path.write_text('frame_rate = 5\n[dof.NECK]\nrest = 2\n[action.A]\nmap = [["NEK", 0, 1, "rsin"]]\n')
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_cli_help_has_an_example(run, command):
    status, out, _ = run(command, "--help")
    assert status == 0
    assert re.search(rf"examples?:\n  marotte {command}", out)


def test_cli_help_lists_the_commands(run):
    status, out, _ = run("--help")
    assert status == 0
    assert all(f"\n    {command} " in out for command in COMMANDS)


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["check"], ["render", PET], ["run", PET, "--score", SCORE], ["mcu", "avr"]]
)
def test_cli_wrong_arguments_are_the_users_mistake(run, arguments):
    status, _, err = run(*arguments)
    assert status == 2
    assert "usage: marotte" in err


def test_check_says_what_is_fine(run):
    status, out, err = run("check", ROBOT, SCORE, PET)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith(f"{PET}: a puppet with 10 DOFs, ") and lines[0].endswith(": fine")
    lines = [line for line in lines if not line.startswith(("  bands", "  gains"))]
    assert re.fullmatch(re.escape(SCORE) + r": a score of \d+ cues, 20 s: fine", lines[1])
    assert lines[2] == f"{ROBOT}: a robot with 10 outputs: fine"
    assert lines[3] == "  motor layer: a tick every 20000 us, 50 Hz"
    words = "EYEBROW GP2 every 20000 us, written at 50 Hz range 0..1, speed 10, accel 200"
    assert " ".join(lines[4].split()) == words
    assert len(lines) == 4 + 10


def test_check_shows_the_bands_at_the_frame_rate_and_the_gains_of_moods(run, tmp_path):
    puppet = tmp_path / "p.toml"
    puppet.write_text(
        "frame_rate = 60\n[dof.A]\n[mood.SHY]\ngains = [-0.5, 2, 1.25, 1, 1, 0, 4]\n[mood.M]\ntempo = 2\n"
    )
    _, *lines = run("check", puppet)[1].splitlines()
    assert lines == [
        "  bands, in Hz    30  8.4   4.0  2.0  0.99  0.49  0.25",
        "  gains of SHY  -0.5    2  1.25    1     1     0     4",
        "  gains of M       1    1     1    1     1     1     1  tempo 2",
    ]


def test_check_shows_the_limits_in_use_and_the_real_periods(run, tmp_path):
    puppet = tmp_path / "p.toml"
    puppet.write_text("[dof.A]\nlimits = { range = [0.1, 1], speed = 4 }\n[dof.W]\nkind = 'relative'\n")
    robot = tmp_path / "r.toml"
    robot.write_text(
        "rate = 333\n[chip.C]\nsda = 4\nscl = 5\noe = 6\n"
        '[output.A]\ndriver = "pca9685"\nchip = "C"\nchannel = 3\nrate = 50\nrange = [0, 0.9]\nspeed = 6\naccel = 50\n'
        '[output.W]\ndriver = "bridge"\npwm = 2\ndirection = 3\n'
    )
    lines = run("check", puppet, robot)[1].splitlines()
    assert lines[3] == "  motor layer: a tick every 3008 us, 332.4 Hz"
    assert lines[4:] == [
        "  A  C 3    every 18022 us, written at 55.41 Hz  range 0.1..0.9, speed 4, accel 50",
        "  W  GP2/3  PWM of 20 kHz, written at 332.4 Hz   range -1..1, accel 20",
    ]
    alone = run("check", robot)[1].splitlines()
    assert alone[2] == "  A  C 3    every 18022 us, written at 55.41 Hz"


def test_check_reports_every_mistake_of_every_file(run, tmp_path, bad):
    score = tmp_path / "score.toml"
    score.write_text('[[cue]]\nat = -1\nbehaviour = "B"\n')
    robot = tmp_path / "robot.toml"
    robot.write_text("[output.NECK]\npin = 0\n[output.TAIL]\npin = 3\n")
    status, out, err = run("check", bad, score, robot)
    assert (status, out) == (2, "")
    keys = [
        "frame_rate",
        "dof.NECK.rest",
        "action.A.map[0][0]",
        "cue[0].at",
        "cue[0].behaviour",
        "output.NECK.pin",
        "output.TAIL",
    ]
    *lines, count = err.splitlines()
    assert [line.split(" ")[1].rstrip(":") for line in lines] == keys
    assert lines[0] == f"{bad}:1 frame_rate: found 5, expected a whole number in 10..60"
    assert count == "7 mistakes"


def test_check_knows_each_kind_by_its_content(run, tmp_path):
    for name, text, kind in (
        ("d", "[kill]\npin = 2\n", "robot"),
        ("e", "rate = 60\n", "robot"),
        ("a", "[dof.A]\n", "puppet"),
        ("b", "[[cue]]\nat=0\n", "score"),
        ("c", 'mcu="rp2040"\n', "robot"),
    ):
        (tmp_path / name).write_text(text)
        _, out, err = run("check", tmp_path / name, *([tmp_path / "a"] if kind == "score" else []))
        assert f": a {kind} " in out, err


@pytest.mark.parametrize(("puppets", "found"), [([], "found no puppet file"), ([PET, PET], "found 2 puppet files")])
def test_check_of_a_score_needs_its_puppet(run, puppets, found):
    status, _, err = run("check", SCORE, *puppets)
    assert status == 2
    assert f"a score is checked against its puppet: {found}, expected one" in err


def test_check_of_files_that_are_none(run, tmp_path):
    (tmp_path / "broken.toml").write_text("[dof\n")
    status, _, err = run("check", tmp_path / "absent.toml", tmp_path, tmp_path / "broken.toml")
    assert status == 2
    assert "absent.toml: cannot be read: no such file or directory" in err
    assert f"{tmp_path}: cannot be read: is a directory" in err
    assert "broken.toml:1: not valid TOML: " in err
    assert err.endswith("3 mistakes\n")


def test_render_and_run_report_the_mistakes_of_all_files(run, tmp_path, bad):
    robot = tmp_path / "robot.toml"
    robot.write_text("[output.NECK]\npin = 0\n")
    for command in (
        ["render", "--seconds", "1", "--out", tmp_path / "o.csv"],
        ["plot", "--seconds", "1", "--out", tmp_path / "o.png"],
        ["run"],
    ):
        status, _, err = run(command[0], bad, "--score", SCORE, "--robot", robot, "--mcu", "unix", *command[1:])
        assert status == 2
        assert "dof.NECK.rest" in err and 'unknown behaviour "CALM"' in err and "output.NECK.pin" in err
    assert list(tmp_path.glob("o.*")) == []


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf", "1e9", "ten", "1/0", "9" * 40, ""])
def test_render_seconds_must_be_sensible(run, tmp_path, seconds):
    status, _, err = run(
        "render", PET, "--score", SCORE, f"--seconds={seconds}", "--mcu", "unix", "--out", tmp_path / "o.csv"
    )
    assert status == 2
    assert "expected a number of seconds above 0" in err


def test_render_that_cannot_be_written_fails_before_the_work(run, tmp_path, monkeypatch):
    monkeypatch.setattr("marotte.rendering.render", lambda *_, **__: pytest.fail("rendered for nothing"))
    out = tmp_path / "absent" / "o.csv"
    status, _, err = run("render", PET, "--score", SCORE, "--seconds", "1", "--mcu", "unix", "--out", out)
    assert status == 1
    assert f"{out}: cannot be written: no such file or directory" in err


PLOT = ["plot", PET, "--score", SCORE, "--seconds", "1"]


@pytest.mark.parametrize("out", ["o.pdf", "o", "png", ""])
def test_plot_is_a_png_or_an_svg(run, out):
    status, _, err = run(*PLOT, "--out", out)
    assert status == 2
    assert f"found {out!r}, expected a name that ends in .png or .svg" in err


def test_plot_of_an_unknown_dof_is_the_users_mistake(run, tmp_path):
    expected = f"marotte: {PET} has no DOF 'NEK'; did you mean \"NECK\"?\n"
    assert run(*PLOT, "--dof", "HEAD_YAW", "NEK", "--out", tmp_path / "o.png") == (2, "", expected)
    assert list(tmp_path.iterdir()) == []


def test_plot_without_matplotlib_says_how_to_install_it(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    status, out, err = run(*PLOT, "--out", tmp_path / "o.png")
    assert (status, out) == (2, "")
    assert (
        err == "marotte: plotting needs matplotlib, which is not installed; please run: pip install 'matplotlib>=3.8'\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_plot_that_cannot_be_written_fails_before_the_work(run, tmp_path, monkeypatch):
    monkeypatch.setattr("marotte.rendering.render", lambda *_, **__: pytest.fail("rendered for nothing"))
    out = tmp_path / "absent" / "o.png"
    expected = f"marotte: {out}: cannot be written: no such file or directory\n"
    assert run(*PLOT, "--out", out) == (1, "", expected)


@pytest.mark.parametrize("port", ["/dev/ttyNOSUCH7", "socket://127.0.0.1:1", "/dev/null", __file__])
def test_run_says_what_is_wrong_with_a_port_within_two_seconds(run, port):
    start_s = time.monotonic()
    status, _, err = run("run", PET, "--score", SCORE, "--port", port)
    assert status == 1
    assert err.startswith(f"marotte: {port}: ") and err.count("\n") == 1
    assert time.monotonic() - start_s < 2


@pytest.mark.parametrize(("answer", "expected"), [(b"", "no answer within"), (b"OK\r\n", "is not Marotte's firmware")])
def test_run_says_that_a_port_is_silent_or_foreign_within_two_seconds(run, answer, expected):
    import pty
    import tty

    master, slave = pty.openpty()
    tty.setraw(slave)

    def answer_all():
        with contextlib.suppress(OSError):
            while os.read(master, 1000):
                os.write(master, answer)

    threading.Thread(target=answer_all, daemon=True).start()
    port = os.ttyname(slave)
    start_s = time.monotonic()
    status, _, err = run("run", PET, "--score", SCORE, "--port", port)
    elapsed_s = time.monotonic() - start_s
    os.close(slave)
    assert status == 1
    assert err.startswith(f"marotte: {port}: ") and expected in err and err.count("\n") == 1
    assert elapsed_s < 2


def test_run_is_on_a_port_or_an_mcu(run):
    status, _, err = run("run", PET, "--score", SCORE, "--port", "x", "--mcu", "unix")
    assert status == 2
    assert "not allowed with" in err


def test_run_arms_only_what_is_wired(run):
    status, _, err = run("run", PET, "--score", SCORE, "--mcu", "unix", "--arm")
    assert status == 2
    assert "--arm needs --robot" in err


def test_ports_lists_them(run, monkeypatch):
    monkeypatch.setattr(commands.ports, "available", lambda: [commands.ports.Port("/dev/ttyACM0", "Board")])
    assert run("ports")[:2] == (0, "/dev/ttyACM0  Board\n")
    monkeypatch.setattr(commands.ports, "available", list)
    assert "no serial port found" in run("ports")[1]


SAVE_MISTAKES = [
    ([], "save needs PUPPET and --robot FILE, or --erase"),
    ([PET], "save needs PUPPET and --robot FILE, or --erase"),
    (["--robot", ROBOT], "save needs PUPPET and --robot FILE, or --erase"),
    ([PET, "--erase"], "--erase takes no puppet, robot or behaviour"),
    (["--behaviour", "CALM", "--erase"], "--erase takes no puppet, robot or behaviour"),
    ([PET, "--robot", ROBOT, "--behaviour", "CLAM"], f"{PET} has no behaviour 'CLAM'; did you mean \"CALM\"?"),
]


@pytest.mark.parametrize(("arguments", "expected"), SAVE_MISTAKES)
def test_save_mistakes_are_told(run, arguments, expected):
    assert run("save", *arguments, "--mcu", "unix") == (2, "", f"marotte: {expected}\n")


def test_save_keeps_the_flash_of_emulated_mcus_only(run):
    status, _, err = run("save", "--erase", "--port", "/dev/ttyNOSUCH7", "--flash", "x")
    assert status == 2
    assert "--flash is for an emulated MCU" in err


FLASH_PATHS = [
    ("", "is a directory"),
    ("absent/flash.bin", "no such file or directory"),
    ("file/flash.bin", "not a directory"),
    ("fifo", "is no file"),
    ("x" * 300, "file name too long"),
]


@pytest.mark.parametrize("command", [["save", PET, "--robot", ROBOT, "--mcu", "rp2040"], ["mcu", "rp2040"]])
@pytest.mark.parametrize(("path", "expected"), FLASH_PATHS, ids=[expected for _, expected in FLASH_PATHS])
def test_flash_that_cannot_be_a_file_is_told_before_anything_starts(
    run, tmp_path, monkeypatch, command, path, expected
):
    monkeypatch.setattr("marotte.mcu.rp2040.EmulatorProcess", lambda *_: pytest.fail("started"))
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "fifo")
    place = tmp_path / path
    assert run(*command, "--flash", place) == (1, "", f"marotte: {place}: cannot keep the flash: {expected}\n")
    assert {each.name for each in tmp_path.iterdir()} == {"file", "fifo"}


def test_save_reports_the_mistakes_of_both_files(run, tmp_path, bad):
    robot = tmp_path / "robot.toml"
    robot.write_text("[output.NECK]\npin = 0\n")
    status, _, err = run("save", bad, "--robot", robot, "--mcu", "unix")
    assert status == 2
    assert "dof.NECK.rest" in err and "output.NECK.pin" in err


@pytest.mark.parametrize("arguments", [["--erase"], [PET, "--robot", ROBOT]])
def test_save_says_what_is_wrong_with_a_port(run, arguments):
    status, _, err = run("save", *arguments, "--port", "/dev/ttyNOSUCH7")
    assert status == 1
    assert err.startswith("marotte: /dev/ttyNOSUCH7: ") and err.count("\n") == 1


def test_save_hands_over_what_is_to_be_kept(run, monkeypatch, tmp_path):
    saved = []
    monkeypatch.setattr(commands, "save", lambda *arguments: saved.append(arguments[:2]))
    assert (
        run("save", PET, "--robot", ROBOT, "--behaviour", "CALM", "--mcu", "rp2040", "--flash", tmp_path / "f")[0] == 0
    )
    assert run("save", "--erase", "--port", "/dev/ttyACM0")[0] == 0
    (what, where), (nothing, port) = saved
    assert (what.puppet.name, what.robot.name, what.behaviour) == ("pet", "pet-1", "CALM")
    assert where == commands.Where(None, "rp2040", tmp_path / "f")
    assert (nothing, port.port) == (None, "/dev/ttyACM0")


def test_calibrate_needs_an_output_of_the_robot(run):
    expected = f"marotte: {ROBOT} has no output for 'NEK'; did you mean \"NECK\"?\n"
    assert run("calibrate", ROBOT, "NEK", "--mcu", "unix") == (2, "", expected)


def test_calibrate_says_what_is_wrong_with_a_port(run):
    status, _, err = run("calibrate", ROBOT, "NECK", "--port", "/dev/ttyNOSUCH7")
    assert status == 1
    assert err.startswith("marotte: /dev/ttyNOSUCH7: ") and err.count("\n") == 1


@pytest.mark.parametrize("options", [["--link", "uart"], ["--image", "x.uf2"]])
def test_mcu_options_of_the_chip_are_not_for_the_pc(run, options):
    status, _, err = run("mcu", "unix", *options)
    assert status == 2
    assert "for the rp2040 only" in err


@pytest.mark.parametrize("port", ["-1", "65536", "x"])
def test_mcu_tcp_port_must_be_one(run, port):
    assert run("mcu", "unix", f"--tcp={port}")[0] == 2


def test_cli_shows_errors_without_a_traceback(run, monkeypatch):
    def fail(*_):
        raise MarotteError("the sky fell")

    monkeypatch.setattr(commands, "list_ports", fail)
    assert run("ports") == (1, "", "marotte: the sky fell\n")


def test_cli_interrupted(run, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "list_ports", interrupt)
    assert run("ports") == (130, "", "")


def test_cli_reader_that_goes_away_is_no_failure_to_show():
    command = [sys.executable, "-m", "marotte", "check", PET]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        errors = process.stderr.read().decode()
    assert "Traceback" not in errors and "BrokenPipe" not in errors
