"""Time: when the next frame is due, and the master phase.

Frame `n` stands for the instant `n / F` exactly. The frame clock counts in the microseconds of the board's timer and
carries the remainder of `1000000 / F` over, so frame `n` is due within one tick of `n / F` however long it runs. The
master phase `P` is an exact rational: `P(n+1) = P(n) + T(n) / F` with the tempo `T` a multiple of 1/65536.

Board ticks are taken modulo 2^30, so every value here is a small integer and nothing allocates.
"""

import micropython
from micropython import const

TICKS_MASK = const(0x3FFFFFFF)
_TICKS_HALF = const(0x20000000)
_LONG_US = const(0x10000000)

# Places in the master phase array: P = whole + (sixteenth + remainder / F) / 65536, whole modulo 2^28.
PHASE_WHOLE = const(0)
PHASE_SIXTEENTH = const(1)
PHASE_REMAINDER = const(2)
PHASE_WORDS = const(3)


def ticks_diff(later, earlier):
    """Return `later - earlier` in microseconds for ticks modulo 2^30, in -2^29 .. 2^29 - 1."""
    difference = (later - earlier) & TICKS_MASK
    if difference >= _TICKS_HALF:
        difference -= TICKS_MASK
        difference -= 1
    return difference


class FrameClock:
    """Tells when frames are due; measures how late they were begun.

    `rate_hz` is the frame rate, 10..60. `late_us` is how late the last frame was begun, `late_max_us` how late one was at most
    since `start`.
    """

    def __init__(self):
        self.rate_hz = 30
        self.due_us = 0
        self.late_us = self.late_max_us = 0
        self._remainder = 0
        self._is_held = False

    def hold(self, rate_hz):
        """Let no frame be due until `start`, and `until_us` a long time."""
        self.rate_hz = rate_hz
        self._is_held = True

    def start(self, due_us, rate_hz):
        """Make frame 0 due at this instant, now or soon."""
        self.rate_hz = rate_hz
        self._is_held = False
        self.due_us = due_us
        self.late_max_us = 0
        self._remainder = 0

    def until_us(self, now_us):
        """Return how long until the next frame is due, in microseconds; 0 or less when it is."""
        if self._is_held:
            return _LONG_US
        return ticks_diff(self.due_us, now_us)

    def begin(self, now_us):
        """Note the lateness of the frame that begins now, and set the instant at which the next one is due."""
        late_us = ticks_diff(now_us, self.due_us)
        self.late_us = late_us
        if late_us > self.late_max_us:
            self.late_max_us = late_us
        rate_hz = self.rate_hz
        period_us = 1000000 // rate_hz
        self._remainder += 1000000 % rate_hz
        if self._remainder >= rate_hz:
            self._remainder -= rate_hz
            period_us += 1
        self.due_us = (self.due_us - (TICKS_MASK - period_us) - 1) & TICKS_MASK  # the plain sum may pass 2^30


@micropython.viper
def advance(phase: ptr32, tempo_q16: int, rate_hz: int):
    """Add `tempo / rate` to the master phase. Bits: the remainder stays below 2^18 + 60, the rest below 2^28 + 4."""
    remainder = phase[2] + tempo_q16
    carried = remainder // rate_hz
    phase[2] = remainder - carried * rate_hz
    sixteenth = phase[1] + carried
    phase[1] = sixteenth & 0xFFFF
    phase[0] = (phase[0] + (sixteenth >> 16)) & 0xFFFFFFF
