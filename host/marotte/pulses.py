"""Servo pulses, as an emulated MCU's pin has made them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from marotte.mcu.base import VirtualMcu
from marotte.wiring import Robot


@dataclass(frozen=True)
class Pulse:
    """One whole pulse."""

    start_ns: int
    width_ns: int


@dataclass(frozen=True)
class PulseSummary:
    """The pulses of one output over a run."""

    dof: str
    pin: int
    count: int
    last_us: float
    least_us: float
    greatest_us: float


def pulses(edges: Sequence[tuple[int, int]]) -> list[Pulse]:
    """Return the whole pulses of a pin's edges `(t_ns, level)`; one that is still high at the end is left out."""
    found = []
    rise_ns = None
    for t_ns, level in edges:
        if level:
            rise_ns = t_ns
        elif rise_ns is not None:
            found.append(Pulse(rise_ns, t_ns - rise_ns))
            rise_ns = None
    return found


def measure(mcu: VirtualMcu, robot: Robot) -> list[PulseSummary]:
    """Return what the servo pins of a robot have done until they were killed; those that gave no pulse are left out.

    The last pulse of a pin does not count: the kill has driven the pin low, perhaps in the middle of it.
    """
    summaries = []
    for output in robot.outputs.values():
        pin = output.drive.pulse_pin
        widths_us = [] if pin is None else [pulse.width_ns / 1000 for pulse in pulses(mcu.edges(pin))[:-1]]
        if pin is not None and widths_us:
            least_us, greatest_us = min(widths_us), max(widths_us)
            summaries.append(PulseSummary(output.dof, pin, len(widths_us), widths_us[-1], least_us, greatest_us))
    return summaries
