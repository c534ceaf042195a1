"""Calibrating one output of a robot by hand: the DOF goes where it is told, and its calibration changes while it does.

with Calibration(session, robot, robot.outputs["NECK"]) as calibration:
    calibration.do("0")            # go to the least value
    calibration.do("low 1040")     # and give it this pulse
print(calibration.text())          # for the robot file
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace

from marotte.drivers import Bridge
from marotte.errors import MarotteError
from marotte.functions import Function
from marotte.limits import Limits, tightest, whole_range
from marotte.outputs import DEAD_BAND_RANGE, TOP_SPEED_RANGE, TRIM_MAX_US, Output, is_beyond
from marotte.puppet import ABSOLUTE, RELATIVE, Action, Dof, Live, MappingEntry, Puppet
from marotte.session import Session
from marotte.signals import uninterruptible
from marotte.tables import build_tables, weight_q28
from marotte.wiring import Robot
from shared import formats

GENTLE_SPEED = 0.5
"""Range widths a second: an end that is set wrong is seen before anything breaks."""
GENTLE_ACCEL = 4.0

_SERVO_COMMANDS = ["low US", "high US", "trim US"]
_WHEEL_COMMANDS = ["dead SHARE", "top SHARE"]
_ACTION = "GO"
_CHANNEL = "PLACE"


class CalibrationError(MarotteError):
    """A command that is none, or a number that is out of its range."""


def is_wheel(output: Output) -> bool:
    """Return whether an output says by itself that its DOF is relative."""
    return isinstance(output.drive, Bridge) or output.dead_band > 0 or output.top_speed < 1


class Calibration:
    """One output of a robot, armed alone while it is entered as a context. Methods raise MarotteError."""

    def __init__(self, session: Session, robot: Robot, output: Output, relative: bool | None = None) -> None:
        """`relative` says what kind of DOF it is; by default that follows from the output."""
        self.relative = is_wheel(output) if relative is None else relative
        self.output = output
        self._session = session
        limits = tightest(self.relative, output.limits, Limits(speed=GENTLE_SPEED, accel=GENTLE_ACCEL))
        self.range = limits.range
        gentle = Limits(limits.range, None if self.relative else limits.speed, limits.accel)
        self._robot = replace(robot, outputs={output.dof: replace(output, limits=gentle)}, autostart=False)

    def __enter__(self) -> Calibration:
        session = self._session
        session.upload(build_tables(_puppet(self.output.dof, self.relative), self._robot))
        try:
            session.weight_targets(0, {0: weight_q28(1.0)})
            session.arm()
            session.wait_attached()
            session.start()
            session.flush()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._end()

    def _end(self) -> None:
        """Kill the outputs and stop, not to be interrupted in it."""
        with uninterruptible(), contextlib.suppress(MarotteError):
            self._session.kill()
            self._session.stop()
            self._session.flush()

    @property
    def commands(self) -> str:
        """The commands that this output understands, in a line."""
        low, high = self.range
        setters = [*(_SERVO_COMMANDS * self.output.drive.has_pulses), *(_WHEEL_COMMANDS * self.relative)]
        return ", ".join([f"VALUE ({low:g} to {high:g})", *setters, "invert", "show", "done"])

    def do(self, line: str) -> str:
        """Carry out a command; return what to answer. Raises CalibrationError for what is none."""
        word, *operands = line.split() or ["show"]
        if word == "show" and not operands:
            return self.text()
        if word == "invert" and not operands:
            return self._change(invert=not self.output.invert)
        if not operands and _is_number(word):
            return self.go(float(word))
        setters = self._setters()
        if word in setters and len(operands) == 1 and _is_number(operands[0]):
            return setters[word](float(operands[0]))
        raise CalibrationError(f"found {line.strip()!r}, expected {self.commands}")

    def go(self, value: float) -> str:
        """Let the DOF go to a value."""
        _check("the value", value, *self.range)
        low, high = whole_range(self.relative)
        self._session.live_targets(formats.FRAME_NOW, {0: weight_q28((value - low) / (high - low))})
        return f"{self.output.dof} goes to {value:g}"

    def text(self) -> str:
        """Return the calibration as it belongs into the robot file."""
        output = self.output
        lines = [f"[output.{output.dof}]"]
        if output.drive.has_pulses:
            low, high = output.pulse_us
            lines += [f"pulse_us = [{low:g}, {high:g}]", f"trim_us = {output.trim_us:g}"]
        if self.relative:
            lines += [f"dead_band = {output.dead_band:g}", f"top_speed = {output.top_speed:g}"]
        return "\n".join([*lines, f"invert = {str(output.invert).lower()}"])

    def _setters(self) -> Mapping[str, Callable[[float], str]]:
        low, high = self.output.pulse_us
        setters: dict[str, Callable[[float], str]] = {}
        if self.output.drive.has_pulses:
            setters["low"] = lambda us: self._change(pulse_us=(_pulse(us), high))
            setters["high"] = lambda us: self._change(pulse_us=(low, _pulse(us)))
            setters["trim"] = lambda us: self._change(trim_us=_check("the trim", us, -TRIM_MAX_US, TRIM_MAX_US))
        if self.relative:
            setters["dead"] = lambda share: self._change(dead_band=_check("the dead band", share, *DEAD_BAND_RANGE))
            setters["top"] = lambda share: self._change(top_speed=_check("the top speed", share, *TOP_SPEED_RANGE))
        return setters

    def _change(self, **changes: object) -> str:
        changed = replace(self.output, **changes)  # type: ignore[arg-type]
        for end_us in changed.ends_us:
            _check("a pulse with its trim", end_us, formats.PULSE_MIN_US, formats.PULSE_MAX_US)
        if not changed.has_span:
            low_us, high_us = changed.pulse_us
            raise CalibrationError(
                f"found {low_us:g} and {high_us:g} us as the pulses' ends, "
                f"expected two that are 1/{1 << formats.PULSE_BITS} us apart at least"
            )
        if not is_beyond(changed.top_speed, changed.dead_band):
            raise CalibrationError(
                f"found {changed.top_speed:g} as top speed, expected more than the dead band of {changed.dead_band:g}, "
                f"by 1/{formats.VALUE_ONE} at least"
            )
        self._session.calibrate(changed)
        self.output = changed
        return ", ".join(self.text().splitlines()[1:])


def _puppet(dof: str, relative: bool) -> Puppet:
    """Return a puppet of one DOF that follows a live channel."""
    low, high = whole_range(relative)
    entry = MappingEntry(dof, low, high, Function("live", (_CHANNEL,)))
    return Puppet(
        "calibration",
        dofs={dof: Dof(dof, RELATIVE if relative else ABSOLUTE, (low + high) / 2, (low, high), signal=False)},
        actions={_ACTION: Action(_ACTION, (entry,), tau_s=(0.03, 0.03))},
        lives={_CHANNEL: Live(_CHANNEL, 0.5)},
    )


def _is_number(word: str) -> bool:
    try:
        return float(word) == float(word)
    except ValueError:
        return False


def _pulse(pulse_us: float) -> float:
    return _check("a pulse", pulse_us, formats.PULSE_MIN_US, formats.PULSE_MAX_US)


def _check(what: str, value: float, low: float, high: float) -> float:
    """Return a value that is in its range. Raises CalibrationError."""
    if not low <= value <= high:
        raise CalibrationError(f"found {value:g} as {what}, expected a number in {low:g}..{high:g}")
    return value
