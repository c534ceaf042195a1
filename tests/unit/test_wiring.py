"""Robot files: pins, pulses, and the mistakes in them."""

from pathlib import Path

import pytest

from marotte.puppet_file import load_puppet
from marotte.tomlfile import FileMistakes
from marotte.wiring import Output, load_robot, read_robot

PUPPETS = Path(__file__).parents[2] / "puppets"


def mistakes_of(tmp_path, text, puppet=None):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    _, mistakes = read_robot(path, puppet)
    if mistakes:
        with pytest.raises(FileMistakes):
            load_robot(path, puppet)
    return [str(mistake).removeprefix(str(path)) for mistake in mistakes]


def test_robot_reads_everything(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(
        'name="one"\nmcu="rp2040"\nlink_timeout=1.5\n'
        "[output.NECK]\npin=28\npulse_us=[2000,1000.5]\ntrim_us=-12.5\ninvert=true\n[output.WHEEL]\npin=2\n"
    )
    robot = load_robot(path)
    assert (robot.name, robot.mcu, robot.link_timeout_s) == ("one", "rp2040", 1.5)
    assert robot.outputs["NECK"] == Output("NECK", 28, (2000.0, 1000.5), -12.5, True)
    assert robot.outputs["WHEEL"] == Output("WHEEL", 2, (1000.0, 2000.0), 0.0, False)


@pytest.mark.parametrize(
    ("output", "ends_us"),
    [
        (Output("A", 2), (1000, 2000)),
        (Output("A", 2, (900, 2100), 10), (910, 2110)),
        (Output("A", 2, (900, 2100), 10, True), (2110, 910)),
        (Output("A", 2, (2100, 900), -10, True), (890, 2090)),
    ],
)
def test_output_ends_have_trim_and_inversion(output, ends_us):
    assert output.ends_us == ends_us


def test_robot_of_the_pet_moves_every_dof():
    puppet = load_puppet(PUPPETS / "pet.toml")
    assert list(load_robot(PUPPETS / "pet-robot.toml", puppet).outputs) == list(puppet.dofs)


MISTAKES = [
    ('mcu="esp32"', ':1 mcu: found "esp32", expected "rp2040"'),
    ("link_timeout=0", ":1 link_timeout: found 0, expected a number in 0.1..60"),
    ("[output.NECK]", ':1 output.NECK: has no "pin"; expected the number of its pin, 0..29'),
    ("[output.NECK]\npin=30", ":2 output.NECK.pin: found 30, expected a whole number in 0..29"),
    ('[output.NECK]\npin="GP2"', ':2 output.NECK.pin: found "GP2", expected a whole number'),
    ("[output.NECK]\npin=0", ":2 output.NECK.pin: found 0, expected another pin: GP0 and GP1 are the link's UART"),
    ("[output.NECK]\npin=25", ":2 output.NECK.pin: found 25, expected another pin: on a Pico, GP25 is wired"),
    ("[output.A]\npin=2\n[output.B]\npin=2", ":4 output.B.pin: found 2, which drives A already"),
    (
        "[output.A]\npin=2\n[output.B]\npin=18",
        ":4 output.B.pin: found 18, expected another pin: it shares a PWM channel",
    ),
    ("[output.A]\npin=2\npulse_us=[1000]", ":3 output.A.pulse_us: found 1 values, expected 2: the pulse widths"),
    ("[output.A]\npin=2\npulse_us=[200,2000]", ":3 output.A.pulse_us[0]: found 200, expected a number in 300..3000"),
    ("[output.A]\npin=2\ntrim_us=301", ":3 output.A.trim_us: found 301, expected a number in -300..300"),
    (
        "[output.A]\npin=2\npulse_us=[400,2900]\ntrim_us=200",
        ":4 output.A.trim_us: with its trim the pulses end at 600 and 3100",
    ),
    ("[output.A]\npin=2\ninvert=1", ":3 output.A.invert: found 1, expected true or false"),
    ("[output.A]\npin=2\npuls_us=[1,2]", ':3 output.A.puls_us: unknown key; did you mean "pulse_us"?'),
    ("[outputs.A]\npin=2", 'outputs: unknown key; did you mean "output"?'),
    ("output=3", ":1 output: found 3, expected a table"),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[expected[:50] for _, expected in MISTAKES])
def test_robot_mistake_is_named_and_placed(tmp_path, text, expected):
    found = mistakes_of(tmp_path, text)
    assert any(expected in line for line in found), found


def test_robot_output_must_be_a_dof_of_the_puppet(tmp_path):
    puppet = load_puppet(PUPPETS / "pet.toml")
    found = mistakes_of(tmp_path, "[output.NEK]\npin=2\n", puppet)
    assert found == [':1 output.NEK: the puppet has no such DOF; did you mean "NECK"?']


def test_robot_reports_all_mistakes(tmp_path):
    assert len(mistakes_of(tmp_path, "link_timeout=99\n[output.A]\npin=1\ninvert=3\n[output.B]\npulse_us=3\n")) == 5
