"""One robot: its outputs, the chips and pins that they share, and what is safe for its hardware. See docs/puppet-file.md.

robot = load_robot("puppets/pet-robot.toml", puppet)
print(robot.motor_period_us, robot.outputs["NECK"].drive.place)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from marotte.drivers import CHIPS, Pca9685
from marotte.fixed import fixed
from marotte.outputs import RATE_RANGE_HZ, Output, read_output
from marotte.pins import PinPlan, read_pin
from marotte.puppet import Puppet
from marotte.tomlfile import Document, FileMistakes, Mistake, Table, did_you_mean, found
from shared import formats

LINK_TIMEOUT_RANGE_S = (0.1, 60)
ATTACH_RANGE_S = (0, formats.ATTACH_MAX_MS / 1000)
CLOSED = "closed"
OPEN = "open"


@dataclass(frozen=True)
class Kill:
    """A switch between a pin and ground that takes all pulses away."""

    pin: int
    switch: str = CLOSED
    """How it is while all is well: `closed`, so that a broken wire kills too, or `open`."""

    @property
    def level(self) -> int:
        """The pin's level that kills; a switch that is open leaves the pin at 1."""
        return int(self.switch == CLOSED)


@dataclass(frozen=True)
class Robot:
    """One robot: its outputs by DOF, in the file's order."""

    name: str = "robot"
    mcu: str = "rp2040"
    link_timeout_s: float = 0.5
    outputs: Mapping[str, Output] = field(default_factory=dict)
    rate_hz: float = float(RATE_RANGE_HZ[0])
    """How often outputs are written that do not say so themselves."""
    attach_interval_s: float = 0.1
    """After so long the next DOF gets its pulses, when all are armed."""
    autostart: bool = False
    """Whether what is kept on the MCU is armed when it is switched on."""
    kill: Kill | None = None
    chips: Mapping[str, Pca9685] = field(default_factory=dict)

    @property
    def motor_period_us(self) -> int:
        """The period of the motor layer's ticks: as quick as the quickest output wants them."""
        rates_hz = [self.rate_hz, *(output.rate_hz for output in self.outputs.values() if output.rate_hz is not None)]
        step_us = formats.MOTOR_PERIOD_STEP_US
        return math.ceil(1e6 / max(rates_hz) / step_us) * step_us

    def turns(self, output: Output) -> int:
        """Return after how many ticks an output is written again: what comes nearest to its rate, and a PWM can do."""
        wanted = fixed(1e6 / (output.rate_hz or self.rate_hz) / self.motor_period_us, 0)
        return max(1, min(wanted, formats.PWM_PERIOD_MAX_US // self.motor_period_us))

    def written_us(self, output: Output) -> int:
        """Return after how many microseconds an output is written again."""
        return self.turns(output) * self.motor_period_us

    def period_us(self, output: Output) -> float:
        """Return the period of an output's pulses."""
        return output.drive.period_us(self.written_us(output), self.chips)


def load_robot(path: str | Path, puppet: Puppet | None = None) -> Robot:
    """Return the robot of a file, checked against a puppet if one is given. Raises FileMistakes, with every mistake."""
    robot, mistakes = read_robot(path, puppet)
    if mistakes:
        raise FileMistakes(mistakes)
    return robot


def read_robot(path: str | Path, puppet: Puppet | None = None) -> tuple[Robot, list[Mistake]]:
    """Return what could be read of a robot, and every mistake in its file."""
    document = Document(path)
    robot = document.read_until_full(lambda: _robot(document, puppet), Robot())
    return robot, document.in_order()


def _robot(document: Document, puppet: Puppet | None) -> Robot:
    root = document.root()
    name = root.text("name", document.path.stem)
    mcu = root.choice("mcu", ("rp2040",), "rp2040")
    link_timeout_s = root.number("link_timeout", *LINK_TIMEOUT_RANGE_S, default=Robot.link_timeout_s)
    rate_hz = root.number("rate", *RATE_RANGE_HZ, default=Robot.rate_hz)
    attach_interval_s = root.number("attach_interval", *ATTACH_RANGE_S, default=Robot.attach_interval_s)
    autostart = root.boolean("autostart", default=Robot.autostart)
    plan = PinPlan()
    kill = _kill(root.table("kill"), plan) if root.has("kill") else None
    chips = _chips(root, plan)
    tables = dict(root.tables("output"))
    outputs = {dof: _output(dof, table, puppet, chips) for dof, table in tables.items()}
    root.finish()
    known = {dof: output for dof, output in outputs.items() if output}
    robot = Robot(name, mcu, link_timeout_s, known, rate_hz, attach_interval_s, autostart, kill, chips)
    for dof, output in known.items():
        _check_together(tables[dof], output, robot, plan)
    return robot


def _kill(table: Table, plan: PinPlan) -> Kill | None:
    pin = read_pin(table, "pin", "the pin of the switch")
    switch = table.choice("switch", (CLOSED, OPEN), Kill.switch)
    table.finish()
    if pin is not None:
        plan.take(table, "pin", pin, "is the kill pin")
    return None if pin is None else Kill(pin, switch)


def _chips(root: Table, plan: PinPlan) -> dict[str, Pca9685]:
    chips: dict[str, Pca9685] = {}
    tables = dict(root.tables("chip"))
    for name, table in tables.items():
        chip = CHIPS[table.choice("driver", tuple(CHIPS), "pca9685")].read(table, name)
        table.finish()
        if chip:
            _check_chip(table, chip, chips)
            chip.claim(table, plan)
            chips[name] = chip
    if len(tables) > formats.DEVICES_MAX:
        root.mistake(f"has {len(tables)} chips, expected at most {formats.DEVICES_MAX}", "chip")
    return chips


def _check_chip(table: Table, chip: Pca9685, others: Mapping[str, Pca9685]) -> None:
    for other in others.values():
        if (other.sda, other.scl) != (chip.sda, chip.scl):
            continue
        if other.address == chip.address:
            table.mistake(
                f"{chip.address} ({chip.address:#x}) is the address of {other.name} on the same bus, expected another",
                "address",
            )
        if other.baud_hz != chip.baud_hz:
            table.mistake(f"found {chip.baud_hz}, expected {other.baud_hz} as {other.name} has on the same bus", "baud")


def _output(dof: str, table: Table, puppet: Puppet | None, chips: Mapping[str, Pca9685]) -> Output | None:
    known = puppet.dofs.get(dof) if puppet else None
    if puppet and known is None:
        table.mistake(f"the puppet has no such DOF{did_you_mean(dof, puppet.dofs)}")
    output = read_output(dof, table, known.is_relative if known else None, chips)
    if output and known:
        low, high = known.limits_with(output.limits).range
        if low > high:
            theirs = f"{known.limits[0]:g}..{known.limits[1]:g}"
            table.mistake(
                f"found {found(table.value('range'))}, of which the puppet's limits {theirs} leave nothing; "
                "expected a range that overlaps them",
                "range",
            )
    return output


def _check_together(table: Table, output: Output, robot: Robot, plan: PinPlan) -> None:
    """Check what depends on the others: the pins, and the periods of the pulses."""
    period_us = robot.period_us(output)
    output.drive.claim(table, plan, output.dof, period_us)
    if output.feedback:
        plan.take(table.table("feedback"), "pin", output.feedback.pin, f"measures {output.dof}")
    longest_us = max(output.ends_us)
    if output.drive.has_pulses and longest_us > min(period_us, robot.written_us(output)) - formats.PULSE_GAP_US:
        table.mistake(
            f"the pulses are up to {longest_us:g} us long, but begin every {period_us:g} us; "
            f"expected ones that leave {formats.PULSE_GAP_US} us, or a lower rate",
            "pulse_us",
        )
