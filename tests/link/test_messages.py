"""The message dictionary: well formed, and every message of it packed and unpacked as declared."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.link import Message, pack, unpack, wire_packet
from marotte.session import DICTIONARY
from shared import codec, messages

RANGES = {"B": (0, 0xFF), "H": (0, 0xFFFF), "I": (0, 0xFFFFFFFF), "i": (-0x80000000, 0x7FFFFFFF)}
SUFFIXES = ("_q12", "_q15", "_q16", "_q18", "_q24", "_q26", "_q28", "_hz", "_s", "_ms", "_us", "_q4us")
COUNTS = {
    *("protocol", "dictionary", "seed", "seq", "status", "detail", "frame", "armed", "silent"),
    *(
        "dof",
        "dofs",
        "action",
        "actions",
        "mappings",
        "first_mapping",
        "live",
        "lives",
        "function",
        "argument",
        "kind",
        "pin",
    ),
    *("curve", "curves", "samples", "program", "programs", "words", "word", "blink", "blinks", "entry", "cycles"),
    *("first", "old"),
    *("taps", "taps_every", "weights_every", "packets", "damaged", "when_silent"),
    *("kill_pin", "kill_level", "autostart", "device", "driver", "setting", "turns", "stall_ticks"),
    *("ticks", "attached", "released", "stalled", "killed_by", "bus_errors", "bus_gone", "resets", "store"),
    *("bytes", "crc32", "place", "byte"),
    *("dofs_max", "actions_max", "mappings_max", "lives_max", "queue_max", "late_frames", "late_targets", "heap_free"),
    "refused_targets",
    *("signal", "predict", "band", "clipped", "cut_short"),
}
"""Counts, indices, flags and bit sets: what has no unit."""

NAMES = [message[0] for message in messages.MESSAGES]
ENTRIES = {message[0]: message for message in messages.MESSAGES}


def values_of(pairs):
    """A strategy of values for `(name, type)` pairs, ends of their ranges included."""
    return st.fixed_dictionaries({name: st.integers(*RANGES[kind]) for name, kind in pairs})


@st.composite
def contents(draw):
    """A strategy of any message with any fields and as many items as a packet holds: `(entry, fields, items)`."""
    entry = draw(st.sampled_from(messages.MESSAGES))
    _, _, fields, items = entry
    room = (codec.PAYLOAD_MAX - messages.size(fields)) // messages.size(items) if items else 0
    return entry, draw(values_of(fields)), draw(st.lists(values_of(items), max_size=room) if items else st.just([]))


@given(contents())
def test_message_survives_packing_and_unpacking(content):
    (name, message_id, fields, items), values, item_values = content
    payload = pack(name, values, item_values)
    assert len(payload) == messages.size(fields) + len(item_values) * messages.size(items)
    assert messages.length_fits(ENTRIES[name], len(payload))
    assert unpack(message_id, payload) == Message(name, values, item_values)
    wire = bytearray(wire_packet(message_id, 77, payload))
    assert len(wire) <= codec.WIRE_MAX
    length = codec.decode(wire, len(wire) - 1)
    assert codec.is_sealed(wire, length)
    assert wire[: length - 4] == bytes([message_id, 77]) + payload


@given(contents(), st.integers(-12, 12))
def test_message_is_not_unpacked_from_another_length(content, change):
    (name, message_id, fields, items), values, item_values = content
    payload = pack(name, values, item_values)
    other = payload[:change] if change < 0 else payload + bytes(change)
    rest = len(other) - messages.size(fields)
    fits = rest >= 0 and (rest % messages.size(items) == 0 if items else rest == 0)
    assert (unpack(message_id, other) is not None) == fits


@given(contents())
def test_offsets_are_the_places_of_the_fields(content):
    (name, message_id, fields, items), values, item_values = content
    payload = pack(name, values, item_values)
    for field, kind in fields:
        assert struct.unpack_from("<" + kind, payload, messages.offset(message_id, field)) == (values[field],)
    if not {field for field, _ in fields} & {field for field, _ in items}:
        for number, item in enumerate(item_values):
            start = messages.size(fields) + number * messages.size(items)
            for field, kind in items:
                assert struct.unpack_from("<" + kind, payload, start + messages.offset(message_id, field)) == (
                    item[field],
                )


def test_unknown_message_is_not_unpacked():
    assert unpack(0x03, b"") is None
    assert messages.find(0x03) is None
    with pytest.raises(KeyError):
        messages.offset(messages.ACK, "no such field")


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"taps": 7}, "has the fields"),
        ({"taps": 7, "taps_every": 1, "weights_every": 0, "extra": 1}, "has the fields"),
        ({"taps": 256, "taps_every": 1, "weights_every": 0}, "'telemetry'"),
        ({"taps": 7, "taps_every": -1, "weights_every": 0}, "'telemetry'"),
    ],
)
def test_packing_refuses_wrong_fields(fields, complaint):
    with pytest.raises(ValueError, match=complaint):
        pack("telemetry", fields)


def test_dictionary_has_unique_names_and_ids_and_none_is_3():
    ids = [message[1] for message in messages.MESSAGES]
    assert len(set(ids)) == len(ids) and len(set(NAMES)) == len(NAMES)
    assert codec.HANDOVER_SECOND not in ids
    assert all(0 < message_id < 256 for message_id in ids)


@pytest.mark.parametrize("message", messages.MESSAGES, ids=NAMES)
def test_dictionary_entry_is_well_formed(message):
    name, message_id, fields, items = message
    assert messages.find(message_id) is message
    assert getattr(messages, name.upper()) == message_id
    assert messages.size(fields) + messages.size(items) <= codec.PAYLOAD_MAX
    assert messages.size(fields) == struct.calcsize(messages.struct_format(fields))
    for pairs in (fields, items):
        assert len({field for field, _ in pairs}) == len(pairs)
        for field, kind in pairs:
            assert kind in RANGES
            assert field in COUNTS or field.endswith(SUFFIXES), f"{name}.{field} tells no unit"


def test_status_codes_have_their_texts_in_order():
    codes = [messages.OK, messages.RESEND, messages.MISMATCH, messages.UNKNOWN, messages.LENGTH, messages.RANGE]
    codes += [messages.INCOMPLETE, messages.STATE, messages.FULL, messages.FLASH]
    assert codes == list(range(len(messages.STATUS_TEXT)))


@pytest.mark.parametrize("change", ["id", "name", "type", "field", "order"])
def test_dictionary_checksum_changes_with_the_layout(monkeypatch, change):
    name, message_id, fields, items = ENTRIES["dof"]
    changed = {
        "id": (name, message_id + 64, fields, items),
        "name": ("dofs", message_id, fields, items),
        "type": (name, message_id, (*fields[:-1], (fields[-1][0], "i")), items),
        "field": (name, message_id, fields[:-1], items),
        "order": (name, message_id, (fields[1], fields[0], *fields[2:]), items),
    }[change]
    others = tuple(changed if message[0] == name else message for message in messages.MESSAGES)
    assert codec.crc32(messages.canonical_text().encode()) == DICTIONARY
    monkeypatch.setattr(messages, "MESSAGES", others)
    assert codec.crc32(messages.canonical_text().encode()) != DICTIONARY
