"""Any messages in any order at the handlers: each is carried out or refused, and afterwards good tables are taken."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared import codec, formats, messages
from tests.hostile.attack import COMMANDS, LIMITS, RANGES, good_talk, small_upload
from tests.link.test_store import Mcu

STATUSES = range(len(messages.STATUS_TEXT))
DETAIL_MAX = 0xFFFF
"""An answer has room for no more."""

SOAK_EXAMPLES = 5_000


class Switched(Mcu):
    """An MCU whose motor layer takes what has been checked, as it comes, into the tables that play."""

    def __init__(self):
        super().__init__()
        puppet = self.puppet
        puppet.motor.calibrate = lambda *values: puppet.tables.calibrate(*values)
        puppet.motor.limit = lambda *values: puppet.tables.limit(*values)


def numbers(kind):
    """Any number of a message's type, mostly one at which something is decided."""
    least, most = RANGES[kind]
    known = [number for number in LIMITS if least <= number <= most]
    return st.sampled_from(known) | st.integers(least, most)


def values_of(pairs):
    return st.fixed_dictionaries({name: numbers(kind) for name, kind in pairs})


@st.composite
def any_parts(draw):
    """A command with any fields and up to five items."""
    name, _, fields, items = draw(st.sampled_from(list(COMMANDS.values())))
    return name, draw(values_of(fields)), draw(st.lists(values_of(items), max_size=5)) if items else []


@st.composite
def nearly_good_parts(draw):
    """A command of a good host with one number changed, or none."""
    name, fields, items = draw(st.sampled_from([*small_upload(), *good_talk()]))
    _, _, field_pairs, item_pairs = COMMANDS[name]
    fields, items = dict(fields), [dict(item) for item in items]
    for pairs, values in ((field_pairs, [fields]), (item_pairs, items)):
        if pairs and values and draw(st.booleans()):
            field, kind = draw(st.sampled_from(pairs))
            draw(st.sampled_from(values))[field] = draw(numbers(kind))
    return name, fields, items


def check_handlers(uploaded, parts):
    mcu = Switched()
    for name, fields, items in [*small_upload()[:uploaded], *parts, ("stop", {}, []), ("kill", {}, [])]:
        answer = mcu.do(name, fields, items)
        status, detail = answer if isinstance(answer, tuple) else (answer, 0)
        assert status in STATUSES and 0 <= detail <= DETAIL_MAX
    assert mcu.puppet.cues.count <= formats.QUEUE_MAX
    for part in small_upload():
        assert mcu.do(*part) == messages.OK
    assert mcu.puppet.tables.ready and mcu.puppet.tables.missing() == 0


uploads = st.just(len(small_upload())) | st.integers(0, len(small_upload()))


@given(uploads, st.lists(any_parts() | nearly_good_parts(), max_size=25))
def test_handlers_take_or_refuse_any_messages_in_any_order(uploaded, parts):
    check_handlers(uploaded, parts)


@pytest.mark.soak
@settings(max_examples=SOAK_EXAMPLES)
@given(uploads, st.lists(any_parts() | nearly_good_parts(), max_size=60))
def test_handlers_take_or_refuse_many_messages_in_any_order(uploaded, parts):
    check_handlers(uploaded, parts)


@given(
    st.sampled_from(sorted({message[1] for message in COMMANDS.values()})) | st.integers(0, 127),
    st.binary(max_size=codec.PAYLOAD_MAX),
)
def test_handlers_take_or_refuse_any_bytes(message_id, payload):
    mcu = Switched()
    for name, fields, items in small_upload():
        mcu.do(name, fields, items)
    body = bytearray(codec.BODY_MAX)
    body[2 : 2 + len(payload)] = payload
    assert mcu.commands.carry_out(message_id, body, len(payload)) in STATUSES
