"""Curves from CSV files: what comes out is the curve, normalised, and the error that is told is the error that there is."""

import math
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.cli import main
from marotte.curves import function_name, import_curve
from marotte.puppet_file import load_puppet
from marotte.tomlfile import FileMistakes
from tests.reference_functions import table_value

# What a script for Blender writes: a row a frame, from frame 1 on, angles in degrees.
BLENDER = "frame,Head.rotation_x,Head.rotation_z\n" + "".join(
    f"{frame},{20 * math.sin(2 * math.pi * (frame - 1) / 48):.6f},0\n" for frame in range(1, 97)
)
# Seconds and keyframes alone.
KEYFRAMES = "Time,Jaw\n10.0,0\n10.5,90\n11.5,45\n"
# What a spreadsheet in German writes.
SPREADSHEET = "\ufeffFrame;Lid\n0;0,5\n12;1,0\n\n24;-0,5\n36;0,25\n"


def csv_file(tmp_path, text):
    path = tmp_path / "curve.csv"
    path.write_text(text, "utf-8")
    return path


def test_curve_of_every_frame_is_taken_as_it_is(tmp_path):
    curve = import_curve(csv_file(tmp_path, BLENDER), "Head.rotation_x", 2.0)
    assert (curve.rows, len(curve.samples), curve.low, curve.high) == (48, 48, -20, 20)
    assert list(curve.samples) == pytest.approx([(1 + math.sin(2 * math.pi * i / 48)) / 2 for i in range(48)], abs=1e-5)
    assert curve.error_max <= 1e-5


def test_curve_of_keyframes_is_straight_between_them(tmp_path):
    curve = import_curve(csv_file(tmp_path, KEYFRAMES), "Jaw", 2.0, samples=8)
    assert list(curve.samples) == [0, 0.5, 1, 0.875, 0.75, 0.625, 0.5, 0.25]
    assert curve.error_max == 0


def test_curve_of_a_spreadsheet(tmp_path):
    curve = import_curve(csv_file(tmp_path, SPREADSHEET), "Lid", 1.6, frame_rate_hz=30)
    assert (curve.rows, curve.low, curve.high) == (4, -0.5, 1)
    assert list(curve.samples) == pytest.approx([2 / 3, 1, 0, 0.5], abs=1e-5)


def test_curve_without_a_time_is_spread_over_the_period(tmp_path):
    curve = import_curve(csv_file(tmp_path, "a\tb\n1\t0\n2\t4\n3\t1\n4\t3\n"), "b", 7.0)
    assert curve.samples == (0, 1, 0.25, 0.75)


def test_curve_that_ends_early_leads_back_and_says_so(tmp_path):
    curve = import_curve(csv_file(tmp_path, "time,a\n0,0\n1,1\n"), "a", 4.0, samples=4)
    assert curve.samples == pytest.approx((0, 1, 2 / 3, 1 / 3), abs=1e-5)
    assert "the last 3 s have no row" in curve.text("A")


@given(
    values=st.lists(st.integers(-1000, 1000), min_size=3, max_size=300).filter(lambda values: len(set(values)) > 1),
    samples=st.integers(2, 256),
)
def test_curve_error_is_the_distance_to_the_rows(tmp_path_factory, values, samples):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text("v\n" + "\n".join(map(str, values)) + "\n")
    curve = import_curve(path, "v", 1.0, samples)
    low, high = min(values), max(values)
    errors = [
        abs(table_value(curve.samples, i / len(values)) - (value - low) / (high - low))
        for i, value in enumerate(values)
    ]
    assert curve.error_max == pytest.approx(max(errors), abs=1e-9)
    assert curve.error_rms <= curve.error_max + 1e-5  # the samples are rounded
    assert all(0 <= sample <= 1 for sample in curve.samples)


def test_curve_is_text_that_a_puppet_file_takes(tmp_path, capsys):
    path = csv_file(tmp_path, BLENDER)
    assert main(["import-curve", str(path), "--column", "Head.rotation_x", "--period", "2", "--samples", "24"]) == 0
    text = capsys.readouterr().out
    assert "# Head.rotation_x of curve.csv: 48 rows in a period of 2 s, for a tempo of 0.5" in text
    assert "# -20 to 20 have become 0 to 1" in text
    assert len(tomllib.loads(text)["function"]["HEAD_ROTATION_X"]["table"]) == 24
    puppet = tmp_path / "p.toml"
    puppet.write_text(f'[dof.A]\n[action.NOD]\nmap = [["A", 0.2, 0.8, "HEAD_ROTATION_X"]]\n{text}')
    assert load_puppet(puppet).functions["HEAD_ROTATION_X"].samples[6] == 1


@pytest.mark.parametrize(
    ("text", "column", "expected"),
    [
        (BLENDER, "Neck", ":1 Neck: there is no such column; expected one of frame, Head.rotation_x"),
        (KEYFRAMES, "jaws", ':1 jaws: there is no such column; did you mean "Jaw"?'),
        (BLENDER, "Head.rotation_z", "Head.rotation_z: is 0 throughout, expected a curve"),
        ("time,a\n0,1\n1,x\n2,\n3,nan\n", "a", ':3 a: found "x", expected a number'),
        ("time,a\n0,1\n1,x\n2,\n3,nan\n", "a", ':4 a: found "", expected a number'),
        ("time,a\n0,1\n1,x\n2,\n3,nan\n", "a", ':5 a: found "nan", expected a number'),
        ("time,a\nx,1\n1,2\n", "a", ':2 time: found "x", expected a number'),
        ("time,a\n0,1\n0,2\n", "a", ":3 time: time does not increase"),
        ("time,a\n0,1\n9,2\n", "a", "a: has 1 row in a period of 2 s, expected a curve"),
        ("a\n", "a", "a: has no row, expected at least two"),
        ("", "a", "there is no such column"),
    ],
)
def test_curve_mistake_is_named_and_placed(tmp_path, text, column, expected):
    with pytest.raises(FileMistakes) as mistakes:
        import_curve(csv_file(tmp_path, text), column, 2.0)
    assert expected in str(mistakes.value)


def test_curve_file_that_cannot_be_read(tmp_path, capsys):
    assert main(["import-curve", str(tmp_path / "none.csv"), "--column", "a", "--period", "1"]) == 2
    assert "none.csv: cannot be read: no such file" in capsys.readouterr().err
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00a")
    assert main(["import-curve", str(tmp_path / "bytes.csv"), "--column", "a", "--period", "1"]) == 2


@pytest.mark.parametrize(
    "options", [["--samples", "1"], ["--samples", "257"], ["--name", "rsin"], ["--name", "A B"], ["--period", "0"]]
)
def test_curve_options_are_checked(options, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["import-curve", "x.csv", "--column", "a", "--period", "1", *options])
    assert exit_.value.code == 2
    assert "expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "name"), [("Head.rotation_x", "HEAD_ROTATION_X"), ("3", "CURVE_3"), ("", "CURVE"), ("Küste", "K_STE")]
)
def test_function_name_is_an_identifier(text, name):
    assert function_name(text) == name
