"""What the MCU keeps on its flash: a puppet, its robot and calibration, and with what it begins.

The file holds commands as they come over the link, without framing: `length u8, id u8, payload`, the length counting id
and payload. Before them stand the number of bytes and the CRC-32 of all commands (two 32-bit words, little-endian).
First come the tables, `begin` .. `commit`; after them only weight targets and `start`. When the MCU is switched on they
are carried out with the same checks as from the link, and if the robot's `autostart` says so, its outputs are armed.

The host sends a file in pieces. It is written under another name and takes the old one's place only when it has been
read back and is whole, so that at every instant there is the old file or the new one. Writing flash blocks interrupts:
the caller sees to it that nothing is armed and nothing moves. All of this allocates.
"""

import binascii
import os
from struct import pack, unpack

from shared import codec, messages
from shared.formats import STORE_DAMAGED, STORE_MAX, STORE_NONE, STORE_PLAYED

NAME = "marotte.bin"
NEW_NAME = "marotte.new"
HEADER = "<II"
HEADER_BYTES = 8

_CHUNK = 256
_ENOENT = 2  # there is no such file
_PAYLOAD = 2  # place of the payload in a body
_END = -1
_BROKEN = -2
# What may come where: first of all, then up to `commit`, then to the end.
_PARTS = (
    (messages.BEGIN,),
    (
        messages.ROBOT,
        messages.DEVICE,
        messages.DOF,
        messages.CHARACTER,
        messages.OUTPUT,
        messages.FEEDBACK,
        messages.GUARD,
        messages.ACTION,
        messages.MAPPINGS,
        messages.LIVE,
        messages.CURVE,
        messages.PROGRAM,
        messages.BLINK,
        messages.COMMIT,
    ),
    (messages.WEIGHT_TARGETS, messages.START),
)
_LAST_PART = 2


class Files:
    """The files of the MCU's flash; on a PC those of the working folder."""

    def open(self, name, mode):
        """Open a file of bytes. Raises OSError."""
        return open(name, mode)

    def rename(self, old, new):
        """Give a file another's name, which is gone then, in one step. Raises OSError."""
        os.rename(old, new)

    def remove(self, name):
        """Remove a file. Raises OSError."""
        os.remove(name)


class Store:
    """The file on the flash.

    `state` tells what became of it when the MCU was switched on: STORE_NONE, STORE_PLAYED or STORE_DAMAGED. The methods
    return a status, `detail` explains it.
    """

    def __init__(self, files=None):
        self.state = STORE_NONE
        self.detail = 0
        self.files = files or Files()
        self._file = None  # the new one, while it is being written
        self._bytes = self._place = 0

    def begin(self, count, crc32):
        """Begin a new file of so many bytes; one that was under way is forgotten."""
        if not 0 < count <= STORE_MAX:
            return self._refuse(messages.RANGE, 0)
        self._bytes = count
        self._place = 0
        try:
            self._close()
            self._file = self.files.open(NEW_NAME, "wb")
            self._file.write(pack(HEADER, count, crc32))
        except OSError as error:
            return self._fail(error)
        return messages.OK

    def put(self, place, body, start, count):
        """Append `count` bytes from `body[start]` on, which have to be those at `place`, the next."""
        if self._file is None:
            return self._refuse(messages.STATE, 0)
        if place != self._place:
            return self._refuse(messages.RANGE, 0)
        if count > self._bytes - place:
            return self._refuse(messages.RANGE, 1 + self._bytes - place)
        try:
            self._file.write(memoryview(body)[start : start + count])
        except OSError as error:
            return self._fail(error)
        self._place += count
        return messages.OK

    def end(self):
        """Put the new file in the place of the old one if it is whole and well formed."""
        if self._file is None:
            return self._refuse(messages.STATE, 0)
        if self._place < self._bytes:
            return self._refuse(messages.INCOMPLETE, self._bytes - self._place)
        try:
            self._close()
            with self.files.open(NEW_NAME, "rb") as file:
                if not _is_whole(file):
                    return self._refuse(messages.RANGE, 1)
                if not _is_in_order(file):
                    return self._refuse(messages.RANGE, 0)
            self.files.rename(NEW_NAME, NAME)
        except OSError as error:
            return self._fail(error)
        return messages.OK

    def erase(self):
        """Remove the file, and one that was under way."""
        for name in (NAME, NEW_NAME):
            try:
                self._close()
                self.files.remove(name)
            except OSError as error:
                if error.errno != _ENOENT:
                    return self._fail(error)
        return messages.OK

    def _close(self):
        file = self._file
        self._file = None
        if file is not None:
            file.close()

    def _refuse(self, status, detail):
        self.detail = detail
        return status

    def _fail(self, error):
        try:
            self._close()
        except OSError:
            pass  # it is the first failure that is told
        return self._refuse(messages.FLASH, error.errno or 0)


def load(commands):
    """Carry out the file's commands, all or none, and arm if the robot says so. To be called before any frame."""
    store = commands.store
    try:
        file = store.files.open(NAME, "rb")
    except OSError:
        return
    store.state = STORE_DAMAGED
    try:
        with file:
            if not _is_whole(file) or not _is_in_order(file):
                return
            if not _play(file, commands):
                commands.withdraw()
                return
    except OSError:
        commands.withdraw()
        return
    store.state = STORE_PLAYED
    commands.arm_if_autostart()


def _is_whole(file):
    """Return whether a file has the length and the checksum that it says."""
    header = file.read(HEADER_BYTES)
    if len(header) < HEADER_BYTES:
        return False
    left, expected = unpack(HEADER, header)
    if not 0 < left <= STORE_MAX:
        return False
    crc32 = 0
    while True:
        chunk = file.read(_CHUNK)
        if not chunk:
            return left == 0 and crc32 & 0xFFFFFFFF == expected
        left -= len(chunk)
        crc32 = binascii.crc32(chunk, crc32)


def _read(file, body):
    """Read the next command into a body, its payload at the third byte.

    Returns the payload's length, _END behind the last command, _BROKEN for what is none.
    """
    head = file.read(2)
    if not head:
        return _END
    if len(head) < 2 or not 0 < head[0] <= 1 + codec.PAYLOAD_MAX:
        return _BROKEN
    payload = file.read(head[0] - 1)
    if len(payload) < head[0] - 1:
        return _BROKEN
    body[0] = head[1]
    body[_PAYLOAD : _PAYLOAD + len(payload)] = payload
    return len(payload)


def _is_in_order(file):
    """Return whether a file has commands of the right lengths, tables first and little after them."""
    body = bytearray(codec.BODY_MAX)
    file.seek(HEADER_BYTES)
    part = 0
    while True:
        length = _read(file, body)
        if length < 0:
            return length == _END and part == _LAST_PART
        if body[0] not in _PARTS[part] or not messages.length_fits(messages.find(body[0]), length):
            return False
        if body[0] == messages.BEGIN or body[0] == messages.COMMIT:
            part += 1


def _play(file, commands):
    """Carry out the commands of a file; return whether none was refused."""
    body = bytearray(codec.BODY_MAX)
    file.seek(HEADER_BYTES)
    while True:
        length = _read(file, body)
        if length < 0:
            return length == _END
        if commands.carry_out(body[0], body, length) != messages.OK:
            return False
