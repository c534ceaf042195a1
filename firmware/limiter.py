"""Limits: whatever is asked for, no DOF leaves its range, exceeds its top speed or its top acceleration.

An absolute DOF has a position and a velocity per tick. In each tick it takes the velocity that brings it onto its
reference soonest, which means braking in time: `n` ticks of braking by `A` a tick cover `A n (n + 1) / 2`, so over a way
`x` the greatest velocity is `x / n + A (n - 1) / 2` with the least `n` for which `n (n + 1) >= 2 x / A`. The same way
it brakes ahead of the ends of its range. In integers this holds exactly: a DOF that keeps to its limits in one tick can
keep to them in the next. Ease in and ease out follow from it.

A relative DOF's value is a velocity already; its changes are limited.

Source: SPEC of motor control.
"""

import micropython
from micropython import const

_ZERO = const(0x10000000)
_STILL = const(0x800000)


@micropython.viper
def limit(
    wanted_q24: ptr32,
    correction_q24: ptr32,
    reference_q24: ptr32,
    position_q24: ptr32,
    velocity_q24: ptr32,
    dofs: int,
    held: ptr8,
    relative: ptr8,
    low_q24: ptr32,
    high_q24: ptr32,
    speed_q24: ptr32,
    accel_q24: ptr32,
    force_q24: ptr32,
    standing: int,
    calm_q24: int,
):
    """Move every DOF by one tick towards what is wanted, within its limits.

    `wanted`, `correction`, `reference` and `velocity` (per tick) are Q24 with 16 added. `reference` is what was wanted in the
    last tick, within the range; this one's is written there. A DOF that is `held` stands still. `standing` not 0 lets
    relative DOFs come to a stand, by at most `calm_q24` a tick. `force` is the acceleration in force: where `accel` has
    become smaller, a DOF brakes with the old one until it could stop in time with the new one. Limits: `low <= high` within
    0..2^24, speed 1..2^24, accel 2..2^24.
    Bits: positions have 25, distances 26, `2 x / A` 26; `n (n + 1)` stays below 2^27, `A (n - 1)` below 2^26.
    """
    d = 0
    while d < dofs:
        p = position_q24[d]
        low = low_q24[d]
        high = high_q24[d]
        accel = accel_q24[d]
        target = wanted_q24[d] + correction_q24[d] - _ZERO - _ZERO
        if target > high:
            target = high
        if target < low:
            target = low
        v = 0
        if relative[d] and held[d] == 0:
            if standing:
                target = _STILL
                if accel > calm_q24:
                    accel = calm_q24
            v = target - p
            if v > accel:
                v = accel
            if v < -accel:
                v = -accel
        elif held[d] == 0:
            speed = speed_q24[d]
            force = force_q24[d]
            if force < accel:
                force = accel
            before = velocity_q24[d] - _ZERO
            last = reference_q24[d] - _ZERO
            moves = target - last
            way = last - p
            # Twice: the velocity that catches up with the reference, then the greatest that stays in the range.
            turn = 0
            while turn < 2:
                x = way if way >= 0 else 0 - way
                if x > accel:
                    q = (2 * x + accel - 1) // accel
                    n = 0
                    bit = 4096
                    while bit:
                        if (n + bit) * (n + bit + 1) < q:
                            n += bit
                        bit >>= 1
                    n += 1
                    x = ((2 * x) // n + accel * (n - 1)) >> 1
                if turn == 0:
                    v = moves + x if way >= 0 else moves - x
                    if v > speed:
                        v = speed
                    if v < -speed:
                        v = -speed
                    if v > before + force:
                        v = before + force
                    if v < before - force:
                        v = before - force
                    # Now the way to that end of the range which is ahead.
                    way = high - p if v >= 0 else p - low
                    if way < 0:
                        way = 0
                    if v <= accel and v >= -accel and v <= way and v >= -way:
                        force = accel
                        turn = 2
                elif v >= 0:
                    if v > x:
                        v = x
                    if v < before - force:
                        v = before - force
                    else:
                        force = accel
                else:
                    if v < -x:
                        v = 0 - x
                    if v > before + force:
                        v = before + force
                    else:
                        force = accel
                turn += 1
            force_q24[d] = force
            if p + v > 0x1000000:
                v = 0x1000000 - p
            if p + v < 0:
                v = 0 - p
        position_q24[d] = p + v
        velocity_q24[d] = v + _ZERO
        reference_q24[d] = target + _ZERO
        d += 1
