"""Files as nobody would write them: read, or refused with their name and the place of what is wrong, in bounded time."""

import contextlib
import copy
import json
import os
import random
import signal
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marotte.check import check_files
from marotte.curves import BYTES_MAX as CSV_BYTES_MAX
from marotte.curves import import_curve
from marotte.errors import MarotteError
from marotte.keeping import kept
from marotte.positions import line_numbers
from marotte.puppet_file import load_puppet, read_puppet
from marotte.score import read_score
from marotte.tables import build_tables
from marotte.textfile import BYTES_MAX
from marotte.tomlfile import MISTAKES_MAX
from marotte.wiring import read_robot
from tests.generate import random_puppet, random_score

PUPPETS = Path(__file__).parents[2] / "puppets"
PET = load_puppet(PUPPETS / "pet.toml")
NAMES = ("pet.toml", "pet-score.toml", "pet-robot.toml", "pet-robot-pca9685.toml")
TEXTS = {name: (PUPPETS / name).read_text("utf-8") for name in NAMES}
LIMIT_S = 30
"""No file may take longer. It is a hundred times what most of the worst take."""

MISTAKE_MAX = 1500
"""Longest text of one mistake, in characters."""

SOAK_EXAMPLES = 5_000


@contextlib.contextmanager
def time_limit():
    """Fail what takes longer than LIMIT_S, even if it would never end."""

    def end(number, frame):
        raise AssertionError(f"still reading after {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def readings(path):
    """Read a file as each kind of file; return the mistakes of each."""
    puppet, mistakes = read_puppet(path)
    score, score_mistakes = read_score(path, PET)
    robot, robot_mistakes = read_robot(path, PET)
    if not mistakes:
        assert kept(build_tables(puppet))
    if not score_mistakes:
        assert score.steps(PET)
    if not robot_mistakes:
        assert kept(build_tables(PET, robot))
    return mistakes, score_mistakes, robot_mistakes


def check_readings(path):
    """Check that a file is read or refused, whatever it is taken for."""
    with time_limit():
        told = readings(path)
        report = check_files([path])
    for mistakes in (*told, report.mistakes):
        assert len(mistakes) <= MISTAKES_MAX + 1
        for mistake in mistakes:
            assert mistake.file == str(path) and mistake.text.strip()
            assert len(str(mistake)) - len(mistake.file) < MISTAKE_MAX
    return told


# --- values of TOML put in the place of others

numbers = st.one_of(
    st.integers(-5, 5),
    st.sampled_from([2**31, 2**63, -(2**63), 2**64, 10**30, 10**300, -(10**400)]),
    st.sampled_from(
        ["nan", "inf", "-inf", "1e-999999999", "1e999999999", "-0.0", "1e308", "4.9e-324", "0." + "3" * 900]
    ),
    st.floats(-10, 10).map(repr),
)
texts = st.one_of(
    st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
    st.sampled_from(
        ["rsin", "noise17", "blink(9)", "live(A)", "table(T, t)", "0*t", "rsin(1e9*t)", "min(1)", "a" * 3000]
    ),
    st.text("0123456789.+-*/() ,trsincolive", max_size=60),
    st.integers(1, 400).map(lambda depth: "abs(" * depth + "1" + ")" * depth),
)
scalars = st.one_of(
    numbers, texts.map(json.dumps), st.sampled_from(["true", "false", "1979-05-27T07:32:00Z", "07:32:00"])
)
nested = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=5).map(lambda items: "[" + ", ".join(map(str, items)) + "]")
        | st.dictionaries(st.sampled_from(["a", "range", "map", "f"]), inner, max_size=3).map(
            lambda items: "{" + ", ".join(f"{key} = {value}" for key, value in items.items()) + "}"
        )
    ),
    max_leaves=12,
)


class Raw(str):
    """Text that goes into a TOML file as it is."""


def as_toml(value):
    """Return a value as TOML, tables inline."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {as_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else str(value)


def places(value, path=()):
    """Yield the paths of all values in a document."""
    for key in value if isinstance(value, dict) else range(len(value)):
        yield (*path, key)
        if isinstance(value[key], dict | list):
            yield from places(value[key], (*path, key))


@st.composite
def changed_documents(draw):
    """A good document with one to four values replaced, keys renamed or taken away."""
    rng = random.Random(draw(st.integers(0, 20)))
    puppet = random_puppet(rng, level="full", gains=False)
    generated = [puppet, random_score(rng, puppet, 5, level="full", gains=False)]
    document = copy.deepcopy(draw(st.sampled_from([*map(tomllib.loads, TEXTS.values()), *generated])))
    for _ in range(draw(st.integers(1, 4))):
        known = list(places(document))
        if not known:
            break
        *outer, key = draw(st.sampled_from(known))
        inside = document
        for step in outer:
            inside = inside[step]
        how = draw(st.sampled_from(["replace", "replace", "replace", "rename", "drop", "copy"]))
        if how == "replace":
            inside[key] = Raw(draw(nested))
        elif how == "drop":
            del inside[key]
        elif how == "copy" and isinstance(inside, list):
            inside.insert(key, copy.deepcopy(inside[key]))
        elif how == "rename" and isinstance(inside, dict):
            inside[draw(texts | st.sampled_from(["global", "t", "rsin", "A", ""]))] = inside.pop(key)
    return "\n".join(f"{json.dumps(key)} = {as_toml(value)}" for key, value in document.items())


@given(changed_documents())
def test_documents_with_any_values_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    path.write_text(text, "utf-8", newline="")
    check_readings(path)


@st.composite
def changed_texts(draw):
    """The bytes of a good file with pieces lost, doubled and replaced."""
    data = bytearray(draw(st.sampled_from(list(TEXTS.values()))).encode())
    for _ in range(draw(st.integers(1, 5))):
        place = draw(st.integers(0, len(data)))
        end = place + draw(st.sampled_from([0, 1, 1, 3, 40]))
        pieces = st.binary(max_size=6) | st.sampled_from([b"\n", b"[", b"]", b"'''", b'"', b"=", b"[[", b"\xff", b"#"])
        data[place:end] = draw(pieces | st.just(bytes(data[place:end]) * 2))
    return bytes(data)


@given(changed_texts())
def test_texts_with_any_damage_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.toml"
    path.write_bytes(data)
    check_readings(path)


@pytest.mark.soak
@settings(max_examples=SOAK_EXAMPLES)
@given(changed_documents())
def test_many_documents_with_any_values_are_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    path.write_text(text, "utf-8", newline="")
    check_readings(path)


@pytest.mark.soak
@settings(max_examples=SOAK_EXAMPLES)
@given(changed_texts())
def test_many_texts_with_any_damage_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.toml"
    path.write_bytes(data)
    check_readings(path)


@given(st.text(max_size=300))
def test_places_of_any_text_are_found_or_not(text):
    with time_limit():
        assert isinstance(line_numbers(text), dict)


# --- files that are large or deep


def filled(full, line, head="", tail=""):
    """Return a file of nearly so many bytes: `line` again and again, each with its number in the place of `#`."""
    count = (full - len(head) - len(tail)) // (len(line) + 5 * line.count("#"))
    return head + "".join(line.replace("#", str(number)) for number in range(count)) + tail


def heavy(full):
    """Return files of about so many bytes, by what they are full of."""
    return {
        "nothing": "",
        "one name": "a" * full + " = 1",
        "one DOF": f"[dof.{'A' * full}]",
        "unknown keys": filled(full, "K# = 1\n"),
        "unknown keys that are like known ones": filled(full, "frame_rat# = 1\n"),
        "DOFs": filled(full, "[dof.A#]\n"),
        "DOFs with mistakes": filled(full, "[dof.A#]\nrest = 7\n"),
        "mappings": filled(full, '["A#", 0, 1, "rsin"],\n', "[dof.A]\n[action.B]\nmap = [\n", "]"),
        "mappings with different expressions": filled(
            full, '["A", 0, 1, "rsin(#*t)+noise3(t/#)"],\n', "[dof.A]\n[action.B]\nmap = [\n", "]"
        ),
        "actions": filled(full, '[action.A#]\nmap = [["A", 0, 1, "rsin"]]\n', "[dof.A]\n"),
        "actions and a behaviour of all": filled(full, '[action.A#]\nmap = [["A", 0, 1, "rsin"]]\n', "[dof.A]\n")[
            : full // 2 - 60
        ]
        + "\n[behaviour.B]\n"
        + filled(full, "A# = 1\n")[: full // 2],
        "a behaviour of unknown actions": filled(
            full, "A# = 1\n", '[dof.A]\n[action.AA]\nmap = [["A", 0, 1, "rsin"]]\n[behaviour.B]\n'
        ),
        "cues": filled(full, '[[cue]]\nat = 0.#\nbehaviour = "CALM"\n'),
        "cues with mistakes": filled(full, '[[cue]]\nat = "#"\nbehaviour = "CALN"\nmood = 3\nx = 1\n'),
        "outputs": filled(full, "[output.A#]\npin = 2\n"),
        "chips": filled(full, "[chip.A#]\nsda = 4\nscl = 5\noe = 6\n"),
        "functions": filled(full, '[function.A#]\nexpr = "rsin(t)"\n', "[dof.A]\n"),
        "samples": filled(full, "0.5,\n", "[dof.A]\n[function.A]\ntable = [\n", "]"),
        "one expression": f'[dof.A]\n[action.A]\nmap = [["A", 0, 1, "{"1+" * (full // 2 - 60)}1"]]',
        "one text": f'name = "{"x" * full}"',
        "one text of escapes": f'name = "{chr(92) * 2 * (full // 2 - 20)}"',
        "one long text": f"name = '''{'x' * full}'''",
        "one number of many digits": f"noise_spread = 0.{'3' * full}",
        "one integer of many digits": f"seed = {'3' * full}",
        "one integer of as many digits as are read": f"seed = {'3' * 4300}",
        "hexadecimal": f"seed = 0x{'f' * full}",
        "arrays in arrays": f"name = {'[' * (full // 2)}{']' * (full // 2)}",
        "arrays as deep as they are read": f"name = {'[' * 300}{']' * 300}\nseed = {'[' * 450}{']' * 450}",
        "tables in tables": "name = " + "{a = " * (full // 6) + "1" + "}" * (full // 6),
        "a dotted key": ".".join("a" * (full // 2)) + " = 1",
        "dotted keys": filled(full, ".".join("a" * 500) + ".b# = 1\n"),
        "dotted headers": filled(full, "[" + ".".join("a" * 500) + ".b#]\n"),
        "brackets": "[" * full,
        "quotes": '"' * full,
        "triple quotes": "'''" * (full // 3),
        "backslashes": 'name = "' + "\\" * full,
        "points": "." * full,
        "newlines": "\n" * full,
        "spaces": "name = " + " " * full,
        "comments": filled(full, "# a comment with a number: #\n"),
        "carriage returns": "\r" * full,
        "a byte order mark": "\ufeffname = 'x'",
        "null characters": "\0" * full,
        "times of cues": "[[cue]]\nat = 1e-999999999\n[[cue]]\nat = 0." + "0" * 5000 + "1\n[[cue]]\nat = 1e999999999\n",
    }


KINDS = list(heavy(1000))


@pytest.mark.parametrize("kind", KINDS)
def test_heavy_file_is_read_or_refused_in_bounded_time(tmp_path, kind):
    check_heavy(tmp_path / "heavy.toml", heavy(BYTES_MAX // 32)[kind])


@pytest.mark.soak
@pytest.mark.parametrize("kind", KINDS)
def test_file_of_the_greatest_size_is_read_or_refused_in_bounded_time(tmp_path, kind):
    check_heavy(tmp_path / "heavy.toml", heavy(BYTES_MAX - 100)[kind])


def check_heavy(path, text):
    path.write_text(text, "utf-8", newline="")
    assert path.stat().st_size <= BYTES_MAX
    assert any(map(bool, check_readings(path)))


# --- what is no text file

NO_FILES = {
    "a folder": (lambda path: path.mkdir(), "cannot be read: is a directory"),
    "a pipe": (os.mkfifo, "cannot be read: is a device, a pipe or a socket, expected a file"),
    "a device without an end": (lambda path: path.symlink_to("/dev/zero"), "is a device, a pipe or a socket"),
    "a link to itself": (lambda path: path.symlink_to(path), "cannot be read: too many levels of symbolic links"),
    "bytes": (lambda path: path.write_bytes(b"name = '\xff'"), "found the byte 0xff, expected a text file in UTF-8"),
    "half a character": (
        lambda path: path.write_bytes(b"name = '\xe2\x82"),
        "found the byte 0xe2, expected a text file",
    ),
    "nothing": (lambda path: None, "cannot be read: no such file or directory"),
}


@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_text_file_is_refused(tmp_path, kind):
    make, expected = NO_FILES[kind]
    path = tmp_path / "file"
    make(path)
    for mistakes in check_readings(path):
        assert [expected in str(mistake) for mistake in mistakes] == [True]
    with time_limit(), pytest.raises(MarotteError, match="file: ") as refusal:
        import_curve(path, "a", 1.0)
    assert expected in str(refusal.value)


def test_file_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text("#" * (BYTES_MAX + 1))
    for mistakes in check_readings(path):
        assert [str(mistake) for mistake in mistakes] == [
            f"{path}: is larger than {BYTES_MAX} bytes, expected a smaller file"
        ]


def test_names_with_a_null_character_name_no_file():
    for mistakes in check_readings("a\0b"):
        assert [mistake.text for mistake in mistakes] == ["cannot be read: no such file"]


def test_reading_stops_after_many_mistakes_and_says_so(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("[dof.A]\n" + "".join(f"k{number} = 1\n" for number in range(MISTAKES_MAX + 1)))
    _, mistakes = read_puppet(path)
    assert len(mistakes) == MISTAKES_MAX + 1
    assert [mistake.line for mistake in mistakes[:-1]] == list(range(2, MISTAKES_MAX + 2))
    assert str(mistakes[-1]) == f"{path}: has more mistakes, which were not looked for"


# --- curves

CELLS = st.sampled_from(["0", "1", "2.5", "-3", "1e308", "-1e308", "1e-320", "nan", "inf", "", '"', "a,b", "\0", "1_0"])


@given(st.lists(st.lists(CELLS, max_size=4), max_size=8), st.sampled_from([",", ";", "\t"]), st.floats(1e-3, 1e6))
def test_curves_of_any_cells_are_read_or_refused(tmp_path_factory, rows, delimiter, period_s):
    path = tmp_path_factory.getbasetemp() / "curve.csv"
    path.write_text("\n".join(["time,a".replace(",", delimiter), *map(delimiter.join, rows)]), "utf-8", newline="")
    check_curve(path, period_s)


@given(st.binary(max_size=300))
def test_curves_of_any_bytes_are_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "bytes.csv"
    path.write_bytes(data)
    check_curve(path, 1.0)


def heavy_curves(full):
    """Return CSV files of about so many bytes, by what they are full of."""
    return {
        "rows": "a\n" + "1\n0\n" * (full // 4),
        "bad rows": "a\n" + "x\n" * (full // 2),
        "one name": "a" * full,
        "names": "a," * (full // 2),
        "one cell": 'a\n"' + "1" * full,
        "quotes": '"' * full,
        "digits": "a\n" + "1" * min(full, 200_000),
        "more than is read": "a\n" + "1\n" * CSV_BYTES_MAX,
    }


@pytest.mark.parametrize("kind", heavy_curves(0))
def test_heavy_curve_is_read_or_refused_in_bounded_time(tmp_path, kind):
    path = tmp_path / "heavy.csv"
    path.write_text(heavy_curves(CSV_BYTES_MAX // 32)[kind])
    check_curve(path, 1.0)


@pytest.mark.soak
@pytest.mark.parametrize("kind", heavy_curves(0))
def test_curve_of_the_greatest_size_is_read_or_refused_in_bounded_time(tmp_path, kind):
    path = tmp_path / "heavy.csv"
    path.write_text(heavy_curves(CSV_BYTES_MAX - 10)[kind])
    check_curve(path, 1.0)


def check_curve(path, period_s):
    with time_limit():
        try:
            curve = import_curve(path, "a", period_s)
        except MarotteError as error:
            assert str(error).startswith(str(path)) and len(str(error)) < 20 * MISTAKE_MAX
        else:
            assert all(0 <= sample <= 1 for sample in curve.samples) and curve.text("A")
