"""The file on the MCU's flash: whole or not there, wherever the power is cut; played or ignored, never by half."""

import random
import struct
import zlib
from pathlib import Path

import pytest

from marotte.link import LinkRefused, VirtualCarrier, pack
from marotte.mcu.unix import UnixMcu
from marotte.session import Session
from shared import codec, formats, messages
from tests.checked import load_checked
from tests.link.stage import FRAME_US, WARM_UP_US, Parts, open_session, pet_tables

STORE = load_checked("firmware/store.py")
COMMANDS = load_checked("firmware/commands.py")
TABLES = load_checked("firmware/tables.py")
CUES = load_checked("firmware/cues.py")

CHECKOUT = Path(__file__).parents[2]
STEP = codec.PAYLOAD_MAX - 4
"""Bytes of a file in one `save`."""


class PowerCut(Exception):
    """The MCU has lost its power."""


class FakeFile:
    """An open file: what is written reaches the flash when it is closed, or not at all."""

    def __init__(self, files, name, mode):
        self._files, self._name, self._mode = files, name, mode
        self._data = b"" if mode == "wb" else files.files[name]
        self._at = 0

    def write(self, data):
        self._files.act("write")
        self._data += bytes(data)
        return len(data)

    def read(self, count):
        data = self._data[self._at : self._at + count]
        self._at += len(data)
        return data

    def seek(self, place):
        self._at = place

    def close(self):
        if self._mode == "wb":
            self._files.act("close")
            self._files.files[self._name] = self._data

    def __enter__(self):
        return self

    def __exit__(self, *failure):
        self.close()


class FakeFiles:
    """A flash file system. `cut_after` actions that write, the power is lost; `failing` names an action that raises OSError."""

    def __init__(self, files=None):
        self.files = dict(files or {})
        self.cut_after = -1
        self.failing = None
        self.actions = 0

    def act(self, action):
        if action == self.failing:
            raise OSError(28, "no space")
        if self.actions == self.cut_after:
            raise PowerCut
        self.actions += 1

    def open(self, name, mode):
        if mode == "wb":
            self.act("open")
            self.files[name] = b""
        elif name not in self.files:
            raise OSError(2, "no such file")
        return FakeFile(self, name, mode)

    def rename(self, old, new):
        self.act("rename")
        self.files[new] = self.files.pop(old)

    def remove(self, name):
        if name not in self.files:
            raise OSError(2, "no such file")
        self.act("remove")
        del self.files[name]


class Motor:
    """What commands ask of the motor layer."""

    def __init__(self):
        self.armed = False
        self.outputs = True

    def arm(self):
        self.armed = self.outputs
        return self.armed

    def kill(self, killed_by):
        assert killed_by == formats.KILLED_BY_HOST
        self.armed = False


class Exchange:
    step = -1


class Puppet:
    """What commands ask of the puppet: real tables and a real queue, and a note of what it was told."""

    def __init__(self):
        self.frame = -1
        self.tables, self.staged = TABLES.Tables(), TABLES.Tables()
        self.cues = CUES.Cues()
        self.motor = Motor()
        self.exchange = Exchange()
        self.told = []

    def commit(self):
        self.told.append("commit")
        self.tables, self.staged = self.staged, self.tables
        self.staged.ready = False

    def start(self):
        self.told.append("start")
        self.frame = 0

    def stop(self):
        self.frame = -1
        self.cues.clear()


class Telemetry:
    def start(self):
        pass

    def ask(self, taps, taps_every, weights_every):
        pass


class Mcu:
    """An MCU that has just been switched on, with these files on its flash."""

    def __init__(self, files=None):
        self.puppet = Puppet()
        self.flash = files if isinstance(files, FakeFiles) else FakeFiles(files)
        self.commands = COMMANDS.Commands(self.puppet, Telemetry(), STORE.Store(self.flash))

    def do(self, name, fields=None, items=None):
        """Carry out a command as from the link; return its status, with the detail unless it is done."""
        payload = pack(name, fields or {}, items)
        status = self.commands.carry_out(getattr(messages, name.upper()), bytearray(b"\0\0" + payload), len(payload))
        return (status, self.commands.detail) if status else messages.OK

    def save(self, content):
        """Send a whole file; return the answers that were not OK."""
        answers = [self.do("save_begin", {"bytes": len(content), "crc32": zlib.crc32(content)})]
        for place in range(0, len(content), STEP):
            answers.append(self.do("save", {"place": place}, piece(content[place : place + STEP])))
        answers.append(self.do("save_end"))
        return [answer for answer in answers if answer]

    def load(self):
        """Play the file, as at the start; return what became of it."""
        STORE.load(self.commands)
        return self.commands.store.state


def piece(data):
    """The items of a `save`."""
    return [{"byte": byte} for byte in data]


def record(name, fields=None, items=None):
    """A command as the file holds it."""
    payload = pack(name, fields or {}, items)
    return bytes([1 + len(payload), getattr(messages, name.upper())]) + payload


BEGIN = {
    "frame_rate_hz": 30,
    "dofs": 1,
    "actions": 1,
    "mappings": 1,
    "lives": 0,
    "curves": 0,
    "programs": 0,
    "blinks": 0,
    "seed": 7,
    "noise_spread_q15": 0,
    "hold_q26": 1 << 20,
    "link_timeout_ms": 500,
    "when_silent": formats.SILENT_REST,
}
ROBOT = {"motor_period_us": 20000, "attach_ms": 100, "kill_pin": formats.NO_PIN, "kill_level": 0, "autostart": 0}
DOF = {"dof": 0, "kind": 0, "rest_q15": 0, "low_q15": 0, "high_q15": 32768, "speed_q24": 1 << 24, "accel_q24": 1 << 24}
DOF |= {"signal": 1}
OUTPUT = {"dof": 0, "driver": 0, "turns": 1, "end0_q4us": 16000, "end1_q4us": 32000, "dead_q15": 0, "top_q15": 32768}
ACTION = {"action": 0, "tempo_q16": 65536, "rise_q26": 1 << 20, "fall_q26": 1 << 20, "first_mapping": 0}
ACTION |= {"mappings": 1, "entry": 0, "warp_q26": 1 << 20, "cycles": 0}
MAPPING = {"dof": 0, "function": 0, "argument": 0, "low_q15": 0, "high_q15": 32768}
TABLE_RECORDS = [
    record("begin", BEGIN),
    record("robot", ROBOT),
    record("dof", DOF),
    record("output", OUTPUT, [{"setting": 4}]),
    record("action", ACTION),
    record("mappings", {"first_mapping": 0}, [MAPPING]),
    record("commit"),
]
TARGETS = record("weight_targets", {"frame": 0}, [{"action": 0, "target_q28": formats.WEIGHT_ONE}])
START = record("start")
CONTENT = b"".join([*TABLE_RECORDS, TARGETS, START])
OTHER = b"".join([record("begin", BEGIN | {"seed": 8}), *TABLE_RECORDS[1:], TARGETS])


def as_file(content):
    """The bytes of the file on the flash."""
    return struct.pack("<II", len(content), zlib.crc32(content)) + content


def with_autostart(content=CONTENT):
    return content.replace(record("robot", ROBOT), record("robot", ROBOT | {"autostart": 1}))


def test_example_of_the_documentation_is_right():
    assert record("robot", ROBOT).hex(" ") in (CHECKOUT / "docs" / "link.md").read_text("utf-8")


def test_file_is_kept_and_played():
    mcu = Mcu()
    assert mcu.save(CONTENT) == []
    assert mcu.flash.files == {STORE.NAME: as_file(CONTENT)}
    mcu = Mcu(mcu.flash.files)
    assert mcu.load() == formats.STORE_PLAYED
    assert mcu.puppet.told == ["commit", "start"]
    assert mcu.puppet.tables.ready and mcu.puppet.tables.seed == 7 and mcu.puppet.tables.settings[0] == 4
    assert mcu.puppet.tables.when_silent == formats.SILENT_REST
    assert mcu.puppet.cues.count == 1
    assert not mcu.puppet.motor.armed


def test_greeting_before_the_first_frame_does_not_forget_what_the_file_begins_with():
    mcu = Mcu({STORE.NAME: as_file(CONTENT)})
    mcu.load()
    hello = {"protocol": messages.PROTOCOL, "dictionary": mcu.commands.dictionary}
    assert mcu.do("hello", hello) == messages.OK
    assert mcu.puppet.cues.count == 1
    mcu.puppet.frame = 1
    assert mcu.do("hello", hello) == messages.OK
    assert mcu.puppet.cues.count == 0, "later it begins a new session"


def test_outputs_are_armed_at_the_start_only_if_the_robot_says_so():
    mcu = Mcu({STORE.NAME: as_file(with_autostart())})
    assert mcu.load() == formats.STORE_PLAYED
    assert mcu.puppet.motor.armed
    mcu = Mcu()
    content = with_autostart()
    assert mcu.save(content) == []
    assert not mcu.puppet.motor.armed, "not when it is saved"


def test_mcu_without_a_file_waits_for_the_host():
    mcu = Mcu()
    assert mcu.load() == formats.STORE_NONE
    assert mcu.puppet.told == [] and not mcu.puppet.tables.ready


@pytest.mark.parametrize("changing", [False, True])
def test_power_may_be_cut_at_any_instant(changing):
    """The old file stays until the new one takes its place; afterwards the MCU plays one of the two."""
    before = {STORE.NAME: as_file(OTHER)} if changing else {}
    outcomes = set()
    long = CONTENT.replace(TARGETS, TARGETS * 60)
    for cut_after in range(40):
        flash = FakeFiles(before)
        flash.cut_after = cut_after
        try:
            assert Mcu(flash).save(long) == []
            outcomes.add("saved")
        except PowerCut:
            pass
        kept = flash.files.get(STORE.NAME)
        assert kept in (before.get(STORE.NAME), as_file(long))
        mcu = Mcu(flash.files)
        state = mcu.load()
        assert state == (formats.STORE_PLAYED if kept else formats.STORE_NONE)
        outcomes.add(kept)
        mcu = Mcu(flash.files)
        assert mcu.save(CONTENT) == [], "what was left behind is no hindrance"
        assert mcu.flash.files == {STORE.NAME: as_file(CONTENT)}
    assert outcomes == {"saved", before.get(STORE.NAME), as_file(long)}


def test_file_that_is_damaged_anywhere_is_ignored_and_reported():
    good = as_file(with_autostart())
    rng = random.Random(3)
    damaged = [
        good[:place] + bytes([good[place] ^ 1 << rng.randrange(8)]) + good[place + 1 :] for place in range(len(good))
    ]
    damaged += [good[:length] for length in range(len(good))] + [good + b"\0", b"\xff" * 4096]
    for content in damaged:
        mcu = Mcu({STORE.NAME: content})
        assert mcu.load() == formats.STORE_DAMAGED
        assert mcu.puppet.told == [] and mcu.puppet.cues.count == 0 and not mcu.puppet.motor.armed


REFUSED_RECORDS = [
    record("weight_targets", {"frame": 0}, [{"action": 1, "target_q28": 0}]),
    record("weight_targets", {"frame": -2}, []),
]


@pytest.mark.parametrize("bad", REFUSED_RECORDS)
@pytest.mark.parametrize("after_start", [False, True])
def test_file_of_which_the_end_is_refused_leaves_nothing_in_force(bad, after_start):
    content = with_autostart(b"".join([*TABLE_RECORDS, TARGETS, *([START, bad] if after_start else [bad, START])]))
    mcu = Mcu({STORE.NAME: as_file(content)})
    assert mcu.load() == formats.STORE_DAMAGED
    assert mcu.puppet.frame == -1 and mcu.puppet.cues.count == 0 and not mcu.puppet.motor.armed
    assert mcu.do("start") == (messages.STATE, 0) and mcu.do("arm") == (messages.STATE, 0)


@pytest.mark.parametrize("left_out", range(len(TABLE_RECORDS)))
def test_file_with_tables_that_are_refused_is_not_played(left_out):
    content = b"".join(TABLE_RECORDS[:left_out] + TABLE_RECORDS[left_out + 1 :])
    mcu = Mcu({STORE.NAME: as_file(content)})
    complete = TABLE_RECORDS[left_out] == record("output", OUTPUT, [{"setting": 4}])
    assert mcu.load() == (formats.STORE_PLAYED if complete else formats.STORE_DAMAGED)
    assert mcu.puppet.told == (["commit"] if complete else [])


ILL_FORMED = {
    "no tables": TARGETS,
    "nothing after them": b"".join(TABLE_RECORDS[:-1]),
    "two sets of tables": b"".join(TABLE_RECORDS * 2),
    "arm": b"".join([*TABLE_RECORDS, record("arm")]),
    "kill": b"".join([*TABLE_RECORDS, record("kill")]),
    "erase": b"".join([*TABLE_RECORDS, record("save_erase")]),
    "start before the tables": b"".join([START, *TABLE_RECORDS]),
    "start among the tables": b"".join([*TABLE_RECORDS[:3], START, *TABLE_RECORDS[3:]]),
    "hello": b"".join([record("hello", {"protocol": 2, "dictionary": 0}), *TABLE_RECORDS]),
    "from the MCU": b"".join([*TABLE_RECORDS, b"\x05\x81\0\0\0\0"]),
    "unknown": b"".join([*TABLE_RECORDS, b"\x01\x03"]),
    "length 0": b"".join([*TABLE_RECORDS, b"\0"]),
    "too long": b"".join([*TABLE_RECORDS, bytes([2 + codec.PAYLOAD_MAX, messages.WEIGHT_TARGETS]), bytes(245)]),
    "wrong length": b"".join([*TABLE_RECORDS, b"\x02\x20\0"]),
    "length of half an item": b"".join([*TABLE_RECORDS, b"\x08\x22" + bytes(7)]),
    "breaks off in a payload": CONTENT + TARGETS[:-1],
    "breaks off before the id": CONTENT + b"\x01",
}


@pytest.mark.parametrize("name", ILL_FORMED)
def test_file_that_is_ill_formed_is_refused_and_would_not_be_played(name):
    mcu = Mcu({STORE.NAME: as_file(OTHER)})
    assert mcu.save(ILL_FORMED[name]) == [(messages.RANGE, 0)]
    assert mcu.flash.files[STORE.NAME] == as_file(OTHER)
    mcu = Mcu({STORE.NAME: as_file(ILL_FORMED[name])})
    assert mcu.load() == formats.STORE_DAMAGED
    assert mcu.puppet.told == [] and mcu.puppet.frame == -1


def test_pieces_have_to_come_in_order_and_to_fit():
    mcu = Mcu()
    assert mcu.do("save", {"place": 0}, piece(b"x")) == (messages.STATE, 0), "nothing was begun"
    assert mcu.do("save_end") == (messages.STATE, 0)
    for count in (0, 48 * 1024 + 1, 0xFFFFFFFF):
        assert mcu.do("save_begin", {"bytes": count, "crc32": 0}) == (messages.RANGE, 0)
    assert mcu.do("save_begin", {"bytes": 48 * 1024, "crc32": 0}) == messages.OK
    assert mcu.do("save_begin", {"bytes": len(CONTENT), "crc32": zlib.crc32(CONTENT)}) == messages.OK
    for place in (1, 0x40000000, 0xFFFFFFFF):
        assert mcu.do("save", {"place": place}, piece(b"x")) == (messages.RANGE, 0)
    assert mcu.do("save", {"place": 0}, piece(CONTENT[:10])) == messages.OK
    assert mcu.do("save", {"place": 0}, piece(CONTENT[:10])) == (messages.RANGE, 0)
    assert mcu.do("save_end") == (messages.INCOMPLETE, len(CONTENT) - 10)
    rest = CONTENT[10:]
    assert mcu.do("save", {"place": 10}, piece(rest[: STEP // 2])) == messages.OK
    rest = rest[STEP // 2 :]
    assert len(rest) < STEP
    place = len(CONTENT) - len(rest)
    assert mcu.do("save", {"place": place}, piece(rest + b"x")) == (messages.RANGE, 1 + len(rest)), "the byte too many"
    assert mcu.do("save", {"place": place}, piece(rest)) == messages.OK
    assert mcu.do("save", {"place": len(CONTENT)}) == messages.OK, "nothing, where it belongs"
    assert mcu.do("save_end") == messages.OK
    assert mcu.do("save_end") == (messages.STATE, 0)
    assert mcu.flash.files == {STORE.NAME: as_file(CONTENT)}


def test_file_with_another_checksum_is_not_kept():
    mcu = Mcu({STORE.NAME: as_file(OTHER)})
    assert mcu.do("save_begin", {"bytes": len(CONTENT), "crc32": zlib.crc32(CONTENT) ^ 1}) == messages.OK
    for place in range(0, len(CONTENT), STEP):
        assert mcu.do("save", {"place": place}, piece(CONTENT[place : place + STEP])) == messages.OK
    assert mcu.do("save_end") == (messages.RANGE, 1)
    assert mcu.flash.files[STORE.NAME] == as_file(OTHER)
    assert mcu.save(CONTENT) == []


def test_flash_is_not_touched_while_armed_or_while_frames_run():
    mcu = Mcu({STORE.NAME: as_file(OTHER)})
    assert mcu.load() == formats.STORE_PLAYED
    assert mcu.do("save_begin", {"bytes": 2, "crc32": 0}) == messages.OK
    for disturb, calm in (("arm", "kill"), ("start", "stop")):
        assert mcu.do(disturb) == messages.OK
        actions = mcu.flash.actions
        for name, fields in (("save_begin", {"bytes": 2, "crc32": 0}), ("save_end", {}), ("save_erase", {})):
            assert mcu.do(name, fields) == (messages.STATE, 0)
        assert mcu.do("save", {"place": 0}, piece(b"x")) == (messages.STATE, 0)
        assert mcu.flash.actions == actions
        assert mcu.do(calm) == messages.OK
    assert mcu.do("save", {"place": 0}, piece(b"x")) == messages.OK


def test_erasing_removes_the_file_and_may_be_repeated():
    mcu = Mcu({STORE.NAME: as_file(OTHER)})
    assert mcu.do("save_begin", {"bytes": 2, "crc32": 0}) == messages.OK
    for _ in range(2):
        assert mcu.do("save_erase") == messages.OK
        assert mcu.flash.files == {}
    assert mcu.do("save", {"place": 0}, piece(b"x")) == (messages.STATE, 0)
    assert Mcu(mcu.flash.files).load() == formats.STORE_NONE


def test_file_that_cannot_be_read_to_its_end_leaves_nothing_in_force():
    class Failing(FakeFile):
        def read(self, count):
            self._files.reads += 1
            if self._files.reads > self._files.good_reads:
                raise OSError(5, "input or output")
            return super().read(count)

    class Files(FakeFiles):
        reads = 0

        def open(self, name, mode):
            return Failing(self, name, mode)

    for good_reads in range(60):
        flash = Files({STORE.NAME: as_file(with_autostart())})
        flash.good_reads = good_reads
        mcu = Mcu(flash)
        if mcu.load() == formats.STORE_PLAYED:
            break
        assert mcu.puppet.frame == -1 and mcu.puppet.cues.count == 0 and not mcu.puppet.motor.armed
        assert mcu.do("start") == (messages.STATE, 0)
    assert good_reads > 30


@pytest.mark.parametrize("failing", ["open", "write", "close", "rename"])
def test_failure_of_the_flash_is_told_and_leaves_the_old_file(failing):
    flash = FakeFiles({STORE.NAME: as_file(OTHER)})
    flash.failing = failing
    mcu = Mcu(flash)
    assert (messages.FLASH, 28) in mcu.save(CONTENT)
    assert flash.files[STORE.NAME] == as_file(OTHER)
    flash.failing = None
    assert mcu.save(CONTENT) == []
    flash.failing = "remove"
    assert mcu.do("save_erase") == (messages.FLASH, 28)


# --- on the MCUs, through the link

AUTOSTART_US = 3_000_000
"""After so long the pet's outputs are attached, one after the other."""


@pytest.fixture(params=["unix", pytest.param("rp2040", marks=pytest.mark.images)])
def switch_on(request, tmp_path):
    """Makes MCUs that have one flash, one after the other: each finds what those before have kept."""
    if request.param == "unix":
        return lambda: UnixMcu(folder=tmp_path)
    make = request.getfixturevalue("rp2040_mcu")
    return lambda: make(flash=tmp_path / "flash.bin")


def keep(session, tables):
    """Let the MCU keep tables, a behaviour and a start."""
    content = b"".join(record(*part) for part in tables.messages())
    targets = [{"action": 0, "target_q28": formats.WEIGHT_ONE}, {"action": 2, "target_q28": formats.WEIGHT_ONE // 2}]
    content += record("weight_targets", {"frame": 0}, targets) + START
    session.link.post("save_begin", {"bytes": len(content), "crc32": zlib.crc32(content)})
    for place in range(0, len(content), STEP):
        session.link.post("save", {"place": place}, piece(content[place : place + STEP]))
    session.link.post("save_end", {})
    session.flush(20)
    return targets


def taps_of(session, frames):
    """Ask for base and signal; return them by frame, when so many have come."""
    session.telemetry(formats.TAP_BASE | formats.TAP_SIGNAL, 1, 0)
    while len(session.taps) < frames:
        session.pump(FRAME_US)
    return {frame: values for frame, _, values in session.taps}


def pet_that_starts_by_itself():
    parts = pet_tables().messages()
    return Parts((name, fields | ({"autostart": 1} if name == "robot" else {}), items) for name, fields, items in parts)


def test_mcu_plays_what_it_has_kept_when_it_is_switched_on(switch_on):
    with switch_on() as mcu:
        session = open_session(VirtualCarrier(mcu))
        targets = keep(session, pet_tables())
        assert session.status()["frame"] == -1, "what is kept does not play at once"
        session.upload(pet_tables())
        session.weight_targets(0, {target["action"]: target["target_q28"] for target in targets})
        session.start()
        wanted = taps_of(session, 90)
    with switch_on() as mcu:
        session = open_session(VirtualCarrier(mcu))
        assert session.welcome["frame"] >= 0 and not session.welcome["armed"]
        found = taps_of(session, 30)
        status = session.status()
        assert status["store"] == formats.STORE_PLAYED and status["attached"] == 0
    common = wanted.keys() & found.keys()
    assert len(common) > 20
    assert all(wanted[frame] == found[frame] for frame in common)


def test_mcu_arms_itself_when_it_is_switched_on_if_the_robot_says_so(switch_on):
    with switch_on() as mcu:
        session = open_session(VirtualCarrier(mcu))
        keep(session, pet_that_starts_by_itself())
        session.upload(pet_that_starts_by_itself())
        assert not session.status()["armed"]
    with switch_on() as mcu:
        mcu.run_for(AUTOSTART_US)
        outputs = [part for part in pet_tables().messages() if part[0] == "output"]
        assert all(mcu.edges(items[0]["setting"]) for _, _, items in outputs)
        session = Session(VirtualCarrier(mcu))
        session.open()
        status = session.status()
        assert status["armed"] and status["attached"].bit_count() == len(outputs)
        for name in ("save_begin", "save_erase"):
            with pytest.raises(LinkRefused, match="not possible in this state"):
                session.link.post(name, {"bytes": 1, "crc32": 0} if name == "save_begin" else {})
                session.flush()
        session.kill()
        session.stop()
        session.link.post("save_erase", {})
        session.flush(5)
    with switch_on() as mcu:
        mcu.run_for(WARM_UP_US)
        session = open_session(VirtualCarrier(mcu))
        assert session.welcome["frame"] == -1
        assert session.status()["store"] == formats.STORE_NONE


def test_mcu_ignores_a_damaged_file_and_tells(tmp_path):
    with UnixMcu(folder=tmp_path) as mcu:
        keep(open_session(VirtualCarrier(mcu)), pet_that_starts_by_itself())
    file = tmp_path / STORE.NAME
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with UnixMcu(folder=tmp_path) as mcu:
        session = open_session(VirtualCarrier(mcu))
        assert session.welcome["frame"] == -1 and not session.welcome["armed"]
        assert session.status()["store"] == formats.STORE_DAMAGED
        session.upload(pet_tables())
        session.start()
        session.flush()
