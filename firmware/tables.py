"""A puppet's tables: plain integer arrays, filled over the link, checked before they are played.

There are two sets, one that plays and one that is being filled; `commit` of a complete set exchanges them. Every index
that a kernel will use is checked here, because viper checks nothing. All arrays have room for the largest puppet.
"""

from array import array

from firmware.programs import check as check_program
from shared import program as isa
from shared.formats import (
    ACTIONS_MAX,
    ALPHA_ONE,
    BLINKS_MAX,
    CURVES_MAX,
    CYCLES_MAX,
    DOFS_MAX,
    ENTRY_START,
    FRAME_RATE_MAX_HZ,
    FRAME_RATE_MIN_HZ,
    FUNCTION_BLINK,
    FUNCTION_CONST,
    FUNCTION_CURVE,
    FUNCTION_LIVE,
    FUNCTION_NOISE,
    FUNCTION_PROGRAM,
    FUNCTION_RTRIGSIN,
    KIND_RELATIVE,
    LIVES_MAX,
    MAPPINGS_MAX,
    NEW,
    NO_PIN,
    NOISE_TABLES,
    PULSE_BITS,
    PULSE_MAX_US,
    PULSE_MIN_US,
    SAMPLES_MAX,
    SAMPLES_POOL,
    TEMPO_MAX_Q16,
    TEMPO_MIN_Q16,
    VALUE_ONE,
    WEIGHT_ONE,
)

_GAP_MAX_Q18 = 1000 << 18
_PULSE_MIN_Q4US = PULSE_MIN_US << PULSE_BITS
_PULSE_MAX_Q4US = PULSE_MAX_US << PULSE_BITS


def words(count):
    """Return an array of `count` signed 32-bit words, all 0."""
    return array("i", bytes(4 * count))


def halves(count):
    """Return an array of `count` unsigned 16-bit words, all 0."""
    return array("H", bytes(2 * count))


class Tables:
    """One set of tables.

    The methods `begin`, `dof` .. `live` store one message's fields and return None, or the number of the field that is out
    of range. Order: `begin`, then `dof` 0, 1, .., `action` 0, 1, .., `mappings`, `live`, each
    in its place exactly once.
    """

    def __init__(self):
        self.ready = False
        self.frame_rate_hz = 30
        self.dofs = self.actions = self.mappings = self.lives = self.curves = self.programs = self.blinks = 0
        self.seed = 0
        self.spread_q15 = 0
        self.link_timeout_ms = 500
        # what each action, DOF and live channel was in the tables that play
        self.keep_action = bytearray(ACTIONS_MAX)
        self.keep_dof = bytearray(DOFS_MAX)
        self.keep_live = bytearray(LIVES_MAX)
        self._forget_seen()
        # per DOF
        self.relative = bytearray(DOFS_MAX)
        self.rest_q15 = halves(DOFS_MAX)
        self.hold_q26 = words(DOFS_MAX)
        self.limit_low_q15 = halves(DOFS_MAX)
        self.limit_high_q15 = halves(DOFS_MAX)
        self.pin = bytearray(DOFS_MAX)
        self.pulse0_q4us = halves(DOFS_MAX)
        self.pulse1_q4us = halves(DOFS_MAX)
        # per action
        self.tempo_q16 = words(ACTIONS_MAX)
        self.rise_q26 = words(ACTIONS_MAX)
        self.fall_q26 = words(ACTIONS_MAX)
        self.first_mapping = halves(ACTIONS_MAX)
        self.mapping_count = bytearray(ACTIONS_MAX)
        self.entry = bytearray(ACTIONS_MAX)
        self.warp_q26 = words(ACTIONS_MAX)
        self.cycles = halves(ACTIONS_MAX)
        # per mapping
        self.mapped_dof = bytearray(MAPPINGS_MAX)
        self.function = bytearray(MAPPINGS_MAX)
        self.argument = halves(MAPPINGS_MAX)
        self.low_q15 = halves(MAPPINGS_MAX)
        self.high_q15 = halves(MAPPINGS_MAX)
        self.same = halves(MAPPINGS_MAX)
        # per live channel
        self.live_rest_q28 = words(LIVES_MAX)
        self.live_rise_q26 = words(LIVES_MAX)
        self.live_fall_q26 = words(LIVES_MAX)
        # curves, programs, blinks
        self.curve_start = halves(CURVES_MAX)
        self.curve_samples = halves(CURVES_MAX)
        self.samples_q15 = halves(SAMPLES_POOL)
        self.program_start = halves(isa.PROGRAMS_MAX)
        self.program_words = halves(isa.PROGRAMS_MAX)
        self.pool = words(isa.POOL_WORDS)
        self.threshold_q16 = words(BLINKS_MAX)
        self.gap_q18 = words(BLINKS_MAX)

    # fmt: off
    def begin(
        self, frame_rate_hz, dofs, actions, mappings, lives, curves, programs, blinks, seed, spread_q15, hold_q26,
        link_timeout_ms,
    ):
        # fmt: on
        """Empty the set and announce what will come."""
        self.ready = False
        for number, (value, least, most) in enumerate(
            (
                (frame_rate_hz, FRAME_RATE_MIN_HZ, FRAME_RATE_MAX_HZ),
                (dofs, 1, DOFS_MAX),
                (actions, 0, ACTIONS_MAX),
                (mappings, 0, MAPPINGS_MAX),
                (lives, 0, LIVES_MAX),
                (curves, 0, CURVES_MAX),
                (programs, 0, isa.PROGRAMS_MAX),
                (blinks, 0, BLINKS_MAX),
                (seed, 0, 0xFFFFFFFF),
                (spread_q15, 0, VALUE_ONE),
                (hold_q26, 1, ALPHA_ONE - 1),
                (link_timeout_ms, 100, 60000),
            )
        ):
            if not least <= value <= most:
                return number
        self.frame_rate_hz = frame_rate_hz
        self.dofs = dofs
        self.actions = actions
        self.mappings = mappings
        self.lives = lives
        self.seed = seed
        self.spread_q15 = spread_q15
        for dof in range(DOFS_MAX):
            self.hold_q26[dof] = hold_q26
        self.link_timeout_ms = link_timeout_ms
        self.curves = curves
        self.programs = programs
        self.blinks = blinks
        self._forget_seen()
        self.ready = True
        return None

    def _forget_seen(self):
        self._dofs_seen = self._actions_seen = self._mappings_seen = self._lives_seen = 0
        self._curves_seen = self._programs_seen = self._blinks_seen = 0
        for keep in (self.keep_action, self.keep_dof, self.keep_live):
            for place in range(len(keep)):
                keep[place] = NEW
        self._samples_used = self._samples_end = self._words_used = self._words_end = 0

    def dof(self, dof, kind, rest_q15, low_q15, high_q15):
        """Store a DOF; it drives nothing until `output` gives it a pin."""
        if dof != self._dofs_seen or dof >= self.dofs:
            return 0
        if kind > KIND_RELATIVE:
            return 1
        if high_q15 > VALUE_ONE:
            return 4
        if low_q15 > high_q15:
            return 3
        if rest_q15 > VALUE_ONE:
            return 2
        self.relative[dof] = kind
        self.rest_q15[dof] = VALUE_ONE // 2 if kind == KIND_RELATIVE else rest_q15
        self.limit_low_q15[dof] = low_q15
        self.limit_high_q15[dof] = high_q15
        self.pin[dof] = NO_PIN
        self._dofs_seen += 1
        return None

    def output(self, dof, pin, pulse0_q4us, pulse1_q4us, board):
        """Give a stored DOF its pin and the pulse widths at value 0 and at value 1 (either may be the larger)."""
        if dof >= self._dofs_seen:
            return 0
        if not board.is_output(pin):
            return 1
        for other in range(self._dofs_seen):
            if other != dof and self.pin[other] != NO_PIN and board.clash(pin, self.pin[other]):
                return 1
        if not _PULSE_MIN_Q4US <= pulse0_q4us <= _PULSE_MAX_Q4US:
            return 2
        if not _PULSE_MIN_Q4US <= pulse1_q4us <= _PULSE_MAX_Q4US:
            return 3
        self.pin[dof] = pin
        self.pulse0_q4us[dof] = pulse0_q4us
        self.pulse1_q4us[dof] = pulse1_q4us
        return None

    def action(self, action, tempo_q16, rise_q26, fall_q26, first_mapping, mappings, entry, warp_q26, cycles):
        """Store an action; its mappings are `first_mapping` .. `first_mapping + mappings - 1`, 0 cycles no gesture."""
        if action != self._actions_seen or action >= self.actions:
            return 0
        if not TEMPO_MIN_Q16 <= tempo_q16 <= TEMPO_MAX_Q16:
            return 1
        if not 0 < rise_q26 < ALPHA_ONE:
            return 2
        if not 0 < fall_q26 < ALPHA_ONE:
            return 3
        if first_mapping + mappings > self.mappings:
            return 4
        if mappings > DOFS_MAX:
            return 5
        if entry > ENTRY_START:
            return 6
        if not 0 < warp_q26 < ALPHA_ONE:
            return 7
        if cycles > CYCLES_MAX or (cycles and entry != ENTRY_START):
            return 8
        self.tempo_q16[action] = tempo_q16
        self.rise_q26[action] = rise_q26
        self.fall_q26[action] = fall_q26
        self.first_mapping[action] = first_mapping
        self.mapping_count[action] = mappings
        self.entry[action] = entry
        self.warp_q26[action] = warp_q26
        self.cycles[action] = cycles
        self._actions_seen += 1
        return None

    def mapping(self, mapping, dof, function, argument, low_q15, high_q15):
        """Store a mapping. The field numbers count from the item's `dof`, 0; a mapping out of its place is field 0."""
        if mapping != self._mappings_seen or mapping >= self.mappings or dof >= self.dofs:
            return 0
        if function > FUNCTION_RTRIGSIN:
            return 1
        if argument >= self._arguments(function):
            return 2
        if low_q15 > VALUE_ONE:
            return 3
        if high_q15 > VALUE_ONE:
            return 4
        self.mapped_dof[mapping] = dof
        self.function[mapping] = function
        self.argument[mapping] = argument
        self.low_q15[mapping] = low_q15
        self.high_q15[mapping] = high_q15
        self._mappings_seen += 1
        return None

    def _arguments(self, function):
        """Return how many arguments a function may have."""
        if function == FUNCTION_NOISE:
            return NOISE_TABLES
        if function == FUNCTION_CONST:
            return VALUE_ONE + 1
        if function == FUNCTION_LIVE:
            return self.lives
        if function == FUNCTION_CURVE:
            return self.curves
        if function == FUNCTION_PROGRAM:
            return self.programs
        if function >= FUNCTION_BLINK:
            return self.blinks
        return 0x10000

    def curve(self, curve, samples):
        """Begin a curve of so many samples, or go on with it; `sample` stores them, in order."""
        if curve != self._curves_seen or curve >= self.curves:
            return 0
        if self._samples_used == self._samples_end:
            if not 2 <= samples <= min(SAMPLES_MAX, SAMPLES_POOL - self._samples_used):
                return 1
            self.curve_start[curve] = self._samples_used
            self.curve_samples[curve] = samples
            self._samples_end = self._samples_used + samples
        return None if samples == self.curve_samples[curve] else 1

    def sample(self, value_q15):
        """Store a sample of the curve under way; it is field 0."""
        if value_q15 > VALUE_ONE or self._samples_used >= self._samples_end:
            return 0
        self.samples_q15[self._samples_used] = value_q15
        self._samples_used += 1
        if self._samples_used == self._samples_end:
            self._curves_seen += 1
        return None

    def program(self, program, words):
        """Begin a program of so many words, or go on with it; `word` stores them, in order."""
        if program != self._programs_seen or program >= self.programs:
            return 0
        if self._words_used == self._words_end:
            if not 1 <= words <= min(isa.WORDS_MAX, isa.POOL_WORDS - self._words_used):
                return 1
            self.program_start[program] = self._words_used
            self.program_words[program] = words
            self._words_end = self._words_used + words
        return None if words == self.program_words[program] else 1

    def word(self, word):
        """Store a word of the program under way, and check the program with its last one; it is field 0."""
        if self._words_used >= self._words_end:
            return 0
        self.pool[self._words_used] = word
        self._words_used += 1
        if self._words_used == self._words_end:
            start = self.program_start[self._programs_seen]
            if check_program(self.pool, start, self._words_end, self.curves, self.lives) is not None:
                return 0
            self._programs_seen += 1
        return None

    def blink(self, blink, threshold_q16, gap_q18):
        """Store a blink's threshold and least gap."""
        if blink != self._blinks_seen or blink >= self.blinks:
            return 0
        if threshold_q16 > 0x10000:
            return 1
        if gap_q18 > _GAP_MAX_Q18:
            return 2
        self.threshold_q16[blink] = threshold_q16
        self.gap_q18[blink] = gap_q18
        self._blinks_seen += 1
        return None

    def link_repeats(self, action):
        """Note for an action's mappings which one before has the same function: that is evaluated once."""
        first = self.first_mapping[action]
        for mapping in range(first, first + self.mapping_count[action]):
            self.same[mapping] = mapping
            function = self.function[mapping]
            for other in range(first, mapping if function < FUNCTION_BLINK else first):
                if self.function[other] == function and self.argument[other] == self.argument[mapping]:
                    self.same[mapping] = other
                    break

    def keep(self, kind, first, place, old):
        """Note that what is new at `first + place` was `old` in the tables that play, or NEW; it is field 2 and up."""
        keep = (self.keep_action, self.keep_dof, self.keep_live)
        if kind >= len(keep):
            return 0
        if first + place >= (self.actions, self.dofs, self.lives)[kind]:
            return 1
        keep[kind][first + place] = old
        return None

    def live(self, live, rest_q28, rise_q26, fall_q26):
        """Store a live channel."""
        if live != self._lives_seen or live >= self.lives:
            return 0
        if rest_q28 > WEIGHT_ONE:
            return 1
        if not 0 < rise_q26 < ALPHA_ONE:
            return 2
        if not 0 < fall_q26 < ALPHA_ONE:
            return 3
        self.live_rest_q28[live] = rest_q28
        self.live_rise_q26[live] = rise_q26
        self.live_fall_q26[live] = fall_q26
        self._lives_seen += 1
        return None

    def doubled(self):
        """Return the first action that maps a DOF twice, or None: the compositor's sums have no room for that."""
        for action in range(self.actions):
            mapped = 0
            first = self.first_mapping[action]
            for mapping in range(first, first + self.mapping_count[action]):
                bit = 1 << self.mapped_dof[mapping]
                if mapped & bit:
                    return action
                mapped |= bit
        return None

    def missing(self):
        """Return how many of the announced parts have not come."""
        return (
            (self.dofs - self._dofs_seen)
            + (self.actions - self._actions_seen)
            + (self.mappings - self._mappings_seen)
            + (self.lives - self._lives_seen)
            + (self.curves - self._curves_seen)
            + (self.programs - self._programs_seen)
            + (self.blinks - self._blinks_seen)
        )
