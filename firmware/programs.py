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
    playing: ptr8,
    found: int,
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
    sine: ptr16,
    gradients: ptr16,
    live_q28: ptr32,
    curve_start: ptr16,
    curve_samples: ptr16,
    samples_q15: ptr16,
    stack: ptr32,
    value_q15: ptr16,
):
    """Write the values of all programs of the playing actions.

    Values are Q16 and saturate at -16..16; on the stack they stand with 2^21 added. A phase `a * t + b` is `a_q4` times
    the fraction in Q22, within 2^30, in sixteenths of whole cycles. Bits: a product has limbs of 11 + 10
    bits and 21, so at most 2^30.
    """
    n = 0
    while n < found:
        i = int(playing[n])
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            if function[m] == _PROGRAM and int(same[m]) == m:
                p = int(argument[m])
                at = int(program_start[p])
                last = at + int(program_words[p])
                top = 0
                v = 0
                while at < last:
                    code = pool[at]
                    at += 1
                    if code >= _RSIN and code <= _CURVE:
                        k = 0
                        if code >= _NOISE:
                            k = pool[at]
                            at += 1
                        a = pool[at] - 256
                        at += 1
                        whole = a * int(cycle[i])
                        u = ((whole & 15) << 22) + a * ((fraction_q24[i] + 2) >> 2)
                        whole = whole >> 4
                        if code == _NOISE:
                            whole = whole + pool[at]
                            at += 1
                        u = u + (pool[at] << 2)
                        at += 1
                        whole = whole + (u >> 26)
                        u = u & 0x3FFFFFF
                        if code == _NOISE:
                            k = k << 8
                            x = int(gradients[k + (whole & 255)]) - 32768
                            y = int(gradients[k + ((whole + 1) & 255)]) - 32768
                            u = (u + 0x400) >> 11
                            w = 32768 - u
                            v = 32768 + ((((u * w + 0x2000) >> 14) * ((x * w - y * u + 0x4000) >> 15) + 0x2000) >> 14)
                        elif code == _CURVE:
                            x = int(curve_samples[k])
                            u = ((u + 8) >> 4) * x
                            y = u >> 22
                            if y >= x:
                                y = 0
                                u = 0
                            u = (u & 0x3FFFFF) >> 7
                            k = int(curve_start[k])
                            w = int(samples_q15[k + y])
                            y += 1
                            if y == x:
                                y = 0
                            v = (w << 1) + (((int(samples_q15[k + y]) - w) * u + 0x2000) >> 14)
                        else:
                            if code == _RCOS:
                                u = (u + 0x1000000) & 0x3FFFFFF
                            x = u >> 17
                            w = int(sine[x])
                            v = (w << 1) + (((int(sine[x + 1]) - w) * ((u >> 2) & 0x7FFF) + 0x2000) >> 14)
                    elif code == _CONST:
                        v = pool[at] - _LIMIT
                        at += 1
                    elif code == _LIVE:
                        v = (live_q28[pool[at]] + 0x800) >> 12
                        at += 1
                    else:
                        top -= 1
                        v = stack[top] - 0x200000
                        if code == _SCALE:
                            x = pool[at] - _LIMIT
                            y = pool[at + 1] - 10
                            at += 2
                            v = (v >> 10) * x + (((v & 0x3FF) * x) >> 10)
                            if y:
                                v = (v + (1 << (y - 1))) >> y
                        elif code == _NEG:
                            v = 0 - v
                        elif code == _ABS:
                            if v < 0:
                                v = 0 - v
                        else:
                            top -= 1
                            x = stack[top] - 0x200000
                            if code == _ADD:
                                v = x + v
                            elif code == _SUB:
                                v = x - v
                            elif code == _MUL:
                                v = ((x >> 10) * v + (((x & 0x3FF) * v) >> 10) + 32) >> 6
                            elif code == _MIN:
                                if x < v:
                                    v = x
                            elif code == _MAX:
                                if x > v:
                                    v = x
                            else:
                                top -= 1
                                w = stack[top] - 0x200000
                                if code == _CLAMP:
                                    # w limited to x .. v
                                    if w < x:
                                        w = x
                                    if w > v:
                                        w = v
                                    v = w
                                else:
                                    # w + (x - w) * v
                                    x = x - w
                                    if x > _LIMIT:
                                        x = _LIMIT
                                    if x < 0 - _LIMIT:
                                        x = 0 - _LIMIT
                                    v = w + (((x >> 10) * v + (((x & 0x3FF) * v) >> 10) + 32) >> 6)
                    if v > _LIMIT:
                        v = _LIMIT
                    if v < 0 - _LIMIT:
                        v = 0 - _LIMIT
                    stack[top] = v + 0x200000
                    top += 1
                v = (v + 1) >> 1
                if v < 0:
                    v = 0
                if v > 32768:
                    v = 32768
                value_q15[m] = v
            m += 1
        n += 1


class Programs:
    """The machine that evaluates programs: its stack."""

    def __init__(self):
        self._stack = array("i", bytes(4 * isa.DEPTH_MAX))

    def evaluate(self, tables, actions, sine, gradients, live_q28, value_q15):
        """Write the values of all programs of the playing actions to `value_q15`."""
        # fmt: off
        _evaluate(
            actions.playing, actions.found, actions.cycle, actions.fraction_q24, tables.first_mapping,
            tables.mapping_count, tables.function, tables.argument, tables.same, tables.program_start,
            tables.program_words, tables.pool, sine, gradients, live_q28, tables.curve_start, tables.curve_samples,
            tables.samples_q15, self._stack, value_q15,
        )
        # fmt: on
