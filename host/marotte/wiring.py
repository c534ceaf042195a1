"""The wiring and calibration of one robot: which pin drives each DOF, and with which pulses.

    name = "pet-1"
    mcu = "rp2040"               # the default
    link_timeout = 0.5           # seconds of silence after which the host counts as gone; 0.1 to 60, default 0.5
    [output.NECK]                # a DOF of the puppet
    pin = 2                      # GP2
    pulse_us = [1000, 2000]      # pulse at the DOF's least and at its greatest value; 300 to 3000, default 1000 and 2000
    trim_us = -12.5              # added to both; -300 to 300, default 0
    invert = false               # true exchanges the ends

A DOF without an output is computed and drives nothing. Pulses have a resolution of 1/16 us. GP0 and GP1 are the link's UART;
GP23, GP24, GP25 and GP29 are wired to other things on a Pico. Pins `n` and `n + 16` share one PWM channel, so only one of
them can be an output.

Source: RP2040 data sheet, section 4.5.2 (PWM channels); Raspberry Pi Pico data sheet, section 2.1 (pins).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from marotte.puppet import Puppet
from marotte.tomlfile import Document, FileMistakes, Mistake, Table, did_you_mean
from shared import formats

PIN_MAX = 29
LINK_PINS = (0, 1)
TAKEN_PINS = (23, 24, 25, 29)
PWM_PERIOD_PINS = 16
TRIM_MAX_US = 300
LINK_TIMEOUT_RANGE_S = (0.1, 60)


@dataclass(frozen=True)
class Output:
    """The pin that drives a DOF, and its calibration."""

    dof: str
    pin: int
    pulse_us: tuple[float, float] = (1000.0, 2000.0)
    """Pulse widths at the least (0 or -1) and at the greatest value of the DOF, before trim and inversion."""
    trim_us: float = 0.0
    invert: bool = False

    @property
    def ends_us(self) -> tuple[float, float]:
        """Pulse widths at the least and at the greatest value, with trim and inversion."""
        low, high = (end + self.trim_us for end in self.pulse_us)
        return (high, low) if self.invert else (low, high)


@dataclass(frozen=True)
class Robot:
    """One robot: its outputs by DOF, in the file's order."""

    name: str = "robot"
    mcu: str = "rp2040"
    link_timeout_s: float = 0.5
    outputs: Mapping[str, Output] = field(default_factory=dict)


def load_robot(path: str | Path, puppet: Puppet | None = None) -> Robot:
    """Return the robot of a file, checked against a puppet if one is given. Raises FileMistakes, with every mistake."""
    robot, mistakes = read_robot(path, puppet)
    if mistakes:
        raise FileMistakes(mistakes)
    return robot


def read_robot(path: str | Path, puppet: Puppet | None = None) -> tuple[Robot, list[Mistake]]:
    """Return what could be read of a robot, and every mistake in its file."""
    document = Document(path)
    if not document.is_parsed:
        return Robot(), document.mistakes
    root = document.root()
    name = root.text("name", document.path.stem)
    mcu = root.choice("mcu", ("rp2040",), "rp2040")
    link_timeout_s = root.number("link_timeout", *LINK_TIMEOUT_RANGE_S, default=Robot.link_timeout_s)
    outputs: dict[str, Output] = {}
    for dof, table in root.tables("output"):
        if puppet and dof not in puppet.dofs:
            table.mistake(f"the puppet has no such DOF{did_you_mean(dof, puppet.dofs)}")
        output = _output(dof, table)
        if output:
            _check_clash(table, output, outputs)
            outputs[dof] = output
    root.finish()
    return Robot(name, mcu, link_timeout_s, outputs), document.in_order()


def _output(dof: str, table: Table) -> Output | None:
    pin = table.integer("pin", 0, PIN_MAX, -1) if table.require("pin", "the number of its pin, 0..29") else -1
    if pin in LINK_PINS:
        table.mistake(f"found {pin}, expected another pin: GP0 and GP1 are the link's UART", "pin")
    if pin in TAKEN_PINS:
        table.mistake(f"found {pin}, expected another pin: on a Pico, GP{pin} is wired to something else", "pin")
    ends = table.numbers(
        "pulse_us", 2, formats.PULSE_MIN_US, formats.PULSE_MAX_US, "the pulse widths at both ends, in us"
    )
    trim_us = table.number("trim_us", -TRIM_MAX_US, TRIM_MAX_US, 0.0)
    invert = table.boolean("invert", default=False)
    table.finish()
    output = Output(dof, pin, (ends[0], ends[1]) if ends else Output.pulse_us, trim_us, invert)
    if any(not formats.PULSE_MIN_US <= end <= formats.PULSE_MAX_US for end in output.ends_us):
        low, high = sorted(output.ends_us)
        table.mistake(
            f"with its trim the pulses end at {low:g} and {high:g} us, "
            f"expected {formats.PULSE_MIN_US}..{formats.PULSE_MAX_US}",
            "trim_us",
        )
    return output if pin >= 0 else None


def _check_clash(table: Table, output: Output, others: Mapping[str, Output]) -> None:
    for other in others.values():
        if other.pin == output.pin:
            table.mistake(f"found {output.pin}, which drives {other.dof} already", "pin")
        elif other.pin % PWM_PERIOD_PINS == output.pin % PWM_PERIOD_PINS:
            table.mistake(
                f"found {output.pin}, expected another pin: it shares a PWM channel with GP{other.pin} of {other.dof}",
                "pin",
            )
