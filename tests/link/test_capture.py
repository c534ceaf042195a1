"""Captures of the link: what was sent is in them, an MCU does it again, and their figures are those of the bytes."""

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte import cli
from marotte.capture import CaptureError, CapturingCarrier, Record, packets, read_capture
from marotte.link import VirtualCarrier, pack, wire_packet
from marotte.link_tools import dump, replay, stats, stats_text
from marotte.mcu.unix import UnixMcu
from marotte.session import DICTIONARY
from shared import messages
from tests.link.stage import PUPPETS, begin_performance_over, pet_tables

HEADER = f"marotte-capture 1 protocol {messages.PROTOCOL} dictionary {DICTIONARY:08x}\n"
FRAMES = 45
PLAY_US = 1_700_000


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture of the pet's performance on the PC's MCU in virtual time; a command is refused, a packet damaged."""
    path = tmp_path_factory.mktemp("captures") / "pet.capture"
    with UnixMcu() as mcu:
        carrier = CapturingCarrier(VirtualCarrier(mcu), path)
        session = begin_performance_over(carrier)
        carrier.write(b"\x05\x05\x05\0")
        session.link.post("weight_targets", {"frame": -1}, [{"action": 64, "target_q28": 7}], lambda *refusal: None)
        while len(session.taps) < FRAMES:
            session.pump(20_000)
        session.status()
        session.stop()
        session.flush()
        carrier.close()
    return path


def capture_of(path, *records):
    """Write a capture of records: time, direction and bytes."""
    path.write_text(HEADER + "".join(f"{at_us} {way} {data.hex()}\n" for at_us, way, data in records))
    return path


def test_dump_tells_what_was_sent_and_what_came(capture):
    lines = list(dump(read_capture(capture)))
    sent = [line.split()[3] for line in lines if line.split()[1] == ">" and "damaged" not in line]
    upload = [name for name, _, _ in pet_tables().messages()]
    start = sent.index("begin")
    assert sent[start : start + len(upload)] == upload
    texts = [line.split(maxsplit=3)[3] for line in lines]
    assert "weight_targets frame=0 [action=0, target=1] [action=1, target=0.5] [action=2, target=3]" in texts
    assert "tempo frame=40 [action=255, tempo=1.5]" in texts
    assert "weight_targets frame=next [action=64, target=2.6077e-08]" in texts
    assert "ack seq=0 status=0 (done) detail=0" in texts
    assert any(text.startswith("robot motor_period=20000 us attach=") for text in texts)
    assert [line[13:] for line in lines if "damaged, " in line] == ["> --- damaged, 3 bytes: 05 05 05"]
    assert sum(text.startswith("taps ") for text in texts) >= FRAMES
    times = [float(line.split()[0]) for line in lines]
    assert times == sorted(times) and times[-1] > 1


LIVE_FIELDS = {
    "live": 3, "rest_q28": 1 << 27, "rise_q26": 1, "fall_q26": 1 << 24, "predict": 0, "process_q16": 0, "noise_q16": 0,
    "fade_q15": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "fields", "items", "expected"),
    [
        ("ping", {}, [], "ping"),
        ("live", LIVE_FIELDS, [], "rise=1.49012e-08 fall=0.25 predict=0 process=0 noise=0 fade=0"),
        ("calibrate", {"dof": 0, "end0_q4us": 16008, "end1_q4us": 0, "dead_q15": 0, "top_q15": 0}, [], "us dead=0 top=0"),
        ("guard", {"dof": 0, "release_ms": 9, "duty_q15": 0, "window_s": 8}, [], "release=9 ms duty=0 window=8 s"),
        ("save_begin", {"bytes": 9, "crc32": 255}, [], "bytes=9 crc32=000000ff"),
        ("ack", {"seq": 1, "status": 5, "detail": 2}, [], "seq=1 status=5 (a field is out of range) detail=2"),
        ("ack", {"seq": 1, "status": 77, "detail": 2}, [], "seq=1 status=77 detail=2"),
        ("weights", {"frame": -2}, [{"action": 1, "weight_q12": 2048}], "frame=-2 [action=1, weight=0.5]"),
    ],
)  # fmt: skip
def test_dump_tells_fields_in_their_units(name, fields, items, expected):
    message_id = getattr(messages, name.upper())
    wire = wire_packet(message_id, 7, pack(name, fields, items))
    (line,) = dump([Record(1_500_000, message_id < 128, wire)])
    assert line.startswith(f"    1.500000 {'>' if message_id < 128 else '<'}   7 {name}") and line.endswith(expected)


def test_dump_puts_pieces_together_and_shows_what_is_no_packet():
    ping = wire_packet(messages.PING, 9, b"")
    stranger = wire_packet(0x7F, 3, b"\1\2")
    told = wire_packet(messages.ACK, 1, bytes(4))
    records = [
        *(Record(1, True, ping[:3]), Record(2, False, b"\r\n>>> \0" + told[:4]), Record(3, True, ping[3:] + b"\0\0")),
        *(Record(4, False, told[4:]), Record(5, True, stranger + told), Record(6, False, b"\1" * 5000)),
    ]
    lines = [line.split(maxsplit=1)[1] for line in dump(records)]
    assert lines[:4] == [
        "< --- damaged, 6 bytes: 0d 0a 3e 3e 3e 20",
        ">   9 ping",
        "<   1 ack seq=0 status=0 (done) detail=0",
        ">   3 unknown message: " + stranger[:-1].hex(" "),
    ]
    assert lines[4].startswith("> --- damaged, 11 bytes: "), "an answer does not go to the MCU"
    assert all(line.startswith("< --- damaged, ") for line in lines[5:]) and len(lines) < 12


# --- replay


def check_replay(capture, mcu, frames):
    result = replay(read_capture(capture), VirtualCarrier(mcu))
    assert result.differences == []
    assert result.answers > 70 and result.frames >= frames


def test_replay_on_the_same_mcu_agrees(capture):
    with UnixMcu() as mcu:
        check_replay(capture, mcu, FRAMES)


@pytest.mark.images
def test_replay_on_an_rp2040_agrees(capture, rp2040_mcu):
    with rp2040_mcu() as mcu:
        check_replay(capture, mcu, FRAMES - 15)  # it begins later, as it takes its time


def rewritten(capture, path, change):
    """Write a capture in which the MCU's packets are what `change(packet)` makes of them: bytes, or None for no change."""
    records = []
    for packet in packets(read_capture(capture)):
        changed = None if packet.to_mcu else change(packet)
        data = packet.wire + b"\0" if changed is None else changed
        if data:
            records.append((packet.at_us, ">" if packet.to_mcu else "<", data))
    return capture_of(path, *records)


def other_tap(packet):
    """Change one value of the taps of frame 30."""
    message = packet.message
    if message and message.name == "taps" and message.fields["frame"] == 30:
        message.items[4]["value_q15"] ^= 1
        return wire_packet(messages.TAPS, packet.seq, pack("taps", message.fields, message.items))
    return None


def other_answer(packet):
    """Change the detail of the refusal."""
    message = packet.message
    if message and message.name == "ack" and message.fields["status"] == messages.RANGE:
        return wire_packet(messages.ACK, packet.seq, pack("ack", message.fields | {"detail": 9}))
    return None


def no_answer(packet):
    """Take the refusal away."""
    message = packet.message
    return b"" if message and message.name == "ack" and message.fields["status"] == messages.RANGE else None


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (other_tap, ["taps of frame 30, start 1, are not those of the capture"]),
        (other_answer, ["(weight_targets) has status 5, detail 9"]),
        (
            no_answer,
            ["(weight_targets) has status 5, detail 1, in the capture command", "what follows cannot be compared"],
        ),
    ],
)
def test_replay_tells_what_is_not_as_in_the_capture(capture, tmp_path, change, expected):
    changed = rewritten(capture, tmp_path / "changed.capture", change)
    with UnixMcu() as mcu:
        result = replay(read_capture(changed), VirtualCarrier(mcu))
    assert not result.agrees and len(result.differences) == len(expected)
    for difference, part in zip(result.differences, expected, strict=True):
        assert part in difference


def test_replay_of_a_mcu_that_is_deaf_tells_that_answers_are_missing(capture):
    class Deaf(VirtualCarrier):
        def write(self, data):
            pass

    with UnixMcu() as mcu:
        result = replay(read_capture(capture), Deaf(mcu))
    assert (
        result.answers == 0 and "answer 1: none, in the capture command 0 (hello) has status 0" in result.differences[0]
    )


# --- stats


def ack(number, seq, status=messages.OK):
    return wire_packet(messages.ACK, number, bytes([seq, status, 0, 0]))


def test_stats_are_those_of_a_capture_written_by_hand(tmp_path):
    ping, stop, start = (
        wire_packet(message_id, seq, b"")
        for message_id, seq in ((messages.PING, 5), (messages.STOP, 6), (messages.START, 7))
    )
    path = capture_of(
        tmp_path / "hand.capture",
        (0, ">", b"\0" + ping),
        (1_000, "<", ack(0, 5)),
        (2_000, ">", stop + start),
        (2_500, "<", ack(1, 7, messages.RESEND)),  # the first of the two was lost
        (3_000, ">", stop + start),
        (6_000, "<", ack(2, 6)),
        (9_000, "<", ack(5, 7, messages.STATE) + b"\x09\x09\0"),  # two packets of telemetry were lost before it
        (10_000, ">", b"\1\1\1\1\0" + wire_packet(messages.PING, 8, b"")),
        (1_000_000, "<", b"\0"),
    )
    figures = stats(read_capture(path))
    assert figures.length_us == 1_000_000
    assert figures.to_mcu.packets == {"ping": 2, "stop": 2, "start": 2}
    assert figures.to_mcu.bytes == {"ping": 16, "stop": 16, "start": 16}
    assert (figures.to_mcu.damaged, figures.to_mcu.damaged_bytes, figures.to_mcu.all_bytes) == (1, 5, 53)
    assert figures.to_mcu.error_rate == 1 / 7
    assert figures.from_mcu.packets == {"ack": 4} and figures.from_mcu.bytes == {"ack": 48}
    assert (figures.from_mcu.damaged, figures.from_mcu.damaged_bytes) == (1, 3)
    assert (figures.repeated, figures.resends, figures.refused, figures.unanswered, figures.lost) == (2, 1, 1, 1, 2)
    assert figures.round_trips_us == [1_000, 4_000, 7_000]
    assert [figures.round_trip_us(percent) for percent in (1, 33, 34, 50, 67, 99, 100)] == [
        *(1_000, 1_000, 4_000, 4_000, 7_000, 7_000, 7_000)
    ]
    lines = stats_text(figures, 9600).splitlines()
    assert lines[0] == "1.000 s"
    assert [line.split() for line in lines[2:8]] == [
        ["to", "the", "MCU", "packets", "bytes", "bytes/s", "of", "9600", "baud"],
        ["ping", "2", "16", "16", "1.67%"],  # eight bytes of ten bits each, twice, of 9600
        ["start", "2", "16", "16", "1.67%"],
        ["stop", "2", "16", "16", "1.67%"],
        ["damaged", "1", "5", "5", "0.52%"],
        ["all", "7", "53", "53", "5.52%"],
    ]
    assert lines[-1] == "round trips    p50 4.000 ms, p99 7.000 ms, max 7.000 ms"
    assert lines[-3] == "commands       2 repeated, 1 gaps told, 1 refused, 1 unanswered"


def test_stats_begin_anew_with_a_session():
    """A MCU that was reset counts from 0; what is no answer to a command is no round trip."""
    hello = wire_packet(messages.HELLO, 0, pack("hello", {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY}))
    figures = stats([Record(0, False, ack(9, 3)), Record(5, True, hello), Record(9, False, ack(0, 0) + ack(1, 4))])
    assert (figures.lost, figures.unanswered, figures.round_trips_us) == (0, 0, [4])


def test_stats_of_an_empty_capture_are_empty(tmp_path):
    figures = stats(read_capture(capture_of(tmp_path / "empty.capture")))
    assert (figures.length_us, figures.round_trips_us, figures.to_mcu.error_rate) == (0, [], 0)
    assert stats_text(figures).endswith("round trips    none")


# --- the file

BAD = {
    "": "bad.capture:1: found '', expected a capture: marotte-capture 1",
    "[dof.A]\n": "bad.capture:1: found '[dof.A]', expected a capture",
    HEADER.replace("capture 1", "capture 2"): "bad.capture:1: is a capture of format 2, expected format 1",
    HEADER.replace(f"{DICTIONARY:08x}", "0123abcd"): "dictionary 0123abcd, expected those of this program: protocol",
    HEADER + "x > 00\n": "bad.capture:2: found 'x > 00', expected TIME_US > HEX or TIME_US < HEX",
    HEADER + "0 > 00\n1 < 0\n": "bad.capture:3: found '1 < 0', expected",
    HEADER + "0 > 00\n1 - 00\n": "bad.capture:3: found '1 - 00', expected",
    HEADER + "-1 > 00\n": "bad.capture:2: found '-1 > 00', expected",
    HEADER + "5 > 00\n\n": "bad.capture:3: found '', expected",
    HEADER
    + "5 > 00\n4 > 00\n": "bad.capture:3: found '4', expected a time that is not before 5, that of the line before",
    HEADER + "5 > " + "00" * 200_000 + "\n": "bad.capture:2: found '5 > 000",
    HEADER + "5 > \u20ac\n": "bad.capture: cannot be read: expected a capture, a text file",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_bad_capture_is_refused_with_its_place(tmp_path, capsys, text):
    path = tmp_path / "bad.capture"
    path.write_text(text, "utf-8")
    with pytest.raises(CaptureError) as refusal:
        list(read_capture(path))
    assert BAD[text] in str(refusal.value) and len(str(refusal.value)) < 400
    for tool in ("dump", "stats"):
        assert cli.main(["link", tool, str(path)]) == cli.FAILURE
        assert BAD[text] in capsys.readouterr().err


@pytest.mark.parametrize("name", ["absent.capture", "", "a\0b"])
def test_capture_that_is_not_there_is_an_error(tmp_path, name):
    with pytest.raises(CaptureError, match="cannot be read"):
        list(read_capture(tmp_path / name))


@given(
    st.text(max_size=200)
    | st.lists(st.sampled_from(["0 > 00\n", "1 < 05050500\n", "0 <", "\n", "9" * 30]), max_size=9).map("".join)
)
def test_any_text_is_a_capture_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.capture"
    path.write_text(HEADER + text, "utf-8", newline="")
    try:
        records = list(read_capture(path))
    except CaptureError as error:
        assert str(path) in str(error)
    else:
        assert all(record.data for record in records)
        figures = stats(records)
        flows = figures.to_mcu, figures.from_mcu
        assert len(list(dump(records))) == sum(flow.all_packets + flow.damaged for flow in flows)


@given(st.lists(st.tuples(st.booleans(), st.binary(min_size=1, max_size=40)), max_size=12))
def test_any_bytes_are_captured_told_and_counted(tmp_path_factory, pieces):
    class Carrier:
        def __init__(self):
            self.at_us = itertools.count(0, 3)
            self.sent = b""

        def now_us(self):
            return next(self.at_us)

        def write(self, data):
            self.sent += data

        def read(self, wait_us):
            return self.data

        def close(self):
            pass

    path = tmp_path_factory.getbasetemp() / "bytes.capture"
    inner = Carrier()
    carrier = CapturingCarrier(inner, path)
    for to_mcu, data in pieces:
        if to_mcu:
            carrier.write(data)
        else:
            inner.data = data
            assert carrier.read(0) == data
    carrier.close()
    records = list(read_capture(path))
    assert [(record.to_mcu, record.data) for record in records] == pieces
    assert inner.sent == b"".join(data for to_mcu, data in pieces if to_mcu)
    ends = {way: b"".join(data for to_mcu, data in pieces if to_mcu == way).split(b"\0")[:-1] for way in (True, False)}
    assert len(list(dump(records))) == sum(map(bool, (*ends[True], *ends[False])))


class Echo:
    """A carrier that brings back what it was given."""

    def __init__(self):
        self.data = b""

    def now_us(self):
        return 0

    def write(self, data):
        self.data += data

    def read(self, wait_us):
        return self.data

    def close(self):
        pass


def test_capture_that_cannot_be_written_says_so():
    for path, why in (("/dev/full", "no space left on device"), ("/absent/x.capture", "no such file or directory")):
        with pytest.raises(CaptureError, match=f"{path}: cannot be written: {why}"):
            CapturingCarrier(Echo(), path)


def test_capture_on_a_disk_that_fills_up_says_so_once_and_lets_everything_pass(tmp_path):
    inner = Echo()
    carrier = CapturingCarrier(inner, tmp_path / "x.capture")
    with Path("/dev/full").open("w", buffering=1) as full:
        carrier._file.close()
        carrier._file = full
        with pytest.raises(CaptureError, match=r"x.capture: cannot be written: no space left on device"):
            carrier.write(b"kill")
        carrier.write(b"stop")
        assert inner.data == b"killstop" and carrier.read(0) == b"killstop"
        carrier.close()


# --- the command line


@pytest.mark.parametrize("tool", ["dump", "replay", "stats"])
def test_link_tools_have_help_with_an_example(capsys, tool):
    with pytest.raises(SystemExit) as end:
        cli.main(["link", tool, "--help"])
    assert end.value.code == 0
    assert f"  marotte link {tool} run.capture" in capsys.readouterr().out


def test_link_tools_do_their_work(capture, capsys, tmp_path, monkeypatch):
    assert cli.main(["link", "dump", str(capture)]) == cli.FINE
    shown = capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", capture.open())
    assert cli.main(["link", "dump", "-"]) == cli.FINE
    assert capsys.readouterr().out == shown and " hello protocol=" in shown
    assert cli.main(["link", "stats", str(capture), "--baud", "9600"]) == cli.FINE
    assert "of 9600 baud" in capsys.readouterr().out
    robot = str(PUPPETS / "pet-robot.toml")
    assert cli.main(["link", "replay", str(capture), "--mcu", "unix", "--robot", robot]) == cli.FINE
    assert "the emulated unix did as in the capture: " in capsys.readouterr().out
    changed = str(rewritten(capture, tmp_path / "changed.capture", other_tap))
    assert cli.main(["link", "replay", changed, "--mcu", "unix"]) == cli.FAILURE
    assert "the emulated unix did not as in the capture: " in capsys.readouterr().out


def test_run_captures_what_goes_over_the_link(capsys, tmp_path):
    path = tmp_path / "run.capture"
    files = [str(PUPPETS / "pet.toml"), "--score", str(PUPPETS / "pet-score.toml")]
    options = ["--mcu", "unix", "--no-view", "--seconds", "0.3"]
    assert cli.main(["run", *files, *options, "--capture", str(path)]) == cli.FINE
    figures = stats(read_capture(path))
    assert figures.to_mcu.packets["begin"] == figures.to_mcu.packets["kill"] == 1
    assert (figures.unanswered, figures.to_mcu.damaged) == (0, 0)
    assert len(figures.round_trips_us) == figures.to_mcu.all_packets
    assert cli.main(["run", *files, *options, "--capture", str(tmp_path)]) == cli.FAILURE
    assert "cannot be written: is a directory" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["link"], "usage: marotte link"),
        (["link", "dump"], "usage: marotte link dump"),
        (["link", "replay", "x"], "one of the arguments --port --mcu is required"),
        (["link", "stats", "x", "--baud", "0"], "expected bits a second"),
        (["link", "replay", "x", "--port", "y", "--robot", "z"], "--robot is for an emulated MCU"),
    ],
)
def test_wrong_arguments_of_link_are_the_users_mistake(capsys, arguments, expected):
    try:
        status = cli.main(arguments)
    except SystemExit as end:
        status = end.code
    assert status == cli.MISTAKE and expected in capsys.readouterr().err
