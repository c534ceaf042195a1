"""The kinds of emulated MCU, by name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from marotte.errors import MarotteError
from marotte.mcu.base import VirtualMcu
from marotte.pins import i2c_role
from marotte.wiring import CLOSED, Robot

KINDS = ("unix", "unix32", "rp2040")
"""MicroPython on this machine with words of 64 and of 32 bits, and the RP2040 instruction by instruction."""


@contextmanager
def open_mcu(kind: str, flash: Path | None = None) -> Iterator[VirtualMcu]:
    """Yield an emulated MCU of a kind, just switched on, and close it at the end. Raises MarotteError.

    `flash` names what keeps its flash from run to run: a file for the RP2040, a folder for the others.
    """
    # Imported here, as each kind brings along all that it takes to build and run it.
    if kind == "rp2040":
        from marotte.mcu.rp2040 import Rp2040Mcu

        virtual: VirtualMcu = Rp2040Mcu(flash=flash)
    elif kind in KINDS:
        from marotte.mcu.unix import UnixMcu

        if flash:
            _make_folder(flash)
        virtual = UnixMcu(bits=32 if kind == "unix32" else 64, folder=flash)
    else:
        raise MarotteError(f'unknown MCU "{kind}", expected one of {", ".join(KINDS)}')
    with virtual:
        yield virtual


def connected(virtual: VirtualMcu, robot: Robot) -> Robot:
    """Connect to an emulated MCU what a robot has beside its servos; return the robot as it can be there: without feedback.

    Its kill switch is as it should be, and its chips answer.
    """
    if robot.kill and robot.kill.switch == CLOSED:
        virtual.set_pin(robot.kill.pin, 0)
    for chip in robot.chips.values():
        virtual.add_pca9685(i2c_role(chip.sda)[0], chip.address, chip.oe, chip.clock_mhz * 1e6)
    return without_feedback(robot)


def without_feedback(robot: Robot) -> Robot:
    """Return a robot without its potentiometers: an emulated MCU has no servos that would turn them."""
    outputs = {dof: replace(output, feedback=None) for dof, output in robot.outputs.items()}
    return replace(robot, outputs=outputs)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise MarotteError(f"{path}: cannot be made a folder: {(error.strerror or str(error)).lower()}") from error
