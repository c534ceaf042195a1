"""Puppet files: what is read, and that every mistake is found, named and placed."""

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.functions import Function, FunctionError, parse_function
from marotte.kalman import Kalman
from marotte.positions import line_numbers
from marotte.puppet import Character
from marotte.puppet_file import load_puppet, read_puppet
from marotte.tomlfile import FileMistakes, key_text
from shared import formats, program

PET = Path(__file__).parents[2] / "puppets" / "pet.toml"

GOOD = """
name = "test"
frame_rate = 25
seed = 7
noise_spread = 0.5
[dof.NECK]
rest = 0.25
limits = [0.1, 0.9]
signal = false
[dof.WHEEL]
kind = "relative"
[live.GAZE]
rest = 0.75
tau = [0.2, 0.3]
[action.NOD]
tempo = 2
tau = 0.5
map = [ ["NECK", 0.9, 0.1, "noise16"], ["WHEEL", -1, 1.0, "live(GAZE)"] ]
[action.STILL]
map = [ ["NECK", 0.5, 0.5, "const(0.25)"], ["WHEEL", 0, 0, "live(UNDECLARED)"] ]
[behaviour.HAPPY]
NOD = 4
STILL = 0.05
[mood.CALM]
gains = [2.5, -4, 0, 4, 1, 1.0, 1]
tempo = 0.25
"""


def mistakes_of(tmp_path, text):
    path = tmp_path / "puppet.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    _, mistakes = read_puppet(path)
    if mistakes:
        with pytest.raises(FileMistakes):
            load_puppet(path)
    return [str(mistake).removeprefix(str(path)) for mistake in mistakes]


def test_puppet_reads_everything(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(GOOD)
    puppet = load_puppet(path)
    assert (puppet.name, puppet.frame_rate_hz, puppet.seed, puppet.noise_spread) == ("test", 25, 7, 0.5)
    neck, wheel = puppet.dofs.values()
    assert (neck.rest, neck.limits, neck.signal, neck.is_relative) == (0.25, (0.1, 0.9), False, False)
    assert (wheel.rest, wheel.limits, wheel.signal, wheel.is_relative) == (0.0, (-1.0, 1.0), False, True)
    nod, still = puppet.actions.values()
    assert (nod.tempo, nod.tau_s, nod.entry) == (2.0, (0.5, 0.5), "sync")
    assert (still.tempo, still.tau_s) == (1.0, (0.25, 0.25))
    assert nod.mappings[0].function == Function("noise", (16,))
    assert (nod.mappings[0].low, nod.mappings[0].high) == (0.9, 0.1)
    assert nod.mappings[1].function == Function("live", ("GAZE",))
    assert still.mappings[0].function == Function("const", (0.25,))
    assert list(puppet.lives) == ["GAZE", "UNDECLARED"]
    assert puppet.lives["GAZE"].tau_s == (0.2, 0.3)
    assert (puppet.lives["UNDECLARED"].rest, puppet.lives["UNDECLARED"].tau_s) == (0.5, (0.1, 0.1))
    assert puppet.behaviours["HAPPY"] == {"NOD": 4.0, "STILL": 0.05}
    assert (puppet.moods["CALM"].gains, puppet.moods["CALM"].tempo) == ((2.5, -4, 0, 4, 1, 1, 1), 0.25)
    assert (puppet.action_index("STILL"), puppet.live_index("UNDECLARED")) == (1, 1)


def test_puppet_defaults_are_those_of_the_documentation(tmp_path):
    path = tmp_path / "bare.toml"
    path.write_text("[dof.NECK]\n")
    puppet = load_puppet(path)
    assert (puppet.name, puppet.frame_rate_hz, puppet.noise_spread) == ("bare", 30, 0.0)
    neck = puppet.dofs["NECK"]
    assert (neck.kind, neck.rest, neck.limits, neck.signal, neck.character) == ("absolute", 0.5, (0, 1), True, None)
    assert (neck.speed, neck.accel, puppet.when_silent) == (None, None, "idle")


@pytest.mark.parametrize(
    ("old", "ends"),
    [
        ("frame_rate = 25", ["frame_rate = 10", "frame_rate = 60"]),
        ("seed = 7", ["seed = 0", "seed = 4294967295"]),
        ("tempo = 2", ["tempo = 0.05", "tempo = 8", "tempo = 8.0"]),
        ("tau = 0.5", ["tau = 0.03", "tau = 10.0", "tau = [0.03, 10]"]),
        ("tempo = 0.25", ["tempo = 0.25", "tempo = 4.00"]),
        ("noise_spread = 0.5", ["noise_spread = 0", "noise_spread = 1.0"]),
        ("NOD = 4", ["NOD = 0", "NOD = 4.0"]),
    ],
)
def test_puppet_ranges_include_their_ends(tmp_path, old, ends):
    for end in ends:
        assert mistakes_of(tmp_path, GOOD.replace(old, end, 1)) == []


def test_puppet_pet_is_complete():
    puppet = load_puppet(PET)
    expected = "EYEBROW EYELID UPPERLIP LOWERLIP HEAD_YAW HEAD_PITCH NECK WHEEL_LEFT WHEEL_RIGHT BACK"
    assert list(puppet.dofs) == expected.split()
    assert [dof.name for dof in puppet.dofs.values() if dof.is_relative] == ["WHEEL_LEFT", "WHEEL_RIGHT"]
    assert {"NEUTRAL_HEAD", "NEUTRAL_BODY", "HAPPY_FACE", "PIGEON_WALK", "RANDOMBLINK"} < set(puppet.actions)
    assert [name for name, action in puppet.actions.items() if action.cycles] == ["NOD", "SHAKE", "TREMBLE", "SIGH"]
    moved = {entry.dof for action in puppet.actions.values() for entry in action.mappings}
    assert moved == set(puppet.dofs)


# Text to append to or to put in the place of lines of GOOD, and what has to be said about it.
MISTAKES = [
    # the outermost keys
    ('name = "test"', "name = 3", ":2 name: found 3, expected a text"),
    ("frame_rate = 25", "frame_rate = 9", ":3 frame_rate: found 9, expected a whole number in 10..60"),
    ("frame_rate = 25", "frame_rate = 61", ":3 frame_rate: found 61, expected a whole number in 10..60"),
    ("frame_rate = 25", "frame_rate = 30.0", ":3 frame_rate: found 30.0, expected a whole number in 10..60"),
    ("frame_rate = 25", "frame_rate = true", ":3 frame_rate: found true, expected a whole number in 10..60"),
    ("seed = 7", "seed = -1", ":4 seed: found -1, expected a whole number in 0..4294967295"),
    ("seed = 7", "sed = 7", ':4 sed: unknown key; did you mean "seed"?'),
    ("seed = 7", "xyzzy = 7", ":4 xyzzy: unknown key; expected "),
    ("noise_spread = 0.5", "noise_spread = 1.01", ":5 noise_spread: found 1.01, expected a number in 0..1"),
    ("noise_spread = 0.5", "noise_spread = nan", ":5 noise_spread: found NaN, expected a number in 0..1"),
    ("noise_spread = 0.5", "noise_spread = inf", ":5 noise_spread: found Infinity, expected a number in 0..1"),
    ("seed = 7", 'when_silent = "sleep"', ':4 when_silent: found "sleep", expected "idle" or "rest" or "relax"'),
    # DOFs
    ("rest = 0.25", "rest = -0.1", ":7 dof.NECK.rest: found -0.1, expected a number in 0..1"),
    ("rest = 0.25", 'rest = "up"', ':7 dof.NECK.rest: found "up", expected a number in 0..1'),
    ("rest = 0.25", "rest = true", ":7 dof.NECK.rest: found true, expected a number in 0..1"),
    (
        "limits = [0.1, 0.9]",
        "limits = [0.9, 0.1]",
        ":8 dof.NECK.limits: found [0.9, 0.1], expected the least value first",
    ),
    ("limits = [0.1, 0.9]", "limits = [0.1]", ":8 dof.NECK.limits: found 1 values, expected 2"),
    ("limits = [0.1, 0.9]", "limits = 0.5", ":8 dof.NECK.limits: found 0.5, expected the least"),
    ("limits = [0.1, 0.9]", "limits = [-1, 0.9]", ":8 dof.NECK.limits[0]: found -1, expected a number in 0..1"),
    ("signal = false", "signal = 0", ":9 dof.NECK.signal: found 0, expected true or false"),
    ('kind = "relative"', 'kind = "wheel"', ':11 dof.WHEEL.kind: found "wheel", expected "absolute" or "relative"'),
    ('kind = "relative"', 'kind = "relative"\nrest = 0.5', ":12 dof.WHEEL.rest: found 0.5, expected 0"),
    ('kind = "relative"', 'kind = "relative"\nlimits = [-1.5, 1]', ":12 dof.WHEEL.limits[0]: found -1.5"),
    ('kind = "relative"', 'kind = "relative"\nkid = 1', ':12 dof.WHEEL.kid: unknown key; did you mean "kind"?'),
    ("[dof.WHEEL]", '[dof."A B"]', ":10 dof.'A B': expected a name of letters, digits, _ and -"),
    # live channels
    ("rest = 0.75", "rest = 2", ":13 live.GAZE.rest: found 2, expected a number in 0..1"),
    ("tau = [0.2, 0.3]", "tau = [0.2, 0.01]", ":14 live.GAZE.tau[1]: found 0.01, expected a number in 0.03..10"),
    ("tau = [0.2, 0.3]", "tau = [0.2, 0.3, 0.4]", ":14 live.GAZE.tau: found 3 values, expected 2"),
    ("tau = [0.2, 0.3]", 'predict = "guess"', ':14 live.GAZE.predict: found "guess", expected "hold" or "kalman"'),
    ("[live.GAZE]", "[live.GA-ZE]", ":12 live.GA-ZE: expected a name of letters, digits and _"),
    # actions
    ("tempo = 2", "tempo = 0.04", ":16 action.NOD.tempo: found 0.04, expected a number in 0.05..8"),
    ("tempo = 2", "tempo = 8.5", ":16 action.NOD.tempo: found 8.5, expected a number in 0.05..8"),
    ("tau = 0.5", "tau = 11", ":17 action.NOD.tau: found 11, expected a number in 0.03..10"),
    ("tau = 0.5", "warp = 0.01", ":17 action.NOD.warp: found 0.01, expected a number in 0.05..10"),
    ("tau = 0.5", "cycles = 0", ":17 action.NOD.cycles: found 0, expected a whole number in 1..1000"),
    ("tau = 0.5", "cycles = 2", ':17 action.NOD.cycles: only an action with entry = "start" has cycles'),
    ("tau = 0.5", 'entry = "now"', ':17 action.NOD.entry: found "now", expected "sync" or "start"'),
    ("[action.NOD]", "[action.global]", ':15 action.global: "global" names the master tempo'),
    ("[action.STILL]", "[action.X]\n[action.STILL]", ':19 action.X: has no "map"; expected'),
    ("[action.STILL]", "[action.X]\nmap = []\n[action.STILL]", ":20 action.X.map: is empty, expected"),
    ("[action.STILL]", '[action.X]\nmap = "NECK"\n[action.STILL]', ':20 action.X.map: found "NECK", expected an array'),
    # mappings
    ('["NECK", 0.9,', '["NEK", 0.9,', ':18 action.NOD.map[0][0]: unknown DOF "NEK"; did you mean "NECK"?'),
    ('["NECK", 0.9,', "[3, 0.9,", ":18 action.NOD.map[0][0]: unknown DOF 3"),
    ('["NECK", 0.9, 0.1', '["NECK", 1.4, 0.1', ":18 action.NOD.map[0][1]: found 1.4, expected a number in 0..1"),
    ('["NECK", 0.9, 0.1', '["NECK", 0.9, -0.1', ":18 action.NOD.map[0][2]: found -0.1, expected a number in 0..1"),
    ('["WHEEL", -1', '["WHEEL", -1.1', ":18 action.NOD.map[1][1]: found -1.1, expected a number in -1..1"),
    ('["WHEEL", -1', '["NECK", 1', ":18 action.NOD.map[1]: maps NECK again, expected it once; see map[0]"),
    (
        '["WHEEL", -1, 1.0, ',
        '["WHEEL", -1, ',
        ':18 action.NOD.map[1]: found ["WHEEL", -1, "live(GAZE)"], expected a map',
    ),
    (
        '"noise16"',
        '"noise17"',
        ':18 action.NOD.map[0][3]: found "noise17": unknown function "noise17"; expected noise1 to',
    ),
    ('"noise16"', '"noise0"', ':18 action.NOD.map[0][3]: found "noise0": unknown function'),
    ('"noise16"', '"rsine"', 'unknown function "rsine"; did you mean "rsin"?'),
    ('"noise16"', '"const"', "const needs its value"),
    ('"noise16"', '"const(1.5)"', "const has 1.5 as its value, expected a number in 0..1"),
    ('"noise16"', '"const(1, 2)"', "found const(1, 2), expected for const its value"),
    ('"noise16"', '"live"', "live needs its channel"),
    ('"noise16"', '"live(3)"', "live has 3 as its argument, expected the name of a channel"),
    ('"noise16"', '"9"', "9, expected all values in -8..8"),
    ('"noise16"', '"blink(2, 1)"', "blink has 2 as its threshold, expected a number in 0..1"),
    ('"noise16"', '"blink(0.5, 1001)"', "blink has 1001 as its least gap, expected a number in 0..1000"),
    ('"noise16"', '"0.5*blink(0.9, 1)"', "blink stands alone, not inside an expression"),
    ('"noise16"', '"rsin(t"', "not a function or expression"),
    ('"noise16"', '"rsin(t)**2"', "expected numbers, + - * /, and calls of functions"),
    ('"noise16"', '"open(t)"', 'unknown function "open"'),
    ('"noise16"', "7", 'found 7: expected a function in quotes, such as "noise1"'),
    # behaviours and moods
    ("NOD = 4", "NOD = 4.1", ":22 behaviour.HAPPY.NOD: found 4.1, expected a number in 0..4"),
    ("NOD = 4", "NOOD = 4", ':22 behaviour.HAPPY.NOOD: unknown action; did you mean "NOD"?'),
    ("tempo = 0.25", "tempo = 0.2", ":26 mood.CALM.tempo: found 0.2, expected a number in 0.25..4"),
    ("1.0, 1]", "1]", ":25 mood.CALM.gains: found 6 values, expected 7: the gains of the seven bands, highest first"),
    ("1.0, 1]", "4.5, 1]", ":25 mood.CALM.gains[5]: found 4.5, expected a number in -4..4"),
    # tables where there should be values, and the other way round
    ("[dof.WHEEL]", "[dof.WHEEL.extra]", ":10 dof.WHEEL.extra: unknown key"),
    ("seed = 7", "function = 3", ":4 function: found 3, expected a table"),
    # TOML itself
    ("seed = 7", "seed = ", ":4: not valid TOML: invalid value in column 8"),
    ("seed = 7", "seed = 7\nseed = 8", ":5: not valid TOML: cannot overwrite a value"),
    ("[dof.WHEEL]", "[dof.NECK]", ":10: not valid TOML: cannot declare"),
    ("seed = 7", "seed = " + "9" * 5000, ": holds a number that is too long to be read"),
    ("seed = 7", "seed = " + "[" * 100_000, ": is nested too deeply"),
    ("noise_spread = 0.5", "noise_spread = 1e99999999999999999999", ":5 noise_spread: found Infinity"),
]


@pytest.mark.parametrize(("old", "new", "expected"), MISTAKES, ids=[expected[:60] for _, _, expected in MISTAKES])
def test_puppet_mistake_is_named_and_placed(tmp_path, old, new, expected):
    assert old in GOOD
    found = mistakes_of(tmp_path, GOOD.replace(old, new, 1))
    assert any(expected in line for line in found), found


BLINKING = """
[dof.EYELID]
signal = true
[dof.LAMP]
kind = "relative"
[action.LOOK]
map = [["LAMP", 0, 1, "rsin"]]
[action.WINK]
map = [["LAMP", 0, 1, "rtrigsin(0.9, 1)"], ["EYELID", 0, 1, "blink"]]
[action.DOZE]
map = [["EYELID", 0, 1, "blink"]]
"""


def test_puppet_signal_of_a_dof_that_blinks_is_a_mistake_that_names_the_mapping(tmp_path):
    text = ":3 dof.EYELID.signal: found true, expected false: action.WINK.map[1] makes it blink, and nobody knows when it will"
    assert mistakes_of(tmp_path, BLINKING) == [text]
    (found,) = mistakes_of(
        tmp_path, BLINKING.replace("signal = true", "").replace('"relative"', '"relative"\nsignal = true')
    )
    assert "dof.LAMP.signal: found true, expected false: action.WINK.map[0] makes it blink" in found


@pytest.mark.parametrize(
    ("text", "signals"),
    [
        ("", [True, False]),
        ("[dof.C]\nsignal = false\n", [True, False, False]),
        ('[dof.C]\nkind = "relative"\nsignal = true\n', [True, False, True]),
        ('[dof.C]\n[action.WINK]\nmap = [["A", 0, 1, "blink"], ["C", 0, 1, "noise1"]]\n', [False, False, True]),
    ],
)
def test_puppet_signal_is_processed_where_it_is_absolute_and_never_blinks_unless_the_file_says(tmp_path, text, signals):
    path = tmp_path / "p.toml"
    path.write_text('[dof.A]\n[dof.B]\nkind = "relative"\n' + text)
    assert [dof.signal for dof in load_puppet(path).dofs.values()] == signals


def test_puppet_reads_how_live_channels_are_predicted(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text('[dof.A]\n[live.X]\n[live.Y]\npredict = "kalman"\nagility = 9\nnoise = 0.02\nfade = 0.25\n')
    plain, predicted = load_puppet(path).lives.values()
    assert (plain.kalman, predicted.kalman) == (None, Kalman(0.02, 9.0, 0.25))


@pytest.mark.parametrize("key", ["agility", "noise", "fade"])
def test_puppet_parameters_of_a_prediction_that_there_is_not_are_a_mistake(tmp_path, key):
    found = mistakes_of(tmp_path, f"[dof.A]\n[live.X]\n{key} = 0.1\n")
    assert found == [f':3 live.X.{key}: only a channel with predict = "kalman" has {key}']


MOTOR = """
when_silent = "relax"
[dof.NECK]
limits = { range = [0.1, 0.9], speed = 3.0, accel = 25 }
character = { f = 2.0, zeta = 0.5, r = -1.5 }
[dof.JAW]
limits = { accel = 1 }
character = { f = 10 }
[dof.WHEEL]
kind = "relative"
limits = { range = [-0.5, 1], accel = 4 }
[dof.CASTOR]
kind = "relative"
limits = [-1, 0]
"""


def test_puppet_reads_limits_and_characters(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(MOTOR)
    puppet = load_puppet(path)
    neck, jaw, wheel, castor = puppet.dofs.values()
    assert puppet.when_silent == "relax"
    assert (neck.limits, neck.speed, neck.accel) == ((0.1, 0.9), 3.0, 25.0)
    assert neck.character == Character(2.0, 0.5, -1.5)
    assert (jaw.limits, jaw.speed, jaw.accel, jaw.character) == ((0, 1), None, 1, Character(10, 1, 0))
    assert (wheel.limits, wheel.speed, wheel.accel) == ((-0.5, 1), None, 4)
    assert (castor.limits, castor.speed, castor.accel) == ((-1, 0), None, None)


MOTOR_MISTAKES = [
    ("speed = 3.0", "speed = 0.04", ":4 dof.NECK.limits.speed: found 0.04, expected a number in 0.05..50"),
    ("speed = 3.0", "speed = 50.1", ":4 dof.NECK.limits.speed: found 50.1, expected a number in 0.05..50"),
    ("accel = 25", "accel = 0.9", ":4 dof.NECK.limits.accel: found 0.9, expected a number in 1..1000"),
    ("accel = 25", "accel = 1001", ":4 dof.NECK.limits.accel: found 1001, expected a number in 1..1000"),
    ("accel = 25", "acel = 25", ':4 dof.NECK.limits.acel: unknown key; did you mean "accel"?'),
    (
        "range = [0.1, 0.9]",
        "range = [0.9, 0.1]",
        ":4 dof.NECK.limits.range: found [0.9, 0.1], expected the least value",
    ),
    ("range = [0.1, 0.9]", "range = [-0.1, 0.9]", ":4 dof.NECK.limits.range[0]: found -0.1, expected a number in 0..1"),
    ("accel = 4", "accel = 3.9", ":11 dof.WHEEL.limits.accel: found 3.9, expected a number in 4..1000"),
    ("accel = 4", "speed = 4", ":11 dof.WHEEL.limits.speed: a relative DOF has none, as its range is its top speed"),
    ("range = [-0.5, 1]", "range = [0.5, 1]", ":11 dof.WHEEL.limits.range: found [0.5, 1], expected 0 within"),
    ("limits = [-1, 0]", "limits = [-1, -0.5]", ":14 dof.CASTOR.limits: found [-1, -0.5], expected 0 within"),
    ("f = 2.0", "f = 0.1", ":5 dof.NECK.character.f: found 0.1, expected a number in 0.2..10"),
    ("f = 2.0", "f = 10.1", ":5 dof.NECK.character.f: found 10.1, expected a number in 0.2..10"),
    ("zeta = 0.5", "zeta = 0", ":5 dof.NECK.character.zeta: found 0, expected a number in 0.1..3"),
    ("r = -1.5", "r = -4.5", ":5 dof.NECK.character.r: found -4.5, expected a number in -4..4"),
    ("r = -1.5", "q = 1", ":5 dof.NECK.character.q: unknown key"),
    ("f = 10", "zeta = 1", ':8 dof.JAW.character: has no "f"; expected a frequency in Hz, 0.2..10'),
    ("{ f = 10 }", "2.0", ":8 dof.JAW.character: found 2.0, expected a table"),
]


@pytest.mark.parametrize(("old", "new", "expected"), MOTOR_MISTAKES, ids=[case[2][:60] for case in MOTOR_MISTAKES])
def test_puppet_motor_mistake_is_named_and_placed(tmp_path, old, new, expected):
    assert old in MOTOR
    found = mistakes_of(tmp_path, MOTOR.replace(old, new, 1))
    assert any(expected in line for line in found), found


PERFORMED = """
[dof.NECK]
[dof.LID]
[dof.JAW]
[function.WINK]
expr = "blink(0.9, min_gap=3)"
[function.SUM]
expr = "table(SHAPE, 2*t)/2 + 0.5*live(LATE)"
[function.SHAPE]
table = [0, 0.5, 1]
[action.NOD]
entry = "start"
cycles = 2
warp = 0.75
map = [["NECK", 0.2, 0.8, "SUM"], ["LID", 0, 1, "WINK"], ["JAW", 0, 1, "SHAPE"]]
[action.REST]
map = [["NECK", 0, 1, "table(SHAPE)"], ["LID", 0, 1, "rcos(t - 3)"], ["JAW", 0, 1, "clamp(2*noise3(t))"]]
"""


def test_puppet_reads_functions_and_gestures(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(PERFORMED)
    puppet = load_puppet(path)
    nod, rest = puppet.actions.values()
    assert (nod.entry, nod.cycles, nod.warp_s) == ("start", 2, 0.75)
    assert (rest.entry, rest.cycles, rest.warp_s) == ("sync", None, 0.5)
    assert [entry.function.kind for entry in nod.mappings] == ["program", "blink", "curve"]
    assert [entry.function.kind for entry in rest.mappings] == ["curve", "rcos", "program"]
    assert nod.mappings[1].function == Function("blink", (0.9, 3.0))
    assert puppet.functions["SHAPE"].samples == (0, 0.5, 1)
    assert list(puppet.functions) == ["WINK", "SUM", "SHAPE"]
    assert list(puppet.lives) == ["LATE"]
    assert [dof.signal for dof in puppet.dofs.values()] == [True, False, True]


FUNCTION_MISTAKES = [
    ('expr = "rsin(t)"\ntable = [0, 1]', 'has both, expected one of "expr" and "table"'),
    ("", 'has neither, expected one of "expr" and "table"'),
    ("table = [0]", "found 1 samples, expected 2..256"),
    ("table = [0, 1.5]", "function.F.table[1]: found 1.5, expected a number in 0..1"),
    ('expr = "rsin(t) +"', "not a function or expression"),
    ('expr = "rsin(t)"\nexp = 1', 'unknown key; did you mean "expr"?'),
    ('expr = "rsin(t) + G(t)"\n[function.G]\ntable = [0, 1]', '"G" is a table: write table(G, t)'),
    ('expr = "table(G)"\n[function.G]\nexpr = "rsin(t)"', 'unknown table "G"; expected a [function.G] with a table'),
    ('expr = "9*rsin(t)"', "9 * rsin(t) can be 0 to 9, expected all values in -8..8"),
    ('expr = ""', "not a function or expression"),
]


@pytest.mark.parametrize(("body", "expected"), FUNCTION_MISTAKES)
def test_puppet_function_mistake_is_named(tmp_path, body, expected):
    assert any(expected in line for line in mistakes_of(tmp_path, f"{GOOD}[function.F]\n{body}\n"))


@pytest.mark.parametrize("name", ["rsin", "noise3", "blink", "const", "t"])
def test_puppet_function_cannot_have_a_primitives_name(tmp_path, name):
    found = mistakes_of(tmp_path, f'{GOOD}[function.{name}]\nexpr = "rcos(t)"\n')
    assert any("is the name of a primitive" in line for line in found)


def test_puppet_blinking_dof_has_no_signal_processing(tmp_path):
    text = GOOD.replace("signal = false", "signal = true").replace("noise16", "blink")
    assert any("dof.NECK.signal: found true, expected false" in line for line in mistakes_of(tmp_path, text))


def test_puppet_reports_all_mistakes_in_order_of_lines(tmp_path):
    text = (
        GOOD.replace("frame_rate = 25", "frame_rate = 5")
        .replace("tempo = 2", "tempo = 20")
        .replace("NOD = 4", "NOD = 40")
    )
    found = mistakes_of(tmp_path, text.replace('"NECK", 0.9', '"NCK", 1.9'))
    keys = ["frame_rate", "action.NOD.tempo", "action.NOD.map[0][0]", "action.NOD.map[0][1]", "behaviour.HAPPY.NOD"]
    assert [re.search(r" (\S+):", line)[1] for line in found] == keys


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("".join(f"[dof.D{i}]\n" for i in range(17)), "has 17 DOFs, expected at most 16"),
        (
            "[dof.A]\n" + "".join(f'[action.A{i}]\nmap=[["A",0,1,"rsin"]]\n' for i in range(65)),
            "has 65 actions, expected at most 64",
        ),
        ("[dof.A]\n" + "".join(f"[live.L{i}]\n" for i in range(17)), "has 17 live channels, expected at most 16"),
        (
            "".join(f"[dof.D{i}]\n" for i in range(16))
            + "".join(
                f"[action.A{i}]\nmap=[" + ",".join(f'["D{j}",0,1,"rsin"]' for j in range(16)) + "]\n" for i in range(33)
            ),
            "has 528 mappings, expected at most 512",
        ),
        ("", "has no DOF, expected at least one"),
    ],
)
def test_puppet_counts_are_held_to_the_capacity(tmp_path, text, expected):
    assert any(expected in line for line in mistakes_of(tmp_path, text))


def mapped(texts, functions=""):
    """Return a puppet whose mappings have these functions, spread over 16 DOFs."""
    text = "".join(f"[dof.D{j}]\n" for j in range(16)) + functions
    for i in range(0, len(texts), 16):
        rows = ",".join(f'["D{j}", 0, 1, "{function}"]' for j, function in enumerate(texts[i : i + 16]))
        text += f"[action.A{i}]\nmap = [{rows}]\n"
    return text


def tables(count, samples):
    """Return the text of so many different table functions."""
    return "".join(f"[function.C{i}]\ntable = [{i / count}{', 0.5' * (samples - 1)}]\n" for i in range(count))


LONG = "+".join(["noise1(t)"] * 7)
LONG_WORDS = 7 * 5 + 6 + 3  # a noise and an ADD each, CONST and ADD of the number behind
CURVES, SAMPLES, PROGRAMS, WORDS, BLINKS = (
    formats.CURVES_MAX,
    formats.SAMPLES_POOL,
    program.PROGRAMS_MAX,
    program.POOL_WORDS // LONG_WORDS,
    formats.BLINKS_MAX,
)


@pytest.mark.parametrize(
    ("puppet", "count", "most", "what"),
    [
        (lambda n: mapped([f"C{i}" for i in range(n)], tables(n, 2)), CURVES, CURVES, "different tables in use"),
        (
            lambda n: mapped([f"C{i}" for i in range(n)], tables(n, 256)),
            SAMPLES // 256,
            SAMPLES,
            "samples of different tables in use",
        ),
        (
            lambda n: mapped([f"rsin(t + {i}/512)" for i in range(1, n + 1)]),
            PROGRAMS,
            PROGRAMS,
            "different expressions",
        ),
        (
            lambda n: mapped([f"{LONG} + {i / 1000}" for i in range(1, n + 1)]),
            WORDS,
            program.POOL_WORDS,
            "words of compiled expressions",
        ),
        (lambda n: mapped([f"blink(0.9, {i})" for i in range(n)]), BLINKS, BLINKS, "different pairs of threshold"),
    ],
)
def test_puppet_functions_are_held_to_the_capacity(tmp_path, puppet, count, most, what):
    assert mistakes_of(tmp_path, puppet(count)) == []
    (found,) = mistakes_of(tmp_path, puppet(count + 1))
    assert re.search(rf"(action|function): has \d+ {what}.*, expected at most {most}$", found)


def test_puppet_equal_functions_count_once(tmp_path):
    text = mapped(["rsin(t + 0.5)", "C0", "blink(0.9, 1)"] * 100, tables(1, 256))
    assert mistakes_of(tmp_path, text) == []


def test_puppet_of_full_capacity_is_fine(tmp_path):
    text = "".join(f"[dof.D{i}]\n" for i in range(16))
    for i in range(64):
        rows = ",".join(f'["D{(i + j) % 16}", 0, 1, "live(L{j})"]' for j in range(8))
        text += f"[action.A{i}]\nmap = [{rows}]\n"
    assert mistakes_of(tmp_path, text) == []


@pytest.mark.parametrize(
    ("name", "expected"), [("absent.toml", "cannot be read: no such file"), ("", "cannot be read: is a directory")]
)
def test_puppet_file_that_cannot_be_read(tmp_path, name, expected):
    _, mistakes = read_puppet(tmp_path / name)
    assert [mistake.text for mistake in mistakes] == [f"{expected} or directory" if "no such" in expected else expected]


def test_puppet_file_that_is_no_text(tmp_path):
    assert mistakes_of(tmp_path, b"name = \xff\xfe") == [": found the byte 0xff, expected a text file in UTF-8"]


def test_line_numbers_of_every_form():
    text = """# comment with [brackets] = "x"
top = 1
"quoted key" = 2
dotted.key = 3
long = \"\"\"
[not.a.header]
x = 1
\"\"\"
raw = '''
y = ]
'''
array = [ 1,  # one ]
  [2, { a = "]", b = 3 }],
]
[table.inner]
k = { x = 1,
  y = [4,
    5] }
[[list]]
k = 1
[[list]]
k = 2
[list.sub]
k = 3
"""
    expected = {
        ("top",): 2,
        ("quoted key",): 3,
        ("dotted", "key"): 4,
        ("long",): 5,
        ("raw",): 9,
        ("array",): 12,
        ("array", 0): 12,
        ("array", 1): 13,
        ("array", 1, 0): 13,
        ("array", 1, 1): 13,
        ("array", 1, 1, "a"): 13,
        ("array", 1, 1, "b"): 13,
        ("table", "inner"): 15,
        ("table", "inner", "k"): 16,
        ("table", "inner", "k", "x"): 16,
        ("table", "inner", "k", "y"): 17,
        ("table", "inner", "k", "y", 0): 17,
        ("table", "inner", "k", "y", 1): 18,
        ("list", 0): 19,
        ("list", 0, "k"): 20,
        ("list", 1): 21,
        ("list", 1, "k"): 22,
        ("list", 1, "sub"): 23,
        ("list", 1, "sub", "k"): 24,
    }
    assert line_numbers(text) == expected
    assert line_numbers(text.replace("\n", "\r\n")) == expected


def test_line_numbers_stop_where_they_are_unsure():
    assert line_numbers('a = 1\n"b\\u0063" = 2\nd = 3\n') == {("a",): 1}


KEYS = st.sampled_from(
    ["dof", "action", "live", "mood", "behaviour", "function", "cue", "name", "seed", "map", "A", "é", "a b"]
)
SCALARS = st.one_of(
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(["noise1", "live(X)", "const(0.1)", "rsin(t)", "A", "relative"]),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=5) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=20
)


def toml_value(value):
    """Return a value in TOML's spelling."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(c if c.isalnum() and ord(c) < 0xD800 else f"\\U{ord(c):08x}" for c in value) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_value(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    return repr(value)


@given(tree=st.dictionaries(KEYS, VALUES, max_size=6), broken=st.text(max_size=3), at=st.integers(0, 400))
def test_puppet_reader_survives_anything(tmp_path_factory, tree, broken, at):
    text = "\n".join(f"{toml_value(key)} = {toml_value(value)}" for key, value in tree.items()).encode(
        "utf-8", "replace"
    )
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(text[:at] + broken.encode("utf-8", "replace") + text[at:])
    puppet, mistakes = read_puppet(path)
    for mistake in mistakes:
        assert str(mistake).startswith(str(path))
        assert "\n" not in str(mistake)
    if not mistakes:
        assert puppet.dofs


@given(tree=st.dictionaries(KEYS, VALUES, max_size=6))
def test_line_numbers_agree_with_the_text(tree):
    lines = [f"{toml_value(key)} = {toml_value(value)}" for key, value in tree.items() if key.isalnum()]
    found = line_numbers("\n".join(lines))
    for path, line in found.items():
        assert lines[line - 1].startswith(toml_value(path[0])), (path, line)


@given(text=st.text(max_size=60) | st.text(alphabet="rsincotable()+-*/.,t0123456789 ", max_size=60))
def test_function_text_is_a_function_or_a_mistake(text):
    try:
        assert parse_function(text, {"NOD": Function("curve", ("NOD",))}).kind
    except FunctionError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    "text", ["(" * 400, "-" * 490, "1" * 501, "\0", "t\nt", "lambda: 1", "x:=1", "'a'", "...", "1j"]
)
def test_function_text_of_any_depth_is_a_mistake(text):
    with pytest.raises(FunctionError):
        parse_function(text)


def test_key_text_quotes_odd_keys():
    assert key_text(("dof", "A B", "map", 2, 1)) == "dof.'A B'.map[2][1]"
