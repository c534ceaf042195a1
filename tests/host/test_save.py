"""Keeping a puppet on the MCU's flash: it plays when it is switched on, armed if its robot says so, until it is erased."""

from pathlib import Path

import pytest

import marotte
from marotte import cli
from marotte.limits import Limits
from marotte.link import LinkRefused, VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.outputs import Output
from marotte.pulses import pulses
from marotte.session import LinkKilled
from marotte.tables import build_tables
from shared import formats

PUPPETS = Path(__file__).parents[2] / "puppets"
PET = str(PUPPETS / "pet.toml")
ROBOT = str(PUPPETS / "pet-robot.toml")
NECK_PIN = 8


@pytest.fixture(scope="module")
def puppet():
    return marotte.load_puppet(PET)


@pytest.fixture
def flash(tmp_path):
    folder = tmp_path / "flash"
    folder.mkdir()
    return folder


def opened(mcu):
    session = marotte.Session(VirtualCarrier(mcu))
    session.open()
    return session


def write_robot(tmp_path, autostart):
    path = tmp_path / "robot.toml"
    path.write_text(f"autostart = {autostart}\n[output.NECK]\npin = {NECK_PIN}\n")
    return path


@pytest.mark.parametrize("autostart", ["true", "false"])
def test_saved_puppet_plays_when_the_mcu_is_switched_on(tmp_path, flash, puppet, autostart, capsys):
    robot = write_robot(tmp_path, autostart)
    arguments = ["save", PET, "--robot", str(robot), "--behaviour", "HAPPY", "--mcu", "unix", "--flash", str(flash)]
    assert cli.main(arguments) == 0
    armed = {"true": "its outputs are armed by themselves", "false": "its outputs are off until it is armed"}[autostart]
    assert (
        capsys.readouterr().out
        == f"pet is kept on the flash of the emulated unix\nswitched on, it does HAPPY; {armed}\n"
    )
    with UnixMcu(folder=flash) as mcu:
        mcu.run_for(2_000_000)
        assert bool(pulses(mcu.edges(NECK_PIN))) == (autostart == "true")
        session = opened(mcu)
        session.telemetry(0, 0, 1)
        session.flush()
        for _ in range(20):
            session.pump(10_000)
        status = session.status()
        assert (status["store"], status["armed"]) == (formats.STORE_PLAYED, autostart == "true")
        assert status["frame"] > 60
        playing = {list(puppet.actions)[index] for index in session.weights[1]}
        assert playing == set(puppet.behaviours["HAPPY"])


@pytest.mark.parametrize(
    ("when_silent", "expected"),
    [
        ("idle", ""),
        ("rest", "once a host has come and gone, it goes to rest\n"),
        ("relax", "once a host has come and gone, it goes to rest and lets go\n"),
    ],
)
def test_save_says_what_the_puppet_does_when_a_host_is_gone(tmp_path, flash, when_silent, expected, capsys):
    puppet = tmp_path / "puppet.toml"
    puppet.write_text(f'when_silent = "{when_silent}"\n[dof.NECK]\n')
    robot = write_robot(tmp_path, "false")
    assert cli.main(["save", str(puppet), "--robot", str(robot), "--mcu", "unix", "--flash", str(flash)]) == 0
    first, _, rest = capsys.readouterr().out.split("\n", 2)
    assert (first, rest) == ("puppet is kept on the flash of the emulated unix", expected)


def test_save_replaces_what_plays_by_itself(tmp_path, flash):
    save = ["--mcu", "unix", "--flash", str(flash)]
    robot = str(write_robot(tmp_path, "true"))
    assert cli.main(["save", PET, "--robot", robot, "--behaviour", "HAPPY", *save]) == 0
    first = (flash / "marotte.bin").read_bytes()
    assert cli.main(["save", PET, "--robot", robot, *save]) == 0  # the MCU plays when this command comes
    assert (flash / "marotte.bin").read_bytes() != first


def test_erased_puppet_is_gone(flash, capsys):
    save = ["--mcu", "unix", "--flash", str(flash)]
    assert cli.main(["save", PET, "--robot", ROBOT, *save]) == 0
    assert "it stands at rest" in capsys.readouterr().out
    assert cli.main(["save", "--erase", *save]) == 0
    assert capsys.readouterr().out == "the flash of the emulated unix keeps no puppet any more\n"
    with UnixMcu(folder=flash) as mcu:
        mcu.run_for(500_000)
        status = opened(mcu).status()
        assert (status["store"], status["frame"]) == (formats.STORE_NONE, -1)


def test_save_says_when_the_flash_cannot_be_a_folder(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["save", "--erase", "--mcu", "unix", "--flash", str(tmp_path / "file")]) == 1
    assert f"{tmp_path / 'file'}: cannot be made a folder: file exists" in capsys.readouterr().err


@pytest.fixture
def playing(puppet):
    """A session with an MCU that plays the pet with its outputs armed, and the MCU."""
    with UnixMcu() as mcu:
        session = opened(mcu)
        session.upload(build_tables(puppet, marotte.load_robot(ROBOT, puppet)))
        session.arm()
        session.wait_attached()
        session.start()
        session.flush()
        yield session, mcu


def test_save_is_refused_while_the_puppet_moves_or_has_pulses(playing, puppet):
    session, _ = playing
    tables = build_tables(puppet, marotte.load_robot(ROBOT, puppet))
    for stop in (session.stop, session.kill):
        with pytest.raises(LinkRefused, match=r"refused 'save_begin'.*only while the puppet stands"):
            session.save(tables)
        with pytest.raises(LinkRefused, match="refused 'save_erase'"):
            session.erase_saved()
        stop()
    seen = []
    session.save(tables, "CALM", progress=lambda done, of: seen.append((done, of)))
    assert seen[-1][0] == seen[-1][1] == len(seen)


def test_wait_attached_waits_for_the_last_output(puppet):
    robot = marotte.load_robot(ROBOT, puppet)
    with UnixMcu() as mcu:
        session = opened(mcu)
        session.upload(build_tables(puppet, robot))
        session.arm()
        session.wait_attached()
        status = session.status()
        assert status["attached"] == (1 << len(robot.outputs)) - 1
        assert all(pulses(mcu.edges(output.drive.pulse_pin)) for output in list(robot.outputs.values())[:-1])


def test_wait_attached_ends_when_somebody_kills(playing, puppet):
    session, mcu = playing
    mcu.set_pin(22, 0)
    mcu.run_for(50_000)
    with pytest.raises(LinkKilled, match="the outputs are off again: killed by the kill pin"):
        session.wait_attached()


def test_wait_attached_without_tables_is_an_error():
    with UnixMcu() as mcu, pytest.raises(marotte.LinkError, match="no tables"):
        opened(mcu).wait_attached()


def test_calibration_changes_while_it_plays(playing, puppet):
    session, mcu = playing
    neck = marotte.load_robot(ROBOT, puppet).outputs["NECK"]
    session.calibrate(Output("NECK", neck.drive, (1600, 1600)))
    session.flush()
    mcu.run_for(4_000_000)  # pulses glide to where they belong now
    mcu.clear_edges()
    mcu.run_for(200_000)
    widths_us = [pulse.width_ns / 1000 for pulse in pulses(mcu.edges(NECK_PIN))]
    assert widths_us and all(abs(width_us - 1600) < 0.5 for width_us in widths_us)


def test_limits_change_while_it_plays(playing, puppet):
    session, _ = playing
    session.telemetry(formats.TAP_MOTOR, 1, 0)
    session.limit("NECK", Limits(range=(0.2, 0.3)))
    session.weight_targets(formats.FRAME_NOW, {puppet.action_index("NEUTRAL_BODY"): formats.WEIGHT_ONE})
    for _ in range(200):
        session.pump(10_000)
    *_, (_, _, values_q15) = session.taps
    assert values_q15[list(puppet.dofs).index("NECK")] == round(0.3 * 32768)


@pytest.mark.parametrize("change", [lambda session: session.limit("TAIL", Limits())])
def test_change_of_an_unknown_dof_is_an_error(playing, change):
    with pytest.raises(KeyError):
        change(playing[0])
