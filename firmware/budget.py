"""What the work for the future costs, and how much of it fits between two frames.

The costs are those of an RP2040, and every MCU counts with them: what is computed follows from the tables and from who plays,
so it is the same everywhere. They were fitted to measurements on the emulated RP2040 (`make bench` shows what they come to),
with a little more for the main loop between two portions.
"""

import micropython
from micropython import const

from firmware.outlook import BLOCK

_PROGRAM = const(6)  # as in shared.formats

# What work costs on an RP2040 at 125 MHz, in microseconds, a little more than was measured (`make bench`).
_LINK_PERCENT = const(14)  # of a period
_TICK_US = const(950)  # a motor tick
_TICK_DOF_US = const(30)
_FIXED_US = const(3800)  # the frame under way, its bands
_FIXED_DOF_US = const(60)
_FIXED_ACTION_US = const(10)
_FIXED_MAPPING_US = const(9)
ENTER_US = const(250)  # an action that has entered
_NEWS_US = const(1600)  # to begin anew
_NEWS_DOF_US = const(50)
NEAR_US = const(90)  # a DOF whose rings are bent up to the knot `_NEAR`
BEND_US = const(170)  # and beyond
_SKETCH_US = const(750)  # one sketch
_SKETCH_DOF_US = const(36)
_SKETCH_ACTION_US = const(105)
_KNOT_NS = const(66000)  # a knot of it
_KNOT_ACTION_NS = const(300)
_KNOT_MAPPING_NS = const(1600)
_KNOT_WORD_NS = const(700)
_BLOCK_US = const(1150)  # a block of frames to come
_BLOCK_ACTION_US = const(9)
_BLOCK_MAPPING_US = const(10)
_FRAME_NS = const(3000)  # a frame in it
_FRAME_DOF_NS = const(5500)
_FRAME_ACTION_NS = const(12000)
_FRAME_MAPPING_NS = const(200)
_FRAME_WORD_NS = const(500)
_FRAME_LIVE_NS = const(1000)
_PORTION_US = const(3500)  # that is done at once, between looks at what has come


@micropython.viper
def _program_words(
    playing: ptr8,
    found: int,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    signal: ptr8,
    function: ptr8,
    argument: ptr16,
    program_words: ptr16,
) -> int:
    """Return how many words the programs of the playing actions have, on DOFs that are processed."""
    total = 0
    n = 0
    while n < found:
        i = int(playing[n])
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            d = int(mapped_dof[m])
            if signal[d] and int(function[m]) == _PROGRAM:
                k = int(argument[m])
                total += int(program_words[k])
            m += 1
        n += 1
    return total


@micropython.viper
def _load(playing: ptr8, found: int, mappings: ptr8) -> int:
    """Return how many mappings the playing actions have."""
    total = 0
    n = 0
    while n < found:
        i = int(playing[n])
        total += int(mappings[i])
        n += 1
    return total


class Budget:
    """What is left of a period when the frame has been computed, and what is paid for out of that, in microseconds.

    `left` is the former; `sketch` is the cost of a sketch, `block` of a block of frames to come and `frame` of each frame in it;
    `longest` is how many frames a block has at most. `stretch_percent` is how long a step lasts with the motor ticks in it.
    """

    def __init__(self, knots):
        """`knots` is how many a sketch has."""
        self._knots = knots
        self.left_us = self.sketch_us = self.block_us = self.frame_us = 1
        self.longest = BLOCK
        self.stretch_percent = 100

    def weigh(self, tables, playing, found):
        """Take over the load of the actions of a list."""
        t = tables
        # fmt: off
        words = _program_words(
            playing, found, t.first_mapping, t.mapping_count, t.mapped_dof, t.signal, t.function, t.argument,
            t.program_words,
        ) if t.programs else 0
        # fmt: on
        mappings = _load(playing, found, t.mapping_count)
        knot_ns = _KNOT_NS + _KNOT_ACTION_NS * found + _KNOT_MAPPING_NS * mappings + _KNOT_WORD_NS * words
        self.sketch_us = _SKETCH_US + _SKETCH_DOF_US * t.dofs + _SKETCH_ACTION_US * found + self._knots * knot_ns // 1000
        block_us = _BLOCK_US + _BLOCK_ACTION_US * found + _BLOCK_MAPPING_US * mappings
        frame_ns = _FRAME_NS + _FRAME_DOF_NS * t.dofs + _FRAME_ACTION_NS * found + _FRAME_MAPPING_NS * mappings
        frame_us = (frame_ns + _FRAME_WORD_NS * words + _FRAME_LIVE_NS * t.lives) // 1000
        self.longest = min(BLOCK, max(1 + block_us // frame_us, (_PORTION_US - block_us) // frame_us))
        self.block_us = block_us
        self.frame_us = frame_us
        tick_us = _TICK_US + _TICK_DOF_US * t.dofs
        tick_percent = 100 * tick_us // t.motor_period_us
        self.stretch_percent = 10000 // max(20, 100 - tick_percent)
        percent = max(20, 100 - _LINK_PERCENT - tick_percent)
        fixed_us = _FIXED_US + _FIXED_DOF_US * t.dofs + _FIXED_ACTION_US * found + _FIXED_MAPPING_US * mappings
        self.left_us = 10000 * percent // t.frame_rate_hz - fixed_us

    def news_us(self, tables):
        """Return what it costs to begin anew, without a sketch."""
        return _NEWS_US + _NEWS_DOF_US * tables.dofs

    def frames(self, us):
        """Return how many frames a block may have that is paid for with so much."""
        return min(self.longest, (us - self.block_us) // self.frame_us)
