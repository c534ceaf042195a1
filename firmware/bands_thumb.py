"""The loops of `bands` that run often in the RP2040's own instructions: the same to the bit, several times as fast.

`smooth`, `split` and `bend` do what those of `bands` do, which say what has to come out. Each prepares a few words and lets a
function without variables do the rest; see `foresight_thumb`.
"""

from array import array

import micropython
from micropython import const

from firmware.tables import words

_DOFS = const(16)
_ZERO = const(0x100000)
_DELTA_ZERO = const(0x10000)

_task = words(12)


def quartets(taps):
    """Return `tap_table` rearranged, `c_1 .. c_4`, four words a place behind the middle, 0 beyond their ends. Allocates."""
    table = array("i")
    for place in range(1, 31):
        for first, last in ((0, 3), (3, 10), (10, 25), (25, 56)):
            table.append(taps[first + place] if first + place < last else 0)
    return table


@micropython.asm_thumb
def _sum_pairs(r0):
    """Add up pairs of a ring, every eighth frame, four times.

    Words: 0 address of a row, 1 place in it in bytes, 2 address of quartets, 3 how many; 4..7 get the sums of
    tap * (pair - 32768).
    """
    mov(r4, r8)
    mov(r5, r9)
    mov(r6, r10)
    mov(r7, r11)
    push({r0, r4, r5, r6, r7})
    ldr(r1, [r0, 0])
    ldr(r2, [r0, 4])
    mov(r3, r2)
    ldr(r4, [r0, 8])
    ldr(r5, [r0, 12])
    mov(r12, r5)
    mov(r5, 0)
    mov(r8, r5)
    mov(r9, r5)
    mov(r10, r5)
    mov(r11, r5)
    mov(r0, 1)
    lsl(r0, r0, 15)
    label(LOOP)
    add(r2, 16)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r6, r1, r2)
    ldrh(r5, [r6, 0])
    sub(r3, 16)
    lsl(r3, r3, 22)
    lsr(r3, r3, 22)
    add(r6, r1, r3)
    ldrh(r6, [r6, 0])
    add(r5, r5, r6)
    sub(r5, r5, r0)
    ldr(r6, [r4, 0])
    mul(r6, r5)
    mov(r7, r8)
    add(r7, r7, r6)
    mov(r8, r7)
    ldr(r6, [r4, 4])
    mul(r6, r5)
    mov(r7, r9)
    add(r7, r7, r6)
    mov(r9, r7)
    ldr(r6, [r4, 8])
    mul(r6, r5)
    mov(r7, r10)
    add(r7, r7, r6)
    mov(r10, r7)
    ldr(r6, [r4, 12])
    mul(r6, r5)
    mov(r7, r11)
    add(r7, r7, r6)
    mov(r11, r7)
    add(r4, 16)
    mov(r7, r12)
    sub(r7, 1)
    mov(r12, r7)
    bne(LOOP)
    pop({r0, r4, r5, r6, r7})
    mov(r1, r8)
    str(r1, [r0, 16])
    mov(r1, r9)
    str(r1, [r0, 20])
    mov(r1, r10)
    str(r1, [r0, 24])
    mov(r1, r11)
    str(r1, [r0, 28])
    mov(r8, r4)
    mov(r9, r5)
    mov(r10, r6)
    mov(r11, r7)


@micropython.asm_thumb
def _smooth_row(r0):
    """Run the kernel three times over a part of a row, the last time into another row.

    Words: 0 address of the row, 1 place in it in bytes, 2 address of scratch, 3 steps of the first pass, 4 of the second, 5 of
    the third, 6 address of the other row, 7 place in it in bytes.
    """
    mov(r4, r8)
    mov(r5, r9)
    push({r0, r4, r5})
    ldr(r1, [r0, 0])
    ldr(r2, [r0, 4])
    ldr(r3, [r0, 8])
    ldr(r4, [r0, 12])
    mov(r8, r4)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r0, r1, r2)
    ldrh(r4, [r0, 0])
    add(r2, 2)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r0, r1, r2)
    ldrh(r5, [r0, 0])
    add(r2, 2)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r0, r1, r2)
    ldrh(r6, [r0, 0])
    add(r2, 2)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r0, r1, r2)
    ldrh(r7, [r0, 0])
    add(r2, 2)
    label(FIRST)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r0, r1, r2)
    ldrh(r0, [r0, 0])
    add(r2, 2)
    mov(r9, r0)
    add(r4, r4, r0)
    add(r0, r5, r7)
    lsl(r0, r0, 2)
    add(r4, r4, r0)
    lsl(r0, r6, 2)
    add(r4, r4, r0)
    lsl(r0, r6, 1)
    add(r4, r4, r0)
    str(r4, [r3, 0])
    add(r3, 4)
    mov(r4, r5)
    mov(r5, r6)
    mov(r6, r7)
    mov(r7, r9)
    mov(r0, r8)
    sub(r0, 1)
    mov(r8, r0)
    bne(FIRST)

    pop({r0})
    push({r0})
    ldr(r3, [r0, 8])
    ldr(r2, [r0, 16])
    label(SECOND)
    ldr(r4, [r3, 0])
    ldr(r5, [r3, 32])
    add(r4, r4, r5)
    ldr(r5, [r3, 8])
    ldr(r6, [r3, 24])
    add(r5, r5, r6)
    lsl(r5, r5, 2)
    add(r4, r4, r5)
    ldr(r5, [r3, 16])
    lsl(r6, r5, 2)
    add(r4, r4, r6)
    lsl(r5, r5, 1)
    add(r4, r4, r5)
    str(r4, [r3, 0])
    add(r3, 4)
    sub(r2, 1)
    bne(SECOND)

    pop({r0})
    push({r0})
    ldr(r3, [r0, 8])
    ldr(r2, [r0, 20])
    ldr(r1, [r0, 24])
    ldr(r7, [r0, 28])
    mov(r6, 1)
    lsl(r6, r6, 11)
    mov(r8, r6)
    label(THIRD)
    ldr(r4, [r3, 0])
    ldr(r5, [r3, 64])
    add(r4, r4, r5)
    ldr(r5, [r3, 16])
    ldr(r6, [r3, 48])
    add(r5, r5, r6)
    lsl(r5, r5, 2)
    add(r4, r4, r5)
    ldr(r5, [r3, 32])
    lsl(r6, r5, 2)
    add(r4, r4, r6)
    lsl(r5, r5, 1)
    add(r4, r4, r5)
    mov(r5, r8)
    add(r4, r4, r5)
    lsr(r4, r4, 12)
    lsl(r7, r7, 22)
    lsr(r7, r7, 22)
    add(r5, r1, r7)
    strh(r4, [r5, 0])
    add(r7, 2)
    add(r3, 4)
    sub(r2, 1)
    bne(THIRD)
    pop({r0, r4, r5})
    mov(r8, r4)
    mov(r9, r5)


@micropython.asm_thumb
def _bend_row(r0):
    """Add a straight line to a part of two rows, within 0..32768.

    Words: 0 and 1 addresses of the rows, 2 place in both in bytes, 3 how many, 4 the line's beginning, 5 its slope, both with 8
    places more.
    """
    mov(r4, r8)
    push({r4})
    ldr(r1, [r0, 0])
    ldr(r2, [r0, 8])
    ldr(r3, [r0, 4])
    ldr(r4, [r0, 16])
    ldr(r5, [r0, 20])
    ldr(r0, [r0, 12])
    mov(r8, r0)
    label(LOOP)
    lsl(r2, r2, 22)
    lsr(r2, r2, 22)
    add(r7, r1, r2)
    ldrh(r6, [r7, 0])
    asr(r0, r4, 8)
    add(r6, r6, r0)
    bpl(POSITIVE)
    mov(r6, 0)
    label(POSITIVE)
    mov(r0, 1)
    lsl(r0, r0, 15)
    cmp(r6, r0)
    ble(WITHIN)
    mov(r6, r0)
    label(WITHIN)
    strh(r6, [r7, 0])
    add(r7, r3, r2)
    ldrh(r6, [r7, 0])
    asr(r0, r4, 8)
    add(r6, r6, r0)
    bpl(POSITIVE_TOO)
    mov(r6, 0)
    label(POSITIVE_TOO)
    mov(r0, 1)
    lsl(r0, r0, 15)
    cmp(r6, r0)
    ble(WITHIN_TOO)
    mov(r6, r0)
    label(WITHIN_TOO)
    strh(r6, [r7, 0])
    add(r2, 2)
    add(r4, r4, r5)
    mov(r0, r8)
    sub(r0, 1)
    mov(r8, r0)
    bne(LOOP)
    pop({r4})
    mov(r8, r4)


@micropython.viper
def smooth(
    base_q15: ptr16,
    third_q15: ptr16,
    row: ptr8,
    dofs: int,
    signal: ptr8,
    first: int,
    frames: int,
    scratch: ptr32,
):
    """Do what `bands.smooth` does."""
    task = ptr32(_task)
    task[1] = ((first - 14) & 511) << 1
    task[2] = int(scratch)
    task[3] = frames + 24
    task[4] = frames + 16
    task[5] = frames
    task[7] = (first & 511) << 1
    d = 0
    while d < dofs:
        if signal[d]:
            task[0] = int(base_q15) + (int(row[d]) << 10)
            task[6] = int(third_q15) + (int(row[d]) << 10)
            _smooth_row(_task)
        d += 1


@micropython.viper
def split(
    base_q15: ptr16, third_q15: ptr16, row: ptr8, dofs: int, signal: ptr8, frame: int, taps: ptr32, level_q16: ptr32
):
    """Do what `bands.split` does; `taps` are those of `tap_table`, then those of `quartets`."""
    task = ptr32(_task)
    task[1] = (frame & 511) << 1
    task[2] = int(taps) + 224
    task[3] = 30
    d = 0
    while d < dofs:
        if signal[d]:
            at = int(row[d]) << 9
            a = int(base_q15[at + (frame & 511)])
            level_q16[d] = (a << 1) + _ZERO
            pair = int(base_q15[at + ((frame + 1) & 511)]) + int(base_q15[at + ((frame - 1) & 511)])
            pair_2 = int(base_q15[at + ((frame + 2) & 511)]) + int(base_q15[at + ((frame - 2) & 511)])
            level_q16[_DOFS + d] = ((6 * a + (pair << 2) + pair_2 + 4) >> 3) + _ZERO
            a = a * taps[3] + pair * taps[4] + pair_2 * taps[5]
            j = 3
            while j < 7:
                a += taps[3 + j] * (
                    int(base_q15[at + ((frame + j) & 511)]) + int(base_q15[at + ((frame - j) & 511)])
                )
                j += 1
            level_q16[2 * _DOFS + d] = ((a + 0x40) >> 7) + _ZERO
            task[0] = int(third_q15) + (at << 1)
            _sum_pairs(_task)
            a = int(third_q15[at + (frame & 511)])
            level_q16[3 * _DOFS + d] = (a << 1) + _ZERO
            a -= 16384
            level_q16[4 * _DOFS + d] = ((a * taps[0] + task[4] + 4) >> 3) + 32768 + _ZERO
            level_q16[5 * _DOFS + d] = ((a * taps[3] + task[5] + 0x40) >> 7) + 32768 + _ZERO
            level_q16[6 * _DOFS + d] = ((a * taps[10] + task[6] + 0x400) >> 11) + 32768 + _ZERO
            level_q16[7 * _DOFS + d] = ((a * taps[25] + task[7] + 0x4000) >> 15) + 32768 + _ZERO
        d += 1


@micropython.viper
def bend(
    base_q15: ptr16,
    third_q15: ptr16,
    row: ptr8,
    dofs: int,
    changed: ptr8,
    first_dof: int,
    frame: int,
    end: int,
    knot: ptr8,
    first_knot: int,
    knots: int,
    delta_q15: ptr32,
):
    """Do what `bands.bend` does."""
    task = ptr32(_task)
    last = knots - 1
    d = first_dof
    while d < dofs:
        if changed[d]:
            task[0] = int(base_q15) + (int(row[d]) << 10)
            task[1] = int(third_q15) + (int(row[d]) << 10)
            n = frame + int(knot[first_knot])
            b = first_knot
            while n < end:
                now = (delta_q15[(d << 4) + b] - _DELTA_ZERO) << 8
                slope = 0
                until = end
                if b < last:
                    until = frame + int(knot[b + 1])
                    if until > end:
                        until = end
                    k = int(knot[b + 1]) - int(knot[b])
                    slope = (((delta_q15[(d << 4) + b + 1] - _DELTA_ZERO) << 8) - now) // k
                    b += 1
                task[2] = (n & 511) << 1
                task[3] = until - n
                task[4] = now + 128
                task[5] = slope
                if until > n:
                    _bend_row(_task)
                n = until
        d += 1
