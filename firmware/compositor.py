"""The motion compositor: masks, the convex sum, and HOLD.

`value_j = sum(mask_ij * w_i * a_ij) / sum(mask_ij * w_i)` over the playing actions `i` and one more, HOLD, that every
DOF has: a constant value that takes the DOF over, through the same filters as every weight, while no action asks for
it. The mask is the list of mappings itself: an action sums into the DOFs it maps and touches no other.
"""

import micropython


@micropython.viper
def hold_targets(
    actions: int,
    target_q28: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    dofs: int,
    relative: ptr8,
    base_q15: ptr16,
    hold_target_q28: ptr32,
    hold_w_q28: ptr32,
    hold_q15: ptr16,
    wanted: ptr8,
):
    """Set HOLD's target of every DOF: 1 while no action that maps it has a target above 0, else 0.

    Where the target becomes 1 on an absolute DOF while HOLD's own weight is below 1/256, its value becomes the DOF's
    base of the frame before. `wanted` is scratch, one byte a DOF.
    """
    d = 0
    while d < dofs:
        wanted[d] = 0
        d += 1
    i = 0
    while i < actions:
        if target_q28[i]:
            m = int(first_mapping[i])
            end = m + int(mappings[i])
            while m < end:
                wanted[mapped_dof[m]] = 1
                m += 1
        i += 1
    d = 0
    while d < dofs:
        if wanted[d]:
            hold_target_q28[d] = 0
        else:
            if hold_target_q28[d] == 0:
                if relative[d] == 0 and hold_w_q28[d] < 0x100000:
                    hold_q15[d] = base_q15[d]
                hold_target_q28[d] = 0x10000000
        d += 1


@micropython.viper
def blend(
    playing: ptr8,
    found: int,
    w_q28: ptr32,
    first_mapping: ptr16,
    mappings: ptr8,
    mapped_dof: ptr8,
    low_q15: ptr16,
    high_q15: ptr16,
    value_q15: ptr16,
    dofs: int,
    hold_w_q28: ptr32,
    hold_q15: ptr16,
    base_q15: ptr16,
    weight_sum: ptr32,
    shift: ptr8,
    upper: ptr32,
    lower: ptr32,
):
    """Write every DOF's convex sum to `base_q15`; where all weights are 0 the base stays.

    `weight_sum`, `shift`, `upper` and `lower` are scratch, one entry a DOF. A DOF's weights are shifted right so that
    their sum stays below 2^27: faint ones keep all their bits where no others are heavy. Bits: the numerator is `upper
    * 2^12 + lower`, `upper` at most 2^27 / 2^12 * 2^15 = 2^30; a product of a weight's upper limb is at most 2^30, of
    its lower one 2^27. The division takes 4 bits a step: its remainder stays below 2^27, shifted below 2^31.
    """
    d = 0
    while d < dofs:
        weight_sum[d] = (hold_w_q28[d] >> 8) + 1
        d += 1
    n = 0
    while n < found:
        i = int(playing[n])
        w = (w_q28[i] >> 8) + 1
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            d = int(mapped_dof[m])
            weight_sum[d] = weight_sum[d] + w
            m += 1
        n += 1
    d = 0
    while d < dofs:
        total_q20 = weight_sum[d]
        places = 0
        while total_q20 >= 0x80000:
            total_q20 = total_q20 >> 1
            places += 1
        shift[d] = places
        w = hold_w_q28[d] >> places
        a = int(hold_q15[d])
        carried = (w & 0xFFF) * a
        weight_sum[d] = w
        upper[d] = (w >> 12) * a + (carried >> 12)
        lower[d] = carried & 0xFFF
        d += 1
    n = 0
    while n < found:
        i = int(playing[n])
        m = int(first_mapping[i])
        end = m + int(mappings[i])
        while m < end:
            d = int(mapped_dof[m])
            w = w_q28[i] >> int(shift[d])
            a = int(low_q15[m])
            a = a + (((int(high_q15[m]) - a) * int(value_q15[m]) + 0x4000) >> 15)
            carried = (w & 0xFFF) * a + lower[d]
            weight_sum[d] = weight_sum[d] + w
            upper[d] = upper[d] + (w >> 12) * a + (carried >> 12)
            lower[d] = carried & 0xFFF
            m += 1
        n += 1
    d = 0
    while d < dofs:
        divisor = weight_sum[d]
        if divisor:
            carried = lower[d] + (divisor >> 1)
            rest = upper[d] + (carried >> 12)
            carried = carried & 0xFFF
            quotient = rest // divisor
            rest = ((rest - quotient * divisor) << 4) | (carried >> 8)
            digit = rest // divisor
            quotient = (quotient << 4) | digit
            rest = ((rest - digit * divisor) << 4) | ((carried >> 4) & 15)
            digit = rest // divisor
            quotient = (quotient << 4) | digit
            rest = ((rest - digit * divisor) << 4) | (carried & 15)
            base_q15[d] = (quotient << 4) | (rest // divisor)
        d += 1
