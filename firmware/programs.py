"""Programs: custom functions, compiled by the host, evaluated by a small stack machine.

A program from the wire is not trusted. `check` walks it once before it is played and follows the height of its stack;
what passes cannot read or write outside its arrays, and having no jumps it ends. See `shared.program`.
"""

from array import array

import micropython
from micropython import const

from shared import program as isa
from shared.formats import NOISE_TABLES

_PROGRAM = const(6)

# As in shared.program; viper inlines constants of its own file only.
_CONST = const(0)
_RSIN = const(1)
_RCOS = const(2)
_NOISE = const(3)
_CURVE = const(4)
_LIVE = const(5)
_ADD = const(6)
_SUB = const(7)
_MUL = const(8)
_SCALE = const(9)
_NEG = const(10)
_ABS = const(11)
_MIN = const(12)
_MAX = const(13)
_CLAMP = const(14)
_LIMIT = const(0x100000)

_PLACES = const(16)  # of a value on the stack: the frames of a block

_TAKES = bytes(isa.TAKES)

_OPERAND_LIMITS = {
    isa.CONST: ((-isa.LIMIT_Q16, isa.LIMIT_Q16),),
    isa.RSIN: ((-isa.A_MAX_Q4, isa.A_MAX_Q4), (0, 0xFFFFFF)),
    isa.RCOS: ((-isa.A_MAX_Q4, isa.A_MAX_Q4), (0, 0xFFFFFF)),
    isa.NOISE: ((0, NOISE_TABLES - 1), (-isa.A_MAX_Q4, isa.A_MAX_Q4), (0, 255), (0, 0xFFFFFF)),
    isa.SCALE: ((-isa.SCALE_MAX, isa.SCALE_MAX), (isa.SHIFT_MIN, isa.SHIFT_MAX)),
}


def check(words, start, end, curves, lives):
    """Check `words[start:end]`; shift its signed operands so that no stored word is negative. Return None, or a bad place.

    `curves` and `lives` are how many there are. A program that has been checked is not checked again.
    """
    at = start
    height = 0
    while at < end:
        opcode = words[at]
        if not 0 <= opcode < len(isa.OPERANDS):
            return at - start
        operands = isa.OPERANDS[opcode]
        height -= isa.TAKES[opcode]
        if height < 0 or height >= isa.DEPTH_MAX or at + operands >= end:
            return at - start
        height += 1
        limits = _OPERAND_LIMITS.get(opcode, ())
        if opcode == isa.CURVE:
            limits = ((0, curves - 1), (-isa.A_MAX_Q4, isa.A_MAX_Q4), (0, 0xFFFFFF))
        elif opcode == isa.LIVE:
            limits = ((0, lives - 1),)
        for least, most in limits:
            at += 1
            if not least <= words[at] <= most:
                return at - start
            if least < 0:
                words[at] -= least
        at += 1
    return None if height == 1 else end - start


@micropython.viper
def _evaluate(
    stack: ptr32,
    gradients: ptr16,
    playing: ptr8,
    found: int,
    frames: int,
    cycle: ptr16,
    fraction_q24: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    function: ptr8,
    argument: ptr16,
    same: ptr16,
    program_start: ptr16,
    program_words: ptr16,
    pool: ptr32,
    takes: ptr8,
    sine: ptr16,
    live_q28: ptr32,
    curve_start: ptr16,
    curve_samples: ptr16,
    samples_q15: ptr16,
    value_q15: ptr16,
    curve_mean_q15: ptr16,
    spacing_q2: ptr16,
    pace_q22: ptr32,
    fade_q15: ptr16,
    weight_course_q28: ptr32,
    mapped_dof: ptr8,
    signal: ptr8,
    low_q15: ptr16,
    high_q15: ptr16,
    shift: ptr8,
    numerator: ptr32,
    denominator: ptr32,
):
    """Write the values of all programs of the playing actions to `value`, if `frames` is 0.

    Else the phases are those of a block of so many frames, up to 16 (see `outlook`), 16 places for each action of the list, the
    live channels have 16 places each too, and the values are added to the sums of their DOFs as in `foresight`, if these are
    processed. Where `spacing[b]` is not 0 the frame is one of a sketch, and what is periodic counts for less, the farther it gets
    on its way to the next one: `pace[n]` is the part of a cycle by which a frame moves action `n` of the list on.

    An instruction is looked up once and done for all frames, and a program that stands in an action twice is evaluated once.
    Values are Q16 and saturate at -16..16, in the operations that may leave that; on the stack, where each has 16 places, they
    stand with 2^21 added. `takes[opcode]` is how many an instruction takes. A phase `a * t + b` is `a_q4` times the fraction in
    Q22, within 2^30, in sixteenths of whole cycles. Bits: a product has limbs of 11 + 10 bits and 21, so at most 2^30.
    """
    live = 0
    count = 1
    sketching = 0
    if frames:
        live = 4
        count = frames
        k = 0
        while k < frames:
            sketching = sketching | int(spacing_q2[k])
            k += 1
    n = 0
    while n < found:
        i = int(playing[n])
        first = (n << 4) if frames else i
        m = int(first_mapping[i])
        begin = m
        last = m + int(mappings[i])
        known = 0
        while m < last:
            end = 0
            if function[m] == _PROGRAM:
                k = int(same[m]) - begin
                d = int(mapped_dof[m])
                if (signal[d] and (known >> k) & 1 == 0) if frames else begin + k == m:
                    known = known | (1 << k)
                    end = 1
            if end:
                p = int(argument[m])
                at = int(program_start[p])
                end = at + int(program_words[p])
                top = 0
                while at < end:
                    code = pool[at]
                    at += 1
                    k = top - (int(takes[code]) << 4)
                    top = k + 16
                    stop = k + count
                    if code >= _RSIN and code <= _CURVE:
                        row = k
                        p = 0
                        if code >= _NOISE:
                            p = pool[at]
                            at += 1
                        a = pool[at] - 256
                        at += 1
                        ahead = 0
                        if code == _NOISE:
                            ahead = pool[at]
                            at += 1
                        b = pool[at] << 2
                        at += 1
                        mean = 0x208000
                        j = first
                        if code == _NOISE:
                            p = p << 8
                            while k < stop:
                                w = a * int(cycle[j])
                                u = ((w & 15) << 22) + a * ((fraction_q24[j] + 2) >> 2) + b
                                w = (w >> 4) + ahead + (u >> 26)
                                x = int(gradients[p + (w & 255)]) - 32768
                                y = int(gradients[p + ((w + 1) & 255)]) - 32768
                                u = ((u & 0x3FFFFFF) + 0x400) >> 11
                                w = 32768 - u
                                w = (((u * w + 0x2000) >> 14) * ((x * w - y * u + 0x4000) >> 15) + 0x2000) >> 14
                                stack[k] = w + 0x208000
                                k += 1
                                j += 1
                        elif code == _CURVE:
                            x = int(curve_samples[p])
                            mean = 0x200000 + (int(curve_mean_q15[p]) << 1)
                            p = int(curve_start[p])
                            while k < stop:
                                u = ((a * int(cycle[j])) & 15) << 22
                                u = (u + a * ((fraction_q24[j] + 2) >> 2) + b) & 0x3FFFFFF
                                u = ((u + 8) >> 4) * x
                                y = u >> 22
                                if y >= x:
                                    y = 0
                                    u = 0
                                u = (u & 0x3FFFFF) >> 7
                                w = int(samples_q15[p + y])
                                y += 1
                                if y == x:
                                    y = 0
                                stack[k] = 0x200000 + (w << 1) + (((int(samples_q15[p + y]) - w) * u + 0x2000) >> 14)
                                k += 1
                                j += 1
                        else:
                            if code == _RCOS:
                                b += 0x1000000
                            while k < stop:
                                u = ((a * int(cycle[j])) & 15) << 22
                                u = (u + a * ((fraction_q24[j] + 2) >> 2) + b) & 0x3FFFFFF
                                x = u >> 17
                                w = int(sine[x])
                                u = (int(sine[x + 1]) - w) * ((u >> 2) & 0x7FFF)
                                stack[k] = 0x200000 + (w << 1) + ((u + 0x2000) >> 14)
                                k += 1
                                j += 1
                        if sketching:
                            x = ((a * pace_q22[n]) >> 4) & 0x3FFFFF
                            if x > 0x200000:
                                x = 0x400000 - x
                            k = row
                            b = 0
                            while k < stop:
                                u = int(spacing_q2[b])
                                if u:
                                    u = (x * u) >> 18
                                    y = int(fade_q15[u]) if u < 64 else 0
                                    stack[k] = mean + ((((stack[k] - mean) >> 1) * y) >> 14)
                                k += 1
                                b += 1
                    elif code == _CONST:
                        v = pool[at] + (0x200000 - _LIMIT)
                        at += 1
                        while k < stop:
                            stack[k] = v
                            k += 1
                    elif code == _LIVE:
                        j = pool[at] << live
                        at += 1
                        while k < stop:
                            stack[k] = ((live_q28[j] + 0x800) >> 12) + 0x200000
                            k += 1
                            j += 1
                    elif code == _ADD:
                        while k < stop:
                            v = stack[k] + stack[k + 16] - 0x200000
                            if v > 0x300000:
                                v = 0x300000
                            if v < 0x100000:
                                v = 0x100000
                            stack[k] = v
                            k += 1
                    elif code == _SUB:
                        while k < stop:
                            v = stack[k] - stack[k + 16] + 0x200000
                            if v > 0x300000:
                                v = 0x300000
                            if v < 0x100000:
                                v = 0x100000
                            stack[k] = v
                            k += 1
                    elif code == _MUL:
                        while k < stop:
                            x = stack[k] - 0x200000
                            v = stack[k + 16] - 0x200000
                            v = ((x >> 10) * v + (((x & 0x3FF) * v) >> 10) + 32) >> 6
                            if v > _LIMIT:
                                v = _LIMIT
                            if v < 0 - _LIMIT:
                                v = 0 - _LIMIT
                            stack[k] = v + 0x200000
                            k += 1
                    elif code == _SCALE:
                        x = pool[at] - _LIMIT
                        y = pool[at + 1] - 10
                        at += 2
                        w = (1 << y) >> 1
                        while k < stop:
                            v = stack[k] - 0x200000
                            v = ((v >> 10) * x + (((v & 0x3FF) * x) >> 10) + w) >> y
                            if v > _LIMIT:
                                v = _LIMIT
                            if v < 0 - _LIMIT:
                                v = 0 - _LIMIT
                            stack[k] = v + 0x200000
                            k += 1
                    elif code == _NEG:
                        while k < stop:
                            stack[k] = 0x400000 - stack[k]
                            k += 1
                    elif code == _ABS:
                        while k < stop:
                            if stack[k] < 0x200000:
                                stack[k] = 0x400000 - stack[k]
                            k += 1
                    elif code == _MIN:
                        while k < stop:
                            if stack[k] > stack[k + 16]:
                                stack[k] = stack[k + 16]
                            k += 1
                    elif code == _MAX:
                        while k < stop:
                            if stack[k] < stack[k + 16]:
                                stack[k] = stack[k + 16]
                            k += 1
                    elif code == _CLAMP:
                        # w limited to x .. y
                        while k < stop:
                            w = stack[k]
                            x = stack[k + 16]
                            y = stack[k + 32]
                            if w < x:
                                w = x
                            if w > y:
                                w = y
                            stack[k] = w
                            k += 1
                    else:
                        # w + (x - w) * v
                        while k < stop:
                            w = stack[k]
                            x = stack[k + 16] - w
                            v = stack[k + 32] - 0x200000
                            if x > _LIMIT:
                                x = _LIMIT
                            if x < 0 - _LIMIT:
                                x = 0 - _LIMIT
                            v = w + (((x >> 10) * v + (((x & 0x3FF) * v) >> 10) + 32) >> 6)
                            if v > 0x300000:
                                v = 0x300000
                            if v < 0x100000:
                                v = 0x100000
                            stack[k] = v
                            k += 1
                # Values, and where they go.
                k = 0
                while k < count:
                    v = (stack[k] - 0x1FFFFF) >> 1
                    if v < 0:
                        v = 0
                    if v > 32768:
                        v = 32768
                    stack[k] = v
                    k += 1
                if frames:
                    u = int(same[m])
                    p = m
                    while p < last:
                        d = int(mapped_dof[p])
                        if int(same[p]) == u and signal[d]:
                            low = int(low_q15[p])
                            x = int(high_q15[p]) - low
                            y = int(shift[d])
                            k = 0
                            j = first
                            at = d << 4
                            while k < frames:
                                w = weight_course_q28[j] >> y
                                denominator[at] = denominator[at] + w
                                numerator[at] = numerator[at] + w * (low + ((x * stack[k] + 0x4000) >> 15))
                                k += 1
                                j += 1
                                at += 1
                        p += 1
                else:
                    value_q15[m] = stack[0]
            m += 1
        n += 1


class Programs:
    """The machine that evaluates programs: its stack, 16 places for each value."""

    def __init__(self):
        self._stack = array("i", bytes(4 * _PLACES * isa.DEPTH_MAX))

    def evaluate(self, tables, actions, sine, gradients, live_q28, value_q15):
        """Write the values of all programs of the playing actions to `value_q15`."""
        t = tables
        none = self._stack
        # fmt: off
        _evaluate(
            self._stack, gradients, actions.playing, actions.found, 0, actions.cycle, actions.fraction_q24,
            t.first_mapping, t.mapping_count, t.function, t.argument, t.same, t.program_start, t.program_words, t.pool,
            _TAKES, sine, live_q28, t.curve_start, t.curve_samples, t.samples_q15, value_q15, t.curve_mean_q15, none, none, none,
            none, t.mapped_dof, t.signal, t.low_q15, t.high_q15, none, none, none,
        )
        # fmt: on

    def add(self, tables, outlook, sine, gradients, frames, spacing_q2, fade_q15, shift, numerator, denominator):
        """Add the values of all programs in a block of frames to the sums of their DOFs, for `foresight`."""
        t = tables
        o = outlook
        # fmt: off
        _evaluate(
            self._stack, gradients, o.playing, o.found, frames, o.cycle_course, o.fraction_course_q24, t.first_mapping,
            t.mapping_count, t.function, t.argument, t.same, t.program_start, t.program_words, t.pool, _TAKES, sine,
            o.live_course_q28, t.curve_start, t.curve_samples, t.samples_q15, self._stack, t.curve_mean_q15, spacing_q2,
            o.pace_q22, fade_q15, o.weight_course_q28, t.mapped_dof, t.signal, t.low_q15, t.high_q15, shift, numerator,
            denominator,
        )
        # fmt: on
