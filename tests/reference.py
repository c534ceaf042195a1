"""The motion's oracle: the base tap (the compositor's output) of a puppet and a score, in float64.

Written from the definitions of `docs/motion.md` alone and sharing no code with `firmware`, `shared`
or `host`. Tempos, the master phase, the whole periods of phases and the frames of cues are integers
or fractions, so nothing drifts in 24 h; everything else is a float64.

Readings where the definitions leave a choice:
- Numbers are the decimals that the file shows (the shortest that give the float `tomllib` returns),
  and tempos round to 1/65536 half up.
- A target rises, or an action enters, by the comparison of its targets before and after all cues of
  a frame: set to 0 and back within one frame it has done neither.
- A gesture that ends in a frame stays ended even if a cue of that frame called it again: the ends
  come after the cues.
- A live channel that nothing declares has the defaults; so has one that a declaration leaves bare.
- Phases are kept whole here: functions repeat after 4096 periods, so keeping them modulo that is
  the same.
- The offset's shrinking is bounded by half of what the nominal phase advances to the next frame.
"""

import math
from bisect import bisect_right
from collections import defaultdict
from fractions import Fraction

import numpy

from tests.reference_actions import (
    MARGIN_PERIODS,
    TEMPO_ONE_Q16,
    Action,
    Hold,
    SmoothedValue,
    frame_of_cue,
    tempo_q16,
    wrap_margin_periods,
)
from tests.reference_functions import FunctionCompiler, TriggeredSine

_FAINT = 1 / 256
_PHASES_REPEAT_PERIODS = 4096
_LIVE_REST = 0.5
_LIVE_TAU_S = 0.1


def render(puppet, score, frames):
    """Return (base, weight_sums), each an array [frames, dofs], of the first frames of a score."""
    reference = ReferencePuppet(puppet, score)
    base = numpy.empty((frames, len(reference.dofs)))
    weight_sums = numpy.empty_like(base)
    for n in range(frames):
        base[n] = reference.step()
        weight_sums[n] = reference.weight_sums
    return base, weight_sums


def checkpoints(puppet, score, frames, every):
    """Yield (frame, base, weight_sums) for frames 0, every, 2*every ... and for the last one.

    Weights are stepped through every frame between, and stretches in which nothing but the phases
    can change are jumped over, so that 24 h take seconds to minutes.
    """
    reference = ReferencePuppet(puppet, score)
    for n in sorted({*range(0, frames, every), frames - 1}):
        reference.advance_to(n)
        base = reference.step()
        yield n, base, reference.weight_sums


class ReferencePuppet:
    """A puppet that plays a score, frame by frame.

    Args:
        puppet, score: valid files as `tomllib` gives them.

    Attributes:
        dofs: names of the DOFs in file order.
        frame: the frame that the next `step` computes.
        cues: lists of the cues that act in a frame, in their order, by frame.
        weight_sums: per DOF the sum of weights, HOLD included, in the frame just stepped.
    """

    def __init__(self, puppet, score):
        self.frame = 0
        self.frame_rate = puppet.get("frame_rate", 30)
        self.dofs = list(puppet["dof"])
        self._closest = dict.fromkeys(("enter", "hold", "silence", "wrap", "gesture"), math.inf)
        self._behaviours = puppet.get("behaviour", {})
        self._moods = puppet.get("mood", {})
        self.cues = defaultdict(list)
        for cue in sorted(score.get("cue", []), key=lambda cue: Fraction(str(cue["at"]))):
            self.cues[frame_of_cue(cue["at"], self.frame_rate)].append(cue)
        self._cue_frames = list(self.cues)
        self._master = 0
        self._global_tempo_q16 = TEMPO_ONE_Q16
        self._live = defaultdict(lambda: SmoothedValue(_LIVE_REST, _LIVE_TAU_S, self.frame_rate))
        for name, channel in puppet.get("live", {}).items():
            tau_s = channel.get("tau", _LIVE_TAU_S)
            self._live[name] = SmoothedValue(channel.get("rest", _LIVE_REST), tau_s, self.frame_rate)
        self._holds = [Hold(dof, self.frame_rate) for dof in puppet["dof"].values()]
        self._actions = {}
        self._add_actions(puppet)
        self._actions_of_dof = [[] for _ in self.dofs]
        for action in self._actions.values():
            for j, *_ in action.mappings:
                self._actions_of_dof[j].append(action)
        self._base = [hold.value for hold in self._holds]
        self.weight_sums = numpy.ones(len(self.dofs))

    def _add_actions(self, puppet):
        compiler = FunctionCompiler(puppet, lambda name: self._live[name].value)
        mapping_index = 0
        for name, table in puppet.get("action", {}).items():
            action = self._actions[name] = Action(table, self.frame_rate)
            for dof, low, high, text in table["map"]:
                function = compiler.compile(text, mapping_index)
                action.mappings.append((self.dofs.index(dof), low, high, function))
                if isinstance(function, TriggeredSine):
                    action.triggered.append(function)
                mapping_index += 1

    @property
    def weights(self):
        """The weight of every action, by name, in the frame just stepped."""
        return {name: action.weight.value for name, action in self._actions.items()}

    @property
    def targets(self):
        """The weight target of every action, by name, in the frame just stepped."""
        return {name: action.weight.target for name, action in self._actions.items()}

    @property
    def phases(self):
        """The phase of every action, 0..4096 periods, at the frame to come and before its cues."""
        return {name: action.phase(self._master) % _PHASES_REPEAT_PERIODS for name, action in self._actions.items()}

    @property
    def closest(self):
        """How near, so far, each kind of decision was to falling the other way, by kind.

        Kinds: `"enter"` and `"hold"` (weight from 1/256), `"silence"` (weight from the snap to 0,
        only of actions with random functions: their streams count the frames), and in periods
        `"wrap"`, `"gesture"` and `"blink"`.
        """
        triggered = [function for action in self._actions.values() for function in action.triggered]
        blink = min((function.closest_periods for function in triggered), default=math.inf)
        return self._closest | {"blink": blink}

    def is_decided(self, phase_error=1 / 8192, weight_error=2.0**-24):
        """Whether every decision so far would fall alike with phases and weights so far off.

        An implementation within its bounds may differ for good after a closer one, so comparisons
        pass over such draws. The defaults are twice the bound of a phase, in periods, and what 28
        bits after the point leave of a weight whose filters are not slow.
        """
        closest = self.closest
        weights = min(closest[kind] for kind in ("enter", "hold", "silence"))
        return weights > weight_error and min(closest[kind] for kind in ("wrap", "gesture", "blink")) > phase_error

    def step(self):
        """Compute one frame and return its base: an array with one value per DOF, 0..1 or -1..1."""
        self._step_weights()
        self._compose()
        self._step_phases()
        return numpy.array(self._base)

    def advance_to(self, frame):
        """Go to a later frame without composing those between, unless something depends on them."""
        while self.frame < frame:
            if self._next_base_matters():
                self.step()
            elif self._only_phases_move():
                next_cue = bisect_right(self._cue_frames, self.frame)
                stop = min([frame] + [n - 1 for n in self._cue_frames[next_cue : next_cue + 1]])
                self._jump(stop - self.frame)
            else:
                self._step_weights()
                self._step_triggered()
                self._step_phases()

    def _next_base_matters(self):
        """Whether HOLD may take over in the next frame, at the base of this one.

        It can in frames of cues and of the ends of gestures, which may begin in this frame.
        """
        return (
            self.frame in self.cues
            or self.frame + 1 in self.cues
            or any(action.gesture_runs for action in self._actions.values())
        )

    def _step_weights(self):
        """Take the part of a frame that comes before the functions."""
        actions = self._actions.values()
        for action in actions:
            action.target_before = action.weight.target
        for cue in self.cues.get(self.frame, ()):
            self._apply(cue)
        for action in actions:
            if action.gesture_runs and not action.rises:
                advance = action.phase(self._master) - action.rose_at
                excess = advance - (action.cycles - float(MARGIN_PERIODS))
                self._note("gesture", abs(excess))
                if excess > 0:
                    action.weight.target = 0.0
        self._set_hold_targets()
        for action in actions:
            if action.rises:
                if self._is_faint("enter", action.weight):
                    action.enter(self._master)
                    self._note("wrap", wrap_margin_periods(action.offset))
                action.rose_at = action.phase(self._master)
        for action in actions:
            action.weight.step()
            if action.triggered and action.weight.target == 0:
                self._note("silence", action.weight.snap_margin)
        for smoothed in (*(hold.weight for hold in self._holds), *self._live.values()):
            smoothed.step()

    def _set_hold_targets(self):
        for j, hold in enumerate(self._holds):
            held = any(action.weight.target > 0 for action in self._actions_of_dof[j])
            takes_over = not held and hold.weight.target == 0
            hold.weight.target = 0.0 if held else 1.0
            if takes_over and hold.absolute and self._is_faint("hold", hold.weight):
                hold.value = self._base[j]

    def _compose(self):
        """Set the base of every DOF to the convex sum over its actions and HOLD."""
        sums = [hold.weight.value * hold.value for hold in self._holds]
        weight_sums = [hold.weight.value for hold in self._holds]
        for action in self._actions.values():
            weight = action.weight.value
            if weight > 0:
                phase = action.phase(self._master)
                for j, low, high, function in action.mappings:
                    sums[j] += weight * (low + (high - low) * function(phase))
                    weight_sums[j] += weight
        self._base = [total / weight for total, weight in zip(sums, weight_sums, strict=True)]
        self.weight_sums = numpy.array(weight_sums)

    def _step_triggered(self):
        """Let random functions live through a frame that is not composed."""
        for action in self._actions.values():
            if action.triggered and action.weight.value > 0:
                phase = action.phase(self._master)
                for function in action.triggered:
                    function(phase)

    def _step_phases(self):
        """Take the end of a frame: offsets shrink and the master phase advances."""
        for action in self._actions.values():
            if action.offset:
                action.shrink_offset(self._global_tempo_q16)
        self._master += self._global_tempo_q16
        self.frame += 1

    def _only_phases_move(self):
        """Whether, until a cue comes, every weight stays and every offset dies out by its own law."""
        smoothed = (*(hold.weight for hold in self._holds), *self._live.values())
        return all(value.at_rest for value in smoothed) and all(
            action.weight.at_rest and not action.gesture_runs and action.offset_shrinks_freely(self._global_tempo_q16)
            for action in self._actions.values()
        )

    def _jump(self, frames):
        """Take `frames` frames in which `_only_phases_move`."""
        alive = [action for action in self._actions.values() if action.triggered and action.weight.value > 0]
        if alive:
            for _ in range(frames):
                self._step_triggered()
                for action in alive:
                    action.offset *= action.offset_kept
                self._master += self._global_tempo_q16
        else:
            self._master += self._global_tempo_q16 * frames
        for action in self._actions.values():
            if action not in alive:
                action.offset *= action.offset_kept**frames
        self.frame += frames

    def _apply(self, cue):
        """Apply one cue in the order behaviour, weights, mood, gains (not of the base), live, tempo."""
        targets = {}
        if "behaviour" in cue:
            targets = dict.fromkeys(self._actions, 0.0) | self._behaviours[cue["behaviour"]]
        for name, target in (targets | cue.get("weights", {})).items():
            self._actions[name].weight.target = target
        tempos = {}
        if "tempo" in self._moods.get(cue.get("mood"), {}):
            tempos["global"] = self._moods[cue["mood"]]["tempo"]
        for name, target in cue.get("live", {}).items():
            self._live[name].target = target
        for name, tempo in (tempos | cue.get("tempo", {})).items():
            self._set_tempo(name, tempo_q16(tempo))

    def _set_tempo(self, name, new_tempo_q16):
        if name == "global":
            self._global_tempo_q16 = new_tempo_q16
            return
        action = self._actions[name]
        if new_tempo_q16 != action.tempo_q16:
            action.change_tempo(new_tempo_q16, self._master)
            if action.weight.value > 0 or action.weight.target > 0:
                self._note("wrap", wrap_margin_periods(action.offset))

    def _is_faint(self, decision, weight):
        """Return whether a weight is below 1/256 and note how close it was."""
        self._note(decision, abs(weight.value - _FAINT))
        return weight.value < _FAINT

    def _note(self, decision, margin):
        self._closest[decision] = min(self._closest[decision], margin)
