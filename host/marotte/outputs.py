"""One output of a robot: what drives a DOF, its calibration, and what protects its hardware."""

from __future__ import annotations

from dataclasses import dataclass, field

from marotte.drivers import DRIVES, Chips, Drive
from marotte.fixed import fixed
from marotte.limits import Limits, read_limits
from marotte.pins import ADC_PINS
from marotte.tomlfile import Table, found
from shared import formats

RATE_RANGE_HZ = (50, 333)
TRIM_MAX_US = 300
DEAD_BAND_RANGE = (0, 0.5)
DEAD_BAND_RISE = 64
"""A wheel gets its dead band's share from 1/64 of full speed on, below in proportion."""
TOP_SPEED_RANGE = (0.1, 1)
RELEASE_RANGE_S = (0.1, 60)
SHARE_RANGE = (0.05, 1)
WINDOW_RANGE_S = (1, 600)
GAIN_RANGE = (0, 1)
INTEGRAL_RANGE = (0, 10)
MOST_RANGE = (0, 0.5)
STALL_RANGE = (0.02, 1)
STALL_TIME_RANGE_S = (0.1, 10)
SPAN_MIN = formats.FEEDBACK_SPAN_MIN_Q15 / formats.VALUE_ONE


@dataclass(frozen=True)
class Duty:
    """How much of the time a DOF may move before it is let go to cool down."""

    share: float = 1.0
    window_s: int = 60


@dataclass(frozen=True)
class Feedback:
    """A potentiometer at a DOF: it corrects slow errors, and shows a stall."""

    pin: int
    at: tuple[float, float]
    """What the pin measures where the DOF's value is 0 and where it is 1, as shares of the supply."""
    gain: float = 0.3
    """How much of an error is corrected at once."""
    integral: float = 0.5
    """How much of an error is corrected in each second that it lasts."""
    most: float = 0.1
    """The greatest correction, in the DOF's value."""
    stall: float = 0.15
    """The error that counts as a stall when it lasts `stall_time_s`."""
    stall_time_s: float = 0.5


@dataclass(frozen=True)
class Output:
    """What drives a DOF, and its calibration."""

    dof: str
    drive: Drive
    pulse_us: tuple[float, float] = (1000.0, 2000.0)
    """Pulse widths at the least (0 or -1) and at the greatest value of the DOF, before trim and inversion."""
    trim_us: float = 0.0
    invert: bool = False
    rate_hz: float | None = None
    """How often it is written; None: as often as the robot's `rate` says."""
    limits: Limits = field(default_factory=Limits)
    """What the hardware stands, in the DOF's value."""
    dead_band: float = 0.0
    """Wheels: the share of full drive at which they just begin to turn."""
    top_speed: float = 1.0
    """Wheels: the share of full drive that counts as a speed of 1."""
    release_s: float | None = None
    """Standing still for so long, the DOF is let go; None: never."""
    duty: Duty = field(default_factory=Duty)
    feedback: Feedback | None = None

    @property
    def ends_us(self) -> tuple[float, float]:
        """Pulse widths at the least and at the greatest value, with trim and inversion."""
        low, high = (end + self.trim_us for end in self.pulse_us)
        return (high, low) if self.invert else (low, high)

    @property
    def has_span(self) -> bool:
        """Whether its pulses at both ends differ, as finely as they travel."""
        low, high = (fixed(end_us, formats.PULSE_BITS) for end_us in self.ends_us)
        return low != high

    def drive_of(self, speed: float) -> float:
        """Return the drive, -1..1, with which a wheel has a speed of -1..1; from 1/64 on it is outside the dead band."""
        size = abs(speed)
        drive = self.dead_band * min(DEAD_BAND_RISE * size, 1) + (self.top_speed - self.dead_band) * size
        return drive if speed >= 0 else -drive


def is_beyond(top_speed: float, dead_band: float) -> bool:
    """Return whether a top speed is above a dead band, as finely as they travel."""
    return fixed(top_speed, formats.VALUE_BITS) > fixed(dead_band, formats.VALUE_BITS)


def read_output(dof: str, table: Table, relative: bool | None, chips: Chips) -> Output | None:
    """Return the output of an `[output.DOF]`, None if what drives it cannot be made out.

    `relative` says what kind of DOF it is, None if that is not known.
    """
    driver = table.choice("driver", tuple(DRIVES), "pins")
    drive_class = DRIVES[driver]
    if relative is False and not drive_class.for_absolute:
        table.mistake(
            f'found "{driver}", expected another driver: {dof} is absolute, and a bridge drives wheels', "driver"
        )
    drive = drive_class.read(table, chips)
    pulse_us, trim_us = _pulses(table) if drive_class.has_pulses else (Output.pulse_us, Output.trim_us)
    invert = table.boolean("invert", default=False)
    rate_hz = table.number("rate", *RATE_RANGE_HZ, default=RATE_RANGE_HZ[0]) if table.has("rate") else None
    limits = read_limits(table, relative)
    dead_band, top_speed = _wheel(table, relative)
    release_s = table.number("release", *RELEASE_RANGE_S, default=1.0) if table.has("release") else None
    duty = _duty(table)
    feedback = _feedback(table, relative) if table.has("feedback") else None
    table.finish()
    if drive is None:
        return None
    output = Output(
        dof,
        drive,
        pulse_us,
        trim_us,
        invert,
        rate_hz,
        limits,
        dead_band,
        top_speed,
        release_s,
        duty,
        feedback,
    )
    _check_ends(table, output)
    return output


def _pulses(table: Table) -> tuple[tuple[float, float], float]:
    ends = table.numbers(
        "pulse_us", 2, formats.PULSE_MIN_US, formats.PULSE_MAX_US, "the pulse widths at both ends, in us"
    )
    return (ends[0], ends[1]) if ends else Output.pulse_us, table.number("trim_us", -TRIM_MAX_US, TRIM_MAX_US, 0.0)


def _check_ends(table: Table, output: Output) -> None:
    if any(not formats.PULSE_MIN_US <= end <= formats.PULSE_MAX_US for end in output.ends_us):
        low, high = sorted(output.ends_us)
        table.mistake(
            f"with its trim the pulses end at {low:g} and {high:g} us, "
            f"expected {formats.PULSE_MIN_US}..{formats.PULSE_MAX_US}",
            "trim_us",
        )
    if not output.has_span:
        table.mistake(
            f"found {found(table.value('pulse_us'))}, expected two pulse widths, 1/{1 << formats.PULSE_BITS} us apart at least",
            "pulse_us",
        )


def _wheel(table: Table, relative: bool | None) -> tuple[float, float]:
    """Return dead band and top speed."""
    if relative is False:
        for key in ("dead_band", "top_speed"):
            if table.has(key):
                table.mistake("expected none: this DOF is absolute, and it belongs to wheels", key)
        return Output.dead_band, Output.top_speed
    dead_band = table.number("dead_band", *DEAD_BAND_RANGE, default=Output.dead_band)
    top_speed = table.number("top_speed", *TOP_SPEED_RANGE, default=Output.top_speed)
    if not is_beyond(top_speed, dead_band):
        table.mistake(
            f"found {found(table.value('top_speed', top_speed))}, expected more than the dead band of {dead_band:g}, "
            f"by 1/{formats.VALUE_ONE} at least",
            "top_speed",
        )
    return dead_band, top_speed


def _duty(table: Table) -> Duty:
    if not table.has("duty"):
        return Duty()
    inner = table.table("duty")
    inner.require("share", f"the share of the time in which it may move, {SHARE_RANGE[0]:g}..{SHARE_RANGE[1]:g}")
    share = inner.number("share", *SHARE_RANGE, default=Duty.share)
    window_s = inner.integer("window", *WINDOW_RANGE_S, default=Duty.window_s)
    inner.finish()
    return Duty(share, window_s)


def _feedback(table: Table, relative: bool | None) -> Feedback | None:
    if relative:
        table.mistake("expected none: this DOF is relative, and has no place that could be measured", "feedback")
    inner = table.table("feedback")
    pin = None
    pins = f"{ADC_PINS[0]}..{ADC_PINS[-1]}"
    if inner.require("pin", f"the number of the pin that measures, {pins}"):
        pin = inner.integer("pin", ADC_PINS[0], ADC_PINS[-1], -1)
    at = None
    what = "what is measured where its value is 0 and where it is 1, as shares of the supply"
    if inner.require("at", what):
        at = inner.numbers("at", 2, 0, 1, what)
    if at and abs(at[0] - at[1]) < SPAN_MIN:
        inner.mistake(f"found {found(inner.value('at'))}, expected values at least {SPAN_MIN:g} apart", "at")
    rest = (
        inner.number("gain", *GAIN_RANGE, default=Feedback.gain),
        inner.number("integral", *INTEGRAL_RANGE, default=Feedback.integral),
        inner.number("most", *MOST_RANGE, default=Feedback.most),
        inner.number("stall", *STALL_RANGE, default=Feedback.stall),
        inner.number("stall_time", *STALL_TIME_RANGE_S, default=Feedback.stall_time_s),
    )
    inner.finish()
    return None if pin is None or pin < 0 or at is None else Feedback(pin, (at[0], at[1]), *rest)
