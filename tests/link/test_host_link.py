"""The host's end of the link against an MCU that follows a script: losses, gaps, repetitions, silence, and strangers."""

import itertools

import pytest

from marotte.link import (
    HURRY_US,
    RETRY_US,
    SILENT_US,
    URGENT_WINDOW,
    WINDOW,
    WINDOW_BYTES,
    WIRE_OVERHEAD,
    Link,
    LinkRefused,
    LinkSilent,
    LinkTaken,
    pack,
    wire_packet,
)
from marotte.session import DICTIONARY, OPEN_TIMEOUT_S, PING_US, LinkForeign, Session
from shared import formats, messages
from tests.link.carriers import ScriptedCarrier, ack
from tests.link.safety import puppet_text, tables_of

STEP_US = 1000
DELAY_US = 3000


def settle(link, limit_us=3_000_000):
    """Pump until all commands are acknowledged."""
    waited_us = 0
    while link.pending:
        link.pump(STEP_US)
        waited_us += STEP_US
        assert waited_us < limit_us
    return waited_us


def link_to(script):
    """A link to a scripted MCU, with its carrier and the list of the messages that come."""
    carrier = ScriptedCarrier(script)
    received = []
    return Link(carrier, received.append), carrier, received


def faithful(number, message_id, seq):
    return ack(seq), DELAY_US


def test_link_keeps_no_more_than_its_window_under_way():
    link, carrier, _ = link_to(faithful)
    for _ in range(3 * WINDOW):
        link.post("ping")
    assert len(carrier.arrived) == WINDOW
    assert link.pending == 3 * WINDOW
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == list(range(3 * WINDOW))
    assert link.counters.repeated == 0


def test_link_keeps_few_bytes_under_way():
    link, carrier, _ = link_to(faithful)
    items = [{"live": 0, "target_q28": 1}] * 20
    for _ in range(10):
        link.post("live_targets", {"frame": -1}, items)
    size = 4 + 20 * 5 + WIRE_OVERHEAD
    assert len(carrier.arrived) == WINDOW_BYTES // size
    link.post("live_targets", {"frame": -1}, [*items, *items])
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == list(range(11))


def test_link_sends_a_command_that_is_longer_than_its_window(monkeypatch):
    monkeypatch.setattr("marotte.link.WINDOW_BYTES", 20)
    link, carrier, _ = link_to(faithful)
    for _ in range(3):
        link.post("live_targets", {"frame": -1}, [{"live": 0, "target_q28": 1}] * 40)
    assert len(carrier.arrived) == 1
    settle(link)
    assert len(carrier.arrived) == 3


def test_kill_overtakes_what_is_not_sent_and_withdraws_an_arm():
    carrier = ScriptedCarrier(faithful)
    session = Session(carrier)
    for _ in range(WINDOW + 2):
        session.start()
    session.arm()
    session.kill()
    session.stop()
    sent = [message_id for message_id, _, _ in carrier.arrived]
    assert sent == [messages.START] * WINDOW + [messages.KILL]
    session.flush()
    sent = [message_id for message_id, _, _ in carrier.arrived]
    assert sent[WINDOW + 1 :] == [messages.START, messages.START, messages.STOP]
    assert [seq for _, seq, _ in carrier.arrived] == list(range(WINDOW + 4))


def test_urgent_commands_wait_where_the_mcu_could_not_remember_so_many():
    link, carrier, _ = link_to(faithful)
    for _ in range(3 * URGENT_WINDOW):
        link.post("kill", urgent=True)
    assert len(carrier.arrived) == URGENT_WINDOW
    settle(link)
    assert len(carrier.arrived) == 3 * URGENT_WINDOW


def test_link_numbers_commands_modulo_256():
    link, carrier, _ = link_to(faithful)
    for _ in range(600):
        link.post("ping")
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == [number % 256 for number in range(600)]


def test_link_repeats_what_is_not_acknowledged_in_time():
    link, carrier, _ = link_to(lambda number, _, seq: (b"" if number == 0 else ack(seq), DELAY_US))
    link.post("ping")
    assert settle(link) == pytest.approx(RETRY_US + DELAY_US, abs=2 * STEP_US)
    assert [seq for _, seq, _ in carrier.arrived] == [0, 0]
    assert link.counters.repeated == 1


def test_link_repeats_all_that_follow_a_lost_command_in_their_order():
    def script(number, message_id, seq):
        if number == 1:
            return b"", DELAY_US  # lost on the way
        if 1 < number < WINDOW:
            return ack(seq, messages.RESEND, 1), DELAY_US
        return ack(seq), DELAY_US

    link, carrier, _ = link_to(script)
    for _ in range(WINDOW):
        link.post("ping")
    waited_us = settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == [*range(WINDOW), *range(1, WINDOW)]
    assert waited_us < RETRY_US / 2, "a gap that the MCU reports is filled at once"


def test_link_asks_at_once_for_an_answer_that_was_lost():
    link, carrier, _ = link_to(lambda number, _, seq: (b"" if number == 0 else ack(seq), DELAY_US))
    for _ in range(WINDOW):
        link.post("ping")
    waited_us = settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == [*range(WINDOW), 0]
    assert waited_us < RETRY_US / 2, "the answer to a later one tells that it was carried out"


def test_link_tells_the_refusals_of_answers_that_overtook_others_in_the_order_of_the_commands():
    def script(number, message_id, seq):
        return (b"" if number == 0 else ack(seq, messages.RANGE, seq), DELAY_US)

    link, _, _ = link_to(script)
    told = []
    for _ in range(WINDOW):
        link.post("ping", on_refused=lambda status, detail: told.append(detail))
    settle(link)
    assert told == list(range(WINDOW))


def test_link_repeats_an_urgent_command_whatever_waits_before_it():
    link, carrier, _ = link_to(lambda *_: (b"", 0))
    link.post("ping")
    link.post("kill", urgent=True)
    for _ in range(2 * RETRY_US // STEP_US):
        link.pump(STEP_US)
    sent = [message_id for message_id, _, _ in carrier.arrived]
    assert sent.count(messages.KILL) >= 2


@pytest.mark.parametrize(
    "answer",
    [lambda seq: ack(seq, messages.RESEND, (seq + 100) & 255), lambda seq: ack((seq + 50) & 255)],
    ids=["gaps of others", "answers to others"],
)
def test_link_that_is_never_answered_says_so_although_the_mcu_can_be_heard(answer):
    link, carrier, _ = link_to(lambda number, _, seq: (answer(seq), DELAY_US))
    link.post("ping")
    with pytest.raises(LinkTaken, match="does another program use this port"):
        settle(link)
    assert carrier.now_us() == pytest.approx(SILENT_US, abs=2 * STEP_US)


def test_link_drops_the_beginning_of_a_packet_whose_end_was_lost():
    def script(number, message_id, seq):
        return (ack(seq)[:-1] if number == 0 else ack(seq), DELAY_US)

    link, carrier, _ = link_to(script)
    link.post("ping")
    assert settle(link) == pytest.approx(RETRY_US + DELAY_US, abs=2 * STEP_US)
    assert len(carrier.arrived) == 2 and link.counters.damaged == 1


def test_link_waits_for_the_answers_that_came_while_the_host_was_suspended():
    link, carrier, _ = link_to(lambda number, _, seq: (ack(seq), 10 * SILENT_US + 2 * STEP_US))
    link.post("ping")
    link.pump(STEP_US)
    carrier.read(10 * SILENT_US)  # the time in which nobody looked
    settle(link)


def test_link_hurries_once_for_all_that_report_a_gap():
    def script(number, message_id, seq):
        return (
            (b"", 0)
            if number == 0
            else (ack(seq, messages.RESEND, 0), DELAY_US)
            if number < WINDOW
            else (ack(seq), DELAY_US)
        )

    link, carrier, _ = link_to(script)
    for _ in range(WINDOW):
        link.post("ping")
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == [*range(WINDOW), *range(WINDOW)]
    assert carrier.arrived[WINDOW][2] - carrier.arrived[0][2] >= min(DELAY_US, HURRY_US)


@pytest.mark.parametrize(
    ("name", "answers"),
    [
        ("twice", lambda seq: ack(seq) + ack(seq)),
        ("with a zero more", lambda seq: b"\0" + ack(seq) + b"\0"),
        ("after an old one", lambda seq: ack((seq - 1) & 255) + ack(seq)),
        ("after one of the future", lambda seq: ack((seq + 3) & 255) + ack(seq)),
        ("after a damaged one", lambda seq: ack(seq, messages.STATE)[:-3] + b"\x55\0" + ack(seq)),
        ("after text", lambda seq: b"Traceback (most recent call last):\r\n\0" + ack(seq)),
        ("after a message that does not exist", lambda seq: wire_packet(0xF0, 0, b"?") + ack(seq)),
        ("after a message of another length", lambda seq: wire_packet(messages.ACK, 0, b"???") + ack(seq)),
        ("after a gap that is none", lambda seq: ack(seq, messages.RESEND, (seq + 9) & 255) + ack(seq)),
    ],
)
def test_link_takes_an_answer(name, answers):
    link, carrier, received = link_to(lambda number, _, seq: (answers(seq), DELAY_US))
    for _ in range(20):
        link.post("ping")
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == list(range(20)), name
    assert received == []


def test_link_takes_an_answer_that_comes_in_pieces():
    link, carrier, received = link_to(faithful)
    telemetry = wire_packet(messages.WEIGHTS, 5, pack("weights", {"frame": 7}, [{"action": 1, "weight_q12": 4096}]))
    pieces = [telemetry[:1], telemetry[1:4], telemetry[4:], telemetry[:-1], telemetry[-1:]]
    carrier.read = lambda wait_us: pieces.pop(0)
    while pieces:
        link.pump(STEP_US)
    assert [(message.name, message.fields, message.items) for message in received] == [
        ("weights", {"frame": 7}, [{"action": 1, "weight_q12": 4096}])
    ] * 2
    assert link.counters.received == 2 and link.counters.damaged == 0


def test_link_keeps_little_of_what_never_ends():
    link, carrier, _ = link_to(faithful)
    carrier.read = lambda wait_us: b"x" * 5000
    for _ in range(50):
        link.pump(STEP_US)
    assert len(link._partial) < 2000


def test_link_tells_a_refusal_by_error_or_callback():
    link, _, _ = link_to(lambda number, _, seq: (ack(seq, messages.RANGE, 258), DELAY_US))
    link.post("stop")
    with pytest.raises(LinkRefused, match="refused 'stop': a field is out of range") as refusal:
        settle(link)
    assert (refusal.value.status, refusal.value.detail) == (messages.RANGE, 258)
    told = []
    link.post("stop", on_refused=lambda status, detail: told.append((status, detail)))
    settle(link)
    assert told == [(messages.RANGE, 258)]


def test_link_goes_on_after_a_refusal():
    link, carrier, _ = link_to(lambda number, _, seq: (ack(seq, 99 if seq == 2 else messages.OK), DELAY_US))
    for _ in range(12):
        link.post("ping")
    with pytest.raises(LinkRefused, match="status 99"):
        settle(link)
    settle(link)
    assert [seq for _, seq, _ in carrier.arrived] == list(range(12))


def test_link_without_answers_is_silent_in_a_second():
    link, carrier, _ = link_to(lambda *_: (b"", 0))
    link.pump(10 * SILENT_US)  # nothing is under way, so nobody is waited for
    start_us = carrier.now_us()
    link.post("ping")
    with pytest.raises(LinkSilent, match="has not answered for 1 s"):
        settle(link)
    assert carrier.now_us() - start_us == pytest.approx(SILENT_US, abs=2 * STEP_US)
    assert link.counters.repeated == pytest.approx(SILENT_US / RETRY_US, abs=1)


def welcome(protocol=messages.PROTOCOL, dictionary=DICTIONARY):
    fields = {name: 0 for name, _ in messages.find(messages.WELCOME)[2]} | {
        "protocol": protocol,
        "dictionary": dictionary,
    }
    return wire_packet(messages.WELCOME, 0, pack("welcome", fields))


@pytest.mark.parametrize("lost", [0, 1, 3])
def test_session_opens_although_greetings_are_lost(lost):
    carrier = ScriptedCarrier(lambda number, _, seq: (b"" if number < lost else ack(seq) + welcome(), DELAY_US))
    session = Session(carrier)
    session.open()
    assert session.welcome["dictionary"] == DICTIONARY
    assert {message_id for message_id, _, _ in carrier.arrived} == {messages.HELLO}
    session.stop()
    session.flush()


def test_greeting_is_sent_although_no_number_suits_it():
    link, carrier, _ = link_to(faithful)
    link.post("hello", {"protocol": messages.PROTOCOL, "dictionary": 0x03030303})
    settle(link)
    assert carrier.arrived[0][:2] == (messages.HELLO, 0)


def test_session_with_nobody_says_so_within_two_seconds():
    carrier = ScriptedCarrier(lambda *_: (b"", 0))
    with pytest.raises(LinkSilent, match=r"no answer within 1.5 s: is the firmware running"):
        Session(carrier).open()
    assert carrier.now_us() <= OPEN_TIMEOUT_S * 1e6 + 2 * STEP_US


@pytest.mark.parametrize(
    "answer",
    [b"login: ", b"\0" * 40, bytes(range(256)), ack(0)[:-2] + b"\0", wire_packet(0x55, 0, b"hello")],
    ids=["a computer", "zeros", "all bytes", "a damaged packet", "packets of others"],
)
def test_session_with_something_else_says_so_within_two_seconds(answer):
    carrier = ScriptedCarrier(lambda *_: (answer, DELAY_US))
    with pytest.raises(LinkForeign, match="not Marotte's firmware"):
        Session(carrier).open()
    assert carrier.now_us() <= OPEN_TIMEOUT_S * 1e6 + 2 * STEP_US


@pytest.mark.parametrize("answer", [b"\r\n>>> ", b"raw REPL; CTRL-B to exit\r\n>"])
def test_session_with_a_repl_says_how_to_get_the_firmware(answer):
    carrier = ScriptedCarrier(lambda *_: (answer, DELAY_US))
    with pytest.raises(LinkForeign, match=r"MicroPython's REPL answers at this port.*`mpremote reset`"):
        Session(carrier).open()


@pytest.mark.parametrize(
    ("protocol", "dictionary", "status"),
    [
        (messages.PROTOCOL + 1, DICTIONARY, messages.MISMATCH),
        (messages.PROTOCOL, DICTIONARY ^ 0x1234, messages.MISMATCH),
        (messages.PROTOCOL + 1, DICTIONARY, messages.OK),
        (messages.PROTOCOL, DICTIONARY, messages.MISMATCH),
    ],
)
def test_session_refuses_another_version_with_both_numbers(protocol, dictionary, status):
    carrier = ScriptedCarrier(lambda number, _, seq: (ack(seq, status) + welcome(protocol, dictionary), DELAY_US))
    with pytest.raises(LinkForeign) as refusal:
        Session(carrier).open()
    text = str(refusal.value)
    assert f"the firmware speaks protocol {protocol}, dictionary {dictionary:08x}" in text
    assert f"this program speaks protocol {messages.PROTOCOL}, dictionary {DICTIONARY:08x}" in text
    assert "flash" in text


def test_session_pings_when_it_has_nothing_to_say():
    carrier = ScriptedCarrier(lambda number, message_id, seq: (ack(seq) + welcome() * (number == 0), DELAY_US))
    session = Session(carrier)
    session.open()
    for _ in range(500):
        session.pump(2000)
    pings = [at_us for message_id, _, at_us in carrier.arrived if message_id == messages.PING]
    assert len(pings) == 1_000_000 // PING_US
    assert max(b - a for a, b in itertools.pairwise(pings)) < 200_000


def test_session_pings_more_often_where_the_mcu_is_soon_to_find_the_link_silent():
    carrier = ScriptedCarrier(faithful)
    session = Session(carrier)
    session.upload(tables_of(puppet_text(["A"]), "link_timeout = 0.1"))
    for _ in range(500):
        session.pump(2000)
    pings = [at_us for message_id, _, at_us in carrier.arrived if message_id == messages.PING]
    assert max(b - a for a, b in itertools.pairwise(pings)) < 40_000


def test_session_splits_targets_into_messages_that_fit():
    carrier = ScriptedCarrier(faithful)
    session = Session(carrier)
    session.weight_targets(9, {action: action << 20 for action in range(64)})
    session.flush()
    assert [message_id for message_id, _, _ in carrier.arrived] == [messages.WEIGHT_TARGETS] * 5


def test_session_sends_the_newest_of_the_targets_that_wait():
    carrier = ScriptedCarrier(faithful)
    session = Session(carrier)
    refused = []
    for _ in range(WINDOW):
        session.stop()
    for value in range(5):
        session.weight_targets(formats.FRAME_NOW, {1: value, 2: value}, refused.append)
        session.live_targets(formats.FRAME_NOW, {1: value}, refused.append)
        session.weight_targets(100 + value, {1: value})
    session.weight_targets(formats.FRAME_NOW, {1: 9})
    session.flush()
    sent = [message_id for message_id, _, _ in carrier.arrived][WINDOW:]
    assert sent.count(messages.LIVE_TARGETS) == 1, "one for all"
    assert sent.count(messages.WEIGHT_TARGETS) == 5 + 2, (
        "stamped ones are sent all, and of the others what is not superseded"
    )
    assert refused == []
