"""Error correction: a DOF with a potentiometer is led until it stands where it should.

The potentiometer tells where a DOF is. Where it should be is what the motor layer commands, as late as a servo
follows: low-passed with 100 ms, of which a hobby servo needs some 60 to move, the pulse and the converter the rest.
Without this lag every move would count as an error. What is left is slow: a load that pulls, a horn that sits a tooth
off, a gear's play.

A proportional and an integral term make the correction, which the motor layer adds before its limiter, so speed and
acceleration stay limited. The command is judged without the correction it contains. Where the limiter cannot carry a
correction out, at the end of the range, the command seems lower by as much, the error is smaller, and the integral
stops by itself.

The integral does not grow while the correction is at its limit in that direction, while the DOF moves fast (then the
error is mostly lag), while the error is so large that it counts as a stall, or while the DOF has no pulses. Without
pulses it is held, not faded: a servo that is let go for standing still has the same offset when it is wanted again, and
would twitch at each attachment if it had to be learnt anew. A reading outside the plausible range is no reading: the
correction fades.

Errors below 1/512 are left alone. The servo's own dead band and friction are about as large; an integral that pushes
against them until the servo slips would hunt for ever, and the converter's noise would make it tremble.

Runs in the motor tick: one conversion a tick, the potentiometers in turn. Signed words are stored with `ZERO_Q24`
added, the integral with `2^29`, because a 64-bit port reads words without their sign.

Source: SPEC of motor control.
"""

import micropython
from micropython import const

from firmware.tables import words
from firmware.trajectory import ZERO_Q24, exp_q15
from shared.formats import DOFS_MAX, FEEDBACK_PIN_FIRST, FEEDBACK_PIN_LAST, NO_PIN

CHANNELS = FEEDBACK_PIN_LAST - FEEDBACK_PIN_FIRST + 1

_LAG_US = const(100000)  # of the command, until it is compared
_FADE_US = const(500000)  # of the correction, once readings are lost
_ZERO = const(0x10000000)
_ZERO_Q28 = const(0x20000000)
_ONE = const(0x1000000)
_DEAD = const(0x8000)  # 1/512: errors below it are left alone
_FAST = const(0x40000)  # 1/64 of the range within the lag
_FADED = const(0x1000)  # 1/4096: a fading correction below it is gone
_PLAUSIBLE_Q15 = const(512)  # 1/64
_OFF_Q24 = const(0x8000000)  # a stall level that no error reaches

# What is set for a channel, `settings[16 * channel + ..]`.
_DOF = const(0)
_AT0_Q15 = const(1)
_SCALE = const(2)  # 2^29 / (at1 - at0), with _ZERO added
_LOW_Q15 = const(3)  # ratios to which readings are clamped
_HIGH_Q15 = const(4)
_LEAST_Q15 = const(5)  # plausible ratios
_MOST_Q15 = const(6)
_GAIN_Q15 = const(7)
_INTEGRAL_Q24 = const(8)  # per turn
_LIMIT_Q24 = const(9)
_STALL_Q24 = const(10)
_STALL_TICKS = const(11)
_TURNS = const(12)  # ticks from one reading to the next
_FADE_Q15 = const(13)  # share lost per turn
_PIN = const(14)
_AT1_Q15 = const(15)

# What a channel has come to, `state[4 * channel + ..]`.
_LAGGED = const(0)
_MEASURED = const(1)
_SUM_Q28 = const(2)
_RUN = const(3)

# Bits of DOFs, `masks[..]`.
_VALID = const(0)
_LOST = const(1)
_STALLED = const(2)
_BEFORE = const(3)  # those that had pulses in the tick before

# Besides, in `masks`.
_CHANNELS = const(4)
_LAG_Q15 = const(5)  # share of the low-pass per tick
_TURN = const(6)  # the channel that is converted next
_UNDER_WAY = const(7)  # 1 more than the channel that is being converted, 0 for none
_READ = const(8)  # 1 more than the channel whose conversion is over

# What `tick` does.
_RUNS = const(0)
_PAUSES = const(1)
_BEGINS = const(2)


@micropython.viper
def _follow(
    position_q24: ptr32, correction_q24: ptr32, settings: ptr32, state: ptr32, masks: ptr32, attached: int
) -> int:  # fmt: skip
    """Let the commands of all channels, without their corrections, pass the low-pass, and choose the next channel.

    A DOF that had no pulses until now has no lag. Returns the pin whose conversion is to be started.
    Bits: a command is within -1..2, a difference within 3 in Q24, below 2^26; in limbs of 14 + 12 times 15: below 2^29.
    """
    channels = masks[_CHANNELS]
    lag_q15 = masks[_LAG_Q15]
    both = attached & masks[_BEFORE]
    masks[_BEFORE] = attached
    k = 0
    while k < channels:
        d = settings[(k << 4) + _DOF]
        wanted = position_q24[d] - (correction_q24[d] - _ZERO)
        lagged = state[k << 2] - _ZERO
        if both & (1 << d):
            ahead = wanted - lagged
            lagged += (((ahead >> 12) * lag_q15) + (((ahead & 0xFFF) * lag_q15) >> 12) + 4) >> 3
        else:
            lagged = wanted
        state[k << 2] = lagged + _ZERO
        k += 1
    turn = masks[_TURN]
    masks[_READ] = masks[_UNDER_WAY]
    masks[_UNDER_WAY] = turn + 1
    masks[_TURN] = turn + 1 if turn + 1 < channels else 0
    return settings[(turn << 4) + _PIN]


@micropython.viper
def _correct(
    position_q24: ptr32, correction_q24: ptr32, settings: ptr32, state: ptr32, masks: ptr32, attached: int,
    ratio_q15: int,
):  # fmt: skip
    """Take the reading of the channel that is over into account: write its DOF's measured value, correction, and bits.

    Bits: measured is within -1/4..5/4 (its product below 1.25 * 2^29), the error clamped to -1..1, as are gain and
    correction. `error * gain` in limbs of 13 + 12 and 15; `error * integral`, Q48 to Q28, in limbs of 13 + 12 each: 2^25 * 16.
    The integral, within 1 and a turn's growth, stays within 2^29.
    """
    channel = masks[_READ] - 1
    if channel < 0:
        return
    s = channel << 4
    t = channel << 2
    d = settings[s + _DOF]
    bit = 1 << d
    others = 0xFFFF ^ bit
    limit = settings[s + _LIMIT_Q24]
    correction = correction_q24[d] - _ZERO
    integral = state[t + _SUM_Q28] - _ZERO_Q28
    if ratio_q15 < settings[s + _LEAST_Q15] or ratio_q15 > settings[s + _MOST_Q15]:
        masks[_VALID] = masks[_VALID] & others
        masks[_LOST] = masks[_LOST] | bit
        state[t + _RUN] = 0
        fade_q15 = settings[s + _FADE_Q15]
        correction -= (correction >> 12) * fade_q15 >> 3
        integral -= ((integral >> 16) * fade_q15) << 1
        if -_FADED < correction and correction < _FADED:
            correction = 0
            integral = 0
    else:
        if ratio_q15 < settings[s + _LOW_Q15]:
            ratio_q15 = settings[s + _LOW_Q15]
        if ratio_q15 > settings[s + _HIGH_Q15]:
            ratio_q15 = settings[s + _HIGH_Q15]
        measured = ((ratio_q15 - settings[s + _AT0_Q15]) * (settings[s + _SCALE] - _ZERO) + 16) >> 5
        state[t + _MEASURED] = measured + _ZERO
        masks[_VALID] = masks[_VALID] | bit
        masks[_LOST] = masks[_LOST] & others
        if attached & bit:
            lagged = state[t + _LAGGED] - _ZERO
            error = lagged - measured
            if error > _ONE:
                error = _ONE
            if error < -_ONE:
                error = -_ONE
            size = error if error > 0 else -error
            stall = settings[s + _STALL_Q24]
            run = 0
            if size > stall:
                run = state[t + _RUN] + settings[s + _TURNS]
                if run >= settings[s + _STALL_TICKS]:
                    run = settings[s + _STALL_TICKS]
                    masks[_STALLED] = masks[_STALLED] | bit
            state[t + _RUN] = run
            ahead = position_q24[d] - correction - lagged
            is_slow = 1
            if ahead > _FAST or ahead < -_FAST or size > stall:
                is_slow = 0
            if error > _DEAD:
                error -= _DEAD
            elif error < -_DEAD:
                error += _DEAD
            else:
                error = 0
            high = error >> 12
            low = error & 0xFFF
            gain_q15 = settings[s + _GAIN_Q15]
            share = (high * gain_q15 + ((low * gain_q15) >> 12) + 4) >> 3
            correction = share + (integral >> 4)
            if is_slow:
                if (error > 0 and correction < limit) or (error < 0 and correction > -limit):
                    rate = settings[s + _INTEGRAL_Q24]
                    rate_high = rate >> 12
                    rate_low = rate & 0xFFF
                    integral += ((high * rate_high) << 4) + (
                        (high * rate_low + low * rate_high + ((low * rate_low) >> 12) + 0x80) >> 8
                    )
                    if integral > limit << 4:
                        integral = limit << 4
                    if integral < -(limit << 4):
                        integral = -(limit << 4)
                    correction = share + (integral >> 4)
        else:
            state[t + _RUN] = 0
            masks[_STALLED] = masks[_STALLED] & others
            correction = integral >> 4
        if correction > limit:
            correction = limit
        if correction < -limit:
            correction = -limit
    state[t + _SUM_Q28] = integral + _ZERO_Q28
    correction_q24[d] = correction + _ZERO


class Feedback:
    """The potentiometers of a robot and the corrections they ask for.

    `load`, `measured`, `start`, `forgive` and the properties belong to the main loop, `tick` to the motor tick.
    """

    def __init__(self, board):
        self._board = board
        self._mode = _BEGINS
        self._rates = (0, 0)  # what the following two have been computed for: motor period, number of channels
        self._lag_q15 = 0
        self._fade_q15 = 0
        self._settings = words(16 * CHANNELS)
        self._state = words(4 * CHANNELS)
        self._masks = words(9)
        self._channel_of = bytearray(DOFS_MAX)

    @property
    def valid(self):
        """DOFs, as bits, of which the last reading was one."""
        return self._masks[_VALID]

    @property
    def lost(self):
        """DOFs, as bits, whose potentiometer reads what it cannot: a wire is broken."""
        return self._masks[_LOST]

    @property
    def stalled(self):
        """DOFs, as bits, that have stalled since they got their pulses; nothing else clears a bit but `forgive`."""
        return self._masks[_STALLED]

    def load(self, tables):
        """Take over other tables; a channel whose pin and ends stay the same keeps its integral. Allocates.

        The integral term is set per motor tick: an error of 1 moves the correction by `feedback_integral_q24` in each. A
        DOF that is measured in every third tick only moves by three times as much then.
        """
        self._mode = _PAUSES
        kept = self._integrals()
        settings, state = self._settings, self._state
        channels = 0
        for dof in range(tables.dofs):
            channels += tables.feedback_pin[dof] != NO_PIN
        if self._rates != (tables.motor_period_us, channels):
            self._rates = tables.motor_period_us, channels
            self._lag_q15 = 32768 - exp_q15(tables.motor_period_us, _LAG_US)
            self._fade_q15 = 32768 - exp_q15(channels * tables.motor_period_us, _FADE_US)
        channel = 0
        for place in range(len(self._masks)):
            self._masks[place] = 0
        for dof in range(tables.dofs):
            pin = tables.feedback_pin[dof]
            if pin == NO_PIN:
                continue
            s, t = 16 * channel, 4 * channel
            at0_q15, at1_q15 = tables.feedback_at0_q15[dof], tables.feedback_at1_q15[dof]
            span = at1_q15 - at0_q15
            least, most = min(at0_q15, at1_q15), max(at0_q15, at1_q15)
            limit_q24 = tables.feedback_most_q15[dof] << 9
            settings[s + _DOF] = dof
            settings[s + _PIN] = pin
            settings[s + _AT0_Q15] = at0_q15
            settings[s + _AT1_Q15] = at1_q15
            settings[s + _SCALE] = ((1 << 30) // span + 1 >> 1) + _ZERO
            settings[s + _LOW_Q15] = max(0, least - (abs(span) >> 2))
            settings[s + _HIGH_Q15] = most + (abs(span) >> 2)
            settings[s + _LEAST_Q15] = _PLAUSIBLE_Q15 if least >= _PLAUSIBLE_Q15 else 0
            settings[s + _MOST_Q15] = 32768 - _PLAUSIBLE_Q15 if most <= 32768 - _PLAUSIBLE_Q15 else 32768
            settings[s + _GAIN_Q15] = tables.feedback_gain_q15[dof]
            settings[s + _INTEGRAL_Q24] = min(tables.feedback_integral_q24[dof] * channels, _ONE)
            settings[s + _LIMIT_Q24] = limit_q24
            is_watched = tables.stall_q15[dof] and tables.stall_ticks[dof]
            settings[s + _STALL_Q24] = tables.stall_q15[dof] << 9 if is_watched else _OFF_Q24
            settings[s + _STALL_TICKS] = tables.stall_ticks[dof]
            settings[s + _TURNS] = channels
            settings[s + _FADE_Q15] = self._fade_q15
            integral = kept.get((pin, at0_q15, at1_q15), _ZERO_Q28) - _ZERO_Q28
            state[t + _SUM_Q28] = max(-limit_q24 << 4, min(integral, limit_q24 << 4)) + _ZERO_Q28
            state[t + _LAGGED] = state[t + _MEASURED] = ZERO_Q24
            state[t + _RUN] = 0
            self._channel_of[dof] = channel
            channel += 1
        self._masks[_CHANNELS] = channels
        self._masks[_LAG_Q15] = self._lag_q15
        self._mode = _BEGINS

    def pause(self):
        """Leave the corrections alone until the next `load`: the tables are about to change."""
        self._mode = _PAUSES

    def tick(self, attached, position_q24, correction_q24):
        """Read the conversion that the last tick has started, start the next one, and write the corrections.

        `attached` has the bit of each DOF that has pulses, `position_q24` is where the DOFs are led, corrections included,
        `correction_q24` (with `ZERO_Q24` added) what these are, as they were written last. Allocates nothing.
        """
        if self._mode != _RUNS:
            if self._mode == _BEGINS:
                self._begin(correction_q24)
            return
        board = self._board
        settings = self._settings
        state = self._state
        masks = self._masks
        ratio_q15 = board.adc_read()
        board.adc_start(_follow(position_q24, correction_q24, settings, state, masks, attached))
        _correct(position_q24, correction_q24, settings, state, masks, attached, ratio_q15)

    def _begin(self, correction_q24):
        """Write the corrections that are known from before."""
        channels = self._masks[_CHANNELS]
        for dof in range(DOFS_MAX):
            correction_q24[dof] = _ZERO
        for channel in range(channels):
            integral = self._state[4 * channel + _SUM_Q28] - _ZERO_Q28
            correction_q24[self._settings[16 * channel]] = (integral >> 4) + _ZERO
        self._mode = _RUNS if channels else _PAUSES

    def measured(self, dof):
        """Return where a DOF is, Q24 in 0..1, or -1 if that is not known."""
        if not self._masks[_VALID] & (1 << dof):
            return -1
        return _clamped(self._state[4 * self._channel_of[dof] + _MEASURED] - _ZERO)

    def start(self, dof):
        """Return the command that leaves a DOF where it is, Q24 in 0..1, or -1 if that is not known.

        It is the measured value and what has been learnt of the offset: pulses that begin there move nothing. The
        correction is part of it and stays; the course begins at the command without it.
        """
        if not self._masks[_VALID] & (1 << dof):
            return -1
        t = 4 * self._channel_of[dof]
        integral = self._state[t + _SUM_Q28] - _ZERO_Q28
        return _clamped(self._state[t + _MEASURED] - _ZERO + (integral >> 4))

    def forgive(self, dof):
        """Forget that a DOF has stalled."""
        board = self._board
        masks = self._masks
        state = board.lock()
        if masks[_STALLED] & (1 << dof):
            masks[_STALLED] ^= 1 << dof
            self._state[4 * self._channel_of[dof] + _RUN] = 0
        board.unlock(state)

    def _integrals(self):
        """Return {(pin, ratio at 0, ratio at 1): integral in Q28 with 2 added}."""
        kept = {}
        settings = self._settings
        for s in range(0, 16 * self._masks[_CHANNELS], 16):
            key = settings[s + _PIN], settings[s + _AT0_Q15], settings[s + _AT1_Q15]
            kept[key] = self._state[s // 4 + _SUM_Q28]
        return kept


def _clamped(value_q24):
    return 0 if value_q24 < 0 else _ONE if value_q24 > _ONE else value_q24
