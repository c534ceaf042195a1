"""The state of one action in the motion's oracle: its smoothed weight and its exact phase.

Written from the definitions of `docs/motion.md` alone, like `tests.reference`, which says how they
are read. Tempos and nominal phases are integers or fractions; weights and offsets are float64.
"""

import math
from fractions import Fraction

TEMPO_ONE_Q16 = 65536
MARGIN_PERIODS = Fraction(1, 1024)
_SNAP = 2.0**-18
_HOLD_TAU_S = 0.25
_ACTION_TAU_S = 0.25
_WARP_S = 0.5


def frame_of_cue(at_s, frame_rate):
    """Return the first frame whose instant is not before the decimal time `at_s`."""
    return math.ceil(Fraction(str(at_s)) * frame_rate)


def tempo_q16(tempo):
    """Return a tempo of a file in units of 1/65536, rounded half up."""
    return math.floor(Fraction(str(tempo)) * TEMPO_ONE_Q16 + Fraction(1, 2))


def whole_cycles(x):
    """Return the whole number that `wrap` takes from the exact phase `x`."""
    return math.floor(x + Fraction(1, 2) + MARGIN_PERIODS)


def wrap_margin_periods(wrapped):
    """Return how near a wrapped phase is to either end of its range, where it would wrap otherwise."""
    half = 0.5 - float(MARGIN_PERIODS)
    return min(half - wrapped, wrapped + 0.5 + float(MARGIN_PERIODS))


class SmoothedValue:
    """Two exponential filters in cascade that reach their target exactly: weights and live channels.

    Args:
        start: target and value at first.
        tau_s: time constant in seconds, or a pair `[rise, fall]`.
        frame_rate: frames per second.

    Attributes:
        snap_margin: how near the value was, in the step just taken, to reaching its target otherwise.
    """

    def __init__(self, start, tau_s, frame_rate):
        rise_s, fall_s = tau_s if isinstance(tau_s, (list, tuple)) else (tau_s, tau_s)
        self._rise = 1 - math.exp(-1 / (frame_rate * rise_s))
        self._fall = 1 - math.exp(-1 / (frame_rate * fall_s))
        self.target = self.smoothed = self.value = start
        self.snap_margin = math.inf

    @property
    def at_rest(self):
        return self.target == self.smoothed == self.value

    def step(self):
        """Take the step of one frame."""
        self.snap_margin = math.inf
        if self.at_rest:
            return
        a = self._rise if self.target > self.smoothed else self._fall
        self.smoothed += (self.target - self.smoothed) * a
        self.value += (self.smoothed - self.value) * a
        if abs(self.target - self.smoothed) < _SNAP:
            self.smoothed = self.target
        if self.smoothed == self.target:
            distance = abs(self.target - self.value)
            self.snap_margin = abs(distance - _SNAP)
            if distance < _SNAP:
                self.value = self.target


class Hold:
    """The action HOLD of one DOF: what holds it while nothing else does."""

    def __init__(self, dof, frame_rate):
        self.absolute = dof.get("kind", "absolute") == "absolute"
        self.value = dof.get("rest", 0.5) if self.absolute else 0.0
        self.weight = SmoothedValue(1.0, _HOLD_TAU_S, frame_rate)


class Action:
    """One action: weight, phase and mappings.

    `master` in the methods is the master phase in units of 1/(frame_rate * 65536) period. Times the
    rounded tempo it is the nominal phase in ticks, of which a period has frame_rate * 65536**2: all
    integers. The action's phase is the nominal phase + `whole_periods` + `offset`.
    """

    def __init__(self, table, frame_rate):
        self.weight = SmoothedValue(0.0, table.get("tau", _ACTION_TAU_S), frame_rate)
        self.target_before = 0.0
        self.tempo_q16 = tempo_q16(table.get("tempo", 1))
        self.starts_own_time = table.get("entry", "sync") == "start"
        self.cycles = table.get("cycles")
        self.offset_kept = math.exp(-1 / (frame_rate * table.get("warp", _WARP_S)))
        self.whole_periods = 0
        self.offset = 0.0
        self.rose_at = None
        self.mappings = []
        self.triggered = []
        self.ticks_per_period = frame_rate * TEMPO_ONE_Q16 * TEMPO_ONE_Q16

    @property
    def rises(self):
        """Whether the target has risen from 0 with this frame's cues."""
        return self.target_before == 0 < self.weight.target

    @property
    def gesture_runs(self):
        return self.cycles is not None and self.weight.target > 0

    def phase(self, master):
        """Return the phase in periods, whole ones included."""
        ticks = self.tempo_q16 * master + self.whole_periods * self.ticks_per_period
        return ticks / self.ticks_per_period + self.offset

    def exact_nominal(self, master):
        """Return the nominal phase in periods, a fraction."""
        return Fraction(self.tempo_q16 * master, self.ticks_per_period)

    def nominal_advance(self, global_tempo_q16):
        """Return the periods by which the nominal phase advances in one frame."""
        return self.tempo_q16 * global_tempo_q16 / self.ticks_per_period

    def split_offset(self, excess):
        """Keep an exact difference from the nominal phase as whole periods and an offset."""
        self.whole_periods = whole_cycles(excess)
        self.offset = float(excess - self.whole_periods)

    def change_tempo(self, new_tempo_q16, master):
        """Go on from the present phase with another tempo."""
        phase = self.exact_nominal(master) + self.whole_periods + Fraction(self.offset)
        self.tempo_q16 = new_tempo_q16
        self.split_offset(phase - self.exact_nominal(master))

    def enter(self, master):
        """Begin at the master's phase, or with a time of its own."""
        self.split_offset(-self.exact_nominal(master) if self.starts_own_time else Fraction(0))
        for function in self.triggered:
            function.enter()

    def offset_shrinks_freely(self, global_tempo_q16):
        """Whether the offset dies out exponentially from now on, unbounded by the tempo."""
        step = abs(self.offset) * (1 - self.offset_kept)
        return step <= self.nominal_advance(global_tempo_q16) / 2

    def shrink_offset(self, global_tempo_q16):
        """Warp the time towards the master's by one frame, never by more than half."""
        step = abs(self.offset) * (1 - self.offset_kept)
        step = min(step, self.nominal_advance(global_tempo_q16) / 2)
        self.offset -= math.copysign(step, self.offset)
