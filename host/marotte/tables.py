"""A puppet and a robot in fixed point: the messages that upload them.

    tables = build_tables(load_puppet("puppets/pet.toml"), load_robot("puppets/pet-robot.toml"))
    for name, fields, items in tables.messages():
        print(name, fields, items)

Everything is rounded to nearest, halves up; the formats are those of `shared/formats.py`. A positive weight target never
becomes 0, as that would end the action instead of making it faint; speeds and accelerations, per motor tick, are rounded down.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

from marotte.character import response
from marotte.fixed import fixed
from marotte.kalman import kalman_fields
from marotte.limits import LimitsInUse
from marotte.link import PAYLOAD_SENT_MAX
from marotte.outputs import Feedback, Output
from marotte.pools import Pools
from marotte.puppet import Action, Dof, Live, MappingEntry, Puppet
from marotte.wiring import Robot
from shared import formats, messages

Message: TypeAlias = tuple[str, dict[str, int], list[dict[str, int]]]
"""Name, fields, and items: see `shared/messages.py`."""

HOLD_TAU_S = 0.25
"""How HOLD, which takes over what no action moves, comes and goes."""

UPLOAD_ITEMS_MAX = {"mappings": 8, "curve": 32, "program": 18}
"""Most items of a message of an upload: what an RP2040 checks in 2 ms, so that no frame waits long for it."""

ACCEL_MIN_Q24 = 2
"""The least acceleration per tick that the motor layer can brake with."""

SILENT = {"idle": formats.SILENT_IDLE, "rest": formats.SILENT_REST, "relax": formats.SILENT_RELAX}

_MESSAGES = {name: (fields, items) for name, _, fields, items in messages.MESSAGES}


@dataclass(frozen=True)
class Tables:
    """What an MCU needs to know of a puppet and of the robot that it moves."""

    puppet: Puppet
    robot: Robot

    def messages(self) -> Iterator[Message]:
        """Yield the upload's messages in their order, `begin` first and `commit` last."""
        puppet = self.puppet
        pools = Pools(puppet.functions, list(puppet.lives))
        mappings = [self._mapping(entry, pools) for action in puppet.actions.values() for entry in action.mappings]
        yield "begin", self._begin(len(mappings), pools), []
        yield "robot", self._robot(), []
        for index, chip in enumerate(self.robot.chips.values()):
            yield "device", {"device": index, "driver": chip.code}, _items("setting", chip.settings())
        for index, dof in enumerate(puppet.dofs.values()):
            yield "dof", self._dof(index, dof), []
        for index, dof in enumerate(puppet.dofs.values()):
            if dof.character:
                yield "character", {"dof": index, **response(dof.character, self.tick_s).fixed()}, []
        yield from self._outputs()
        first = 0
        for index, action in enumerate(puppet.actions.values()):
            yield "action", self._action(index, action, first), []
            first += len(action.mappings)
        step = UPLOAD_ITEMS_MAX["mappings"]
        for start in range(0, len(mappings), step):
            yield "mappings", {"first_mapping": start}, mappings[start : start + step]
        for index, live in enumerate(puppet.lives.values()):
            yield "live", self._live(index, live), []
        for index, samples_q15 in enumerate(pools.curves):
            yield from _in_parts("curve", {"curve": index, "samples": len(samples_q15)}, "value_q15", samples_q15)
        for index, words in enumerate(pools.programs):
            yield from _in_parts("program", {"program": index, "words": len(words)}, "word", words)
        for index, (threshold_q16, gap_q18) in enumerate(pools.blinks):
            yield "blink", {"blink": index, "threshold_q16": threshold_q16, "gap_q18": gap_q18}, []
        yield "commit", {}, []

    def _begin(self, mappings: int, pools: Pools) -> dict[str, int]:
        puppet = self.puppet
        return {
            "frame_rate_hz": puppet.frame_rate_hz,
            "dofs": len(puppet.dofs),
            "actions": len(puppet.actions),
            "mappings": mappings,
            "lives": len(puppet.lives),
            "curves": len(pools.curves),
            "programs": len(pools.programs),
            "blinks": len(pools.blinks),
            "seed": puppet.seed,
            "noise_spread_q15": fixed(puppet.noise_spread, formats.VALUE_BITS),
            "hold_q26": alpha_q26(HOLD_TAU_S, puppet.frame_rate_hz),
            "link_timeout_ms": fixed(self.robot.link_timeout_s * 1000, 0),
            "when_silent": SILENT[puppet.when_silent],
        }

    def _robot(self) -> dict[str, int]:
        robot = self.robot
        return {
            "motor_period_us": robot.motor_period_us,
            "attach_ms": fixed(robot.attach_interval_s * 1000, 0),
            "kill_pin": robot.kill.pin if robot.kill else formats.NO_PIN,
            "kill_level": robot.kill.level if robot.kill else 0,
            "autostart": int(robot.autostart),
        }

    @property
    def tick_s(self) -> Fraction:
        """The motor layer's period."""
        return Fraction(self.robot.motor_period_us, 1_000_000)

    @property
    def outputs_mask(self) -> int:
        """The DOFs that have an output, a bit each."""
        return sum(1 << index for index, name in enumerate(self.puppet.dofs) if name in self.robot.outputs)

    def limits(self, dof: Dof) -> LimitsInUse:
        """Return what a DOF is held to: the tighter of what puppet and robot say."""
        output = self.robot.outputs.get(dof.name)
        return dof.limits_with(output.limits) if output else dof.limits_with()

    def _dof(self, index: int, dof: Dof) -> dict[str, int]:
        return {
            "dof": index,
            "kind": formats.KIND_RELATIVE if dof.is_relative else formats.KIND_ABSOLUTE,
            "rest_q15": value_q15(dof.rest, dof),
            **limit_fields(self.limits(dof), dof, self.tick_s),
            "signal": int(dof.signal),
        }

    def _outputs(self) -> Iterator[Message]:
        """Yield the outputs of all DOFs, then their feedbacks, then their guards."""
        names = list(self.puppet.dofs)
        outputs = [(index, self.robot.outputs[name]) for index, name in enumerate(names) if name in self.robot.outputs]
        for index, output in outputs:
            fields = {"dof": index, "driver": output.drive.code, "turns": self.robot.turns(output)}
            settings = output.drive.settings(output.invert, self.robot.chips)
            yield "output", {**fields, **calibration_fields(output)}, _items("setting", settings)
        for index, output in outputs:
            if output.feedback:
                yield "feedback", {"dof": index, **self._feedback(output.feedback)}, []
        for index, output in outputs:
            if output.release_s is not None or output.duty.share < 1:
                yield "guard", {"dof": index, **_guard(output)}, []

    def _feedback(self, feedback: Feedback) -> dict[str, int]:
        at0, at1 = (fixed(ratio, formats.VALUE_BITS) for ratio in feedback.at)
        return {
            "pin": feedback.pin,
            "at0_q15": at0,
            "at1_q15": at1,
            "gain_q15": fixed(feedback.gain, formats.VALUE_BITS),
            "integral_q24": fixed(Fraction(feedback.integral) * self.tick_s, formats.POSITION_BITS),
            "most_q15": fixed(feedback.most, formats.VALUE_BITS),
            "stall_q15": fixed(feedback.stall, formats.VALUE_BITS),
            "stall_ticks": max(1, fixed(Fraction(feedback.stall_time_s) / self.tick_s, 0)),
        }

    def _action(self, index: int, action: Action, first_mapping: int) -> dict[str, int]:
        rise, fall = (alpha_q26(tau_s, self.puppet.frame_rate_hz) for tau_s in action.tau_s)
        return {
            "action": index,
            "tempo_q16": tempo_q16(action.tempo),
            "rise_q26": rise,
            "fall_q26": fall,
            "first_mapping": first_mapping,
            "mappings": len(action.mappings),
            "entry": formats.ENTRY_START if action.entry == "start" else formats.ENTRY_SYNC,
            "warp_q26": alpha_q26(action.warp_s, self.puppet.frame_rate_hz),
            "cycles": action.cycles or 0,
        }

    def _live(self, index: int, live: Live) -> dict[str, int]:
        frame_rate_hz = self.puppet.frame_rate_hz
        rise, fall = (alpha_q26(tau_s, frame_rate_hz) for tau_s in live.tau_s)
        prediction = {"predict": formats.PREDICT_HOLD, "process_q16": 0, "noise_q16": 0, "fade_q15": 0}
        if live.kalman:
            prediction = {"predict": formats.PREDICT_KALMAN, **kalman_fields(live.kalman, frame_rate_hz)}
        return {
            "live": index,
            "rest_q28": weight_q28(live.rest),
            "rise_q26": rise,
            "fall_q26": fall,
            **prediction,
        }

    def _mapping(self, entry: MappingEntry, pools: Pools) -> dict[str, int]:
        code, argument = pools.code(entry.function)
        dof = self.puppet.dofs[entry.dof]
        return {
            "dof": list(self.puppet.dofs).index(entry.dof),
            "function": code,
            "argument": argument,
            "low_q15": value_q15(entry.low, dof),
            "high_q15": value_q15(entry.high, dof),
        }


def keeps(playing: Puppet, new: Puppet) -> Iterator[Message]:
    """Yield what says which actions, DOFs and live channels go on as which, for the exchange of a moving puppet's tables.

    What has the same name goes on; a DOF that has become of another kind does not.
    """
    same_kind = [name for name, dof in new.dofs.items() if name in playing.dofs and playing.dofs[name].kind == dof.kind]
    for kind, old_names, names, going_on in (
        (formats.KEEP_ACTIONS, playing.actions, new.actions, new.actions),
        (formats.KEEP_DOFS, playing.dofs, new.dofs, same_kind),
        (formats.KEEP_LIVES, playing.lives, new.lives, new.lives),
    ):
        old_index = {name: index for index, name in enumerate(old_names)}
        items = [{"old": old_index.get(name, formats.NEW) if name in going_on else formats.NEW} for name in names]
        step = items_per_message("keep")
        for start in range(0, len(items), step):
            yield "keep", {"kind": kind, "first": start}, items[start : start + step]


def build_tables(puppet: Puppet, robot: Robot | None = None) -> Tables:
    """Return the tables of a puppet; without a robot it drives no pin."""
    return Tables(puppet, robot or Robot())


def value_q15(value: float, dof: Dof) -> int:
    """Return a DOF's value as it travels: 0..1 as it is, -1..1 (relative) shifted and halved."""
    return fixed((value + 1) / 2 if dof.is_relative else value, formats.VALUE_BITS)


def value_of(value: int, dof: Dof) -> float:
    """Return the DOF's value, 0..1 or -1..1, that a `value_q15` stands for; exact."""
    share = value / formats.VALUE_ONE
    return 2 * share - 1 if dof.is_relative else share


def limit_fields(limits: LimitsInUse, dof: Dof, tick_s: Fraction) -> dict[str, int]:
    """Return limits as the messages `dof` and `limit` have them, speed and acceleration per motor tick.

    Rounded down, so that the motor layer, which adds them up exactly, never exceeds what they say; yet a wheel's acceleration is
    never below what brings it to a stand in time.
    """
    low_q15, high_q15 = (value_q15(value, dof) for value in limits.range)
    if dof.is_relative:  # travels as (value + 1) / 2
        unit_tick = (1 << formats.POSITION_BITS - 1) * tick_s
        speed_q24 = formats.POSITION_ONE
        stand = math.ceil(unit_tick * 1000 / formats.STAND_MS)
        accel_q24 = max(math.floor(Fraction(limits.accel) * unit_tick), stand)
    else:
        unit_tick = formats.POSITION_ONE * tick_s
        speed_q24 = math.floor(Fraction(limits.speed) * unit_tick)
        accel_q24 = max(math.floor(Fraction(limits.accel) * unit_tick * tick_s) - 1, ACCEL_MIN_Q24)
    return {
        "low_q15": low_q15,
        "high_q15": high_q15,
        "speed_q24": speed_q24,
        "accel_q24": min(accel_q24, formats.POSITION_ONE),
    }


def calibration_fields(output: Output) -> dict[str, int]:
    """Return an output's calibration as the messages `output` and `calibrate` have it; a bridge has no pulses, hence no ends."""
    end0_us, end1_us = output.ends_us if output.drive.has_pulses else (0.0, 0.0)
    return {
        "end0_q4us": fixed(end0_us, formats.PULSE_BITS),
        "end1_q4us": fixed(end1_us, formats.PULSE_BITS),
        "dead_q15": fixed(output.dead_band, formats.VALUE_BITS),
        "top_q15": fixed(output.top_speed, formats.VALUE_BITS),
    }


def weight_q28(weight: float) -> int:
    """Return a weight, weight target or live value; what is above 0 stays above 0."""
    return max(fixed(weight, formats.WEIGHT_BITS), 1 if weight > 0 else 0)


def tempo_q16(tempo: float) -> int:
    """Return a tempo, rounded to 1/65536."""
    return fixed(tempo, formats.TEMPO_BITS)


def gain4_q16(gain: float) -> int:
    """Return a band's gain -4..4 as it travels: with 4 added, so that it is never negative."""
    return fixed(gain + 4, formats.GAIN_BITS)


def alpha_q26(tau_s: float, frame_rate_hz: int) -> int:
    """Return a filter coefficient `1 - exp(-1 / (F * tau))`."""
    return fixed(-math.expm1(-1 / (frame_rate_hz * tau_s)), formats.ALPHA_BITS)


def items_per_message(name: str) -> int:
    """Return how many items a message of this name is sent with at most."""
    fields, items = _MESSAGES[name]
    return (PAYLOAD_SENT_MAX - messages.size(fields)) // messages.size(items)


def _in_parts(name: str, fields: dict[str, int], item: str, values: Sequence[int]) -> Iterator[Message]:
    """Yield as many messages of this name as the values need, in order; `item` is the field of an item."""
    step = UPLOAD_ITEMS_MAX[name]
    for start in range(0, len(values), step):
        yield name, fields, _items(item, values[start : start + step])


def _items(field: str, values: Iterable[int]) -> list[dict[str, int]]:
    return [{field: value} for value in values]


def _guard(output: Output) -> dict[str, int]:
    return {
        "release_ms": fixed((output.release_s or 0) * 1000, 0),
        "duty_q15": fixed(output.duty.share, formats.VALUE_BITS),
        "window_s": fixed(output.duty.window_s, 0),
    }
