"""Prints what the codec makes of bodies of every length, a line each; MicroPython and CPython must print the same."""

from shared import codec


def bodies():
    """Yield one body of every length: runs of zeros, of ones, and bytes of a linear congruential generator, in turns."""
    state = 1
    for length in range(codec.OVERHEAD - 4, codec.BODY_MAX - 3):
        body = bytearray(length)
        kind = length % 4
        for i in range(length):
            state = (state * 1103 + 12345) % 65536
            body[i] = (0, 255, state >> 8, state >> 8 if state % 5 else 0)[kind]
        yield body


def answers():
    """Yield a line for each body: sealed, coded, decoded again, decoded with a byte changed."""
    for body in bodies():
        sealed = bytearray(codec.BODY_MAX)
        sealed[: len(body)] = body
        length = codec.seal(sealed, len(body))
        wire = bytearray(codec.WIRE_MAX)
        wire_length = codec.encode(sealed, length, wire)
        parts = [sealed[:length].hex(), wire[:wire_length].hex()]
        back = bytearray(wire[: wire_length - 1])
        again = codec.decode(back, len(back))
        parts += [str(again), back.hex(), str(codec.is_sealed(back, again))]
        for place in (0, len(body) // 2):
            changed = bytearray(wire[: wire_length - 1])
            changed[place] = changed[place] ^ (1 << len(body) % 8)
            again = codec.decode(changed, len(changed))
            parts += [str(again), changed.hex(), str(again >= 0 and codec.is_sealed(changed, again))]
        yield " ".join(parts)


for line in answers():
    print(line)
