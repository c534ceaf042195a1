"""Hostile hosts at the firmware: whatever they say, no index leaves its array, no integer its bits, and the puppet plays on.

Viper checks nothing, so three kinds of MCU are attacked: the checked one, on which any index outside its array and any integer
out of its bits raises; MicroPython on the PC and an RP2040 with the real kernels, on which every array stands between canaries.
"""

import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.unix import UnixMcu
from shared import formats, messages
from tests.hostile import canaries
from tests.hostile.attack import (
    COMMANDS,
    FRAME_US,
    STAMPED,
    TABLE_PARTS,
    Attack,
    assault,
    first_frames,
    good_talk,
    single_changes,
    small_upload,
    try_changes,
)
from tests.link.stage import WARM_UP_US
from tests.motion.checked_mcu import CheckedMcu

CANARIES = Path(canaries.__file__)
PC_WIDTH = 1024
"""Elements of a canary; an index of 8 bits that goes wrong lands in it, wherever it comes from."""
PICO_WIDTH = 4
PICO_START_US = 5_000_000
"""Longer than it takes to make all arrays, with a collection of the heap before each."""
ROUNDS = 3
ARRAYS_MIN = 200
"""Arrays that a firmware has at least."""
CHANGES = 300
SOAK_SEEDS = 150

PROGRAM = """
import sys
from tests.hostile import canaries
canaries.install({width})
canaries.perform_on_pc({width}, {fault!r})
"""


@cache
def good_frames():
    """Base and signal of the pet's first frames on an MCU that nobody has attacked."""
    with UnixMcu() as mcu:
        mcu.run_for(WARM_UP_US)
        return first_frames(mcu)[0]


def check_it_plays(mcu):
    """Check that an MCU plays the pet as one that nobody has attacked, and that its ticks have never stood still."""
    frames, status = first_frames(mcu)
    assert frames == good_frames()
    assert status["killed_by"] != formats.KILLED_BY_STOPPED_TICKS
    return status


def guarded_mcu(folder, bits, fault=""):
    """Return a PC's MCU whose arrays stand between canaries."""
    program = folder / f"canaries{bits}.py"
    program.write_text(PROGRAM.format(width=PC_WIDTH, fault=fault))
    return UnixMcu(bits, program=program)


def start_guarded_pico(mcu, fault=""):
    """Let an RP2040 perform with its arrays between canaries; return its raw REPL, which waits for the end."""
    repl = RawRepl(mcu)
    repl.exec(CANARIES.read_text("utf-8"))
    repl.exec(f"install({PICO_WIDTH})")
    repl.start(f"perform_on_pico({PICO_WIDTH}, {fault!r})")
    mcu.run_for(PICO_START_US)
    return repl


def canaries_of(mcu):
    """End the firmware and return its report: how many arrays it has, and the lines about broken canaries."""
    mcu.send(b"\r\x03")
    text = b""
    for _ in range(1000):
        mcu.run_for(5_000)
        text += b"".join(data for _, data in mcu.receive())
        if b"end of report" in text:
            break
    return report_in(text)


def report_in(text):
    """Return what the last report in a text says."""
    report = text[text.rindex(b"arrays ") : text.rindex(b"end of report")].decode(errors="replace")
    return int(re.match(r"arrays (\d+)", report)[1]), re.findall(r"^broken .*", report, re.MULTILINE)


def check_canaries(mcu):
    arrays, broken = canaries_of(mcu)
    assert arrays > ARRAYS_MIN and broken == []


def attack_checked(seed, rounds=ROUNDS):
    with CheckedMcu() as mcu:
        attack = assault(mcu, seed, rounds)
        check_it_plays(mcu)
    return attack


def attack_guarded(folder, bits, seed, rounds=ROUNDS):
    with guarded_mcu(folder, bits) as mcu:
        attack = assault(mcu, seed, rounds)
        check_it_plays(mcu)
        check_canaries(mcu)
    return attack


def attack_pico(image, seed, rounds):
    """Attack an RP2040 whose arrays stand between canaries, let it begin anew with a file of the attacker's, look at both."""
    with Rp2040Mcu(image, timed_flash=False) as mcu:
        repl = start_guarded_pico(mcu)
        attack = assault(mcu, seed, rounds, resets=False)
        check_it_plays(mcu)
        attack.begin_session()
        assert any(attack.save() for _ in range(20))
        check_canaries(mcu)
        mcu.run_for(PICO_START_US)
        status = check_it_plays(mcu)
        assert status["store"] in (formats.STORE_PLAYED, formats.STORE_DAMAGED)
        mcu.send(b"\r\x03")
        arrays, broken = report_in(repl.finish(10_000_000).encode())
        assert arrays > ARRAYS_MIN and broken == []
    return attack


@pytest.mark.parametrize("seed", range(2))
def test_attacked_firmware_leaves_no_array_and_no_range(seed):
    assert attack_checked(seed).packets > 100


def test_attacked_firmware_leaves_its_canaries_alone(tmp_path):
    told = Counter()
    for seed in range(10):
        told += attack_guarded(tmp_path, 64, seed).told
    # These attacks mean something: every message is tried, those that they know of are carried out, and others are not.
    taken, refused = ({name for name, status in told if status == wanted} for wanted in (messages.OK, messages.RANGE))
    assert {name for name, _ in told} == set(COMMANDS)
    assert taken >= {*TABLE_PARTS, *(name for name, _, _ in good_talk()), *STAMPED, "save", "save_end"}
    assert refused >= {"commit", "action", "mappings", "output", "limit", *STAMPED}


@pytest.mark.images
@pytest.mark.parametrize("seed", range(3))
def test_attacked_firmware_leaves_its_canaries_alone_in_32_bits(tmp_path, seed):
    assert attack_guarded(tmp_path, 32, seed).packets > 100


def check_changes(mcu, count, seed=0, guarded=True):
    """Play tables in which one number is changed, for so many changes of all; then the MCU plays as ever."""
    with mcu:
        attack = try_changes(mcu, count, seed)
        check_it_plays(mcu)
        if guarded:
            check_canaries(mcu)
    assert attack.played > count, "some of them were taken, and played for some frames"
    return attack


def test_changed_tables_leave_no_array_and_no_range():
    check_changes(CheckedMcu(), CHANGES // 2, guarded=False)


def test_changed_tables_leave_canaries_alone(tmp_path):
    check_changes(guarded_mcu(tmp_path, 64), CHANGES)


@pytest.mark.images
def test_changed_tables_leave_canaries_alone_in_32_bits(tmp_path):
    check_changes(guarded_mcu(tmp_path, 32), CHANGES, 1)


@pytest.mark.soak
def test_all_changed_tables_leave_everything_alone(tmp_path):
    every = len(single_changes())
    check_changes(CheckedMcu(), every, guarded=False)
    for bits in (64, 32):
        check_changes(guarded_mcu(tmp_path, bits), every)


@pytest.mark.images
def test_attacked_rp2040_leaves_its_canaries_alone(rp2040_image_path):
    attack_pico(rp2040_image_path, 1, 1)


FAULTS = {
    "an action that is not there": """
from firmware import cues
from firmware.commands import Commands
Commands._on_weight_targets = lambda self, body, length: self._queue(cues.WEIGHT, body, length, 255)
""",
    "a DOF that is not there": """
from firmware.tables import Tables
original = Tables.mapping
def mapping(self, mapping, dof, *rest):
    bad = original(self, mapping, dof if dof < self.dofs else 0, *rest)
    self.mapped_dof[mapping] = dof
    return bad
Tables.mapping = mapping
""",
    "a packet that is too long": """
from firmware import inbox
original = inbox._next
inbox._next = lambda ring, wire, room, state: original(ring, wire, 2 * room, state)
""",
}


def do_harm(mcu, dof=0):
    """Play tables with a mapping of some DOF, and send targets and bytes that lead past the ends of arrays if nobody looks."""
    attack = Attack(mcu, 0)
    parts = small_upload()
    mapping = next(items for name, _, items in parts if name == "mappings")[0]
    mapping["dof"] = dof
    for name, fields, items in parts:
        attack.say(name, fields, items)
    for action in (0, 65):
        attack.say("weight_targets", {"frame": 0}, [{"action": action, "target_q28": formats.WEIGHT_ONE}])
    attack.say("start")
    attack.wait(10 * FRAME_US)
    mcu.send(b"\1" * 260 + b"\0")
    mcu.run_for(100_000)


@pytest.mark.parametrize("fault", FAULTS)
def test_canaries_show_a_check_that_is_missing(tmp_path, fault):
    dof = 20 if "DOF" in fault else 0
    with guarded_mcu(tmp_path, 64, FAULTS[fault]) as mcu:
        do_harm(mcu, dof)
        assert canaries_of(mcu)[1]
    with guarded_mcu(tmp_path, 64) as mcu:
        do_harm(mcu, dof)
        check_canaries(mcu)


@pytest.mark.images
def test_canaries_of_an_rp2040_show_a_check_that_is_missing(rp2040_image_path):
    with Rp2040Mcu(rp2040_image_path, timed_flash=False) as mcu:
        start_guarded_pico(mcu, FAULTS["an action that is not there"])
        do_harm(mcu)
        assert canaries_of(mcu)[1]


@pytest.mark.soak
def test_long_attacks_leave_everything_alone(tmp_path, rp2040_image_path):
    packets = frames = 0
    for seed in range(1000, 1000 + SOAK_SEEDS):
        attacks = [attack_checked(seed), *(attack_guarded(tmp_path, bits, seed, 4 * ROUNDS) for bits in (64, 32))]
        if seed % 10 == 0:
            attacks.append(attack_pico(rp2040_image_path, seed, ROUNDS))
        packets += sum(attack.packets for attack in attacks)
        frames += sum(attack.played for attack in attacks)
    print(f"\n{packets} packets, {frames} frames with tables of the attacker's")
