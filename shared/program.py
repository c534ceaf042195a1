"""Programs: what a custom expression is compiled to, and what the MCU evaluates.

A program is a straight line of signed 32-bit words for a machine with a small stack: an opcode, then its operands.
There are no jumps, so it cannot loop. Values on the stack are Q16 and saturate at -16..16. The host compiles it; the
MCU checks every word before it plays.

Phases are given as `a * t + b`: `a` in sixteenths (-256..256), `b` as whole cycles modulo 256 and a fraction in Q24,
since everything that a program may evaluate repeats after 256 whole cycles of its argument.
"""

CONST = 0  # value_q16
RSIN = 1  # a_q4, b_q24
RCOS = 2  # a_q4, b_q24
NOISE = 3  # table 0..15, a_q4, b_cycle 0..255, b_q24
CURVE = 4  # curve, a_q4, b_q24
LIVE = 5  # live channel
ADD = 6
SUB = 7
MUL = 8
SCALE = 9  # factor, shift: x * factor >> shift, factor within 2^20, shift 10..40
NEG = 10
ABS = 11
MIN = 12
MAX = 13
CLAMP = 14  # x, low, high
LERP = 15  # a, b, x: a + (b - a) * x

OPERANDS = (1, 2, 2, 4, 3, 1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0)
TAKES = (0, 0, 0, 0, 0, 0, 2, 2, 2, 1, 1, 1, 2, 2, 3, 3)  # values from the stack; every opcode leaves one

VALUE_BITS = 16
LIMIT_Q16 = 16 << VALUE_BITS
A_MAX_Q4 = 256
SCALE_MAX = 1 << 20
SHIFT_MIN = 10
SHIFT_MAX = 40

DEPTH_MAX = 16
WORDS_MAX = 128  # of one program
POOL_WORDS = 2560  # of all programs of a puppet
PROGRAMS_MAX = 255
