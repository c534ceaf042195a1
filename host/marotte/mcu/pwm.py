"""Output pins as an emulated MCU without emulated hardware sees them: what was written, and the edges that follow from it.

The model is the Pico's PWM: both pins of a slice share its period and phase, and a new on-time takes effect when the period
ends. A pin that is taken from its slice changes at once.
"""

from __future__ import annotations

import struct
from array import array
from typing import NamedTuple

Q18_BITS = 18
SLICES = 8
_WRITE = struct.Struct("<BI")
_LOW, _HIGH, _END, _ATTACH = -1, -2, -3, -4
"""In the log of a pin, where anything from 0 up is an on-time; from _ATTACH down are places in the list of attachments."""


class Drive(NamedTuple):
    """What was written to one output, in order: instants, and values beside them, as arrays of 64-bit integers."""

    t_us: array[int]
    value: array[int]


class _Phase(NamedTuple):
    period_ns: int
    wrap_ns: int  # one of the instants at which a period ends


class Pins:
    """The output pins of a Pico. All instants are those at which something is done, and never run backwards."""

    def __init__(self) -> None:
        self._pins: dict[int, _Pin] = {}
        self._sliced: list[set[int]] = [set() for _ in range(SLICES)]  # pins with pulses since the slice was started

    def attach(self, at_us: int, pin: int, period_us: int, until_wrap_us: int) -> None:
        """Give a pin to its PWM slice. The slice begins to count now, unless its other pins keep it running: then a pin that
        has had pulses from it before gets the next ones with the second write, when its old ones are certainly gone.
        """
        phase = _Phase(period_us * 1000, (at_us + until_wrap_us) * 1000)
        number = (pin >> 1) % SLICES
        others = [other for name, other in self._pins.items() if (name >> 1) % SLICES == number and name != pin]
        running = [other.phase for other in others if other.pwm and other.phase.period_ns == phase.period_ns]
        if not running:
            self._sliced[number] = set()
        model = self._pins.setdefault(pin, _Pin())
        model.attach(at_us, running[0] if running else phase, pin in self._sliced[number])
        self._sliced[number].add(pin)

    def write(self, at_us: int, data: bytes) -> None:
        """Set on-times from the next period on: pin u8, pulse_q18us u32, repeated. A pin without PWM stays as it is."""
        pins = self._pins
        for pin, pulse_q18us in _WRITE.iter_unpack(data):
            model = pins.get(pin)
            if model and model.pwm:
                model.log_us.append(at_us)
                model.log.append(pulse_q18us)

    def end(self, at_us: int, pin: int) -> None:
        """Let a pin have no more pulses, from its next period on."""
        self._pins[pin].end(at_us)

    def drive(self, at_us: int, pin: int, level: int) -> None:
        """Drive a pin to a level, whatever it was before."""
        self._pins.setdefault(pin, _Pin()).drive(at_us, level)

    def quiet(self, at_us: int) -> None:
        """Drive all pins low that have PWM."""
        for model in self._pins.values():
            if model.pwm:
                model.drive(at_us, 0)

    def reset(self, at_us: int) -> None:
        """Let go of all pins, which then are low."""
        for model in self._pins.values():
            model.drive(at_us, 0)

    def edges(self, pin: int, end_us: int) -> list[tuple[int, int]]:
        """Return the edges `(t_ns, level)` of a pin up to an instant, since they were forgotten."""
        model = self._pins.get(pin)
        return model.edges_until(end_us) if model else []

    def clear_edges(self, end_us: int) -> None:
        """Forget all edges up to an instant."""
        for model in self._pins.values():
            model.edges_until(end_us).clear()

    def drives(self) -> dict[int, Drive]:
        """Return the on-times in `pulse_q18us` that were written to each pin, since they were forgotten."""
        found = {}
        for pin, model in self._pins.items():
            drive = model.drive_log()
            if drive.t_us:
                found[pin] = drive
        return found

    def clear_drives(self, end_us: int) -> None:
        """Forget all that was written up to an instant; what it did to the pins stays."""
        for model in self._pins.values():
            model.forget(end_us)


class _Pin:
    """One pin: the log of what was done to it, and how far that has been turned into edges."""

    def __init__(self) -> None:
        self.pwm = False
        self.phase = _Phase(0, 0)
        self.log_us = array("q")
        self.log = array("q")
        self._attached: list[tuple[_Phase, bool]] = []  # whether the first write only clears
        self._done = 0  # entries of the log that have become edges
        self._edges: list[tuple[int, int]] = []
        self._level = 0
        self._period_ns = 0  # 0: no PWM
        self._wrap_ns = 0
        self._fall_ns = -1  # when the pulse under way ends, -1 if it does not
        self._width_ns = 0
        self._clears = False

    def attach(self, at_us: int, phase: _Phase, clears: bool) -> None:
        self.pwm = True
        self.phase = phase
        self.log_us.append(at_us)
        self.log.append(_ATTACH - len(self._attached))
        self._attached.append((phase, clears))

    def end(self, at_us: int) -> None:
        self.log_us.append(at_us)
        self.log.append(_END)

    def drive(self, at_us: int, level: int) -> None:
        self.pwm = False
        self.log_us.append(at_us)
        self.log.append(_HIGH if level else _LOW)

    def drive_log(self) -> Drive:
        if not self.log or min(self.log) >= 0:
            return Drive(self.log_us[:], self.log[:])
        written = [place for place, value in enumerate(self.log) if value >= 0]
        return Drive(array("q", [self.log_us[n] for n in written]), array("q", [self.log[n] for n in written]))

    def forget(self, end_us: int) -> None:
        self.edges_until(end_us)
        del self.log_us[:], self.log[:], self._attached[:]
        self._done = 0

    def edges_until(self, end_us: int) -> list[tuple[int, int]]:
        """Let time pass; return the list of all edges that are remembered."""
        for place in range(self._done, len(self.log)):
            at_ns = self.log_us[place] * 1000
            self._advance(at_ns)
            entry = self.log[place]
            if entry >= 0 and self._clears:
                self._clears = False
            elif entry >= 0:
                self._width_ns = entry * 1000 + (1 << Q18_BITS >> 1) >> Q18_BITS
            elif entry == _END:
                self._width_ns = 0
            elif entry > _ATTACH:
                self._period_ns = 0
                self._turn(at_ns, 1 if entry == _HIGH else 0)
            else:
                phase, self._clears = self._attached[_ATTACH - entry]
                self._period_ns = phase.period_ns
                self._wrap_ns = at_ns + 1 + (phase.wrap_ns - at_ns - 1) % phase.period_ns
                self._width_ns = 0
                self._fall_ns = -1
                self._turn(at_ns, 0)
        self._done = len(self.log)
        self._advance(end_us * 1000)
        return self._edges

    def _advance(self, end_ns: int) -> None:
        """Turn the periods up to and with an instant into edges."""
        if not self._period_ns:
            return
        while True:
            if 0 <= self._fall_ns <= end_ns and self._fall_ns < self._wrap_ns:
                self._turn(self._fall_ns, 0)
                self._fall_ns = -1
            if self._wrap_ns > end_ns:
                return
            self._turn(self._wrap_ns, 1 if self._width_ns else 0)
            self._fall_ns = self._wrap_ns + self._width_ns if 0 < self._width_ns < self._period_ns else -1
            self._wrap_ns += self._period_ns

    def _turn(self, at_ns: int, level: int) -> None:
        if level != self._level:
            self._level = level
            self._edges.append((at_ns, level))
