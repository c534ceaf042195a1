"""The pins of a Pico: what each can do, and who of a robot uses it, so that no two use one.

Source: RP2040 data sheet, sections 1.4.3 (functions of the pins) and 4.5.2 (PWM); Raspberry Pi Pico data sheet, section 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass

from marotte.tomlfile import Table
from shared import formats

PIN_MAX = 29
LINK_PINS = (0, 1)
TAKEN_PINS = (23, 24, 25, 29)
ADC_PINS = tuple(range(formats.FEEDBACK_PIN_FIRST, formats.FEEDBACK_PIN_LAST + 1))
PWM_PERIOD_PINS = 16
"""Pins so far apart share a PWM channel."""
SLICES = 8
I2C_PERIOD_PINS = 4
"""The I2C functions of the pins repeat: SDA and SCL of the first controller, then those of the second."""


def read_pin(table: Table, key: str, what: str) -> int | None:
    """Return the pin that a key names, which has to be there and is described as `what`; None if it is not fit for us."""
    if not table.require(key, f"the number of {what}, 0..{PIN_MAX}"):
        return None
    pin = table.integer(key, 0, PIN_MAX, -1)
    if pin in LINK_PINS:
        table.mistake(f"found {pin}, expected another pin: GP0 and GP1 are the link's UART", key)
    elif pin in TAKEN_PINS:
        table.mistake(f"found {pin}, expected another pin: on a Pico, GP{pin} is wired to something else", key)
    elif pin >= 0:
        return pin
    return None


def slice_of(pin: int) -> int:
    """Return the PWM slice of a pin, which has one period for all its pins."""
    return pin // 2 % SLICES


def i2c_role(pin: int) -> tuple[int, str]:
    """Return the I2C controller that a pin can be connected to, and as what: `sda` or `scl`."""
    place = pin % I2C_PERIOD_PINS
    return place // 2, "scl" if place % 2 else "sda"


@dataclass(frozen=True)
class _Pulses:
    pin: int
    owner: str
    period_us: float
    chip: str = ""
    """The chip whose channel it is; empty for a pin of ours."""


class PinPlan:
    """Who uses which pin. What clashes is noted as a mistake where the later one stands."""

    def __init__(self) -> None:
        self._uses: dict[int, str] = {}
        self._pulses: list[_Pulses] = []
        self._channels: list[_Pulses] = []
        self._buses: dict[int, tuple[int, int]] = {}

    def take(self, table: Table, key: str, pin: int, use: str, *, shared: bool = False) -> bool:
        """Give a pin to a use, such as "drives NECK", which several can share or not; return whether it was free for it."""
        if pin in self._uses and not (shared and self._uses[pin] == use):
            table.mistake(f"found {pin}, which {self._uses[pin]} already", key)
            return False
        self._uses[pin] = use
        return True

    def take_pulses(self, table: Table, key: str, pin: int, owner: str, period_us: float) -> None:
        """Give a pin to an owner, such as "NECK", as an output of pulses with this period."""
        if not self.take(table, key, pin, f"drives {owner}"):
            return
        for other in self._pulses:
            if other.pin % PWM_PERIOD_PINS == pin % PWM_PERIOD_PINS:
                shared = f"it shares a PWM channel with GP{other.pin} of {other.owner}"
            elif slice_of(other.pin) == slice_of(pin) and other.period_us != period_us:
                shared = (
                    f"it shares a PWM slice with GP{other.pin} of {other.owner}, so they would need one period, "
                    f"and have {period_us:g} and {other.period_us:g} us"
                )
            else:
                continue
            table.mistake(f"found {pin}, expected another pin: {shared}", key)
            break
        self._pulses.append(_Pulses(pin, owner, period_us))

    def take_channel(self, table: Table, key: str, chip: str, channel: int, owner: str, period_us: float) -> None:
        """Give a channel of a chip, all of whose channels have one period, to an owner."""
        for other in self._channels:
            if other.chip != chip:
                continue
            if other.pin == channel:
                table.mistake(f"found {channel}, which drives {other.owner} already", key)
            elif other.period_us != period_us:
                table.mistake(
                    f"its pulses would have a period of {period_us:g} us, those of {other.owner} on the same chip have "
                    f"{other.period_us:g} us; expected one rate for all channels of a chip",
                    key,
                )
            else:
                continue
            break
        self._channels.append(_Pulses(channel, owner, period_us, chip))

    def take_bus(self, table: Table, sda: int, scl: int) -> None:
        """Give two pins to an I2C bus; several chips share it by naming the same ones."""
        for key, pin in (("sda", sda), ("scl", scl)):
            if i2c_role(pin)[1] != key:
                table.mistake(f"found {pin}, expected a pin that can be {key.upper()}: {_pins_for(key)}", key)
                return
        controller = i2c_role(sda)[0]
        if i2c_role(scl)[0] != controller:
            table.mistake(
                f"found {scl}, which belongs to I2C{1 - controller}, while GP{sda} (sda) belongs to I2C{controller}; "
                f"expected {_pins_for('scl', controller)}",
                "scl",
            )
            return
        before = self._buses.setdefault(controller, (sda, scl))
        if before != (sda, scl):
            table.mistake(
                f"found GP{sda} and GP{scl}, but I2C{controller} has GP{before[0]} and GP{before[1]} already; "
                "expected these or pins of the other controller",
                "sda",
            )
        else:
            self.take(table, "sda", sda, f"is SDA of I2C{controller}", shared=True)
            self.take(table, "scl", scl, f"is SCL of I2C{controller}", shared=True)


def _pins_for(key: str, controller: int | None = None) -> str:
    free = [pin for pin in range(PIN_MAX) if pin not in (*LINK_PINS, *TAKEN_PINS)]
    roles = [(i2c_role(pin), pin) for pin in free]
    fit = [str(pin) for (number, role), pin in roles if role == key and controller in (None, number)]
    return ", ".join(fit[:-1]) + " or " + fit[-1]
