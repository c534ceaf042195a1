"""What commands mean: each message to the MCU has a handler here, from the link as from the file on its flash.

A handler gets a body, whose payload begins at its third byte, and the payload's length, which has been checked; it
returns a status and may set `detail`. Fields are checked before they are used: kernels get only indices and lengths
that were checked here, in `tables` or in `cues`.

Nothing here allocates while a puppet plays, but for the tables that are to replace its own.
"""

from struct import pack, unpack_from

from micropython import const

from firmware import cues
from firmware.exchange import check_kept
from firmware.tables import halves
from shared import codec, messages
from shared.formats import (
    BANDS,
    DEVICE_SETTINGS_MAX,
    KILLED_BY_HOST,
    TAP_BASE,
    TAP_DERIVATIVES,
    TAP_MOTOR,
    TAP_SIGNAL,
)

_PAYLOAD = const(2)  # place of the payload in a body
_LEAN = (
    messages.HELLO,
    messages.PING,
    messages.WEIGHT_TARGETS,
    messages.LIVE_TARGETS,
    messages.TEMPO,
    messages.GAINS,
    messages.ARM,
    messages.KILL,
    messages.TELEMETRY,
    messages.STATUS_REQUEST,
    messages.CALIBRATE,
    messages.LIMIT,
)
"""What is carried out without allocating."""

_LARGE = const(0x3FFFFFFF)  # more than any field may have, and no large integer

_HELLO_FORMAT = messages.struct_format(messages.find(messages.HELLO)[2])
_DICTIONARY = codec.crc32(messages.canonical_text().encode())  # here, while the heap has room for the text
_MAPPING_FORMAT = messages.struct_format(messages.find(messages.MAPPINGS)[3])


def _half(body, at):
    """Return the unsigned 16-bit number at a place of the payload."""
    at += _PAYLOAD
    return body[at] | body[at + 1] << 8


def _word(body, at):
    """Return the unsigned 32-bit number at a place of the payload, or `_LARGE` for one that is larger."""
    at += _PAYLOAD
    if body[at + 3] >= 0x40:
        return _LARGE
    return body[at] | body[at + 1] << 8 | body[at + 2] << 16 | body[at + 3] << 24


class Commands:
    """Carries out the commands for one puppet.

    `detail` explains the last status. `allocates` tells which ids need the heap. `dictionary` is the checksum of the
    message dictionary. `store` keeps what is to be kept on the flash.
    """

    def __init__(self, puppet, telemetry, store):
        self.detail = 0
        self.dictionary = _DICTIONARY
        self._puppet = puppet
        self._telemetry = telemetry
        self.store = store
        self._hello = pack(_HELLO_FORMAT, messages.PROTOCOL, self.dictionary)
        self._settings = halves(DEVICE_SETTINGS_MAX)
        # By message id: length of the fields (-1: no such message), of an item, and what carries it out.
        self._fixed = [-1] * 128
        self._item = bytearray(128)
        self._formats = [None] * 128
        self._handlers = [None] * 128
        self.allocates = bytearray(128)
        for name, message_id, fields, items in messages.MESSAGES:
            if message_id < 128:
                self.allocates[message_id] = message_id not in _LEAN
                self._fixed[message_id] = messages.size(fields)
                self._item[message_id] = messages.size(items)
                self._formats[message_id] = messages.struct_format(fields)
                self._handlers[message_id] = getattr(self, "_on_" + name)

    def carry_out(self, message_id, body, length):
        """Check the length of a command's payload and carry it out; return its status."""
        self.detail = message_id
        fixed = self._fixed[message_id]
        if fixed < 0:
            return messages.UNKNOWN
        item = self._item[message_id]
        if length < fixed or (length != fixed if item == 0 else (length - fixed) % item != 0):
            self.detail = length
            return messages.LENGTH
        self.detail = 0
        return self._handlers[message_id](body, length)

    def withdraw(self):
        """Let the tables that play count for nothing: no motion, nothing to start or arm."""
        self._puppet.stop()
        self._puppet.tables.ready = False

    def arm_if_autostart(self):
        """Arm if the robot that plays is one that does so when it is switched on."""
        puppet = self._puppet
        if puppet.tables.ready and puppet.tables.autostart:
            puppet.motor.arm()

    def _fields(self, message_id, body):
        return unpack_from(self._formats[message_id], body, _PAYLOAD)

    # --- the session

    def _on_hello(self, body, length):
        if self._puppet.frame != 0:  # before the first frame, what a kept puppet begins with still waits
            self._puppet.cues.clear()
        self._telemetry.ask(0, 0, 0)
        for place in range(length):  # byte by byte, because a host may come back during a performance
            if body[_PAYLOAD + place] != self._hello[place]:
                return messages.MISMATCH
        return messages.OK

    def _on_ping(self, body, length):
        return messages.OK

    # --- tables, into the staging area

    def _on_begin(self, body, length):
        if self._puppet.exchange.step >= 0:
            return messages.STATE
        return self._judge(self._puppet.staged.begin(*self._fields(messages.BEGIN, body)))

    def _on_robot(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.robot(*self._fields(messages.ROBOT, body)))

    def _on_device(self, body, length):
        fields = self._fields(messages.DEVICE, body)
        count = self._take_settings(messages.DEVICE, body, length)
        return self._staged() or self._judge(self._puppet.staged.device(*fields, self._settings, count))

    def _on_dof(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.dof(*self._fields(messages.DOF, body)))

    def _on_character(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.character(*self._fields(messages.CHARACTER, body)))

    def _on_output(self, body, length):
        fields = self._fields(messages.OUTPUT, body)
        count = self._take_settings(messages.OUTPUT, body, length)
        return self._staged() or self._judge(self._puppet.staged.output(*fields, self._settings, count))

    def _on_feedback(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.feedback(*self._fields(messages.FEEDBACK, body)))

    def _on_guard(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.guard(*self._fields(messages.GUARD, body)))

    def _on_action(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.action(*self._fields(messages.ACTION, body)))

    def _on_mappings(self, body, length):
        status = self._staged()
        if status:
            return status
        (first,) = self._fields(messages.MAPPINGS, body)
        item = self._item[messages.MAPPINGS]
        staged = self._puppet.staged
        for n in range((length - 2) // item):
            bad = staged.mapping(first + n, *unpack_from(_MAPPING_FORMAT, body, _PAYLOAD + 2 + n * item))
            if bad is not None:
                return self._judge(1 + 5 * n + bad)
        return messages.OK

    def _on_live(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.live(*self._fields(messages.LIVE, body)))

    def _on_curve(self, body, length):
        staged = self._puppet.staged
        return self._staged() or self._stream(messages.CURVE, body, length, staged.curve, staged.sample)

    def _on_program(self, body, length):
        staged = self._puppet.staged
        return self._staged() or self._stream(messages.PROGRAM, body, length, staged.program, staged.word)

    def _on_blink(self, body, length):
        return self._staged() or self._judge(self._puppet.staged.blink(*self._fields(messages.BLINK, body)))

    def _on_keep(self, body, length):
        status = self._staged()
        if status:
            return status
        kind, first = self._fields(messages.KEEP, body)
        for place in range(length - 2):
            bad = self._puppet.staged.keep(kind, first, place, body[_PAYLOAD + 2 + place])
            if bad is not None:
                return self._judge(bad)
        return messages.OK

    def _on_commit(self, body, length):
        puppet = self._puppet
        staged = puppet.staged
        tables = puppet.tables
        if puppet.frame >= 0 and (
            staged.frame_rate_hz != tables.frame_rate_hz or staged.motor_period_us != tables.motor_period_us
        ):
            return messages.STATE
        status = self._staged()
        if status:
            return status
        self.detail = staged.missing()
        if self.detail:
            return messages.INCOMPLETE
        bad = self._judge(staged.doubled())
        if bad == messages.OK and not check_kept(staged, tables):
            bad = self._judge(0)
        if bad == messages.OK:
            puppet.commit()
        return bad

    def _staged(self):
        """Return whether tables may come: after `begin`, and not while others wait to be put into force."""
        puppet = self._puppet
        return messages.OK if puppet.staged.ready and puppet.exchange.step < 0 else messages.STATE

    def _judge(self, bad_field):
        if bad_field is None:
            return messages.OK
        self._puppet.staged.ready = False  # a set of which a part was refused is never played
        return self._refuse(bad_field)

    def _refuse(self, bad_field):
        self.detail = bad_field
        return messages.RANGE

    def _take_settings(self, message_id, body, length):
        """Copy the settings behind the fields, as far as there is room for them; return how many there are."""
        start = self._fixed[message_id]
        count = (length - start) // 2
        for place in range(min(count, DEVICE_SETTINGS_MAX)):
            self._settings[place] = _half(body, start + 2 * place)
        return count

    def _stream(self, message_id, body, length, begin, store):
        """Store what comes in several packets: the fields to `begin`, then each item to `store`."""
        bad = begin(*self._fields(message_id, body))
        if bad is not None:
            return self._judge(bad)
        item = self._item[message_id]
        for place in range(_PAYLOAD + 3, _PAYLOAD + length, item):
            (value,) = unpack_from("<i" if item == 4 else "<H", body, place)
            if store(value) is not None:
                return self._judge(2 + (place - _PAYLOAD - 3) // item)
        return messages.OK

    # --- the performance

    def _on_start(self, body, length):
        if not self._puppet.tables.ready:
            return messages.STATE
        self._telemetry.start()
        self._puppet.start()
        return messages.OK

    def _on_stop(self, body, length):
        self._puppet.stop()
        return messages.OK

    def _on_weight_targets(self, body, length):
        return self._queue(cues.WEIGHT, body, length, self._puppet.tables.actions)

    def _on_live_targets(self, body, length):
        return self._queue(cues.LIVE, body, length, self._puppet.tables.lives)

    def _on_tempo(self, body, length):
        return self._queue(cues.TEMPO, body, length, self._puppet.tables.actions)

    def _on_gains(self, body, length):
        return self._queue(cues.GAIN, body, length, BANDS)

    def _on_arm(self, body, length):
        puppet = self._puppet
        return messages.OK if puppet.tables.ready and puppet.motor.arm() else messages.STATE

    def _on_kill(self, body, length):
        self._puppet.motor.kill(KILLED_BY_HOST)
        return messages.OK

    def _on_telemetry(self, body, length):
        taps = body[_PAYLOAD]
        if taps > TAP_BASE | TAP_SIGNAL | TAP_MOTOR | TAP_DERIVATIVES:
            return messages.RANGE
        self._telemetry.ask(taps, _half(body, 1), _half(body, 3))
        return messages.OK

    def _on_status_request(self, body, length):
        return messages.OK

    def _queue(self, kind, body, length, indices):
        queue = self._puppet.cues
        status = queue.put(kind, body, _PAYLOAD, length, indices)
        if status:
            self.detail = queue.detail
        return status

    # --- the tables that play

    def _on_calibrate(self, body, length):
        tables = self._puppet.tables
        if not tables.ready:
            return messages.STATE
        dof = body[_PAYLOAD]
        end0_q4us = _half(body, 1)
        end1_q4us = _half(body, 3)
        dead_q15 = _half(body, 5)
        top_q15 = _half(body, 7)
        bad = tables.bad_calibration(dof, end0_q4us, end1_q4us, dead_q15, top_q15)
        if bad is not None:
            return self._refuse(bad)
        self._puppet.motor.calibrate(dof, end0_q4us, end1_q4us, dead_q15, top_q15)
        return messages.OK

    def _on_limit(self, body, length):
        tables = self._puppet.tables
        if not tables.ready:
            return messages.STATE
        dof = body[_PAYLOAD]
        low_q15 = _half(body, 1)
        high_q15 = _half(body, 3)
        speed_q24 = _word(body, 5)
        accel_q24 = _word(body, 9)
        bad = tables.bad_limit(dof, low_q15, high_q15, speed_q24, accel_q24)
        if bad is not None:
            return self._refuse(bad)
        self._puppet.motor.limit(dof, low_q15, high_q15, speed_q24, accel_q24)
        return messages.OK

    # --- what is kept on the flash

    def _on_save_begin(self, body, length):
        return self._may_save() or self._saved(self.store.begin(*self._fields(messages.SAVE_BEGIN, body)))

    def _on_save(self, body, length):
        return self._may_save() or self._saved(self.store.put(_word(body, 0), body, _PAYLOAD + 4, length - 4))

    def _on_save_end(self, body, length):
        return self._may_save() or self._saved(self.store.end())

    def _on_save_erase(self, body, length):
        return self._may_save() or self._saved(self.store.erase())

    def _may_save(self):
        """Return whether flash may be written: that blocks interrupts, on which kill and all motion depend."""
        puppet = self._puppet
        return messages.STATE if puppet.motor.armed or puppet.frame >= 0 else messages.OK

    def _saved(self, status):
        if status:
            self.detail = self.store.detail
        return status
