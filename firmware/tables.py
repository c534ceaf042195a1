"""A puppet's tables: plain integer arrays, filled over the link, checked before they are played.

There are two sets, one that plays and one that is being filled; `commit` of a complete set exchanges them. Every index
that a kernel will use is checked here, because viper checks nothing. All arrays have room for the largest puppet.
"""

from array import array

import micropython

from firmware.programs import check as check_program
from shared import program as isa
from shared.formats import (
    ACTIONS_MAX,
    ALPHA_ONE,
    ATTACH_MAX_MS,
    BLINKS_MAX,
    CURVES_MAX,
    CYCLES_MAX,
    DEVICE_SETTINGS_MAX,
    DEVICES_MAX,
    DOFS_MAX,
    DRIVER_BRIDGE,
    ENTRY_START,
    FEEDBACK_PIN_FIRST,
    FEEDBACK_PIN_LAST,
    FEEDBACK_SPAN_MIN_Q15,
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
    MOTOR_PERIOD_MAX_US,
    MOTOR_PERIOD_MIN_US,
    MOTOR_PERIOD_STEP_US,
    NEW,
    NO_DRIVER,
    NO_PIN,
    NOISE_TABLES,
    POSITION_BITS,
    POSITION_ONE,
    PREDICT_KALMAN,
    PULSE_BITS,
    PULSE_GAP_US,
    PULSE_MAX_US,
    PULSE_MIN_US,
    PWM_PERIOD_MAX_US,
    RESPONSE_MAX_Q24,
    SAMPLES_MAX,
    SAMPLES_POOL,
    SETTINGS_MAX,
    SILENT_RELAX,
    STAND_MS,
    TEMPO_MAX_Q16,
    TEMPO_MIN_Q16,
    TURNS_MAX,
    VALUE_BITS,
    VALUE_ONE,
    VARIANCE_MAX_Q16,
    WEIGHT_ONE,
)

_GAP_MAX_Q18 = 1000 << 18
_PULSE_MIN_Q4US = PULSE_MIN_US << PULSE_BITS
_PULSE_MAX_Q4US = PULSE_MAX_US << PULSE_BITS
_ACCEL_MIN_Q24 = 2
_UNIT_TO_POSITION = POSITION_BITS - VALUE_BITS
_RESPONSES = 6  # coefficients of a character
_RESPONSE_ZERO = 1 << 28  # what is added to them: 16


@micropython.viper
def _fill_words(values: ptr32, count: int, value: int):
    """Set words to a value."""
    i = 0
    while i < count:
        values[i] = value
        i += 1


@micropython.viper
def _fill_halves(values: ptr16, count: int, value: int):
    """Set 16-bit words to a value."""
    i = 0
    while i < count:
        values[i] = value
        i += 1


@micropython.viper
def _fill_bytes(values: ptr8, count: int, value: int):
    """Set bytes to a value."""
    i = 0
    while i < count:
        values[i] = value
        i += 1


@micropython.viper
def _link(first: int, count: int, function: ptr8, argument: ptr16, blink: int, same: ptr16):
    """Write to `same` for each of `count` mappings the first with its function and argument; blinks have only themselves."""
    mapping = first
    end = first + count
    while mapping < end:
        found = mapping
        kind = int(function[mapping])
        if kind < blink:
            other = first
            while other < found:
                if int(function[other]) == kind and int(argument[other]) == int(argument[mapping]):
                    found = other
                other += 1
        same[mapping] = found
        mapping += 1


def words(count):
    """Return an array of `count` signed 32-bit words, all 0.

    It is made from a range, not from bytes: those would be as large as it is, and leave a hole in the heap.
    """
    values = array("i", range(count))
    _fill_words(values, count, 0)
    return values


def halves(count):
    """Return an array of `count` unsigned 16-bit words, all 0."""
    values = array("H", range(count))
    _fill_halves(values, count, 0)
    return values


def is_pin(pin):
    """Return whether a Pico leaves this pin to us: the UART has the first two, and it uses 23 to 25 itself."""
    return 2 <= pin <= 22 or 26 <= pin <= 28


def _stand_accel_q24(period_us):
    """Return the least acceleration, per tick, that brings full speed to a stand in STAND_MS, rounded up."""
    return -(-(POSITION_ONE // 2) * period_us // (STAND_MS * 1000))


class Tables:
    """One set of tables.

    The methods named like messages store one message's fields and return None, or the number of the field that is out
    of range. Order: `begin`, then `robot`, `device`, `dof` 0, 1, .., what a DOF has (`character`, `output`, `feedback`,
    `guard`), `action` 0, 1, .., `mappings`, `live`, each in its place exactly once.

    `drivers` checks the settings of outputs and devices (`check_output`, `check_device`) and knows which pins they use
    (`uses`); None leaves all that unchecked.
    """

    def __init__(self, drivers=None):
        self._drivers = drivers
        self.ready = False
        self.frame_rate_hz = 30
        self.dofs = self.actions = self.mappings = self.lives = self.curves = self.programs = self.blinks = 0
        self.seed = 0
        self.spread_q15 = 0
        self.link_timeout_ms = 500
        self.when_silent = 0
        # the robot
        self.motor_period_us = MOTOR_PERIOD_MAX_US
        self.attach_ms = 0
        self.kill_pin = NO_PIN
        self.kill_level = 0
        self.autostart = False
        self.device_driver = bytearray(DEVICES_MAX)
        self.device_settings = halves(DEVICES_MAX * DEVICE_SETTINGS_MAX)
        # what each action, DOF and live channel was in the tables that play
        self.keep_action = bytearray(ACTIONS_MAX)
        self.keep_dof = bytearray(DOFS_MAX)
        self.keep_live = bytearray(LIVES_MAX)
        # per DOF
        self.relative = bytearray(DOFS_MAX)
        self.rest_q15 = halves(DOFS_MAX)
        self.signal = bytearray(DOFS_MAX)
        self.hold_q26 = words(DOFS_MAX)
        self.limit_low_q24 = words(DOFS_MAX)
        self.limit_high_q24 = words(DOFS_MAX)
        self.speed_q24 = words(DOFS_MAX)
        self.accel_q24 = words(DOFS_MAX)
        self.has_character = bytearray(DOFS_MAX)
        self.response_q24 = words(DOFS_MAX * _RESPONSES)  # with 16 added, as words have no sign
        # per DOF: its output
        self.driver = bytearray(DOFS_MAX)
        self.turns = bytearray(DOFS_MAX)
        self.end0_q4us = halves(DOFS_MAX)
        self.end1_q4us = halves(DOFS_MAX)
        self.dead_q15 = halves(DOFS_MAX)
        self.top_q15 = halves(DOFS_MAX)
        self.settings = halves(DOFS_MAX * SETTINGS_MAX)
        # per DOF: its feedback and its guard
        self.feedback_pin = bytearray(DOFS_MAX)
        self.feedback_at0_q15 = halves(DOFS_MAX)
        self.feedback_at1_q15 = halves(DOFS_MAX)
        self.feedback_gain_q15 = halves(DOFS_MAX)
        self.feedback_integral_q24 = words(DOFS_MAX)
        self.feedback_most_q15 = halves(DOFS_MAX)
        self.stall_q15 = halves(DOFS_MAX)
        self.stall_ticks = halves(DOFS_MAX)
        self.release_ms = halves(DOFS_MAX)
        self.duty_q15 = halves(DOFS_MAX)
        self.window_s = halves(DOFS_MAX)
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
        self.live_predict = bytearray(LIVES_MAX)
        self.live_process_q16 = words(LIVES_MAX)
        self.live_noise_q16 = words(LIVES_MAX)
        self.live_fade_q15 = halves(LIVES_MAX)
        # curves, programs, blinks
        self.curve_start = halves(CURVES_MAX)
        self.curve_samples = halves(CURVES_MAX)
        self.curve_mean_q15 = halves(CURVES_MAX)
        self.samples_q15 = halves(SAMPLES_POOL)
        self.program_start = halves(isa.PROGRAMS_MAX)
        self.program_words = halves(isa.PROGRAMS_MAX)
        self.pool = words(isa.POOL_WORDS)
        self.threshold_q16 = words(BLINKS_MAX)
        self.gap_q18 = words(BLINKS_MAX)
        self._forget_seen()

    # fmt: off
    def begin(
        self, frame_rate_hz, dofs, actions, mappings, lives, curves, programs, blinks, seed, spread_q15, hold_q26,
        link_timeout_ms, when_silent,
    ):
        # fmt: on
        """Empty the set and announce what will come."""
        self.ready = False
        # One by one: tuples of limits would be allocated, which takes long where the heap is nearly full.
        if not FRAME_RATE_MIN_HZ <= frame_rate_hz <= FRAME_RATE_MAX_HZ:
            return 0
        if not 1 <= dofs <= DOFS_MAX:
            return 1
        if actions > ACTIONS_MAX:
            return 2
        if mappings > MAPPINGS_MAX:
            return 3
        if lives > LIVES_MAX:
            return 4
        if curves > CURVES_MAX:
            return 5
        if programs > isa.PROGRAMS_MAX:
            return 6
        if blinks > BLINKS_MAX:
            return 7
        if spread_q15 > VALUE_ONE:
            return 9
        if not 1 <= hold_q26 < ALPHA_ONE:
            return 10
        if not 100 <= link_timeout_ms <= 60000:
            return 11
        if when_silent > SILENT_RELAX:
            return 12
        self.frame_rate_hz = frame_rate_hz
        self.dofs = dofs
        self.actions = actions
        self.mappings = mappings
        self.lives = lives
        self.seed = seed
        self.spread_q15 = spread_q15
        _fill_words(self.hold_q26, DOFS_MAX, hold_q26)
        self.link_timeout_ms = link_timeout_ms
        self.when_silent = when_silent
        self.curves = curves
        self.programs = programs
        self.blinks = blinks
        self._forget_seen()
        self.ready = True
        return None

    def _forget_seen(self):
        self._dofs_seen = self._actions_seen = self._mappings_seen = self._lives_seen = 0
        self._curves_seen = self._programs_seen = self._blinks_seen = 0
        _fill_bytes(self.keep_action, ACTIONS_MAX, NEW)
        _fill_bytes(self.keep_dof, DOFS_MAX, NEW)
        _fill_bytes(self.keep_live, LIVES_MAX, NEW)
        self._samples_used = self._samples_end = self._words_used = self._words_end = 0
        self._robot_seen = False
        self._stand_accel_q24 = _stand_accel_q24(MOTOR_PERIOD_MAX_US)
        self._guarded = 0  # bit per DOF
        _fill_bytes(self.device_driver, DEVICES_MAX, NO_DRIVER)
        # what a DOF may have: character, output, feedback, guard
        _fill_bytes(self.has_character, DOFS_MAX, 0)
        _fill_bytes(self.driver, DOFS_MAX, NO_DRIVER)
        _fill_bytes(self.turns, DOFS_MAX, 1)
        _fill_halves(self.top_q15, DOFS_MAX, VALUE_ONE)
        _fill_halves(self.dead_q15, DOFS_MAX, 0)
        _fill_bytes(self.feedback_pin, DOFS_MAX, NO_PIN)
        _fill_halves(self.release_ms, DOFS_MAX, 0)
        _fill_halves(self.duty_q15, DOFS_MAX, VALUE_ONE)
        _fill_halves(self.window_s, DOFS_MAX, 0)

    def robot(self, motor_period_us, attach_ms, kill_pin, kill_level, autostart):
        """Store what all outputs share: the motor layer's period, the pace of attaching, the pin that kills."""
        if self._robot_seen or not MOTOR_PERIOD_MIN_US <= motor_period_us <= MOTOR_PERIOD_MAX_US:
            return 0
        if motor_period_us % MOTOR_PERIOD_STEP_US:
            return 0
        if attach_ms > ATTACH_MAX_MS:
            return 1
        if kill_pin != NO_PIN and not is_pin(kill_pin):
            return 2
        if kill_level > 1:
            return 3
        if autostart > 1:
            return 4
        self.motor_period_us = motor_period_us
        self.attach_ms = attach_ms
        self.kill_pin = kill_pin
        self.kill_level = kill_level
        self.autostart = bool(autostart)
        self._stand_accel_q24 = _stand_accel_q24(motor_period_us)
        self._robot_seen = True
        return None

    def device(self, device, driver, settings, count):
        """Store a chip that outputs share: `count` settings from the beginning of `settings`, which are fields 2 and up."""
        if not self._robot_seen or device >= DEVICES_MAX or self.device_driver[device] != NO_DRIVER:
            return 0
        if driver > DRIVER_BRIDGE:
            return 1
        if count > DEVICE_SETTINGS_MAX:
            return 2 + DEVICE_SETTINGS_MAX
        if self._drivers is not None:
            bad = self._drivers.check_device(driver, settings, count)
            if bad is None and self.kill_pin != NO_PIN:
                bad = self._drivers.device_uses(driver, settings, self.kill_pin)
            if bad is not None:
                return 2 + bad
        self.device_driver[device] = driver
        for place in range(DEVICE_SETTINGS_MAX):
            self.device_settings[device * DEVICE_SETTINGS_MAX + place] = settings[place] if place < count else 0
        return None

    def dof(self, dof, kind, rest_q15, low_q15, high_q15, speed_q24, accel_q24, signal):
        """Store a DOF; it drives nothing until `output` gives it a driver."""
        if not self._robot_seen or dof != self._dofs_seen or dof >= self.dofs:
            return 0
        if kind > KIND_RELATIVE:
            return 1
        if rest_q15 > VALUE_ONE:
            return 2
        bad = self._bad_limit(kind, low_q15, high_q15, speed_q24, accel_q24)
        if bad is not None:
            return 3 + bad
        if signal > 1:
            return 7
        self.relative[dof] = kind
        self.signal[dof] = signal
        self.rest_q15[dof] = VALUE_ONE // 2 if kind == KIND_RELATIVE else rest_q15
        self.limit(dof, low_q15, high_q15, speed_q24, accel_q24)
        self._dofs_seen += 1
        return None

    def limit(self, dof, low_q15, high_q15, speed_q24, accel_q24):
        """Set the range, top speed and top acceleration of a DOF, which have been checked."""
        self.limit_low_q24[dof] = low_q15 << _UNIT_TO_POSITION
        self.limit_high_q24[dof] = high_q15 << _UNIT_TO_POSITION
        self.speed_q24[dof] = speed_q24
        self.accel_q24[dof] = accel_q24

    def bad_limit(self, dof, low_q15, high_q15, speed_q24, accel_q24):
        """Return the number of the bad field of new limits for a DOF, or None; stores nothing. Allocates nothing."""
        if dof >= self._dofs_seen:
            return 0
        bad = self._bad_limit(self.relative[dof], low_q15, high_q15, speed_q24, accel_q24)
        return None if bad is None else 1 + bad

    def _bad_limit(self, kind, low_q15, high_q15, speed_q24, accel_q24):
        if high_q15 > VALUE_ONE:
            return 1
        if low_q15 > high_q15:
            return 0
        if kind == KIND_RELATIVE:
            if low_q15 > VALUE_ONE // 2:  # it could not stand
                return 0
            if high_q15 < VALUE_ONE // 2:
                return 1
        if not 1 <= speed_q24 <= POSITION_ONE:
            return 2
        least = self._stand_accel_q24 if kind == KIND_RELATIVE else _ACCEL_MIN_Q24
        if not least <= accel_q24 <= POSITION_ONE:
            return 3
        return None

    # fmt: off
    def character(
        self, dof, position_error_q24, position_rate_q24, position_slope_q24, rate_error_q24, rate_rate_q24,
        rate_slope_q24,
    ):
        # fmt: on
        """Give a stored DOF its second-order dynamics: six coefficients of `response_q24`, in this order."""
        if dof >= self._dofs_seen or self.has_character[dof]:
            return 0
        responses = (
            position_error_q24, position_rate_q24, position_slope_q24, rate_error_q24, rate_rate_q24, rate_slope_q24
        )
        for number, response_q24 in enumerate(responses):
            if not -RESPONSE_MAX_Q24 <= response_q24 <= RESPONSE_MAX_Q24:
                return 1 + number
            self.response_q24[dof * _RESPONSES + number] = response_q24 + _RESPONSE_ZERO
        self.has_character[dof] = 1
        return None

    def output(self, dof, driver, turns, end0_q4us, end1_q4us, dead_q15, top_q15, settings, count):
        """Give a stored DOF its output: `count` settings from the beginning of `settings`, which are fields 7 and up.

        The ends are the pulse widths at value 0 and at value 1 (either may be the larger), both 0 for a bridge.
        """
        if dof >= self._dofs_seen or self.driver[dof] != NO_DRIVER:
            return 0
        if driver > DRIVER_BRIDGE:
            return 1
        if not 1 <= turns <= TURNS_MAX or turns * self.motor_period_us > PWM_PERIOD_MAX_US:
            return 2
        bad = self._bad_calibration(driver, turns, end0_q4us, end1_q4us, dead_q15, top_q15)
        if bad is not None:
            return 3 + bad
        if count > SETTINGS_MAX:
            return 7 + SETTINGS_MAX
        self.turns[dof] = turns
        if self._drivers is not None:
            bad = self._drivers.check_output(driver, self, dof, settings, count)
            if bad is not None:
                return 7 + bad
        self.driver[dof] = driver
        for place in range(SETTINGS_MAX):
            self.settings[dof * SETTINGS_MAX + place] = settings[place] if place < count else 0
        self.calibrate(dof, end0_q4us, end1_q4us, dead_q15, top_q15)
        return None

    def calibrate(self, dof, end0_q4us, end1_q4us, dead_q15, top_q15):
        """Set the ends, dead band and top of a DOF's output, which have been checked."""
        self.end0_q4us[dof] = end0_q4us
        self.end1_q4us[dof] = end1_q4us
        self.dead_q15[dof] = dead_q15
        self.top_q15[dof] = top_q15

    def bad_calibration(self, dof, end0_q4us, end1_q4us, dead_q15, top_q15):
        """Return the number of the bad field of a new calibration for a DOF, or None; stores nothing. Allocates nothing."""
        if dof >= self._dofs_seen or self.driver[dof] == NO_DRIVER:
            return 0
        bad = self._bad_calibration(self.driver[dof], self.turns[dof], end0_q4us, end1_q4us, dead_q15, top_q15)
        return None if bad is None else 1 + bad

    def _bad_calibration(self, driver, turns, end0_q4us, end1_q4us, dead_q15, top_q15):
        least = most = 0
        if driver != DRIVER_BRIDGE:
            least = _PULSE_MIN_Q4US
            most = min(_PULSE_MAX_Q4US, (turns * self.motor_period_us - PULSE_GAP_US) << PULSE_BITS)
        if not least <= end0_q4us <= most:
            return 0
        if not least <= end1_q4us <= most:
            return 1
        if top_q15 > VALUE_ONE:
            return 3
        if dead_q15 >= top_q15:
            return 2
        return None

    def feedback(self, dof, pin, at0_q15, at1_q15, gain_q15, integral_q24, most_q15, stall_q15, stall_ticks):
        """Give a stored absolute DOF its feedback input: the ratios measured at value 0 and at value 1, and its correction."""
        if dof >= self._dofs_seen or self.relative[dof] or self.feedback_pin[dof] != NO_PIN:
            return 0
        if not FEEDBACK_PIN_FIRST <= pin <= FEEDBACK_PIN_LAST or pin == self.kill_pin:
            return 1
        if self._drivers is not None and self._drivers.uses(self, pin):
            return 1
        for other in range(self._dofs_seen):
            if self.feedback_pin[other] == pin:
                return 1
        if at0_q15 > VALUE_ONE:
            return 2
        if at1_q15 > VALUE_ONE or abs(at1_q15 - at0_q15) < FEEDBACK_SPAN_MIN_Q15:
            return 3
        for number, value, most in (
            (4, gain_q15, VALUE_ONE),
            (5, integral_q24, POSITION_ONE),
            (6, most_q15, VALUE_ONE),
            (7, stall_q15, VALUE_ONE),
        ):
            if value > most:
                return number
        self.feedback_pin[dof] = pin
        self.feedback_at0_q15[dof] = at0_q15
        self.feedback_at1_q15[dof] = at1_q15
        self.feedback_gain_q15[dof] = gain_q15
        self.feedback_integral_q24[dof] = integral_q24
        self.feedback_most_q15[dof] = most_q15
        self.stall_q15[dof] = stall_q15
        self.stall_ticks[dof] = stall_ticks
        return None

    def guard(self, dof, release_ms, duty_q15, window_s):
        """Give a stored DOF its guard: when it is let go for standing still, and how much of a window it may move."""
        if dof >= self._dofs_seen or self._guarded & 1 << dof:
            return 0
        if not 1 <= duty_q15 <= VALUE_ONE:
            return 2
        if duty_q15 < VALUE_ONE and window_s == 0:
            return 3
        self.release_ms[dof] = release_ms
        self.duty_q15[dof] = duty_q15
        self.window_s[dof] = window_s
        self._guarded |= 1 << dof
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
        if mapping != self._mappings_seen or mapping >= self.mappings or dof >= self._dofs_seen:
            return 0
        if function > FUNCTION_RTRIGSIN or (function >= FUNCTION_BLINK and self.signal[dof]):
            return 1  # signal processing needs the future, and nobody knows when there is a blink
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
            samples = self.samples_q15[self.curve_start[self._curves_seen] : self._samples_end]
            self.curve_mean_q15[self._curves_seen] = (sum(samples) + len(samples) // 2) // len(samples)
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
        _link(self.first_mapping[action], self.mapping_count[action], self.function, self.argument, FUNCTION_BLINK, self.same)

    def keep(self, kind, first, place, old):
        """Note that what is new at `first + place` was `old` in the tables that play, or NEW; it is field 2 and up."""
        if kind == 0:
            keep = self.keep_action
            count = self.actions
        elif kind == 1:
            keep = self.keep_dof
            count = self.dofs
        elif kind == 2:
            keep = self.keep_live
            count = self.lives
        else:
            return 0
        if first + place >= count:
            return 1
        keep[first + place] = old
        return None

    def live(self, live, rest_q28, rise_q26, fall_q26, predict, process_q16, noise_q16, fade_q15):
        """Store a live channel."""
        if live != self._lives_seen or live >= self.lives:
            return 0
        if rest_q28 > WEIGHT_ONE:
            return 1
        if not 0 < rise_q26 < ALPHA_ONE:
            return 2
        if not 0 < fall_q26 < ALPHA_ONE:
            return 3
        if predict > PREDICT_KALMAN:
            return 4
        if process_q16 > VARIANCE_MAX_Q16:
            return 5
        if noise_q16 > VARIANCE_MAX_Q16 or (noise_q16 == 0 and predict == PREDICT_KALMAN):
            return 6
        if fade_q15 >= VALUE_ONE:
            return 7
        self.live_rest_q28[live] = rest_q28
        self.live_rise_q26[live] = rise_q26
        self.live_fall_q26[live] = fall_q26
        self.live_predict[live] = predict
        self.live_process_q16[live] = process_q16
        self.live_noise_q16[live] = noise_q16
        self.live_fade_q15[live] = fade_q15
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
            (0 if self._robot_seen else 1)
            + (self.dofs - self._dofs_seen)
            + (self.actions - self._actions_seen)
            + (self.mappings - self._mappings_seen)
            + (self.lives - self._lives_seen)
            + (self.curves - self._curves_seen)
            + (self.programs - self._programs_seen)
            + (self.blinks - self._blinks_seen)
        )
