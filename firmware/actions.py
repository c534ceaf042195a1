"""Actions: which of them play, and their phases.

An action's nominal phase is `N = r * P`, its tempo times the master phase. It is computed afresh from the exact master
phase in every frame, so nothing adds up and an action that sleeps costs nothing. The phase is kept as whole cycles
modulo 4096 and a fraction in Q24.
"""

import micropython


@micropython.viper
def select(count: int, target_q28: ptr32, x_q28: ptr32, w_q28: ptr32, playing: ptr8) -> int:
    """Write the indices of the actions with a target or a weight above zero to `playing`; return how many there are."""
    found = 0
    i = 0
    while i < count:
        if target_q28[i] | x_q28[i] | w_q28[i]:
            playing[found] = i
            found += 1
        i += 1
    return found


@micropython.viper
def phases(
    playing: ptr8, found: int, master: ptr32, rate_hz: int, tempo_q16: ptr32, cycle: ptr16, fraction_q24: ptr32
):
    """Write the nominal phase of every playing action: `cycle[i]` in 0..4095, `fraction_q24[i]` in 0..2^24 - 1.

    With `P = whole + (sixteenth + remainder / F) / 2^16` and the tempo `k / 2^16`, `k` at most 2^19: `N = k * whole /
    2^16 + (k * sixteenth + k * remainder / F) / 2^32`. `k` is split in two limbs of 10 bits, `whole` in two of 14,
    which keeps every product below 2^26 and every sum below 2^30. The result is below the exact phase by less than
    2^-24 cycle.
    """
    whole_high = master[0] >> 14
    whole_low = master[0] & 0x3FFF
    sixteenth = master[1]
    remainder = master[2]
    n = 0
    while n < found:
        i = int(playing[n])
        k = tempo_q16[i]
        k_high = k >> 10
        k_low = k & 0x3FF
        # k * whole, modulo 2^28: cycles in Q16
        upper = (k_low * whole_high + (((k_high * whole_high) & 15) << 10)) & 0x3FFF
        cycles_q16 = (k_low * whole_low + (((k_high * whole_low) & 0x3FFFF) << 10) + (upper << 14)) & 0xFFFFFFF
        # k * (sixteenth + remainder / F), down to Q24
        part_q24 = ((k_low * sixteenth + (k * remainder) // rate_hz) >> 8) + ((k_high * sixteenth) << 2)
        sum_q24 = ((cycles_q16 & 0xFFFF) << 8) + part_q24
        fraction_q24[i] = sum_q24 & 0xFFFFFF
        cycle[i] = ((cycles_q16 >> 16) + (sum_q24 >> 24)) & 0xFFF
        n += 1
