"""What an MCU keeps on its flash: the upload, a behaviour and the start, command after command."""

from pathlib import Path

import pytest

from marotte.keeping import kept
from marotte.link import pack, unpack
from marotte.puppet_file import load_puppet
from marotte.tables import build_tables, weight_q28
from marotte.wiring import load_robot
from shared import formats, messages

PUPPETS = Path(__file__).parents[2] / "puppets"


@pytest.fixture(scope="module")
def tables():
    puppet = load_puppet(PUPPETS / "pet.toml")
    return build_tables(puppet, load_robot(PUPPETS / "pet-robot-pca9685.toml", puppet))


def commands_of(data):
    """Return the messages that stand in a file: a byte counts the bytes that follow, the first of which is the id."""
    found = []
    while data:
        length, data = data[0], data[1:]
        found.append(unpack(data[0], data[1:length]))
        data = data[length:]
    return found


def test_kept_are_the_upload_and_the_start(tables):
    *commands, start = commands_of(kept(tables))
    assert [(command.name, command.fields, command.items) for command in commands] == list(tables.messages())
    assert (start.name, start.fields) == ("start", {})


def test_kept_behaviour_comes_before_the_start(tables):
    *_, commit, targets, start = commands_of(kept(tables, "CALM"))
    assert (commit.name, targets.name, start.name) == ("commit", "weight_targets", "start")
    assert targets.fields == {"frame": 0}
    puppet = tables.puppet
    named = {list(puppet.actions)[item["action"]]: item["target_q28"] for item in targets.items}
    assert named == {name: weight_q28(weight) for name, weight in puppet.behaviours["CALM"].items()}


def test_kept_pet_fits_the_flash(tables):
    assert len(kept(tables, "CALM")) < formats.STORE_MAX // 4


def test_kept_records_are_as_the_firmware_reads_them(tables):
    data = kept(tables)
    begin = pack(*next((name, fields, items) for name, fields, items in tables.messages()))
    assert data[:2] == bytes((1 + len(begin), messages.BEGIN))
    assert data[2 : 2 + len(begin)] == begin
    assert data[-2:] == bytes((1, messages.START))


def test_kept_unknown_behaviour_is_an_error(tables):
    with pytest.raises(KeyError):
        kept(tables, "SLEEPY")
