"""Puppet and robot in fixed point."""

import math
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.link import pack
from marotte.puppet import Dof
from marotte.puppet_file import load_puppet
from marotte.tables import (
    alpha_q26,
    build_tables,
    fixed,
    items_per_message,
    tempo_q16,
    value_of,
    value_q15,
    weight_q28,
)
from marotte.wiring import load_robot
from shared import codec, formats, messages

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
    assert begin["link_timeout_ms"] == 750
    names = [name for name, _, _ in tables.messages()]
    assert names == [
        "begin",
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


def test_tables_dofs_are_in_unit_values(tmp_path):
    assert [fields for fields, _ in messages_named(tables_of(tmp_path), "dof")] == [
        {"dof": 0, "kind": 0, "rest_q15": 8192, "low_q15": 4096, "high_q15": 28672},
        {"dof": 1, "kind": 1, "rest_q15": 16384, "low_q15": 0, "high_q15": 32768},
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
    assert late["rise_q26"] == late["fall_q26"] == gaze["rise_q26"] > gaze["fall_q26"]


def test_tables_outputs_have_trim_and_inversion(tmp_path):
    robot = "[output.WHEEL]\npin=3\npulse_us=[1000,2000]\ntrim_us=0.0625\ninvert=true\n[output.NECK]\npin=2\n"
    assert [fields for fields, _ in messages_named(tables_of(tmp_path, robot), "output")] == [
        {"dof": 0, "pin": 2, "pulse0_q4us": 16000, "pulse1_q4us": 32000},
        {"dof": 1, "pin": 3, "pulse0_q4us": 32001, "pulse1_q4us": 16001},
    ]


def test_tables_without_a_robot_have_no_output(tmp_path):
    assert messages_named(tables_of(tmp_path), "output") == []


def test_tables_of_the_pet_fit_their_messages():
    puppet = load_puppet(PUPPETS / "pet.toml")
    tables = build_tables(puppet, load_robot(PUPPETS / "pet-robot.toml", puppet))
    mappings = 0
    for name, fields, items in tables.messages():
        assert len(pack(name, fields, items)) <= codec.PAYLOAD_MAX
        if name == "mappings":
            assert fields["first_mapping"] == mappings
            mappings += len(items)
    assert mappings == sum(len(action.mappings) for action in puppet.actions.values())


def test_items_per_message_fill_the_payload():
    for name, _, fields, items in messages.MESSAGES:
        if items:
            size = messages.size(fields) + items_per_message(name) * messages.size(items)
            assert codec.PAYLOAD_MAX - messages.size(items) < size <= codec.PAYLOAD_MAX


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
