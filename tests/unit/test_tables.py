"""Puppet and robot in fixed point."""

import math
from fractions import Fraction
from math import floor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.character import response
from marotte.kalman import Kalman, kalman_fields
from marotte.limits import LimitsInUse
from marotte.link import PAYLOAD_SENT_MAX, pack
from marotte.puppet import Character, Dof
from marotte.puppet_file import load_puppet
from marotte.tables import (
    alpha_q26,
    build_tables,
    fixed,
    items_per_message,
    limit_fields,
    tempo_q16,
    value_of,
    value_q15,
    weight_q28,
)
from marotte.wiring import Robot, load_robot
from shared import codec, formats, messages, program

PUPPETS = Path(__file__).parents[2] / "puppets"
ABSOLUTE = Dof("A")
RELATIVE = Dof("R", "relative", 0.0, (-1.0, 1.0), False)

PUPPET = """
frame_rate = 40
seed = 4294967295
noise_spread = 0.25
[dof.NECK]
rest = 0.25
limits = [0.125, 0.875]
[dof.WHEEL]
kind = "relative"
[live.GAZE]
rest = 1
tau = [0.1, 0.2]
[action.A]
tempo = 1.5
tau = [0.05, 2]
map = [["NECK", 1, 0, "noise16"], ["WHEEL", -1, 0.5, "live(LATE)"]]
[action.B]
map = [["WHEEL", 0, 0, "rsin"], ["NECK", 0, 1, "const(0.5)"]]
[action.C]
map = [["NECK", 0, 1, "rcos"]]
"""


def tables_of(tmp_path, robot_text=""):
    (tmp_path / "p.toml").write_text(PUPPET)
    (tmp_path / "r.toml").write_text(robot_text)
    puppet = load_puppet(tmp_path / "p.toml")
    return build_tables(puppet, load_robot(tmp_path / "r.toml", puppet) if robot_text else None)


def messages_named(tables, name):
    return [(fields, items) for found, fields, items in tables.messages() if found == name]


def test_tables_begin_announces_what_follows(tmp_path):
    tables = tables_of(tmp_path, "link_timeout = 0.75\n[output.NECK]\npin = 2\n")
    (begin, _), *more = messages_named(tables, "begin")
    assert not more
    counts = {"dofs": 2, "actions": 3, "mappings": 5, "lives": 2}
    assert {key: begin[key] for key in counts} == counts
    assert (begin["frame_rate_hz"], begin["seed"], begin["noise_spread_q15"]) == (40, 4294967295, 8192)
    assert (begin["link_timeout_ms"], begin["when_silent"]) == (750, formats.SILENT_IDLE)
    names = [name for name, _, _ in tables.messages()]
    assert names == [
        "begin",
        "robot",
        "dof",
        "dof",
        "output",
        "action",
        "action",
        "action",
        "mappings",
        "live",
        "live",
        "commit",
    ]


def test_tables_live_channels_say_how_they_are_predicted(tmp_path):
    (tmp_path / "p.toml").write_text(PUPPET.replace("rest = 1", 'predict = "kalman"\nagility = 5'))
    (gaze, _), (late, _) = messages_named(build_tables(load_puppet(tmp_path / "p.toml")), "live")
    assert gaze.items() >= {"predict": formats.PREDICT_KALMAN, **kalman_fields(Kalman(agility=5), 40)}.items()
    assert late.items() >= {"predict": formats.PREDICT_HOLD, "process_q16": 0, "noise_q16": 0, "fade_q15": 0}.items()


def test_tables_dofs_are_in_unit_values(tmp_path):
    assert [fields for fields, _ in messages_named(tables_of(tmp_path), "dof")] == [
        {
            "dof": 0,
            "kind": 0,
            "rest_q15": 8192,
            "low_q15": 4096,
            "high_q15": 28672,
            "speed_q24": floor(10 * 0.02 * 2**24),  # the defaults, at 50 Hz
            "accel_q24": floor(200 * 0.02**2 * 2**24) - 1,
            "signal": 1,
        },
        {
            "dof": 1,
            "kind": 1,
            "rest_q15": 16384,
            "low_q15": 0,
            "high_q15": 32768,
            "speed_q24": 1 << 24,
            "accel_q24": floor(20 * 0.02 * 2**23),
            "signal": 0,
        },
    ]


def test_tables_mappings_are_in_file_order_with_their_actions(tmp_path):
    tables = tables_of(tmp_path)
    actions = [fields for fields, _ in messages_named(tables, "action")]
    assert [(fields["first_mapping"], fields["mappings"]) for fields in actions] == [(0, 2), (2, 2), (4, 1)]
    ((fields, items),) = messages_named(tables, "mappings")
    assert fields == {"first_mapping": 0}
    assert [tuple(item.values()) for item in items] == [
        (0, formats.FUNCTION_NOISE, 15, 32768, 0),
        (1, formats.FUNCTION_LIVE, 1, 0, 24576),
        (1, formats.FUNCTION_RSIN, 0, 16384, 16384),
        (0, formats.FUNCTION_CONST, 16384, 0, 32768),
        (0, formats.FUNCTION_RCOS, 0, 0, 32768),
    ]


def test_tables_tempos_and_filters(tmp_path):
    tables = tables_of(tmp_path)
    action = messages_named(tables, "action")[0][0]
    assert action["tempo_q16"] == 98304
    assert action["rise_q26"] == round((1 - math.exp(-1 / (40 * 0.05))) * 2**26)
    assert action["fall_q26"] == round((1 - math.exp(-1 / (40 * 2))) * 2**26)
    (gaze, _), (late, _) = messages_named(tables, "live")
    assert (gaze["rest_q28"], late["rest_q28"]) == (1 << 28, 1 << 27)
    assert (gaze["predict"], gaze["noise_q16"]) == (formats.PREDICT_HOLD, 0)
    assert late["rise_q26"] == late["fall_q26"] == gaze["rise_q26"] > gaze["fall_q26"]


FUNCTIONS = """
frame_rate = 25
[dof.A]
[dof.B]
[dof.C]
[function.SAME_SHAPE]
table = [0, 1, 0.25]
[function.UNUSED]
table = [0, 0.1]
[function.SHAPE]
table = [0.0, 1.0, 0.25]
[function.LONG]
table = [SAMPLES]
[function.SUM]
expr = "0.5*table(LONG, 2*t) + live(X)/4"
[action.NOD]
entry = "start"
warp = 0.75
cycles = 3
map = [["A", 0, 1, "SHAPE"], ["B", 0, 1, "SUM"], ["C", 0, 1, "blink(0.93, 1.2)"]]
[action.AGAIN]
map = [["A", 0, 1, "SAME_SHAPE"], ["B", 0, 1, "0.5*table(LONG, t*2) + 0.25*live(X)"], ["C", 0, 1, "rtrigsin(0.93, 1.2)"]]
[action.MORE]
map = [["A", 0, 1, "table(LONG)"], ["B", 0, 1, "const(1)"], ["C", 0, 1, "blink"]]
"""


@pytest.fixture
def function_tables(tmp_path):
    (tmp_path / "p.toml").write_text(FUNCTIONS.replace("SAMPLES", ", ".join(f"{i / 255:.6f}" for i in range(256))))
    return build_tables(load_puppet(tmp_path / "p.toml"))


def test_tables_share_equal_functions(function_tables):
    items = [item for _, items in messages_named(function_tables, "mappings") for item in items]
    assert [(item["function"], item["argument"]) for item in items] == [
        (formats.FUNCTION_CURVE, 0),
        (formats.FUNCTION_PROGRAM, 0),
        (formats.FUNCTION_BLINK, 0),
        (formats.FUNCTION_CURVE, 0),
        (formats.FUNCTION_PROGRAM, 0),
        (formats.FUNCTION_RTRIGSIN, 0),
        (formats.FUNCTION_CURVE, 1),
        (formats.FUNCTION_CONST, 32768),
        (formats.FUNCTION_BLINK, 1),
    ]
    ((begin, _),) = messages_named(function_tables, "begin")
    assert (begin["curves"], begin["programs"], begin["blinks"]) == (2, 1, 2)


def test_tables_long_curves_come_in_parts(function_tables):
    curves = messages_named(function_tables, "curve")
    assert [(fields["curve"], fields["samples"]) for fields, _ in curves] == [(0, 3)] + 8 * [(1, 256)]
    assert [item["value_q15"] for item in curves[0][1]] == [0, 32768, 8192]
    samples_q15 = [item["value_q15"] for _, items in curves[1:] for item in items]
    assert samples_q15 == [fixed(float(f"{i / 255:.6f}"), 15) for i in range(256)]
    for fields, items in curves:
        assert len(pack("curve", fields, items)) <= codec.PAYLOAD_MAX


def test_tables_programs_have_indices_for_names(function_tables):
    ((fields, items),) = messages_named(function_tables, "program")
    words = [item["word"] for item in items]
    assert fields == {"program": 0, "words": len(words)}
    half, quarter = (program.SCALE, 1 << 19, 20), (program.SCALE, 1 << 19, 21)
    assert words == [program.CURVE, 1, 32, 0, *half, program.LIVE, 0, *quarter, program.ADD]


def test_tables_blinks_and_gestures(function_tables):
    assert [fields for fields, _ in messages_named(function_tables, "blink")] == [
        {"blink": 0, "threshold_q16": 60948, "gap_q18": 314573},
        {"blink": 1, "threshold_q16": 64225, "gap_q18": 524288},
    ]
    nod, again, _ = (fields for fields, _ in messages_named(function_tables, "action"))
    assert (nod["entry"], nod["cycles"], again["entry"], again["cycles"]) == (1, 3, 0, 0)
    assert nod["warp_q26"] == round((1 - math.exp(-1 / (25 * 0.75))) * 2**26)
    assert again["warp_q26"] == round((1 - math.exp(-1 / (25 * 0.5))) * 2**26)


def test_tables_outputs_have_trim_and_inversion(tmp_path):
    robot = "[output.WHEEL]\npin=3\npulse_us=[1000,2000]\ntrim_us=0.0625\ninvert=true\n[output.NECK]\npin=2\n"
    assert messages_named(tables_of(tmp_path, robot), "output") == [
        ({**PLAIN, "dof": 0}, [{"setting": 2}]),
        ({**PLAIN, "dof": 1, "end0_q4us": 32001, "end1_q4us": 16001}, [{"setting": 3}]),
    ]


PLAIN = {"driver": 0, "turns": 1, "end0_q4us": 16000, "end1_q4us": 32000, "dead_q15": 0, "top_q15": 32768}

ROBOT = """
rate = 100
attach_interval = 0.25
autostart = true
[kill]
pin = 22
[chip.UNUSED]
sda = 2
scl = 3
oe = 20
[chip.BODY]
sda = 4
scl = 5
oe = 6
address = 0x41
baud = 1000000
clock = 26.5
[output.NECK]
driver = "pca9685"
chip = "BODY"
channel = 9
rate = 50
range = [0.25, 1]
speed = 2
accel = 100
release = 1.5
feedback = { pin = 27, at = [1, 0.25], gain = 0.25, integral = 0.5, most = 0.125, stall = 0.5, stall_time = 0.25 }
[output.WHEEL]
driver = "bridge"
wiring = "two-pwm"
forward = 12
backward = 13
invert = true
dead_band = 0.25
top_speed = 0.75
accel = 8
duty = { share = 0.5, window = 30 }
"""


def test_tables_robot_with_all_that_it_can_have(tmp_path):
    tables = tables_of(tmp_path, ROBOT)
    names = [name for name, _, _ in tables.messages()]
    parts = ["begin", "robot", "device", "device", "dof", "dof", "output", "output", "feedback", "guard", "guard"]
    assert names[: len(parts)] == parts
    ((robot, _),) = messages_named(tables, "robot")
    assert robot == {"motor_period_us": 10000, "attach_ms": 250, "kill_pin": 22, "kill_level": 1, "autostart": 1}
    settings = [[2, 3, 64, 20, 400, 25000], [4, 5, 65, 6, 1000, 26500]]
    assert messages_named(tables, "device") == [
        ({"device": index, "driver": 1}, [{"setting": setting} for setting in settings[index]]) for index in (0, 1)
    ]
    (neck, neck_settings), (wheel, wheel_settings) = messages_named(tables, "output")
    assert neck == {**PLAIN, "dof": 0, "driver": 1, "turns": 2}
    assert [item["setting"] for item in neck_settings] == [1, 9]
    assert wheel == {
        "dof": 1,
        "driver": 2,
        "turns": 1,
        "end0_q4us": 0,
        "end1_q4us": 0,
        "dead_q15": 8192,
        "top_q15": 24576,
    }
    assert [item["setting"] for item in wheel_settings] == [1, 12, 13, 1]
    ((feedback, _),) = messages_named(tables, "feedback")
    assert feedback == {
        "dof": 0,
        "pin": 27,
        "at0_q15": 32768,
        "at1_q15": 8192,
        "gain_q15": 8192,
        "integral_q24": round(0.5 * 0.01 * 2**24),
        "most_q15": 4096,
        "stall_q15": 16384,
        "stall_ticks": 25,
    }
    assert [fields for fields, _ in messages_named(tables, "guard")] == [
        {"dof": 0, "release_ms": 1500, "duty_q15": 32768, "window_s": 60},
        {"dof": 1, "release_ms": 0, "duty_q15": 16384, "window_s": 30},
    ]
    (neck, _), (wheel, _) = messages_named(tables, "dof")
    assert (neck["low_q15"], neck["high_q15"]) == (8192, 28672)  # the puppet says 0.125 to 0.875
    assert (neck["speed_q24"], neck["accel_q24"]) == (floor(2 * 0.01 * 2**24), floor(100 * 0.01**2 * 2**24) - 1)
    assert (wheel["speed_q24"], wheel["accel_q24"]) == (1 << 24, floor(8 * 0.01 * 2**23))
    assert tables.outputs_mask == 0b11


def test_tables_without_a_robot_have_no_output(tmp_path):
    tables = tables_of(tmp_path)
    assert messages_named(tables, "output") == messages_named(tables, "device") == []
    ((robot, _),) = messages_named(tables, "robot")
    assert robot == {
        "motor_period_us": 20000,
        "attach_ms": 100,
        "kill_pin": formats.NO_PIN,
        "kill_level": 0,
        "autostart": 0,
    }
    assert tables.outputs_mask == 0


def test_tables_characters_are_for_the_robots_rate(tmp_path):
    text = PUPPET.replace("rest = 0.25", "rest = 0.25\ncharacter = { f = 2.5, zeta = 0.7, r = -0.5 }", 1)
    (tmp_path / "p.toml").write_text(text.replace("seed", 'when_silent = "relax"\nseed', 1))
    puppet = load_puppet(tmp_path / "p.toml")
    tables = build_tables(puppet, Robot(rate_hz=333))
    ((fields, items),) = messages_named(tables, "character")
    assert fields == {"dof": 0, **response(Character(2.5, 0.7, -0.5), 0.003008).fixed()}
    assert items == []
    ((begin, _),) = messages_named(tables, "begin")
    assert begin["when_silent"] == formats.SILENT_RELAX


PERIODS_US = st.integers(3008 // 8, 20000 // 8).map(lambda steps: 8 * steps)


@given(low=st.floats(0, 1), high=st.floats(0, 1), speed=st.floats(0.05, 50), accel=st.floats(1, 1000), us=PERIODS_US)
def test_limits_of_an_absolute_dof_are_never_exceeded_by_rounding(low, high, speed, accel, us):
    fields = limit_fields(LimitsInUse((low, high), speed, accel), ABSOLUTE, Fraction(us, 10**6))
    tick_s = Fraction(us, 10**6)
    assert (fields["low_q15"], fields["high_q15"]) == (fixed(low, 15), fixed(high, 15))
    assert 1 <= fields["speed_q24"] <= formats.POSITION_ONE
    assert 0 <= Fraction(speed) * tick_s * 2**24 - fields["speed_q24"] < 1
    assert 2 <= fields["accel_q24"] <= formats.POSITION_ONE
    assert fields["accel_q24"] <= Fraction(accel) * tick_s**2 * 2**24 < fields["accel_q24"] + 2


@given(accel=st.floats(4, 1000), us=PERIODS_US)
def test_limits_of_a_relative_dof_let_it_stand_in_time(accel, us):
    tick_s = Fraction(us, 10**6)
    fields = limit_fields(LimitsInUse((-1.0, 1.0), 10.0, accel), RELATIVE, tick_s)
    assert fields["speed_q24"] == formats.POSITION_ONE
    stand = -(-formats.POSITION_ONE // 2 * us // (formats.STAND_MS * 1000))
    assert stand - 1 <= fields["accel_q24"] <= formats.POSITION_ONE
    assert fields["accel_q24"] * formats.STAND_MS * 1000 >= formats.POSITION_ONE // 2 * us
    exact = min(Fraction(accel) * tick_s * 2**23, formats.POSITION_ONE)
    assert abs(fields["accel_q24"] - exact) <= 1


@pytest.mark.parametrize("name", ["pet-robot.toml", "pet-robot-pca9685.toml"])
def test_tables_of_the_pet_fit_their_messages(name):
    puppet = load_puppet(PUPPETS / "pet.toml")
    tables = build_tables(puppet, load_robot(PUPPETS / name, puppet))
    mappings = 0
    for name, fields, items in tables.messages():
        assert len(pack(name, fields, items)) <= codec.PAYLOAD_MAX
        if name == "mappings":
            assert fields["first_mapping"] == mappings
            mappings += len(items)
    assert mappings == sum(len(action.mappings) for action in puppet.actions.values())


def test_items_per_message_fill_what_is_sent_at_once():
    for name, _, fields, items in messages.MESSAGES:
        if items:
            size = messages.size(fields) + items_per_message(name) * messages.size(items)
            assert PAYLOAD_SENT_MAX - messages.size(items) < size <= PAYLOAD_SENT_MAX


@pytest.mark.parametrize(
    ("value", "bits", "expected"), [(0.5, 0, 1), (1.5, 0, 2), (2.5, 0, 3), (-0.5, 0, 0), (0.25, 1, 1), (0.3, 15, 9830)]
)
def test_fixed_rounds_to_nearest_and_halves_up(value, bits, expected):
    assert fixed(value, bits) == expected


@given(weight=st.floats(0, 4))
def test_weight_is_nearest_and_never_fades_to_nothing(weight):
    q28 = weight_q28(weight)
    assert (q28 > 0) == (weight > 0)
    assert 0 <= q28 <= formats.WEIGHT_MAX
    assert abs(Fraction(q28, 1 << 28) - Fraction(weight)) <= Fraction(1, 1 << 29) or (q28 == 1 and weight < 2**-29)


@given(tempo=st.floats(0.05, 8))
def test_tempo_is_within_its_range_when_rounded(tempo):
    assert formats.TEMPO_MIN_Q16 <= tempo_q16(tempo) <= formats.TEMPO_MAX_Q16
    assert abs(Fraction(tempo_q16(tempo), 65536) - Fraction(tempo)) <= Fraction(1, 131072)


@given(tau_s=st.floats(0.03, 10), rate_hz=st.integers(10, 60))
def test_alpha_is_within_half_a_unit(tau_s, rate_hz):
    assert abs(alpha_q26(tau_s, rate_hz) - (1 - math.exp(-1 / (rate_hz * tau_s))) * 2**26) <= 0.5 + 1e-6
    assert 0 < alpha_q26(tau_s, rate_hz) < formats.ALPHA_ONE


@given(q15=st.integers(0, 32768))
def test_value_survives_the_way_out_and_back(q15):
    for dof in (ABSOLUTE, RELATIVE):
        assert value_q15(value_of(q15, dof), dof) == q15


@pytest.mark.parametrize(
    ("q15", "absolute", "relative"), [(0, 0, -1), (16384, 0.5, 0), (32768, 1, 1), (24576, 0.75, 0.5)]
)
def test_value_of_unit_values(q15, absolute, relative):
    assert (value_of(q15, ABSOLUTE), value_of(q15, RELATIVE)) == (absolute, relative)
