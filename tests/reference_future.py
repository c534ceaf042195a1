"""The motion's oracle looks ahead: the base that would follow if nothing more arrived, many frames at once.

Written from the definitions of `docs/motion.md` alone, like `tests.reference`, whose state it begins with. Values of functions
are computed for all frames of an action in one go, so that foreseeing some hundreds of frames takes milliseconds.
"""

import copy
import functools
import math
from typing import ClassVar

import numpy

from tests.reference import ReferencePuppet
from tests.reference_actions import MARGIN_PERIODS
from tests.reference_functions import FunctionCompiler

_FAINT = 1 / 256


class FarSightedPuppet(ReferencePuppet):
    """A puppet that plays a score and knows at every frame what would come without further cues.

    Attributes:
        is_processed: per DOF whether it takes part in signal processing.
    """

    def __init__(self, puppet, score):
        super().__init__(puppet, score)
        self._live_ahead = {}
        compiler = _ArrayFunctionCompiler(puppet, self._foresee_live)
        self._functions = {}
        blinks = set()
        for name, table in puppet.get("action", {}).items():
            functions = self._functions[name] = []
            for dof, low, high, text in table["map"]:
                function = compiler.compile(text, 0)
                if function:
                    functions.append((self.dofs.index(dof), low, high, function))
                else:
                    blinks.add(dof)
        self.is_processed = [
            table.get("signal", table.get("kind", "absolute") == "absolute" and dof not in blinks)
            for dof, table in puppet["dof"].items()
        ]

    @property
    def weights_rest(self):
        """Per DOF whether its weights, HOLD's too, stood at their targets in the frame just stepped."""
        return [
            hold.weight.at_rest and all(action.weight.at_rest for action in actions)
            for hold, actions in zip(self._holds, self._actions_of_dof, strict=True)
        ]

    def foresee(self, frames):
        """Return (base, weight_sums), arrays [frames, dofs], of the frames after the one just stepped.

        They are exactly what `step` would return if no cue came. DOFs that are not processed have any values.
        """
        self._frames_ahead = frames
        self._live_ahead.clear()
        sums = numpy.zeros((frames, len(self.dofs)))
        weight_sums = numpy.zeros_like(sums)
        held = numpy.zeros(sums.shape, bool)
        for name, action in self._actions.items():
            if action.weight.value == action.weight.target == 0 and action.weight.at_rest:
                continue
            phases = self._foresee_phases(action)
            weights, target_lasts = self._foresee_weights(action, phases)
            for j, *_ in action.mappings:
                held[:target_lasts, j] = True
                weight_sums[:, j] += weights
            for j, low, high, function in self._functions[name]:
                sums[:, j] += weights * (low + (high - low) * function(phases))
        for j, hold in enumerate(self._holds):
            self._add_hold(j, hold, held[:, j], sums[:, j], weight_sums[:, j])
        return sums / weight_sums, weight_sums

    def _foresee_phases(self, action):
        """Return the phases of an action in the frames to come; `_master` is that of the first of them."""
        ahead = numpy.arange(self._frames_ahead)
        ticks_per_frame = action.tempo_q16 * self._global_tempo_q16
        ticks = action.tempo_q16 * self._master + action.whole_periods * action.ticks_per_period
        phases = (ticks + ahead * ticks_per_frame) / action.ticks_per_period
        if action.offset:
            warped = copy.copy(action)
            for k in range(self._frames_ahead):
                phases[k] += warped.offset
                warped.shrink_offset(self._global_tempo_q16)
        return phases

    def _foresee_weights(self, action, phases):
        """Return the weights of an action in the frames to come, and in how many of them its target is above 0."""
        target_lasts = self._frames_ahead if action.weight.target > 0 else 0
        if action.gesture_runs:
            is_over = phases - action.rose_at > action.cycles - float(MARGIN_PERIODS)
            target_lasts = int(numpy.argmax(is_over)) if is_over.any() else self._frames_ahead
        return self._foresee_smoothed(action.weight, action.weight.target, target_lasts, 0.0), target_lasts

    def _foresee_smoothed(self, smoothed, target, frames, target_after):
        """Return values of a weight or live channel that has a target for some frames and then another."""
        value = copy.copy(smoothed)
        value.target = target
        values = numpy.empty(self._frames_ahead)
        for k in range(self._frames_ahead):
            if k == frames:
                value.target = target_after
            if value.at_rest and not k < frames < self._frames_ahead:
                values[k:] = value.value
                break
            value.step()
            values[k] = value.value
        return values

    def _foresee_live(self, name):
        if name not in self._live_ahead:
            channel = self._live[name]
            self._live_ahead[name] = self._foresee_smoothed(channel, channel.target, self._frames_ahead, None)
        return self._live_ahead[name]

    def _add_hold(self, j, hold, held, sums, weight_sums):
        """Add HOLD to the sums of a DOF. It can only take over once, as no target rises without a cue."""
        lasts = int(held.sum())
        weights = self._foresee_smoothed(hold.weight, float(lasts == 0), lasts or self._frames_ahead, 1.0)
        values = numpy.full(self._frames_ahead, float(hold.value))
        takes_over = lasts < self._frames_ahead and (lasts > 0 or hold.weight.target == 0)
        if takes_over and hold.absolute:
            weight_before = weights[lasts - 1] if lasts else hold.weight.value
            if weight_before < _FAINT:
                last = (
                    (sums + weights * values)[lasts - 1] / (weight_sums + weights)[lasts - 1]
                    if lasts
                    else self._base[j]
                )
                values[lasts:] = last
        sums += weights * values
        weight_sums += weights


def _rsin(x):
    return (1 + numpy.sin(2 * math.pi * (x - numpy.floor(x)))) / 2


def _rcos(x):
    return (1 + numpy.cos(2 * math.pi * (x - numpy.floor(x)))) / 2


def _noise(gradients, x):
    j = numpy.floor(x)
    u = x - j
    gradients = numpy.asarray(gradients)
    places = j.astype(int) % len(gradients)
    here, following = gradients[places], gradients[(places + 1) % len(gradients)]
    return 0.5 + 2 * u * (1 - u) * (here * (1 - u) - following * u)


def _table_value(samples, x):
    position = (x - numpy.floor(x)) * len(samples)
    i = numpy.floor(position)
    samples = numpy.asarray(samples, float)
    places = i.astype(int) % len(samples)
    here, following = samples[places], samples[(places + 1) % len(samples)]
    return here + (following - here) * (position - i)


class _ArrayFunctionCompiler(FunctionCompiler):
    """The functions of `FunctionCompiler` for arrays of phases and live values; None for a blink, whose future is unknown."""

    WAVES: ClassVar = {"rsin": _rsin, "rcos": _rcos}
    noise = staticmethod(_noise)
    table_value = staticmethod(_table_value)

    @staticmethod
    def least(*values):
        return functools.reduce(numpy.minimum, values)

    @staticmethod
    def most(*values):
        return functools.reduce(numpy.maximum, values)

    def _triggered(self, call, mapping_index):
        return None
