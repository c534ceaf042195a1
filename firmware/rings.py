"""The rings: the base of every processed DOF and its `G_3`, from the past through the present to the future.

`bands` has the kernels, `bands_thumb` the innermost loops for the RP2040. Each DOF has a row of both rings, which it keeps as
long as it keeps its name.
"""

import gc
import sys

import micropython
from micropython import const

from firmware import bands
from firmware.exchange import gather_words
from firmware.outlook import BLOCK
from firmware.tables import halves, words
from shared.formats import DOFS_MAX

_DOFS = const(16)  # as in shared.formats
_NEW = const(255)
_ZERO_Q16 = const(0x100000)  # as in bands


@micropython.viper
def _match_rows(
    dofs: int,
    keep: ptr8,
    signal: ptr8,
    row: ptr8,
    new_row: ptr8,
    rest_q15: ptr16,
    base_q15: ptr16,
    before_q15: ptr16,
    after_q15: ptr16,
    value_q15: ptr16,
):
    """Give every new DOF the row that it had, or if it had none one that is free, and what it was to be expected to do.

    A DOF that begins to be processed begins with `value`: its rest, or where it is.
    """
    taken = 0
    d = 0
    while d < dofs:
        was = int(keep[d])
        if was != _NEW:
            if signal[was]:
                taken = taken | (1 << int(row[was]))
        d += 1
    free = 0
    d = 0
    while d < dofs:
        was = int(keep[d])
        kept = 0
        a = int(rest_q15[d])
        if was != _NEW:
            kept = int(signal[was])
            a = int(base_q15[was])
        value_q15[d] = a
        if kept:
            new_row[d] = row[was]
        else:
            while (taken >> free) & 1:
                free += 1
            new_row[d] = free
            taken = taken | (1 << free)
        b = 0
        while b < 16:
            if kept:
                a = int(before_q15[(was << 4) + b])
            after_q15[(d << 4) + b] = a
            b += 1
        d += 1


@micropython.viper
def _begin_rows(
    dofs: int,
    keep: ptr8,
    signal: ptr8,
    row: ptr8,
    value_q15: ptr16,
    base: ptr32,
    third: ptr32,
    level_q16: ptr32,
):
    """Let every DOF that was not processed have been at its `value` always, and stay there; rings are written by pairs."""
    d = 0
    while d < dofs:
        was = int(keep[d])
        kept = 0
        if was != _NEW:
            kept = int(signal[was])
        if kept == 0:
            a = int(value_q15[d])
            pair = a | ((a - ((a >> 15) << 16)) << 16)
            at = int(row[d]) << 8
            end = at + 256
            while at < end:
                base[at] = pair
                third[at] = pair
                at += 1
            k = d
            while k < 128:
                level_q16[k] = (a << 1) + _ZERO_Q16
                k += 16
        d += 1


class Rings:
    """The rings, and `level_q16`: `G_0 .. G_7` of one frame, 8 x 16 words with `bands.ZERO_Q16` added.

    Methods take the tables whose DOFs and their `signal` the rows are for.
    """

    def __init__(self):
        self._taps = bands.tap_table()
        self._smooth, self._split, self._bend = bands.smooth, bands.split, bands.bend
        if sys.platform == "rp2":
            from firmware import bands_thumb

            self._taps.extend(bands_thumb.quartets(self._taps))
            self._smooth, self._split, self._bend = bands_thumb.smooth, bands_thumb.split, bands_thumb.bend
        gc.collect()  # what that took would leave holes behind
        self._base_q15 = halves(DOFS_MAX * bands.RING)
        self._third_q15 = halves(DOFS_MAX * bands.RING)
        self.level_q16 = words(bands.LEVELS * DOFS_MAX)
        self._row = bytearray(range(DOFS_MAX))
        self._other_row = bytearray(DOFS_MAX)
        self._value_q15 = halves(DOFS_MAX)
        self._scratch = words(BLOCK + 1 + 24)

    def read(self, tables, frame, value_q15):
        """Read the base of a frame."""
        bands.column(self._base_q15, self._row, tables.dofs, frame, value_q15)

    def write(self, tables, frame, value_q15):
        """Write the base of a frame; its `G_3`, and that of its neighbours, is left as it is."""
        bands.put_column(self._base_q15, self._row, tables.dofs, frame, value_q15)

    def write_block(self, tables, first, frames, block_q15):
        """Write the base of a block of frames, 16 places per DOF, and whatever `G_3` is known now that was not before."""
        bands.put_block(self._base_q15, self._row, tables.dofs, tables.signal, first, frames, block_q15)
        self.smooth(tables, first - bands.THIRD_REACH - 1, frames + 1)

    def fill(self, tables, first, frames, value_q15, stride, at):
        """Fill frames with one value per DOF, `value[at + stride * dof]`."""
        # fmt: off
        bands.fill(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, first, frames, value_q15, stride, at
        )
        # fmt: on

    def smooth(self, tables, first, frames):
        """Compute `G_3` anew, of up to 17 frames."""
        # fmt: off
        self._smooth(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, first, frames, self._scratch
        )
        # fmt: on

    def bend(self, changed, first_dof, dofs, origin, until, knots, first_knot, count, delta_q15):
        """Let the DOFs that have `changed` follow a change at knots, counted from frame `origin`, from one of them on."""
        # fmt: off
        self._bend(
            self._base_q15, self._third_q15, self._row, dofs, changed, first_dof, origin, until, knots, first_knot,
            count, delta_q15,
        )
        # fmt: on

    def split(self, tables, frame):
        """Write the levels of a frame to `level_q16`."""
        # fmt: off
        self._split(
            self._base_q15, self._third_q15, self._row, tables.dofs, tables.signal, frame, self._taps, self.level_q16
        )
        # fmt: on

    def exchange(self, before, tables, base_q15, expected_q15, block_q15, scratch):
        """Let other tables have the rows: DOFs that stay keep theirs, what begins was always where it is.

        `base` are the DOFs' last values, by the tables `before`; `block` becomes what was `expected` at the knots, 16 places per
        DOF. `scratch` is for a word per DOF.
        """
        # fmt: off
        _match_rows(
            tables.dofs, tables.keep_dof, before.signal, self._row, self._other_row, tables.rest_q15, base_q15,
            expected_q15, block_q15, self._value_q15,
        )
        for at in range(0, bands.LEVELS * _DOFS, _DOFS):
            gather_words(self.level_q16, tables.keep_dof, scratch, tables.dofs, 0, at)
        self._row, self._other_row = self._other_row, self._row
        _begin_rows(
            tables.dofs, tables.keep_dof, before.signal, self._row, self._value_q15, self._base_q15, self._third_q15,
            self.level_q16,
        )
        # fmt: on
