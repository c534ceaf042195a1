"""The exchange of tables: at rest, and while the puppet plays.

The host says for every new action, DOF and live channel which old one it was; what keeps its name keeps its state. What
takes long is prepared a step at a time between frames, so that none is late: noise tables, repeated functions, the
streams of blinks. Then, behind a frame, every state array is gathered by the list of old places.
"""

import micropython
from micropython import const

from firmware import functions
from firmware.tables import halves, words
from shared.formats import (
    FUNCTION_BLINK,
    GRADIENTS,
    MAPPINGS_MAX,
    NEW,
    NOISE_TABLES,
    WEIGHT_ONE,
)

_NEW = const(255)
_NOT_KEPT = const(0xFFFF)


@micropython.viper
def gather_words(values: ptr32, old: ptr8, scratch: ptr32, count: int, fresh: int, at: int):
    """Let `values[at + i]` be what `values[at + old[i]]` was, or `fresh` where `old[i]` is 255."""
    i = 0
    while i < count:
        k = int(old[i])
        scratch[i] = fresh if k == _NEW else values[at + k]
        i += 1
    i = 0
    while i < count:
        values[at + i] = scratch[i]
        i += 1


@micropython.viper
def gather_halves(values: ptr16, old: ptr8, scratch: ptr32, count: int, fresh: int, at: int):
    """Do the same with 16-bit words."""
    i = 0
    while i < count:
        k = int(old[i])
        scratch[i] = fresh if k == _NEW else int(values[at + k])
        i += 1
    i = 0
    while i < count:
        values[at + i] = scratch[i]
        i += 1


@micropython.viper
def settle_tempos(old: ptr8, before_q16: ptr32, after_q16: ptr32, count: int, tempo_q16: ptr32, wanted_q16: ptr32):
    """Give new actions their tempo, and those that stay theirs if the file has another one than before."""
    i = 0
    while i < count:
        k = int(old[i])
        if k == _NEW:
            tempo_q16[i] = after_q16[i]
            wanted_q16[i] = after_q16[i]
        elif before_q16[k] != after_q16[i]:
            wanted_q16[i] = after_q16[i]
        i += 1


class Exchange:
    """Exchanges the staged tables of a puppet for those that play. `step` is the next step, -1 if there is nothing to do."""

    def __init__(self, puppet):
        self.step = -1
        self._puppet = puppet
        a = puppet.actions
        self._of_actions = (
            a.target_q28, a.x_q28, a.w_q28, a.before_q28, a.start_q18, a.fraction_q24, a.tempo_q16, a.wanted_tempo_q16
        )  # fmt: skip
        self._seed = self._spread_q15 = -1  # of the gradients that play
        self._gradients = halves(NOISE_TABLES * GRADIENTS)  # those of the staged tables
        self._old_mapping = halves(MAPPINGS_MAX)
        self._scratch = words(MAPPINGS_MAX)

    def begin(self):
        """Begin to prepare the staged tables, which are complete."""
        self.step = 0

    def prepare(self):
        """Take one step; return whether all is prepared."""
        puppet = self._puppet
        staged = puppet.staged
        step = self.step
        if step < NOISE_TABLES:
            if not self._are_drawn(staged):
                functions.fill_gradients(self._gradients, step + 1, staged.seed, staged.spread_q15)
        elif step - NOISE_TABLES < staged.actions:
            action = step - NOISE_TABLES
            staged.link_repeats(action)
            self._find_blinks(action)
        elif step - NOISE_TABLES == staged.actions and puppet.frame >= 0:
            puppet.motor.prepare(staged)
        else:
            return True
        self.step += 1
        return False

    def replace(self):
        """Put the prepared tables into force while the motion stands: everything begins at rest."""
        puppet = self._puppet
        for mapping in range(puppet.staged.mappings):
            self._old_mapping[mapping] = _NOT_KEPT
        self._swap()
        puppet.processing.load(puppet.tables.frame_rate_hz)
        puppet.motor.load(puppet.tables)

    def carry_over(self):
        """Put the prepared tables into force between two frames; what keeps its name goes on."""
        puppet = self._puppet
        micropython.heap_lock()  # what allocates nothing is twice as fast then
        try:
            self._carry_synthesis(puppet.tables, puppet.staged)
            puppet.look()
            puppet.motor.exchange(puppet.staged, gather_words, gather_halves, self._scratch)
            self._swap()
        finally:
            micropython.heap_unlock()

    def _carry_synthesis(self, old, new):
        puppet = self._puppet
        scratch = self._scratch
        a = puppet.actions
        puppet.future.exchange(old, new, puppet, scratch)
        keep = new.keep_action
        count = new.actions
        for values in self._of_actions:
            gather_words(values, keep, scratch, count, 0, 0)
        gather_words(a.offset_q28, keep, scratch, count, WEIGHT_ONE, 0)  # one cycle: no offset
        settle_tempos(keep, old.tempo_q16, new.tempo_q16, count, a.tempo_q16, a.wanted_tempo_q16)
        gather_halves(a.cycle, keep, scratch, count, 0, 0)
        gather_halves(a.kept_cycle, keep, scratch, count, 0, 0)
        keep = new.keep_live
        for values in puppet.live_state:
            gather_words(values, keep, scratch, new.lives, 0, 0)
        for live in range(new.lives):
            if keep[live] == NEW:
                for values in puppet.live_state:
                    values[live] = new.live_rest_q28[live]
        puppet.kalman.rearrange(gather_words, keep, scratch, new)
        keep = new.keep_dof
        puppet.processing.rearrange(gather_words, keep, scratch, new.dofs)
        for values in puppet.hold_state:
            gather_words(values, keep, scratch, new.dofs, WEIGHT_ONE, 0)
        gather_halves(puppet.base_q15, keep, scratch, new.dofs, 0, 0)
        gather_halves(puppet.hold_q15, keep, scratch, new.dofs, 0, 0)
        for dof in range(new.dofs):
            if keep[dof] == NEW:
                puppet.base_q15[dof] = puppet.hold_q15[dof] = new.rest_q15[dof]
        puppet.cues.renumber(new.keep_action, new.actions, new.keep_live, new.lives)
        puppet.base_ring.rearrange(gather_halves, keep, scratch, new.dofs, puppet.frame, new.rest_q15)

    def _swap(self):
        puppet = self._puppet
        puppet.tables, puppet.staged = puppet.staged, puppet.tables
        puppet.staged.ready = False
        if not self._are_drawn(puppet.tables):
            puppet.gradients, self._gradients = self._gradients, puppet.gradients
            self._seed = puppet.tables.seed
            self._spread_q15 = puppet.tables.spread_q15
        puppet.blinks.exchange(puppet.tables, self._old_mapping, self._scratch)
        self.step = -1

    def _are_drawn(self, tables):
        """Return whether the gradients that play are those of these tables."""
        return tables.seed == self._seed and tables.spread_q15 == self._spread_q15

    def _find_blinks(self, action):
        """Seed the streams of an action's blinks, and note which old mapping each of them continues."""
        puppet = self._puppet
        old = puppet.tables
        new = puppet.staged
        was = new.keep_action[action]
        first = new.first_mapping[action]
        for mapping in range(first, first + new.mapping_count[action]):
            self._old_mapping[mapping] = _NOT_KEPT
            if new.function[mapping] < FUNCTION_BLINK:
                continue
            puppet.blinks.seed_next(new.seed, mapping)
            if was == NEW:
                continue
            dof = new.keep_dof[new.mapped_dof[mapping]]
            start = old.first_mapping[was]
            for other in range(start, start + old.mapping_count[was]):
                if old.mapped_dof[other] == dof and old.function[other] == new.function[mapping]:
                    self._old_mapping[mapping] = other


def check_kept(new, old):
    """Return whether the lists of what is kept name old things of the right kind; DOFs keep their kind or count as new."""
    for keep, count, limit in (
        (new.keep_action, new.actions, old.actions),
        (new.keep_dof, new.dofs, old.dofs),
        (new.keep_live, new.lives, old.lives),
    ):
        for place in range(count):
            if keep[place] != NEW and keep[place] >= limit:
                return False
    for dof in range(new.dofs):
        was = new.keep_dof[dof]
        if was != NEW and new.relative[dof] != old.relative[was]:
            new.keep_dof[dof] = NEW
    return True
