"""The packet codec: COBS framing, a CRC-32, and nothing else.

A packet's body is `id, sequence number, payload, CRC-32` (little-endian, the checksum of Ethernet and zlib over all
before it). On the wire the body is COBS-coded, so it has no zero in it, and one zero byte ends it. A reader that comes
in late, or loses bytes, finds the next packet behind the next zero.

COBS puts the distance to the next zero first, then the id; as no id is 3, no packet begins with `0D 03`, which is what
mpremote sends to reach the REPL.

Sizes: a body has at most BODY_MAX bytes, on the wire at most WIRE_MAX with its zero. The functions work in buffers of
the caller and allocate nothing. On the MCU they are viper kernels; every intermediate stays inside 17 bits, because the
checksum is kept in two halves.

Source: Cheshire and Baker, Consistent Overhead Byte Stuffing, 1999; CRC-32 as in IEEE 802.3.
"""

from array import array

try:
    import micropython
except ImportError:
    from shared import cpython as micropython  # type: ignore[no-redef]
    from shared.cpython import ptr8, ptr16

BODY_MAX = 250
OVERHEAD = 6  # id, sequence number, checksum
PAYLOAD_MAX = BODY_MAX - OVERHEAD
WIRE_MAX = BODY_MAX + 2  # one code byte as long as a body is at most 254 bytes, and the zero

HANDOVER_FIRST = 0x0D
HANDOVER_SECOND = 0x03

_POLYNOMIAL = 0xEDB88320


def _nibble_tables():
    low = array("H", (0 for _ in range(16)))
    high = array("H", (0 for _ in range(16)))
    for nibble in range(16):
        crc = nibble
        for _ in range(4):
            crc = (crc >> 1) ^ (_POLYNOMIAL if crc & 1 else 0)
        low[nibble] = crc & 0xFFFF
        high[nibble] = crc >> 16
    return low, high


_CRC_LOW, _CRC_HIGH = _nibble_tables()


@micropython.viper
def _checksum(body: ptr8, length: int, low_table: ptr16, high_table: ptr16, crc: ptr16):
    """Write the CRC-32 of the first `length` bytes into crc[0] (low half) and crc[1] (high half)."""
    low = 0xFFFF
    high = 0xFFFF
    i = 0
    while i < length:
        low = low ^ body[i]
        index = low & 15
        low = ((low >> 4) | ((high & 15) << 12)) ^ low_table[index]
        high = (high >> 4) ^ high_table[index]
        index = low & 15
        low = ((low >> 4) | ((high & 15) << 12)) ^ low_table[index]
        high = (high >> 4) ^ high_table[index]
        i += 1
    crc[0] = low ^ 0xFFFF
    crc[1] = high ^ 0xFFFF


_crc = array("H", (0, 0))


def seal(body, length):
    """Append the checksum to `body[:length]`; return the length with it, `length + 4`."""
    _checksum(body, length, _CRC_LOW, _CRC_HIGH, _crc)
    body[length] = _crc[0] & 0xFF
    body[length + 1] = _crc[0] >> 8
    body[length + 2] = _crc[1] & 0xFF
    body[length + 3] = _crc[1] >> 8
    return length + 4


def is_sealed(body, length):
    """Return whether `length` bytes are long enough for a packet and end with the checksum of those before."""
    if length < OVERHEAD:
        return False
    _checksum(body, length - 4, _CRC_LOW, _CRC_HIGH, _crc)
    return (
        body[length - 4] == _crc[0] & 0xFF
        and body[length - 3] == _crc[0] >> 8
        and body[length - 2] == _crc[1] & 0xFF
        and body[length - 1] == _crc[1] >> 8
    )


@micropython.viper
def encode(body: ptr8, length: int, wire: ptr8) -> int:
    """COBS-code `length` bytes (at most 254) into `wire`, a zero behind them; return the number of bytes there."""
    code_at = 0
    code = 1
    out = 1
    i = 0
    while i < length:
        value = body[i]
        if value == 0:
            wire[code_at] = code
            code_at = out
            code = 1
        else:
            wire[out] = value
            code += 1
        out += 1
        i += 1
    wire[code_at] = code
    wire[out] = 0
    return out + 1


@micropython.viper
def decode(wire: ptr8, length: int) -> int:
    """Decode `length` COBS bytes (without their zero) in place; return the body's length, -1 if they are not COBS.

    A code byte that points past the end makes them malformed. The body is never longer than what was there before.
    """
    out = 0
    i = 0
    while i < length:
        code = int(wire[i])
        if code == 0 or i + code > length:
            return -1
        i += 1
        code -= 1
        while code > 0:
            wire[out] = wire[i]
            out += 1
            i += 1
            code -= 1
        if i < length:
            wire[out] = 0
            out += 1
    return out


def crc32(data):
    """Return the CRC-32 of bytes as an integer. For start-up and the host: it makes a large integer."""
    _checksum(data, len(data), _CRC_LOW, _CRC_HIGH, _crc)
    return _crc[0] | _crc[1] << 16
