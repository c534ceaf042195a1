"""What can drive a DOF: a PWM pin for a servo, a channel of a PCA9685, an H-bridge for a motor.

One class for each, which knows its keys in the robot file, its pins, and its settings on the wire; a new driver is a class
here and a line in DRIVES (and in CHIPS, if outputs share it), and its other half in the firmware.

Source: NXP's PCA9685 data sheet, sections 7.1 (addresses) and 7.3.5 (prescaler).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from marotte.fixed import fixed
from marotte.pins import PinPlan, read_pin
from marotte.tomlfile import Table, did_you_mean, found
from shared import formats

ADDRESS_RANGE = (0x40, 0x7F)
ADDRESS_OF_ALL = 0x70
"""Every PCA9685 answers to it when it is switched on."""
CHANNEL_MAX = 15
BAUD_RANGE_HZ = (100_000, 1_000_000)
CLOCK_RANGE_MHZ = (20, 30)
PRESCALE_STEPS = 4096
BRIDGE_PERIOD_US = 50.0

PWM_DIRECTION = "pwm-direction"
TWO_PWM = "two-pwm"


class Chip(ABC):
    """A chip that outputs share."""

    code: ClassVar[int]

    @classmethod
    @abstractmethod
    def read(cls, table: Table, name: str) -> Chip | None:
        """Return the chip of a `[chip.NAME]`, None if it cannot be made out; `driver` has been read."""

    @abstractmethod
    def claim(self, table: Table, plan: PinPlan) -> None:
        """Take the chip's pins."""

    @abstractmethod
    def settings(self) -> list[int]:
        """Return the settings of the message `device`."""


@dataclass(frozen=True)
class Pca9685(Chip):
    """16 PWM channels over I2C."""

    name: str
    sda: int
    scl: int
    oe: int
    """The pin that switches all channels off, whatever the bus does."""
    address: int = 0x40
    baud_hz: int = 400_000
    clock_mhz: float = 25.0
    """Of its oscillator, which is off by some percent; measured, it makes the pulses right."""

    code = formats.DRIVER_PCA9685

    @classmethod
    def read(cls, table: Table, name: str) -> Pca9685 | None:
        sda, scl = (read_pin(table, key, f"the pin that is {key.upper()}") for key in ("sda", "scl"))
        oe = read_pin(table, "oe", "the pin at its OE, which takes all pulses away at once")
        address = table.integer("address", *ADDRESS_RANGE, default=cls.address)
        if address == ADDRESS_OF_ALL:
            table.mistake("found 112 (0x70), expected another address: every PCA9685 answers to this one", "address")
        baud_hz = table.integer("baud", *BAUD_RANGE_HZ, default=cls.baud_hz)
        clock_mhz = table.number("clock", *CLOCK_RANGE_MHZ, default=cls.clock_mhz)
        if sda is None or scl is None or oe is None:
            return None
        return cls(name, sda, scl, oe, address, baud_hz, clock_mhz)

    def claim(self, table: Table, plan: PinPlan) -> None:
        plan.take_bus(table, self.sda, self.scl)
        plan.take(table, "oe", self.oe, "is OE of a chip", shared=True)  # boards in a row may share it

    def period_us(self, asked_us: int) -> float:
        """Return the period of its pulses if one is asked for: the nearest that its prescaler can do."""
        return fixed(self.clock_mhz * asked_us / PRESCALE_STEPS, 0) * PRESCALE_STEPS / self.clock_mhz

    def settings(self) -> list[int]:
        baud_khz, clock_khz = fixed(self.baud_hz / 1000, 0), fixed(self.clock_mhz * 1000, 0)
        return [self.sda, self.scl, self.address, self.oe, baud_khz, clock_khz]


Chips = Mapping[str, Pca9685]


class Drive(ABC):
    """What drives one DOF."""

    code: ClassVar[int]
    has_pulses: ClassVar[bool] = True
    """Whether it makes pulses whose width tells a servo where to go."""
    for_absolute: ClassVar[bool] = True
    """Whether it can drive an absolute DOF."""

    @classmethod
    @abstractmethod
    def read(cls, table: Table, chips: Chips) -> Drive | None:
        """Return the drive of an `[output.DOF]`, None if it cannot be made out; `driver` has been read."""

    @abstractmethod
    def claim(self, table: Table, plan: PinPlan, dof: str, period_us: float) -> None:
        """Take the pins of a DOF's output whose pulses have this period."""

    @abstractmethod
    def settings(self, invert: bool, chips: Chips) -> list[int]:
        """Return the settings of the message `output`."""

    def period_us(self, asked_us: int, chips: Chips) -> float:
        """Return the period that its pulses have if this one is asked for."""
        return asked_us

    @property
    def pulse_pin(self) -> int | None:
        """The pin of ours that gives its servo pulses; None if there is none."""
        return None

    @property
    @abstractmethod
    def place(self) -> str:
        """Where it is, in a few characters: GP8."""


@dataclass(frozen=True)
class Pin(Drive):
    """A servo, or a controller that takes the same pulses, at a pin."""

    pin: int

    code = formats.DRIVER_PINS

    @classmethod
    def read(cls, table: Table, chips: Chips) -> Pin | None:
        pin = read_pin(table, "pin", "its pin")
        return None if pin is None else cls(pin)

    def claim(self, table: Table, plan: PinPlan, dof: str, period_us: float) -> None:
        plan.take_pulses(table, "pin", self.pin, dof, period_us)

    def settings(self, invert: bool, chips: Chips) -> list[int]:
        return [self.pin]

    @property
    def pulse_pin(self) -> int | None:
        return self.pin

    @property
    def place(self) -> str:
        return f"GP{self.pin}"


@dataclass(frozen=True)
class Channel(Drive):
    """A servo at a channel of a PCA9685."""

    chip: str
    channel: int

    code = formats.DRIVER_PCA9685

    @classmethod
    def read(cls, table: Table, chips: Chips) -> Channel | None:
        chip = table.text("chip", "") if table.require("chip", "the name of its [chip.NAME]") else ""
        channel = -1
        if table.require("channel", f"the number of its channel, 0..{CHANNEL_MAX}"):
            channel = table.integer("channel", 0, CHANNEL_MAX, -1)
        if chip and chip not in chips:
            hint = did_you_mean(chip, chips) or "; expected the name of a [chip.NAME]"
            table.mistake(f"found {found(chip)}, which is no chip of this file{hint}", "chip")
        return cls(chip, channel) if chip in chips and channel >= 0 else None

    def claim(self, table: Table, plan: PinPlan, dof: str, period_us: float) -> None:
        plan.take_channel(table, "channel", self.chip, self.channel, dof, period_us)

    def settings(self, invert: bool, chips: Chips) -> list[int]:
        return [list(chips).index(self.chip), self.channel]

    def period_us(self, asked_us: int, chips: Chips) -> float:
        return chips[self.chip].period_us(asked_us)

    @property
    def place(self) -> str:
        return f"{self.chip} {self.channel}"


@dataclass(frozen=True)
class Bridge(Drive):
    """A motor at an H-bridge: PWM of 20 kHz, and a second pin for the direction or for the PWM of the other one."""

    wiring: str
    pins: tuple[int, int]
    """The PWM and the direction, or the PWM forward and backward."""

    code = formats.DRIVER_BRIDGE
    has_pulses = False
    for_absolute = False
    KEYS: ClassVar[Mapping[str, tuple[str, str]]] = {
        PWM_DIRECTION: ("pwm", "direction"),
        TWO_PWM: ("forward", "backward"),
    }

    @classmethod
    def read(cls, table: Table, chips: Chips) -> Bridge | None:
        wiring = table.choice("wiring", tuple(cls.KEYS), PWM_DIRECTION)
        first, second = (read_pin(table, key, f'the pin at "{key}"') for key in cls.KEYS[wiring])
        return None if first is None or second is None else cls(wiring, (first, second))

    def claim(self, table: Table, plan: PinPlan, dof: str, period_us: float) -> None:
        first, second = self.KEYS[self.wiring]
        plan.take_pulses(table, first, self.pins[0], dof, period_us)
        if self.wiring == TWO_PWM:
            plan.take_pulses(table, second, self.pins[1], dof, period_us)
        else:
            plan.take(table, second, self.pins[1], f"drives {dof}")

    def settings(self, invert: bool, chips: Chips) -> list[int]:
        return [list(self.KEYS).index(self.wiring), *self.pins, int(invert)]

    def period_us(self, asked_us: int, chips: Chips) -> float:
        return BRIDGE_PERIOD_US

    @property
    def place(self) -> str:
        return f"GP{self.pins[0]}/{self.pins[1]}"


DRIVES: Mapping[str, type[Drive]] = {"pins": Pin, "pca9685": Channel, "bridge": Bridge}
"""By the name that `driver` of an `[output.DOF]` gives them."""
CHIPS: Mapping[str, type[Pca9685]] = {"pca9685": Pca9685}
"""By the name that `driver` of a `[chip.NAME]` gives them."""
