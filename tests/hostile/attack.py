"""A hostile host: sound packets with any contents, made from the message dictionary and from what a good host would send.

It uploads tables of which parts are changed, and learns: a part that is refused is sent as it should be at the next attempt, so
that most of its tables come into force with what the firmware could not refuse. Then it lets them play, and goes on talking.
Everything follows from a seed.
"""

import random
from collections import Counter
from functools import cache
from pathlib import Path

import marotte
from marotte.keeping import kept
from marotte.link import VirtualCarrier, pack, unpack, wire_packet
from marotte.session import DICTIONARY
from shared import codec, formats, messages, program
from tests.link.stage import Parts, open_session, pet_tables

PUPPETS = Path(__file__).parents[2] / "puppets"
RANGES = {"B": (0, 0xFF), "H": (0, 0xFFFF), "I": (0, 0xFFFFFFFF), "i": (-(1 << 31), (1 << 31) - 1)}
COMMANDS = {message[0]: message for message in messages.MESSAGES if message[1] < 128}
STAMPED = tuple(name for name, _, fields, _ in COMMANDS.values() if fields == (("frame", "i"),))
"""The messages of stamped targets."""
TARGETS = {formats.TEMPO_ONE, formats.WEIGHT_ONE, formats.GAIN4_ONE, 0, formats.GAIN4_MAX}
"""Targets that are right in some of them."""
TABLE_PARTS = (
    *("begin", "robot", "device", "dof", "character", "output", "feedback", "guard", "action", "mappings", "live"),
    *("curve", "program", "blink", "keep", "commit"),
)
ANSWER_US = 600_000
"""Longest time for an answer; an RP2040 takes as long for a `commit`, at rest."""
STEP_US = 1000
FRAME_US = 33_333
EDGES = (0, 1, 2, 15, 16, 64, 200, 256, 511, 40_000, 1 << 26, 1 << 30)
"""Numbers that lie just inside or outside some array or range, whatever they are put in the place of."""

LIMITS = sorted(
    {
        number + off
        for module in (formats, program)
        for number in vars(module).values()
        if isinstance(number, int)
        for off in (-1, 0, 1)
    }
)
"""The numbers at which something is decided, and their neighbours."""


@cache
def good_uploads():
    """Return the parts of good tables: between them they have every part that there is."""
    puppet = marotte.load_puppet(PUPPETS / "pet.toml")
    chips = marotte.load_robot(PUPPETS / "pet-robot-pca9685.toml", puppet)
    uploads = [list(pet_tables().messages()), list(marotte.build_tables(puppet, chips).messages()), small_upload()]
    assert {name for upload in uploads for name, _, _ in upload} >= set(TABLE_PARTS)
    return uploads


def small_upload():
    """Return tables that have one of each part."""
    begin = {"frame_rate_hz": 30, "dofs": 2, "actions": 2, "mappings": 4, "lives": 1, "curves": 1, "programs": 1}
    begin |= {
        "blinks": 1,
        "seed": 0,
        "noise_spread_q15": 0,
        "hold_q26": 1 << 20,
        "link_timeout_ms": 500,
        "when_silent": 2,
    }
    robot = {"motor_period_us": 10000, "attach_ms": 0, "kill_pin": formats.NO_PIN, "kill_level": 0, "autostart": 1}
    dof = {"kind": 0, "rest_q15": 9000, "low_q15": 0, "high_q15": 32768, "speed_q24": 1 << 20, "accel_q24": 1 << 19}
    dof |= {"signal": 1}
    output = {"driver": formats.DRIVER_PINS, "turns": 2, "end0_q4us": 4800, "end1_q4us": 48000}
    output |= {"dead_q15": 0, "top_q15": 32768}
    feedback = {"pin": 28, "at0_q15": 3000, "at1_q15": 29000, "gain_q15": 8000, "integral_q24": 1 << 18}
    feedback |= {"most_q15": 3000, "stall_q15": 9000, "stall_ticks": 20}
    action = {"action": 0, "tempo_q16": 65536, "rise_q26": 1 << 22, "fall_q26": 1 << 22, "first_mapping": 0}
    action |= {"mappings": 2, "entry": 1, "warp_q26": 1 << 20, "cycles": 1000}
    mapping = {"low_q15": 0, "high_q15": 32768}
    live = {"live": 0, "rest_q28": 1 << 27, "rise_q26": 1 << 20, "fall_q26": 1 << 20}
    live |= {"predict": formats.PREDICT_KALMAN, "process_q16": 1 << 16, "noise_q16": 1 << 12, "fade_q15": 30000}
    words = (program.CURVE, 0, 16, 5, program.LIVE, 0, program.NOISE, 3, -40, 200, 9, program.LERP)
    return [
        ("begin", begin, []),
        ("robot", robot, []),
        ("device", {"device": 3, "driver": 1}, [{"setting": value} for value in (4, 5, 0x40, 6, 400, 25000)]),
        ("dof", {"dof": 0} | dof, []),
        ("dof", {"dof": 1} | dof | {"kind": 1, "accel_q24": 1 << 21, "signal": 0}, []),
        ("character", {"dof": 0} | dict.fromkeys([name for name, _ in COMMANDS["character"][2][1:]], 1 << 22), []),
        ("output", {"dof": 0} | output, [{"setting": 2}]),
        ("output", {"dof": 1} | output | {"driver": 1}, [{"setting": 3}, {"setting": 15}]),
        ("feedback", {"dof": 0} | feedback, []),
        ("guard", {"dof": 0, "release_ms": 300, "duty_q15": 16384, "window_s": 1}, []),
        ("action", action, []),
        ("action", action | {"action": 1, "first_mapping": 2, "entry": 0, "cycles": 0}, []),
        (
            "mappings",
            {"first_mapping": 0},
            [
                {"dof": dof, "function": function, "argument": argument} | mapping
                for dof, function, argument in ((0, 6, 0), (1, 7, 0), (0, 5, 0), (1, 2, 15))
            ],
        ),
        ("live", live, []),
        ("curve", {"curve": 0, "samples": 2}, [{"value_q15": 0}, {"value_q15": 32768}]),
        ("program", {"program": 0, "words": len(words)}, [{"word": word} for word in words]),
        ("blink", {"blink": 0, "threshold_q16": 1 << 15, "gap_q18": 1 << 10}, []),
        ("keep", {"kind": 0, "first": 0}, [{"old": formats.NEW}] * 2),
        ("keep", {"kind": 1, "first": 0}, [{"old": formats.NEW}] * 2),
        ("commit", {}, []),
    ]


def good_talk():
    """Return what a good host says during a performance."""
    calibration = {"dof": 0, "end0_q4us": 16000, "end1_q4us": 32000, "dead_q15": 0, "top_q15": 32768}
    limits = {"dof": 1, "low_q15": 0, "high_q15": 32768, "speed_q24": 1 << 22, "accel_q24": 1 << 22}
    return [
        ("calibrate", calibration, []),
        ("limit", limits, []),
        ("limit", limits | {"dof": 0, "low_q15": 16384}, []),
        ("telemetry", {"taps": 15, "taps_every": 1, "weights_every": 1}, []),
        ("hello", {"protocol": messages.PROTOCOL, "dictionary": DICTIONARY}, []),
        *((name, {}, []) for name in ("ping", "arm", "kill", "start", "stop", "status_request")),
    ]


def any_number(rng, kind, near=0):
    """Return any number of a message's type: one at which something is decided, one beside `near`, or just any."""
    least, most = RANGES[kind]
    number = rng.choice(
        (
            rng.choice((0, 1, 2, 3, 255, least, most, most // 2, most // 2 + 1)),
            rng.choice(LIMITS),
            near + rng.choice((-2, -1, 1, 2)),
            near ^ 1 << rng.randrange(32),
            near * rng.choice((2, 3, 256)),
            rng.randint(least, most),
        )
    )
    return number if least <= number <= most else rng.choice((least, most))


def any_message(rng):
    """Return a command with any fields and any number of items: `(name, fields, items)`."""
    name, _, fields, items = rng.choice(list(COMMANDS.values()))
    room = (codec.PAYLOAD_MAX - messages.size(fields)) // messages.size(items) if items else 0
    count = rng.choice((0, 1, 2, rng.randint(0, room))) if items else 0
    values = [{field: any_number(rng, kind) for field, kind in items} for _ in range(min(count, room))]
    return name, {field: any_number(rng, kind) for field, kind in fields}, values


def changed(rng, part):
    """Return a part with something in it changed: a number, or how many items it has."""
    name, fields, items = part
    fields, items = dict(fields), [dict(item) for item in items]
    _, _, field_pairs, item_pairs = COMMANDS[name]
    if items and rng.random() < 0.2:
        place = rng.randrange(len(items))
        if rng.random() < 0.5:
            del items[place:]
        elif messages.size(field_pairs) + (len(items) + 1) * messages.size(item_pairs) <= codec.PAYLOAD_MAX:
            items.insert(place, items[place])
    elif items and rng.random() < 0.6:
        field, kind = rng.choice(item_pairs)
        item = rng.choice(items)
        item[field] = any_number(rng, kind, item[field])
    elif fields:
        field, kind = rng.choice(field_pairs)
        fields[field] = any_number(rng, kind, fields[field])
    return name, fields, items


def single_changes():
    """Return all changes of one number in the small upload: `(part, item or None, field, number)`."""
    found = []
    for place, (name, fields, items) in enumerate(small_upload()):
        _, _, field_pairs, item_pairs = COMMANDS[name]
        rows = [(fields, field, kind, None) for field, kind in field_pairs]
        rows += [(item, field, kind, row) for row, item in enumerate(items) for field, kind in item_pairs]
        for values, field, kind, row in rows:
            least, most = RANGES[kind]
            near = values[field]
            others = {least, most, *EDGES, near - 1, near + 1, 2 * near}
            for number in sorted(others - {near}):
                if least <= number <= most:
                    found.append((place, row, field, number))
    return found


def with_change(parts, place, row, field, number):
    """Return parts with one number changed, as `single_changes` names it."""
    name, fields, items = parts[place]
    fields, items = dict(fields), [dict(item) for item in items]
    (fields if row is None else items[row])[field] = number
    return [*parts[:place], (name, fields, items), *parts[place + 1 :]]


class Attack:
    """A hostile host at an emulated MCU that is performing.

    `told` counts the answers by message and status, `packets` what was sent, `played` the frames that were computed with tables
    of the attacker's.
    """

    def __init__(self, mcu, seed):
        self.mcu = mcu
        self.rng = random.Random(seed)
        self.told = Counter()
        self.packets = 0
        self.played = 0
        self._newest = -1
        self.begin_session()

    def begin_session(self):
        """Greet the MCU as a good host does, and forget what has come."""
        self.mcu.receive()
        self._received = b""
        self._seq = open_session(VirtualCarrier(self.mcu)).link._seq

    def upload(self, attempts=8):
        """Upload good tables in which parts are changed, until a set of them comes into force; return its `begin`, or None."""
        parts = list(self.rng.choice(good_uploads()))
        share = self.rng.choice((0.02, 0.1, 0.4))
        sent = [changed(self.rng, part) if self.rng.random() < share else part for part in parts]
        if self.rng.random() < 0.5:  # what was there before, if it was
            sent = [
                (name, fields, [{"old": 0}]) if name == "keep" else (name, fields, items)
                for name, fields, items in sent
            ]
        for _ in range(attempts):
            for place, part in enumerate(sent):
                if self.say(*part) != messages.OK:
                    # It is the part, or if they do not fit together, several of them.
                    wrong = [place] if part != parts[place] else range(len(parts))
                    for one in wrong:
                        sent[one] = parts[one] if one == place or self.rng.random() < 0.5 else sent[one]
                    break
            else:
                return sent[0][1]
        return None

    def change(self, place, row, field, number):
        """Upload the small tables with one number changed; if they come into force, let them play. Return whether they have."""
        parts = with_change(small_upload(), place, row, field, number)
        if self.rng.random() < 0.5:  # or they are exchanged for those that play
            self.say("stop")
        elif self.rng.random() < 0.5:
            kept_parts = [("keep", {"kind": kind, "first": 0}, [{"old": 0}, {"old": 1}]) for kind in (0, 1)]
            parts = [*parts[:-1], *kept_parts, parts[-1]] if parts[place][0] != "keep" else parts
        if any(self.say(*part) != messages.OK for part in parts):
            return False
        self.say("telemetry", {"taps": 15, "taps_every": 1, "weights_every": 1})
        self.say("weight_targets", {"frame": -1}, [{"action": action, "target_q28": 4 << 28} for action in range(2)])
        self.say_gains(-1)
        for frame, target in ((0, 0), (2, 1), (3, 0)):
            self.say("live_targets", {"frame": frame}, [{"live": 0, "target_q28": target * formats.WEIGHT_ONE}])
        self.say("arm")
        self.say("start")
        self.wait(6 * FRAME_US)
        return True

    def direct(self, begin):
        """Raise weights of all actions and start, mostly armed."""
        self.say("telemetry", {"taps": 15, "taps_every": 1, "weights_every": self.rng.choice((0, 1, 3))})
        for first in range(0, begin["actions"], 16):
            actions = range(first, min(first + 16, begin["actions"]))
            weights = (formats.WEIGHT_ONE, formats.WEIGHT_MAX, 1, 0)
            items = [{"action": action, "target_q28": self.rng.choice(weights)} for action in actions]
            self.say("weight_targets", {"frame": self.rng.choice((-1, 0, 3))}, items)
        if self.rng.random() < 0.8:
            self.say_gains(self.rng.choice((-1, 0, 3)))
        if self.rng.random() < 0.8:
            self.say("arm")
        self.say("start")
        self.wait(self.rng.choice((2, 10, 30)) * FRAME_US)

    def talk(self, count):
        """Say so many things of any kind, and let time pass in between."""
        for _ in range(count):
            kind = self.rng.randrange(10)
            if kind < 4:
                self.say(*any_message(self.rng))
            elif kind == 4:
                part = self.rng.choice(good_talk())
                self.say(*(changed(self.rng, part) if self.rng.random() < 0.5 else part))
            elif kind == 5:
                part = self.rng.choice(self.rng.choice(good_uploads()))
                self.say(*(changed(self.rng, part) if self.rng.random() < 0.5 else part))
            elif kind == 6:
                self.say_bytes(self.rng.randrange(128), self.rng.randbytes(self.rng.randrange(codec.PAYLOAD_MAX + 1)))
            elif kind == 7:
                self.say_targets()
            else:
                self.wait(self.rng.choice((3_000, FRAME_US, 4 * FRAME_US)))

    def say_gains(self, frame):
        """Say gains that are right, as far from 1 as may be."""
        gains = (formats.GAIN4_MAX, 0, formats.GAIN4_ONE)
        bands = range(formats.BANDS)
        self.say("gains", {"frame": frame}, [{"band": band, "gain4_q16": self.rng.choice(gains)} for band in bands])

    def say_targets(self):
        """Say a message of stamped targets, mostly right."""
        name = self.rng.choice(STAMPED)
        _, _, _, items = COMMANDS[name]
        frame = self.rng.choice((-1, self._newest + 2, self._newest - 5, any_number(self.rng, "i")))
        count = self.rng.choice((1, 2, 20))
        values = [{field: any_number(self.rng, kind) for field, kind in items} for _ in range(count)]
        for value in values:
            value[items[0][0]] = self.rng.choice((0, 1, 6, 7, 9, 15, 63, 64, 255))
            value[items[1][0]] = self.rng.choice((*sorted(TARGETS), value[items[1][0]]))
        self.say(name, {"frame": frame}, values)

    def save(self):
        """Let the MCU keep a file of which a part is changed, with a length and a checksum that are right."""
        content = bytearray(kept(pet_tables()))
        if self.rng.random() < 0.7:
            for _ in range(self.rng.choice((1, 1, 3))):
                content[self.rng.randrange(len(content))] = self.rng.randrange(256)
        else:
            parts = [part for part in small_upload() if part[0] != "keep"]
            parts = [part if self.rng.random() < 0.9 else changed(self.rng, part) for part in parts]
            content = bytearray(b"".join(_record(*part) for part in [*parts, ("start", {}, [])]))
        for name in ("kill", "stop"):
            self.say(name)
        self.say("save_begin", {"bytes": len(content), "crc32": codec.crc32(content)})
        for place in range(0, len(content), 200):
            self.say("save", {"place": place}, [{"byte": byte} for byte in content[place : place + 200]])
        return self.say("save_end") == messages.OK

    def say(self, name, fields=None, items=None):
        """Send a command and wait for its answer; return its status."""
        status = self.say_bytes(COMMANDS[name][1], pack(name, fields or {}, items))
        self.told[name, status] += 1
        return status

    def say_bytes(self, message_id, payload):
        """Send a packet of any id and payload as the next command, and return the status of its answer."""
        seq = self._seq
        self._seq = (seq + 1) & 255
        self.packets += 1
        self.mcu.send(wire_packet(message_id, seq, payload))
        for _ in range(ANSWER_US // STEP_US):
            self.mcu.run_for(STEP_US)
            for message in self._take():
                if message.name == "ack" and message.fields["seq"] == seq:
                    return message.fields["status"]
        raise AssertionError(
            f"no answer to {message_id:#04x} {payload.hex()}; the last bytes were {self._received[-300:]!r}"
        )

    def wait(self, time_us):
        """Let time pass, and take what comes."""
        self.mcu.run_for(time_us)
        self._take()

    def _take(self):
        """Return the messages that have come; what is damaged is a fault of the firmware's."""
        *packets, self._received = (self._received + b"".join(data for _, data in self.mcu.receive())).split(b"\0")
        found = []
        for packet in filter(None, packets):
            body = bytearray(packet)
            length = codec.decode(body, len(body))
            assert length > 0 and codec.is_sealed(body, length), f"the MCU has sent {packet!r}"
            message = unpack(body[0], bytes(body[2 : length - 4]))
            assert message, f"the MCU has sent {bytes(body[:length])!r}"
            if message.name == "taps":
                self.played += message.fields["frame"] != self._newest
                self._newest = message.fields["frame"]
            found.append(message)
        return found


def _record(name, fields, items):
    payload = pack(name, fields, items)
    return bytes((1 + len(payload), COMMANDS[name][1])) + payload


def assault(mcu, seed, rounds=1, resets=True):
    """Attack an MCU for so many rounds; return the attack. With `resets` it is reset when it has kept a file of ours."""
    attack = Attack(mcu, seed)
    for _ in range(rounds):
        begin = attack.upload()
        if begin:
            attack.direct(begin)
        attack.talk(attack.rng.randrange(30))
        if attack.rng.random() < 0.5:  # other tables, while these play
            attack.upload(attempts=3)
            attack.wait(20 * FRAME_US)
            attack.talk(10)
        if attack.rng.random() < 0.3 and attack.save() and resets:
            mcu.reset()
            attack.begin_session()
            attack.wait(5 * FRAME_US)
    return attack


def try_changes(mcu, count, seed):
    """Attack an MCU with tables in which one number is changed, for so many changes that a seed chooses; return the attack."""
    attack = Attack(mcu, seed)
    changes = single_changes()
    for change in attack.rng.sample(changes, min(count, len(changes))):
        attack.change(*change)
    return attack


def first_frames(mcu, frames=12):
    """Return base and signal of the pet's first frames, whatever the MCU was doing; and its counters after that."""
    mcu.send(b"\0")
    mcu.run_for(50_000)
    mcu.receive()
    session = marotte.Session(VirtualCarrier(mcu))
    session.open()
    session.kill()
    session.stop()
    session.erase_saved()
    session.upload(Parts(pet_tables().messages()))
    session.telemetry(formats.TAP_BASE | formats.TAP_SIGNAL, 1, 0)
    session.weight_targets(0, {0: formats.WEIGHT_ONE, 1: formats.WEIGHT_ONE // 2})
    session.live_targets(3, {0: formats.WEIGHT_ONE})
    session.start()
    session.flush()
    session.taps.clear()
    while len(session.taps) < frames:
        session.pump(FRAME_US)
    status = session.status()
    session.stop()
    session.flush()
    return list(session.taps)[:frames], status
