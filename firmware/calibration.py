"""Calibration: from a DOF's position to what its output needs, and the tap of the course.

A wheel that only begins to turn at some share of full drive gets that share from speed 1/64 on (below, in proportion),
and full speed is reached at its top speed's share. Pulse ends that are set anew while a DOF moves glide there.

Source: SPEC of motor control.
"""

import micropython
from micropython import const

_STILL = const(0x800000)
_RISE = const(0x20000)  # 1/64 of full speed, where a wheel gets its dead band's share


@micropython.viper
def calibrate(
    position_q24: ptr32,
    level_q24: ptr32,
    pulse_q18us: ptr32,
    dofs: int,
    relative: ptr8,
    end_q4us: ptr16,
    end0_q4us: ptr16,
    end1_q4us: ptr16,
    glide_q4us: int,
    dead_q15: ptr16,
    top_q15: ptr16,
    turn: ptr8,
    turns: ptr8,
) -> int:
    """Write level and pulse width of every DOF; return a mask of the DOFs whose turn it is to be written out.

    `end_q4us` holds 2 x 16 ends as they are now, which follow `end0` and `end1` by at most `glide` a tick. The level is the
    position, or what the wheel's drive has to be, 0x800000 standing still. Pulses are in us with 18 bits behind the point.
    Bits: a level has 25, in limbs of 13 + 12; ends have 16, so products stay within 2^28 and pulse widths below 2^30.
    """
    due = 0
    d = 0
    while d < dofs:
        level = position_q24[d]
        if relative[d]:
            m = level - _STILL
            if m < 0:
                m = 0 - m
            dead = int(dead_q15[d])
            rise = m if m < _RISE else _RISE
            spread = int(top_q15[d]) - dead
            m = ((rise >> 4) * dead >> 5) + ((m >> 10) * spread >> 5) + ((m & 0x3FF) * spread >> 15)
            level = _STILL + m if level >= _STILL else _STILL - m
        level_q24[d] = level
        end = 0
        while end < 2:
            place = end * 16 + d
            now = int(end_q4us[place])
            wanted = int(end1_q4us[d]) if end else int(end0_q4us[d])
            if now != wanted:
                if wanted > now + glide_q4us:
                    wanted = now + glide_q4us
                if wanted < now - glide_q4us:
                    wanted = now - glide_q4us
                end_q4us[place] = wanted
            end += 1
        at_0 = int(end_q4us[d])
        span = int(end_q4us[16 + d]) - at_0
        pulse_q18us[d] = (at_0 << 14) + (span * (level >> 12) << 2) + (span * (level & 0xFFF) >> 10)
        wait = int(turn[d]) + 1
        if wait >= int(turns[d]):
            wait = 0
            due |= 1 << d
        turn[d] = wait
        d += 1
    return due


@micropython.viper
def tap(
    position_q24: ptr32, before_q24: ptr32, dofs: int, z_q15: int, tap_q15: ptr16, at: int
):
    """Write the course between ticks, from `z` = 0 half a tick before the last tick to 1 half a tick behind it.

    The quadratic B-spline through `before[16 + d]`, `before[d]` and the present position, rounded to Q15: its acceleration is
    the second difference of the ticks, never more. Bits: differences have 25, second ones 26, in limbs of 14 + 12.
    """
    d = 0
    while d < dofs:
        oldest = before_q24[16 + d]
        middle = before_q24[d]
        bend = oldest - 2 * middle + position_q24[d]
        slope = 2 * (middle - oldest) + ((bend >> 12) * z_q15 >> 3) + ((bend & 0xFFF) * z_q15 >> 15)
        value = oldest + middle + ((slope >> 12) * z_q15 >> 3) + ((slope & 0xFFF) * z_q15 >> 15)
        value = (value + 0x200) >> 10
        if value < 0:
            value = 0
        if value > 0x8000:
            value = 0x8000
        tap_q15[at + d] = value
        d += 1
