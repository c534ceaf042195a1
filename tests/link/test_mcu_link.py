"""Host and firmware over a link with losses: every command carried out once and in order; what is refused changes nothing."""

import random

import pytest

from marotte.link import LinkRefused, VirtualCarrier, pack, wire_packet
from marotte.mcu.unix import UnixMcu
from marotte.session import DICTIONARY, LinkForeign, Session
from shared import codec, formats, messages
from tests.link.carriers import FaultyCarrier
from tests.link.stage import ALL_TAPS, Parts, begin_performance, open_session, pet_tables

MAX = {"B": 0xFF, "H": 0xFFFF, "I": 0xFFFFFFFF, "i": 0x7FFFFFFF}
FRAMES = 20


@pytest.fixture
def mcu():
    with UnixMcu() as mcu:
        yield mcu


def wide_tables():
    """The largest puppet: every part of it has to come once, in its place, or the firmware refuses it."""
    rng = random.Random(7)
    begin = {
        "frame_rate_hz": 30,
        "dofs": 16,
        "actions": 64,
        "mappings": 512,
        "lives": 16,
        "curves": 0,
        "programs": 0,
        "blinks": 0,
        "seed": 9,
        "noise_spread_q15": 0,
    }
    yield "begin", {**begin, "hold_q26": 1 << 20, "link_timeout_ms": 500, "when_silent": 0}, []
    yield "robot", GOOD["robot"], []
    for dof in range(16):
        yield "dof", GOOD["dof"] | {"dof": dof, "rest_q15": 16384}, []
    for action in range(64):
        fields = {"action": action, "tempo_q16": 65536, "rise_q26": 1 << 22, "fall_q26": 1 << 22}
        fields |= {"first_mapping": 8 * action, "mappings": 8, "entry": 0, "warp_q26": 1 << 22, "cycles": 0}
        yield "action", fields, []
    for first in range(0, 512, 16):
        dofs = [8 * (place // 8 % 2) + place % 8 for place in range(first, first + 16)]
        items = [
            {"dof": dof, "function": 2, "argument": rng.randrange(16), "low_q15": 0, "high_q15": rng.randrange(32769)}
            for dof in dofs
        ]
        yield "mappings", {"first_mapping": first}, items
    for live in range(16):
        yield "live", GOOD["live"] | {"live": live, "rest_q28": 1 << 27}, []
    yield "commit", {}, []


def play(session, frames=FRAMES):
    """Start what is loaded with two weights; return the taps of its first frames."""
    session.taps.clear()
    session.telemetry(ALL_TAPS, 1, 0)
    session.weight_targets(0, {0: formats.WEIGHT_ONE, 1: formats.WEIGHT_ONE // 2})
    session.start()
    while len(session.taps) < frames:
        session.pump(20_000)
    session.stop()
    session.flush()
    return list(session.taps)[:frames]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("faults", [("drop",), ("flip",), ("double",), ("drop", "flip", "double")], ids="-".join)
def test_commands_are_carried_out_once_and_in_order_over_a_bad_link(mcu, faults, seed):
    carrier = FaultyCarrier(VirtualCarrier(mcu), seed, faults)
    session = open_session(carrier)
    carrier.share = 0.0015
    session.upload(Parts(wide_tables()))  # each part in its place, or it would be refused
    for number in range(50):  # one place of the queue each
        session.weight_targets(1000 + number, {number: formats.WEIGHT_ONE})
    session.flush(5)
    carrier.share = 0
    assert carrier.done > 10 and session.link.counters.repeated > 0
    session.pump(200_000)
    for number in range(formats.QUEUE_MAX - 50):
        session.live_targets(2000, {number % 16: 0})
    session.flush(5)
    with pytest.raises(LinkRefused) as refusal:
        session.live_targets(2000, {0: 0})
        session.flush()
    assert (refusal.value.status, refusal.value.detail) == (messages.FULL, 0)


def test_repeated_command_is_answered_as_the_first_time_and_not_carried_out_again(mcu):
    session = open_session(VirtualCarrier(mcu))
    session.upload(pet_tables())
    session.flush()
    seq = session.link._seq
    packet = wire_packet(
        messages.WEIGHT_TARGETS, seq, pack("weight_targets", {"frame": 9}, [{"action": 0, "target_q28": 1}])
    )
    bad = wire_packet(messages.WEIGHT_TARGETS, seq + 1, pack("weight_targets", {"frame": -5}, []))
    for data in (packet, bad, packet, bad, packet):
        mcu.send(data)
    mcu.run_for(10_000)
    answers = [answer for _, answer in mcu.receive()]
    assert [acknowledged(answer) for answer in answers] == [
        (seq, messages.OK, 0),
        (seq + 1, messages.RANGE, 0),
        (seq, messages.OK, 0),
        (seq + 1, messages.RANGE, 0),
        (seq, messages.OK, 0),
    ]
    session.link._seq = seq + 2
    for number in range(formats.QUEUE_MAX - 1):
        session.live_targets(2000, {0: number})
    session.flush()
    with pytest.raises(LinkRefused) as refusal:
        session.live_targets(2000, {0: 0})
        session.flush()
    assert refusal.value.status == messages.FULL, "one place was taken, and only one"


def acknowledged(wire):
    """The fields of an acknowledgement: sequence number, status, detail."""
    body = bytearray(wire.rstrip(b"\0"))
    length = codec.decode(body, len(body))
    assert body[0] == messages.ACK and codec.is_sealed(body, length)
    return body[2], body[3], body[4] | body[5] << 8


def test_command_after_a_gap_is_answered_with_the_number_expected(mcu):
    session = open_session(VirtualCarrier(mcu))
    expected = session.link._seq
    for ahead in (1, 2, 100, 239):
        mcu.send(wire_packet(messages.STOP, (expected + ahead) & 255, b""))
    mcu.run_for(10_000)
    told = [acknowledged(answer) for _, answer in mcu.receive()]
    assert told == [((expected + ahead) & 255, messages.RESEND, expected) for ahead in (1, 2, 100, 239)]


def hello(seq):
    return wire_packet(
        messages.HELLO, seq & 255, pack("hello", {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY})
    )


def test_greeting_that_was_repeated_or_overtaken_on_its_way_begins_no_session(mcu):
    session = open_session(VirtualCarrier(mcu))
    greeting = session.link._seq - 1
    session.weight_targets(1000, {})
    session.flush()
    mcu.send(hello(greeting) + hello(greeting - 1) + hello(greeting - 7))
    session.pump(1_000)
    session.link.post("ping")
    session.flush()
    assert session.link.counters.repeated == 0, "the session goes on with its numbers"


def test_greeting_with_the_number_of_the_last_one_begins_a_session_later(mcu):
    session = open_session(VirtualCarrier(mcu))
    greeting = session.link._seq - 1
    session.link.post("ping")
    session.flush()
    mcu.run_for(600_000)
    mcu.send(hello(greeting) + wire_packet(messages.STOP, (greeting + 1) & 255, b""))  # where a ping was before
    mcu.run_for(10_000)
    answers = [body for _, body in mcu.receive()]
    assert acknowledged(answers[0]) == (greeting & 255, messages.OK, 0)
    assert acknowledged(answers[-1]) == ((greeting + 1) & 255, messages.OK, 0)


def test_command_of_another_host_is_not_taken_for_one_that_was_carried_out(mcu):
    session = open_session(VirtualCarrier(mcu))
    session.link.post("stop")
    session.flush()
    expected = session.link._seq
    other = wire_packet(messages.WEIGHT_TARGETS, (expected - 1) & 255, pack("weight_targets", {"frame": 9}, []))
    mcu.send(other)
    mcu.run_for(10_000)
    assert [acknowledged(answer) for _, answer in mcu.receive()] == [((expected - 1) & 255, messages.RESEND, expected)]


def test_targets_that_find_no_place_are_counted(mcu):
    session = open_session(VirtualCarrier(mcu))
    session.upload(pet_tables())
    session.start()
    refused = []
    for number in range(formats.QUEUE_MAX // 10 + 3):
        session.weight_targets(10_000 + number, dict.fromkeys(range(10), 0), lambda *_: refused.append(10))
    session.flush()
    assert sum(refused) == 30
    assert session.status()["refused_targets"] == 30
    session.start()
    session.flush()
    assert session.status()["refused_targets"] == 0


def test_mcu_without_a_session_answers_nothing_but_a_greeting(mcu):
    for message_id in (messages.PING, messages.ARM, messages.START, messages.STATUS_REQUEST):
        mcu.send(wire_packet(message_id, 0, b""))
    mcu.run_for(100_000)
    assert mcu.receive() == []
    session = Session(VirtualCarrier(mcu))
    session.open()
    assert session.welcome["frame"] == -1


@pytest.mark.parametrize(
    ("protocol", "dictionary"), [(messages.PROTOCOL + 1, DICTIONARY), (messages.PROTOCOL, DICTIONARY ^ 1)]
)
def test_other_version_is_refused_with_both_numbers(mcu, monkeypatch, protocol, dictionary):
    theirs = messages.PROTOCOL
    monkeypatch.setattr("marotte.session.DICTIONARY", dictionary)
    monkeypatch.setattr(messages, "PROTOCOL", protocol)
    with pytest.raises(LinkForeign) as refusal:
        Session(VirtualCarrier(mcu)).open()
    assert f"the firmware speaks protocol {theirs}, dictionary {DICTIONARY:08x}" in str(refusal.value)
    assert f"this program speaks protocol {protocol}, dictionary {dictionary:08x}" in str(refusal.value)


def test_targets_that_do_not_fit_are_refused_whole(mcu):
    session = open_session(VirtualCarrier(mcu))
    session.upload(Parts(wide_tables()))
    for first in range(0, 250, 50):
        session.link.post(
            "live_targets", {"frame": 3000 + first}, [{"live": 1, "target_q28": 0}] * (46 if first else 48)
        )
    session.flush()
    free = formats.QUEUE_MAX - 48 - 4 * 46
    told = []
    for count in (free + 1, free, 1, 0):
        session.link.post(
            "weight_targets",
            {"frame": 5000},
            [{"action": 1, "target_q28": 5}] * count,
            on_refused=lambda status, detail, count=count: told.append((count, status, detail)),
        )
    session.flush()
    assert told == [(free + 1, messages.FULL, free), (1, messages.FULL, 0)]


# Messages that the firmware has to refuse: name, fields that differ from a good message, status, detail.
GOOD = {
    "begin": {
        "frame_rate_hz": 30,
        "dofs": 2,
        "actions": 1,
        "mappings": 1,
        "lives": 1,
        "curves": 1,
        "programs": 1,
        "blinks": 1,
        "seed": 0,
        "noise_spread_q15": 0,
        "hold_q26": 1 << 20,
        "link_timeout_ms": 500,
        "when_silent": 2,
    },
    "robot": {"motor_period_us": 20000, "attach_ms": 2000, "kill_pin": 22, "kill_level": 1, "autostart": 1},
    "device": {"device": 3, "driver": formats.DRIVER_PCA9685},
    "dof": {
        "dof": 0,
        "kind": 0,
        "rest_q15": 0,
        "low_q15": 0,
        "high_q15": 32768,
        "speed_q24": 1 << 24,
        "accel_q24": 1 << 24,
        "signal": 0,
    },
    "character": {
        "dof": 0,
        "position_error_q24": 1 << 28,
        "position_rate_q24": -1 << 28,
        "position_slope_q24": 0,
        "rate_error_q24": 0,
        "rate_rate_q24": 0,
        "rate_slope_q24": 0,
    },
    "output": {
        "dof": 0,
        "driver": formats.DRIVER_PINS,
        "turns": 1,
        "end0_q4us": 4800,
        "end1_q4us": 48000,
        "dead_q15": 0,
        "top_q15": 32768,
    },
    "feedback": {
        "dof": 0,
        "pin": 28,
        "at0_q15": 32768,
        "at1_q15": 32256,
        "gain_q15": 32768,
        "integral_q24": 1 << 24,
        "most_q15": 32768,
        "stall_q15": 32768,
        "stall_ticks": 65535,
    },
    "guard": {"dof": 0, "release_ms": 65535, "duty_q15": 16384, "window_s": 1},
    "action": {
        "action": 0,
        "tempo_q16": 65536,
        "rise_q26": 1 << 20,
        "fall_q26": 1 << 20,
        "first_mapping": 0,
        "mappings": 1,
        "entry": 1,
        "warp_q26": 1 << 20,
        "cycles": 1000,
    },
    "mapping": {"dof": 0, "function": 0, "argument": 0, "low_q15": 0, "high_q15": 0},
    "live": {
        "live": 0,
        "rest_q28": 0,
        "rise_q26": 1 << 20,
        "fall_q26": 1 << 20,
        "predict": formats.PREDICT_KALMAN,
        "process_q16": 1 << 18,
        "noise_q16": 1 << 8,
        "fade_q15": 32767,
    },
    "curve": {"curve": 0, "samples": 2},
    "program": {"program": 0, "words": 2},
    "blink": {"blink": 0, "threshold_q16": 1 << 16, "gap_q18": 1000 << 18},
    "keep": {"kind": 0, "first": 0},
}
ITEMS = {
    "device": [{"setting": setting} for setting in (4, 5, 0x40, 6, 400, 25000)],
    "output": [{"setting": 2}],
    "curve": [{"value_q15": 0}, {"value_q15": 32768}],
    "program": [{"word": 0}, {"word": -65536}],
    "keep": [{"old": formats.NEW}],
}
BAD_FIELDS = [
    *(
        ("begin", name, value)
        for name, value in [("frame_rate_hz", 9), ("frame_rate_hz", 61), ("dofs", 0), ("dofs", 17)]
    ),
    *(("begin", name, value) for name, value in [("actions", 65), ("mappings", 513), ("lives", 17)]),
    *(("begin", name, value) for name, value in [("curves", 65), ("blinks", 129)]),
    *(("begin", name, value) for name, value in [("noise_spread_q15", 32769), ("hold_q26", 0), ("hold_q26", 1 << 26)]),
    *(("begin", name, value) for name, value in [("link_timeout_ms", 99), ("link_timeout_ms", 60001)]),
    ("begin", "when_silent", 3),
    *(("robot", "motor_period_us", value) for value in (0, 3000, 3012, 19999, 20008, 65535)),
    *(("robot", "kill_pin", value) for value in (0, 1, 23, 24, 25, 29, 254)),
    *(("robot", name, value) for name, value in [("attach_ms", 2001), ("kill_level", 2), ("autostart", 2)]),
    *(("device", name, value) for name, value in [("device", 4), ("device", 255), ("driver", 3), ("driver", 255)]),
    *(("dof", name, value) for name, value in [("dof", 1), ("dof", 255), ("kind", 2), ("rest_q15", 32769)]),
    *(("dof", name, value) for name, value in [("high_q15", 32769), ("low_q15", 32769), ("low_q15", 65535)]),
    *(("dof", name, value) for name in ("speed_q24", "accel_q24") for value in (0, (1 << 24) + 1, 0xFFFFFFFF)),
    ("dof", "accel_q24", 1),
    *(("dof", "signal", value) for value in (2, 255)),
    *(("character", "dof", value) for value in (1, 255)),
    *(
        ("character", name, value)
        for name in GOOD["character"]
        if name != "dof"
        for value in ((1 << 28) + 1, (-1 << 28) - 1, 0x7FFFFFFF, -0x80000000)
    ),
    *(("output", name, value) for name, value in [("dof", 1), ("dof", 255), ("driver", 3), ("driver", 255)]),
    *(("output", name, value) for name, value in [("turns", 0), ("turns", 2), ("turns", 255)]),
    *(("output", name, value) for name in ("end0_q4us", "end1_q4us") for value in (0, 4799, 48001, 65535)),
    *(("output", name, value) for name, value in [("dead_q15", 32768), ("dead_q15", 65535), ("top_q15", 32769)]),
    *(("feedback", name, value) for name, value in [("dof", 1), ("dof", 255), ("pin", 2), ("pin", 25), ("pin", 29)]),
    *(("feedback", name, 32769) for name in ("at0_q15", "at1_q15", "gain_q15", "most_q15", "stall_q15")),
    *(("feedback", name, value) for name, value in [("at1_q15", 32257), ("at1_q15", 32768)]),
    *(("feedback", "integral_q24", value) for value in ((1 << 24) + 1, 0xFFFFFFFF)),
    *(("guard", name, value) for name, value in [("dof", 1), ("dof", 255), ("duty_q15", 0), ("duty_q15", 32769)]),
    ("guard", "window_s", 0),
    *(
        ("action", name, value)
        for name, value in [("action", 1), ("action", 255), ("tempo_q16", 3276), ("tempo_q16", 0)]
    ),
    *(("action", name, value) for name, value in [("tempo_q16", 524289), ("tempo_q16", 0xFFFFFFFF), ("rise_q26", 0)]),
    *(("action", name, value) for name, value in [("rise_q26", 1 << 26), ("fall_q26", 0), ("fall_q26", 0x80000000)]),
    *(("action", name, value) for name, value in [("first_mapping", 1), ("first_mapping", 65535)]),
    *(
        ("action", name, value)
        for name, value in [("mappings", 2), ("entry", 2), ("warp_q26", 0), ("warp_q26", 1 << 26)]
    ),
    *(("action", name, value) for name, value in [("cycles", 1001), ("entry", 0)]),
    *(("mapping", name, value) for name, value in [("dof", 2), ("dof", 255), ("function", 9), ("function", 255)]),
    *(("mapping", name, value) for name, value in [("low_q15", 32769), ("high_q15", 32769)]),
    *(("live", name, value) for name, value in [("live", 1), ("live", 255), ("rest_q28", (1 << 28) + 1)]),
    *(("live", name, value) for name, value in [("rest_q28", 0xFFFFFFFF), ("rise_q26", 0), ("fall_q26", 1 << 26)]),
    *(("live", name, value) for name, value in [("predict", 2), ("predict", 255), ("fade_q15", 32768)]),
    *(("live", name, value) for name in ("process_q16", "noise_q16") for value in ((1 << 27) + 1, 0xFFFFFFFF)),
    ("live", "noise_q16", 0),
    *(("curve", name, value) for name, value in [("curve", 1), ("samples", 1), ("samples", 257)]),
    *(("program", name, value) for name, value in [("program", 1), ("words", 0), ("words", 129)]),
    *(
        ("blink", name, value)
        for name, value in [("blink", 1), ("threshold_q16", 65537), ("gap_q18", (1000 << 18) + 1)]
    ),
    *(("keep", name, value) for name, value in [("kind", 3), ("first", 1), ("first", 255)]),
]


def field_number(name, field):
    """The place of a field in its message, as the acknowledgement's detail counts them."""
    if name == "mapping":
        return 1 + list(GOOD["mapping"]).index(field)
    return list(GOOD[name]).index(field)


def order_of(name):
    """The messages that have to come before one of this name, and that message: `(name, fields, items)`."""
    for step in GOOD:
        if step == "mapping":
            yield "mappings", {"first_mapping": 0}, [GOOD["mapping"]]
        else:
            yield step, GOOD[step], ITEMS.get(step, [])
        if step == name:
            return


@pytest.fixture(scope="module")
def loaded():
    """An MCU with the pet loaded, a session with it, and the taps of its first frames."""
    with UnixMcu() as mcu:
        session = open_session(VirtualCarrier(mcu))
        session.upload(pet_tables())
        yield session, play(session)


def refused(session, name, fields=None, items=None):
    """Post a message; return status and detail of its refusal, None if it was carried out."""
    told = []
    session.link.post(name, fields or {}, items, on_refused=lambda *answer: told.append(answer))
    session.flush()
    return told[0] if told else None


@pytest.mark.parametrize(("name", "field", "value"), BAD_FIELDS)
def test_part_with_a_field_out_of_range_is_refused_and_changes_nothing(loaded, name, field, value):
    session, first_taps = loaded
    *before, (last, fields, items) = order_of(name)
    for part in before:
        assert refused(session, *part) is None
    if name == "mapping":
        items = [items[0] | {field: value}]
    else:
        fields = fields | {field: value}
    number = field_number(name, field)
    if (name, field) in (("action", "mappings"), ("action", "entry")):
        number = {number, field_number(name, "first_mapping"), field_number(name, "cycles")}
    if field == "low_q15":
        number = {number, number + 1} if name == "dof" else {number}
    status, detail = refused(session, last, fields, items)
    assert status == messages.RANGE and (detail == number or detail in (number if isinstance(number, set) else ()))
    assert refused(session, "commit")[0] in (messages.INCOMPLETE, messages.STATE)
    assert play(session) == first_taps


@pytest.mark.parametrize(
    ("function", "argument", "taken"),
    [(2, 15, True), (2, 16, False), (3, 32768, True), (3, 32769, False), (4, 0, True), (4, 1, False), (0, 65535, True)]
    + [(function, argument, argument == 0) for function in (5, 6, 7, 8) for argument in (0, 1, 65535)],
)
def test_mapping_with_an_argument_out_of_range_is_refused(loaded, function, argument, taken):
    session, first_taps = loaded
    for part in order_of("action"):
        assert refused(session, *part) is None
    item = GOOD["mapping"] | {"function": function, "argument": argument}
    expected = None if taken else (messages.RANGE, 3)
    assert refused(session, "mappings", {"first_mapping": 0}, [item]) == expected
    assert play(session) == first_taps


@pytest.mark.parametrize("function", [formats.FUNCTION_BLINK, formats.FUNCTION_RTRIGSIN])
@pytest.mark.parametrize("signal", [0, 1])
def test_blink_on_a_dof_whose_signal_is_processed_is_refused(loaded, function, signal):
    session, first_taps = loaded
    begin = GOOD["begin"] | {"dofs": 1}
    for part in (("begin", begin), ("robot", GOOD["robot"]), ("dof", GOOD["dof"] | {"signal": signal})):
        assert refused(session, *part) is None
    assert refused(session, "action", GOOD["action"]) is None
    item = GOOD["mapping"] | {"function": function}
    expected = (messages.RANGE, 2) if signal else None
    assert refused(session, "mappings", {"first_mapping": 0}, [item]) == expected
    assert play(session) == first_taps


def test_bad_tables_leave_those_that_are_loaded(loaded):
    session, first_taps = loaded
    parts = list(pet_tables().messages())
    for number, (name, _, _) in enumerate(parts[:-1]):
        if name not in ("output", "character", "feedback", "guard"):  # which a DOF may lack
            with pytest.raises(LinkRefused):
                session.upload(Parts(parts[:number] + parts[number + 1 :]))
            assert play(session) == first_taps, name


def test_tables_with_an_output_refused_leave_those_that_are_loaded(loaded):
    session, first_taps = loaded
    parts = list(pet_tables().messages())
    pins = [number for number, (name, _, _) in enumerate(parts) if name == "output"]
    clash = ("output", parts[pins[1]][1], [{"setting": parts[pins[0]][2][0]["setting"] + 16}])
    with pytest.raises(LinkRefused, match="refused 'output': a field is out of range") as refusal:
        session.upload(Parts([*parts[: pins[1]], clash, *parts[pins[1] + 1 :]]))
    assert (refusal.value.status, refusal.value.detail) == (messages.RANGE, 7)
    assert refused(session, "commit")[0] == messages.STATE
    assert play(session) == first_taps


@pytest.mark.parametrize(
    ("name", "items", "detail"),
    [
        ("curve", [{"value_q15": 0}, {"value_q15": 32769}], 3),
        ("curve", [{"value_q15": 0}] * 3, 4),
        ("program", [{"word": 0}, {"word": 1 << 21}], 3),
        ("program", [{"word": 6}, {"word": 6}], 3),
        ("program", [{"word": 0}] * 3, 4),
        ("keep", [{"old": formats.NEW}] * 2, 1),
        ("device", [{"setting": 1}] * 9, 10),
        ("device", [{"setting": setting} for setting in (4, 5, 0x3F, 6, 400, 25000)], 4),
        ("output", [{"setting": 2}] * 7, 13),
        ("output", [{"setting": 2}] * 2, 8),
        ("output", [], 7),
        *(("output", [{"setting": pin}], 7) for pin in (0, 1, 6, 22, 23, 255, 65535)),
    ],
)
def test_part_with_a_bad_item_is_refused(loaded, name, items, detail):
    session, first_taps = loaded
    *before, (_, fields, _) = order_of(name)
    for part in before:
        assert refused(session, *part) is None
    assert refused(session, name, fields, items) == (messages.RANGE, detail)
    assert play(session) == first_taps


@pytest.mark.parametrize(
    ("part", "field", "value"), [("begin", "frame_rate_hz", 31), ("robot", "motor_period_us", 10000)]
)
def test_tables_of_another_rate_are_not_exchanged_while_the_motion_runs(mcu, part, field, value):
    session = begin_performance(mcu)
    *parts, _ = wide_tables()
    for name, fields, items in parts:
        assert refused(session, name, fields | {field: value} if name == part else fields, items) is None
    assert refused(session, "commit") == (messages.STATE, 0)
    with UnixMcu() as other:
        calm = begin_performance(other)
        for performance in (session, calm):
            while len(performance.taps) < FRAMES:
                performance.pump(20_000)
        assert list(calm.taps)[:FRAMES] == list(session.taps)[:FRAMES]


def test_commands_that_the_state_forbids_are_refused(mcu):
    session = open_session(VirtualCarrier(mcu))
    names = ["start", "arm", "commit", "calibrate", "limit", *GOOD, "save_end"]
    for name in [name for name in names if name not in ("begin", "mapping")]:
        fields = (GOOD | LIVE).get(name, {})
        assert refused(session, name, fields)[0] == messages.STATE, name
    assert refused(session, "mappings", {"first_mapping": 0}, [GOOD["mapping"]])[0] == messages.STATE
    assert session.status()["frame"] == -1
    parts = [part for part in pet_tables().messages() if part[0] != "output"]
    session.upload(Parts(parts))
    assert refused(session, "arm") == (messages.STATE, 0)  # nothing to drive
    assert not session.status()["armed"]


def test_message_of_a_wrong_length_or_id_is_refused_and_changes_nothing(loaded):
    session, first_taps = loaded
    for message in messages.MESSAGES:
        name, message_id, fields, _ = message
        if message_id >= 128:
            continue
        for length in (0, messages.size(fields) - 1, messages.size(fields) + 1, 244):
            if length >= 0 and not messages.length_fits(message, length):
                assert raw(session, message_id, bytes(length)) == (messages.LENGTH, length), name
    for message_id in set(range(128)) - {message[1] for message in messages.MESSAGES}:
        assert raw(session, message_id, bytes(5)) == (messages.UNKNOWN, message_id)
    session.open()
    assert play(session) == first_taps


LIVE = {
    "calibrate": {"dof": 0, "end0_q4us": 4800, "end1_q4us": 48000, "dead_q15": 0, "top_q15": 32768},
    "limit": {"dof": 0, "low_q15": 0, "high_q15": 32768, "speed_q24": 1 << 24, "accel_q24": 1 << 24},
}
BAD_LIVE = [
    *(("calibrate", "dof", value) for value in (1, 16, 255)),
    *(("calibrate", name, value) for name in ("end0_q4us", "end1_q4us") for value in (0, 4799, 48001, 65535)),
    *(("calibrate", name, value) for name, value in [("dead_q15", 32768), ("top_q15", 32769), ("top_q15", 65535)]),
    *(("limit", "dof", value) for value in (2, 16, 255)),
    *(("limit", name, value) for name, value in [("low_q15", 32769), ("high_q15", 32769), ("high_q15", 65535)]),
    *(("limit", "speed_q24", value) for value in (0, (1 << 24) + 1, 0x3FFFFFFF, 0x40000000, 0xFFFFFFFF)),
    *(("limit", "accel_q24", value) for value in (0, 1, (1 << 24) + 1, 0x40000000, 0xFFFFFFFF)),
]


def two_dofs():
    """A puppet of two DOFs, of which the first has an output."""
    yield "begin", GOOD["begin"] | {"actions": 0, "mappings": 0} | dict.fromkeys(PARTS_LEFT_OUT, 0), []
    yield "robot", GOOD["robot"] | {"kill_pin": formats.NO_PIN, "autostart": 0}, []
    for dof in range(2):
        yield "dof", GOOD["dof"] | {"dof": dof}, []
    yield "output", GOOD["output"], ITEMS["output"]
    yield "commit", {}, []


PARTS_LEFT_OUT = ("lives", "curves", "programs", "blinks")


@pytest.mark.parametrize(("name", "field", "value"), BAD_LIVE)
def test_change_of_what_plays_is_refused_if_a_field_is_out_of_range(mcu, name, field, value):
    session = open_session(VirtualCarrier(mcu))
    session.upload(Parts(two_dofs()))
    assert refused(session, name, LIVE[name]) is None
    assert refused(session, name, LIVE[name] | {field: value}) == (messages.RANGE, list(LIVE[name]).index(field))
    assert refused(session, name, LIVE[name]) is None, "and nothing else is"


def test_change_of_what_plays_leaves_tables_that_are_being_filled(mcu):
    session = open_session(VirtualCarrier(mcu))
    *parts, commit = two_dofs()
    session.upload(Parts([*parts, commit]))
    for part in parts:
        assert refused(session, *part) is None
    assert refused(session, "limit", LIVE["limit"] | {"accel_q24": 0}) == (messages.RANGE, 4)
    assert refused(session, *commit) is None


def raw(session, message_id, payload):
    """Send any packet as the next command; return status and detail of its answer."""
    link = session.link
    mcu = session.carrier.mcu
    mcu.receive()
    mcu.send(wire_packet(message_id, link._seq, payload))
    mcu.run_for(1000)
    seq, status, detail = acknowledged(mcu.receive()[0][1])
    assert seq == link._seq
    link._seq = (link._seq + 1) & 255
    return status, detail


@pytest.mark.parametrize(
    ("name", "frame", "items", "detail"),
    [
        ("weight_targets", -2, [], 0),
        ("weight_targets", -0x80000000, [], 0),
        ("weight_targets", 5, [{"action": 64, "target_q28": 0}], 1),
        ("weight_targets", 5, [{"action": 0, "target_q28": 0}, {"action": 255, "target_q28": 0}], 3),
        ("weight_targets", 5, [{"action": 0, "target_q28": (1 << 30) + 1}], 2),
        ("weight_targets", 5, [{"action": 0, "target_q28": 0}, {"action": 0, "target_q28": 0xFFFFFFFF}], 4),
        ("live_targets", 5, [{"live": 16, "target_q28": 0}], 1),
        ("live_targets", 5, [{"live": 0, "target_q28": (1 << 28) + 1}], 2),
        ("tempo", 5, [{"action": 64, "tempo_q16": 65536}], 1),
        ("tempo", 5, [{"action": 0, "tempo_q16": 65536}, {"action": 255, "tempo_q16": 65536}], 3),
        ("tempo", 5, [{"action": 0, "tempo_q16": 3276}], 2),
        ("tempo", 5, [{"action": 0, "tempo_q16": 524289}], 2),
        ("tempo", 5, [{"action": 255, "tempo_q16": 16383}], 2),
        ("tempo", 5, [{"action": 255, "tempo_q16": 262145}], 2),
        ("tempo", 5, [{"action": 255, "tempo_q16": 0x80000000}], 2),
        ("gains", -2, [], 0),
        ("gains", 5, [{"band": 7, "gain4_q16": 0}], 1),
        ("gains", 5, [{"band": 6, "gain4_q16": 8 << 16}, {"band": 255, "gain4_q16": 0}], 3),
        ("gains", 5, [{"band": 0, "gain4_q16": (8 << 16) + 1}], 2),
        ("gains", 5, [{"band": 0, "gain4_q16": 0}, {"band": 1, "gain4_q16": 0xFFFFFFFF}], 4),
    ],
)
def test_targets_out_of_range_are_refused_whole(loaded, name, frame, items, detail):
    session, first_taps = loaded
    assert refused(session, name, {"frame": frame}, items) == (messages.RANGE, detail)
    assert refused(session, "telemetry", {"taps": 16, "taps_every": 1, "weights_every": 1}) == (messages.RANGE, 0)
    assert play(session) == first_taps
