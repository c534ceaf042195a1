"""docs/puppet-file.md says what the readers do: its examples, its keys, their ranges and their defaults."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from marotte import limits, pins
from marotte.check import check_files
from marotte.expressions import TEXT_MAX
from marotte.functions import Function, parse_function
from marotte.puppet_file import read_puppet
from marotte.score import read_score
from marotte.tomlfile import Table
from marotte.wiring import read_robot
from shared import formats, program

DOCUMENT = (Path(__file__).parents[2] / "docs" / "puppet-file.md").read_text()
RANGE = re.compile(r"(-?[\d.]+) to (-?[\d.]+)(, whole)?")
LITERAL = re.compile(r"`([^`]*)`|-?[\d.]+")


class Row(NamedTuple):
    """A row of a table of keys."""

    chapter: str
    section: str
    key: str
    values: str
    default: str


def chapters():
    """Return the text of each chapter by its heading."""
    parts = re.split(r"^## (.*)\n", DOCUMENT, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows():
    """Return the rows of all tables of keys; a section is the first name in a heading, empty at the top."""
    found = []
    for chapter, text in chapters().items():
        parts = re.split(r"^#{3,4} `\[?(\w+)[.\]`].*\n", text, flags=re.MULTILINE)
        for section, body in zip(["", *parts[1::2]], parts[::2], strict=True):
            for table in re.findall(r"\| key \|.*\n\|[ |-]*\n((?:\|.*\n)+)", body):
                cells = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in table.splitlines()]
                found += [Row(chapter, section, key.strip("`"), values, default) for key, values, default, _ in cells]
    return found


# What stands around a key so that the file is complete.
AROUND = {
    ("The puppet", ""): "{}\n[dof.A]\n",
    ("The puppet", "dof"): "[dof.A]\n{}\n",
    ("The puppet", "limits"): "[dof.A]\nlimits = {{ {} }}\n",
    ("The puppet", "character"): "[dof.A]\ncharacter = {{ {} }}\n",
    ("The puppet", "live"): '[dof.A]\n[live.L]\npredict = "kalman"\n{}\n',
    ("The puppet", "action"): '[dof.A]\n[action.X]\n{}\nentry = "start"\nmap = [["A", 0, 1, "rsin"]]\n',
    ("The puppet", "mood"): "[dof.A]\n[mood.M]\n{}\n",
    ("The score", ""): "[[cue]]\n{}\n",
    ("The robot", ""): "{}\n",
    ("The robot", "kill"): "[kill]\npin = 22\n{}\n",
    ("The robot", "chip"): "[chip.C]\nsda = 4\nscl = 5\noe = 6\n{}\n",
    ("The robot", "output"): "[output.A]\npin = 2\n{}\n",
    ("The robot", "duty"): "[output.A]\npin = 2\nduty = {{ {} }}\n",
    ("The robot", "feedback"): "[output.A]\npin = 2\nfeedback = {{ {} }}\n",
}
AROUND_KEYS = {
    "channel": '[chip.C]\nsda = 4\nscl = 5\noe = 6\n[output.A]\ndriver = "pca9685"\nchip = "C"\n{}\n',
    "wiring": '[output.A]\ndriver = "bridge"\npwm = 2\ndirection = 3\n{}\n',
}
"""The same for keys that other drivers have."""

NEEDED = {
    "character": {"f": "f = 1"},
    "duty": {"share": "share = 0.5"},
    "feedback": {"pin": "pin = 26", "at": "at = [0, 1]"},
}
"""Keys that tables within lines cannot do without."""
INLINE = {"limits", *NEEDED}


def text_around(row, line):
    """Return a file with this line in the row's place, and nothing else that says the same."""
    text = AROUND_KEYS.get(row.key, AROUND[row.chapter, row.section])
    if row.section in INLINE:
        needed = [other for key, other in NEEDED.get(row.section, {}).items() if key != row.key]
        return text.format(", ".join(filter(None, [*needed, line])))
    others = [other for other in text.splitlines() if not other.startswith(f"{row.key} = ")]
    return "\n".join(others).format(line)


def read(tmp_path, row, line):
    """Return what a file with this line in the row's place holds, and its mistakes."""
    path = tmp_path / "file.toml"
    path.write_text(text_around(row, line))
    reader = {"The puppet": read_puppet, "The robot": read_robot}.get(row.chapter)
    if reader:
        return reader(path)
    (tmp_path / "puppet.toml").write_text("[dof.A]\n")
    return read_score(path, read_puppet(tmp_path / "puppet.toml")[0])


def write_examples(tmp_path):
    """Write the three files that the examples make; return their paths."""
    paths = []
    for name, chapter in (("puppet", "The puppet"), ("score", "The score"), ("robot", "The robot")):
        examples = re.findall(r"```toml\n(.*?)```", chapters()[chapter], re.DOTALL)
        paths.append(tmp_path / f"{name}.toml")
        paths[-1].write_text("\n".join(examples))
    return paths


def test_documentation_examples_are_without_mistakes(tmp_path):
    report = check_files(write_examples(tmp_path))
    assert report.mistakes == []
    assert len([line for line in report.fine if line.endswith(": fine")]) == 3


RANGES = [row for row in rows() if RANGE.fullmatch(row.values)]


@pytest.mark.parametrize("row", RANGES, ids=[f"{row.section}.{row.key}" for row in RANGES])
def test_documentation_ranges_are_those_of_the_readers(tmp_path, row):
    low, high, whole = RANGE.fullmatch(row.values).groups()
    assert read(tmp_path, row, f"{row.key} = {low}")[1] == []
    assert read(tmp_path, row, f"{row.key} = {high}")[1] == []
    step = 1 if whole else 0.001
    for beyond in (float(low) - step, float(high) + step):
        _, mistakes = read(tmp_path, row, f"{row.key} = {int(beyond) if whole else f'{beyond:.3f}'}")
        assert [mistake.key.split(".")[-1] for mistake in mistakes] == [row.key]


DEFAULTS = [row for row in rows() if LITERAL.fullmatch(row.default)]


@pytest.mark.parametrize("row", DEFAULTS, ids=[f"{row.section}.{row.key}" for row in DEFAULTS])
def test_documentation_defaults_are_those_of_the_readers(tmp_path, row):
    assert read(tmp_path, row, f"{row.key} = {row.default.strip('`')}") == read(tmp_path, row, "")


def test_documentation_has_every_key_and_no_other(tmp_path, monkeypatch):
    asked = set()
    has = Table.has

    def note(self, key):
        path = self.path
        if len(path) in (0, 2) or path == ("kill",):  # not a table of names of the user's choice
            asked.add((path[0] if path else "", key))
        elif len(path) == 3 and path[2] in INLINE:
            asked.add((path[2], key))
        return has(self, key)

    monkeypatch.setattr(Table, "has", note)
    check_files(write_examples(tmp_path))
    sections = {"dof", "live", "function", "action", "behaviour", "mood", "cue", "output", "chip", "kill"}
    cue = {("cue", row.key) for row in rows() if row.chapter == "The score"}
    documented = {(row.section, row.key) for row in rows() if row.chapter != "The score"} | cue
    keys = {(section, key) for section, key in asked if section != "behaviour" and (section or key not in sections)}
    assert keys == documented


def test_documentation_names_the_limits_where_nobody_says():
    text = " ".join(chapters()["The puppet"].split())
    for what in (
        f"`speed` is {limits.DEFAULT_SPEED:g} and `accel` {limits.DEFAULT_ACCEL_ABSOLUTE:g}",
        f"for a relative DOF `accel` is {limits.DEFAULT_ACCEL_RELATIVE:g}",
        f"in top speeds a second, at least {limits.ACCEL_RANGE_RELATIVE[0]:g}",
    ):
        assert what in text, what


def test_documentation_names_what_a_pico_has():
    text = " ".join(chapters()["The robot"].split())
    free = [pin for pin in range(pins.PIN_MAX + 1) if pin not in (*pins.LINK_PINS, *pins.TAKEN_PINS)]
    assert free == [*range(2, 23), *range(26, 29)]
    assert text.count("2 to 22, 26 to 28") == 7
    assert f"intervals of {formats.PWM_PERIOD_MAX_US // 100 / 10} ms at most" in text
    assert formats.DEVICES_MAX == 4 and "four at most" in text
    first = ", ".join(str(pin) for pin in free if pins.i2c_role(pin) == (0, "sda"))
    assert f"I2C0 has {first}, I2C1 the others" in text


def test_documentation_functions_are_functions():
    table = re.search(r"\| function \|.*\n\|[ |-]*\n((?:\|.*\n)+)", chapters()["Functions"])[1]
    texts = re.findall(r'`"([^"]*)"`', table)
    assert len(texts) > 10
    for text in texts:
        numbers = text.replace("threshold", "0.9").replace("min_gap", "2")
        assert parse_function(numbers, {"NODDING": Function("curve", ("NODDING",))})


def test_documentation_names_the_capacities():
    text = " ".join(chapters()["Functions"].split())
    for what in (
        f"at most {formats.CURVES_MAX} different tables with {formats.SAMPLES_POOL} samples",
        f"{program.PROGRAMS_MAX} different expressions of {program.POOL_WORDS} words",
        f"and {program.WORDS_MAX} each",
        f"{formats.BLINKS_MAX} different pairs",
        f"Expressions have {TEXT_MAX} characters at most",
    ):
        assert what in text, what
    puppet = chapters()["The puppet"]
    for what in (
        f"{formats.DOFS_MAX} at most",
        f"{formats.ACTIONS_MAX} at most",
        f"{formats.MAPPINGS_MAX} mappings at most",
        f"{formats.LIVES_MAX} at most",
        f"2 to {formats.SAMPLES_MAX} samples",
    ):
        assert what in puppet, what
