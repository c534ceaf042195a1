"""The innermost loops of `foresight` in the RP2040's own instructions: the same sums to the bit, in a seventh of the time.

MicroPython's viper keeps nearly all variables in memory. Of what the motion computes, only the frames to come are so many that
this matters: a kernel here lists what is to be done for an action, a job per mapping, and one function without variables does
it. Every other MCU uses `foresight._evaluate`, which says what has to come out.
"""

import micropython
from micropython import const

from firmware.tables import words
from shared.formats import DOFS_MAX

_RCOS = const(1)
_NOISE = const(2)
_LIVE = const(4)
_CURVE = const(5)
_PROGRAM = const(6)

_WORDS = const(15)  # of a job
_READY = const(0)  # kinds of jobs: the row is there already
_SINE = const(1)
_COHERENT = const(2)
_END = const(3)


@micropython.asm_thumb
def _run(r0):
    """Do jobs until one is `_END`. A job has 15 words:

    0 kind, 1 frames, 2 cycles, 3 fractions, 4 table, 5 phase ahead, 6 row, 7 weights, 8 low, 9 span, 10 shift, 11 numerators,
    12 denominators, 13 fades or 0, 14 mean. 2, 3, 4, 6, 7, 11, 12 and 13 are addresses.
    """
    mov(r4, r8)
    mov(r5, r9)
    mov(r6, r10)
    mov(r7, r11)
    push({r4, r5, r6, r7})
    mov(r12, r0)

    label(JOB)
    mov(r0, r12)
    ldr(r4, [r0, 0])
    cmp(r4, 3)
    bne(BEGIN)
    b(END)
    label(BEGIN)
    ldr(r5, [r0, 4])
    mov(r11, r5)  # frames left
    mov(r5, 1)
    lsl(r5, r5, 14)
    mov(r9, r5)  # 0x4000
    cmp(r4, 1)
    beq(SINE)
    cmp(r4, 2)
    beq(NOISE)
    b(FADE)

    # row = sine[k] + ((sine[k + 1] - sine[k]) * (angle & 0x7FFF) + 0x4000 >> 15)
    label(SINE)
    ldr(r5, [r0, 20])
    mov(r8, r5)
    ldr(r1, [r0, 12])
    ldr(r2, [r0, 16])
    ldr(r3, [r0, 24])
    label(SINE_LOOP)
    ldr(r4, [r1, 0])
    add(r1, 4)
    mov(r5, r8)
    add(r4, r4, r5)
    lsl(r4, r4, 8)
    lsr(r5, r4, 23)
    lsl(r5, r5, 1)
    add(r5, r5, r2)
    ldrh(r6, [r5, 0])
    ldrh(r7, [r5, 2])
    sub(r7, r7, r6)
    lsl(r4, r4, 9)
    lsr(r4, r4, 17)
    mul(r7, r4)
    mov(r5, r9)
    add(r7, r7, r5)
    asr(r7, r7, 15)
    add(r7, r7, r6)
    strh(r7, [r3, 0])
    add(r3, 2)
    mov(r5, r11)
    sub(r5, 1)
    mov(r11, r5)
    bne(SINE_LOOP)
    b(FADE)

    # slope = g * v - g_next * u + 0x4000 >> 15, row = 0x4000 + ((u * v + 0x2000 >> 14) * slope + 0x4000 >> 15)
    label(NOISE)
    ldr(r1, [r0, 12])
    ldr(r2, [r0, 16])
    ldr(r3, [r0, 24])
    mov(r5, 1)
    lsl(r5, r5, 15)
    mov(r8, r5)  # 0x8000
    mov(r5, 1)
    lsl(r5, r5, 13)
    mov(r10, r5)  # 0x2000
    ldr(r0, [r0, 8])
    label(NOISE_LOOP)
    ldr(r4, [r1, 0])
    add(r1, 4)
    mov(r5, 1)
    lsl(r5, r5, 8)
    add(r4, r4, r5)
    lsr(r4, r4, 9)  # u
    ldrh(r7, [r0, 0])
    add(r0, 2)
    lsl(r5, r7, 24)
    lsr(r5, r5, 23)
    add(r5, r5, r2)
    ldrh(r6, [r5, 0])
    add(r7, 1)
    lsl(r7, r7, 24)
    lsr(r7, r7, 23)
    add(r7, r7, r2)
    ldrh(r7, [r7, 0])
    mov(r5, r8)
    sub(r6, r6, r5)  # g
    sub(r7, r7, r5)  # g_next
    sub(r5, r5, r4)  # v
    mul(r6, r5)
    mul(r7, r4)
    sub(r6, r6, r7)
    mov(r7, r9)
    add(r6, r6, r7)
    asr(r6, r6, 15)  # slope
    mul(r4, r5)
    mov(r5, r10)
    add(r4, r4, r5)
    lsr(r4, r4, 14)
    mul(r4, r6)
    add(r4, r4, r7)
    asr(r4, r4, 15)
    add(r4, r4, r7)
    strh(r4, [r3, 0])
    add(r3, 2)
    mov(r5, r11)
    sub(r5, 1)
    mov(r11, r5)
    bne(NOISE_LOOP)

    # row = mean + ((row - mean) * fade + 0x4000 >> 15)
    label(FADE)
    mov(r0, r12)
    ldr(r1, [r0, 52])
    cmp(r1, 0)
    beq(ADD)
    ldr(r3, [r0, 24])
    ldr(r5, [r0, 56])
    ldr(r7, [r0, 4])
    mov(r2, r9)
    label(FADE_LOOP)
    ldrh(r4, [r3, 0])
    sub(r4, r4, r5)
    ldrh(r6, [r1, 0])
    add(r1, 2)
    mul(r4, r6)
    add(r4, r4, r2)
    asr(r4, r4, 15)
    add(r4, r4, r5)
    strh(r4, [r3, 0])
    add(r3, 2)
    sub(r7, 1)
    bne(FADE_LOOP)

    # denominator += w, numerator += w * (low + (span * row + 0x4000 >> 15)), w = weight >> shift
    label(ADD)
    ldr(r5, [r0, 4])
    mov(r11, r5)
    ldr(r5, [r0, 36])
    mov(r8, r5)
    ldr(r5, [r0, 32])
    mov(r10, r5)
    ldr(r6, [r0, 40])
    ldr(r1, [r0, 28])
    ldr(r2, [r0, 44])
    ldr(r3, [r0, 48])
    ldr(r0, [r0, 24])
    label(ADD_LOOP)
    ldrh(r4, [r0, 0])
    add(r0, 2)
    mov(r5, r8)
    mul(r4, r5)
    mov(r5, r9)
    add(r4, r4, r5)
    asr(r4, r4, 15)
    mov(r5, r10)
    add(r4, r4, r5)
    ldr(r5, [r1, 0])
    add(r1, 4)
    lsr(r5, r6)
    ldr(r7, [r3, 0])
    add(r7, r7, r5)
    str(r7, [r3, 0])
    add(r3, 4)
    mul(r4, r5)
    ldr(r7, [r2, 0])
    add(r7, r7, r4)
    str(r7, [r2, 0])
    add(r2, 4)
    mov(r7, r11)
    sub(r7, 1)
    mov(r11, r7)
    bne(ADD_LOOP)
    mov(r0, r12)
    add(r0, 60)
    mov(r12, r0)
    b(JOB)

    label(END)
    pop({r4, r5, r6, r7})
    mov(r8, r4)
    mov(r9, r5)
    mov(r10, r6)
    mov(r11, r7)


_jobs = words(_WORDS * DOFS_MAX + 1)


@micropython.viper
def evaluate(
    playing: ptr8,
    found: int,
    frames: int,
    sketching: int,
    cycle_course: ptr16,
    fraction_course_q24: ptr32,
    weight_course_q28: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    signal: ptr8,
    function: ptr8,
    argument: ptr16,
    same: ptr16,
    low_q15: ptr16,
    high_q15: ptr16,
    shift: ptr8,
    sine: ptr16,
    gradients: ptr16,
    live_course_q28: ptr32,
    curve_start: ptr16,
    curve_samples: ptr16,
    curve_mean_q15: ptr16,
    samples_q15: ptr16,
    pace_q22: ptr32,
    spacing_q2: ptr16,
    fade_q15: ptr16,
    faded_q15: ptr16,
    row_q15: ptr16,
    numerator: ptr32,
    denominator: ptr32,
):
    """Do what `foresight._evaluate` does."""
    job = ptr32(_jobs)
    n = 0
    while n < found:
        i = int(playing[n])
        first = n << 4
        begin = int(first_mapping[i])
        last = begin + int(mappings[i])
        known = 0
        at = 0
        if sketching:
            u = pace_q22[n]
            if u > 0x200000:
                u = 0x400000 - u
            b = 0
            while b < frames:
                a = 32768
                k = int(spacing_q2[b])
                if k:
                    k = (u * k) >> 18
                    a = int(fade_q15[k]) if k < 64 else 0
                faded_q15[b] = a
                b += 1
        m = begin
        while m < last:
            d = int(mapped_dof[m])
            code = int(function[m])
            if signal[d] and code < _PROGRAM:
                k = int(same[m]) - begin
                row = k << 4
                kind = _READY
                faded = 0
                mean = 16384
                if (known >> k) & 1 == 0:
                    known = known | (1 << k)
                    b = 0
                    if code <= _NOISE:
                        faded = sketching
                        if code == _NOISE:
                            kind = _COHERENT
                            job[at + 4] = int(gradients) + (int(argument[m]) << 9)
                        else:
                            kind = _SINE
                            job[at + 4] = int(sine)
                            job[at + 5] = code << 22
                    elif code == _LIVE:
                        j = int(argument[m]) << 4
                        while b < frames:
                            a = (live_course_q28[j + b] + 0x1000) >> 13
                            if a > 32768:
                                a = 32768
                            row_q15[row + b] = a
                            b += 1
                    elif code == _CURVE:
                        faded = sketching
                        k = int(argument[m])
                        samples = int(curve_samples[k])
                        mean = int(curve_mean_q15[k])
                        k = int(curve_start[k])
                        while b < frames:
                            u = ((fraction_course_q24[first + b] + 2) >> 2) * samples
                            j = u >> 22
                            if j >= samples:
                                j = 0
                                u = 0
                            u = (u & 0x3FFFFF) >> 7
                            a = int(samples_q15[k + j])
                            j += 1
                            if j == samples:
                                j = 0
                            row_q15[row + b] = a + (((int(samples_q15[k + j]) - a) * u + 0x4000) >> 15)
                            b += 1
                    else:
                        a = int(argument[m])
                        while b < frames:
                            row_q15[row + b] = a
                            b += 1
                job[at] = kind
                job[at + 1] = frames
                job[at + 2] = int(cycle_course) + (first << 1)
                job[at + 3] = int(fraction_course_q24) + (first << 2)
                job[at + 6] = int(row_q15) + (row << 1)
                job[at + 7] = int(weight_course_q28) + (first << 2)
                job[at + 8] = int(low_q15[m])
                job[at + 9] = int(high_q15[m]) - int(low_q15[m])
                job[at + 10] = int(shift[d])
                job[at + 11] = int(numerator) + (d << 6)
                job[at + 12] = int(denominator) + (d << 6)
                job[at + 13] = int(faded_q15) if faded else 0
                job[at + 14] = mean
                at += _WORDS
            m += 1
        if at:
            job[at] = _END
            _run(_jobs)
        n += 1
