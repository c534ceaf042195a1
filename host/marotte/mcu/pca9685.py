"""A model of the PCA9685, an I2C chip with sixteen PWM outputs of 12 bits (NXP, "PCA9685", Rev. 4, 16 April 2015).

Nothing here happens by itself: whenever somebody looks or something changes, `_catch_up` works out the edges since the last
time. They lie on the counts of the chip's own clock, which the 4096 counts of a cycle and the prescaler divide.
The emulated RP2040 has the same model, in `emulator/pca9685.mjs`.
"""

from __future__ import annotations

from collections.abc import Iterable

CHANNELS = 16
CYCLE_COUNTS = 4096
WAKE_NS = 500_000
"""The oscillator is up at most 500 us after SLEEP is cleared (section 7.3.1)."""

_MODE1, _MODE2, _ALLCALLADR, _LED0 = 0, 1, 5, 6
_LED_END = _LED0 + 4 * CHANNELS
_ALL_LED, _PRESCALE = 0xFA, 0xFE
_LEAST_PRESCALE = 3
_RESTART, _AUTO_INCREMENT, _SLEEP, _ALLCALL = 0x80, 0x20, 0x10, 0x01
_INVERT, _ON_ACK, _OFF_LEVEL = 0x10, 0x08, 0x03
_FULL = 0x1000
"""Bit 4 of the high byte: full on, full off."""

_SOFTWARE_RESET = 0x06
_ALL_OFF = [(0, _FULL)] * CHANNELS


class Pca9685Chip:
    """One chip. All instants are in microseconds since power on of the MCU, and never run backwards."""

    def __init__(self, clock_hz: float):
        self.powered = True
        self._clock_hz = clock_hz
        self._edges: list[list[tuple[int, int]]] = [[] for _ in range(CHANNELS)]
        self._levels = [0] * CHANNELS
        self._disabled = False  # the level at OE
        self._power_on()

    def set_power(self, at_us: int, powered: bool) -> None:
        """Plug the chip in, as it is after power on, or pull it out."""
        self._catch_up(at_us)
        if powered and not self.powered:
            self._power_on()
        self.powered = powered
        self._show(at_us)

    def set_disabled(self, at_us: int, disabled: bool) -> None:
        """Set the level at OE, which disables the outputs."""
        self._catch_up(at_us)
        self._disabled = disabled
        self._show(at_us)

    def write(self, at_us: int, data: bytes) -> None:
        """Take one whole transfer from the bus: a register's number, then what goes there."""
        self._catch_up(at_us)
        pointer = data[0]
        written: dict[int, int] = {}  # the bits of the registers written per channel, in this transfer
        for byte in data[1:]:
            if not _is_register(pointer):
                break
            self._store(at_us, pointer, byte, written)
            if self._registers[_MODE1] & _AUTO_INCREMENT:
                # After the last LED register comes MODE1, and after PRESCALE too (table 4).
                pointer = 0 if pointer == _LED_END - 1 or pointer >= _PRESCALE else pointer + 1
        if not self._registers[_MODE2] & _ON_ACK:
            self._load(written)

    def general_call(self, at_us: int, data: bytes) -> None:
        """Take a transfer to address 0: the software reset, or nothing."""
        self._catch_up(at_us)
        if data[:1] == bytes([_SOFTWARE_RESET]):
            self._power_on()
            self._show(at_us)

    def edges(self, at_us: int, channel: int) -> list[tuple[int, int]]:
        """Return the edges `(t_ns, level)` of an output up to now, since they were forgotten."""
        self._catch_up(at_us)
        return self._edges[channel]

    def registers(self) -> bytes:
        """Return all 256 registers."""
        return bytes(self._registers)

    def clear_edges(self, at_us: int) -> None:
        """Forget all edges up to now."""
        self._catch_up(at_us)
        self._edges = [[] for _ in range(CHANNELS)]

    # --- time

    def _power_on(self) -> None:
        self._registers = bytearray(256)
        self._registers[:_LED0] = bytes([_SLEEP | _ALLCALL, 0x04, 0xE2, 0xE4, 0xE8, 0xE0])
        self._registers[_LED0 + 3 : _LED_END : 4] = bytes([_FULL >> 8]) * CHANNELS
        self._registers[_PRESCALE] = 0x1E
        self._loaded = _ALL_OFF[:]  # ON and OFF, as a STOP has taken them over
        self._running = _ALL_OFF[:]  # those that the cycle runs with
        self._high = [0] * CHANNELS  # each channel's PWM, before OE and inversion
        self._woken_ns = 0
        self._done = 0  # counts that _catch_up has dealt with

    @property
    def _asleep(self) -> bool:
        return bool(self._registers[_MODE1] & _SLEEP)

    @property
    def _count_ns(self) -> float:
        return (self._registers[_PRESCALE] + 1) * 1e9 / self._clock_hz

    def _catch_up(self, at_us: int) -> None:
        start_ns = self._woken_ns + WAKE_NS
        if self._asleep or at_us * 1000 < start_ns:
            return
        last = int((at_us * 1000 - start_ns) / self._count_ns)
        while self._done <= last:
            cycle = self._done - self._done % CYCLE_COUNTS
            if self._done == cycle:
                # Values taken over by a STOP act from the beginning of the next cycle on (figures 10 and 11).
                self._running = _ALL_OFF[:] if self._registers[_MODE1] & _RESTART else self._loaded[:]
            self._run_cycle(self._done - cycle, min(last - cycle, CYCLE_COUNTS - 1), start_ns + cycle * self._count_ns)
            self._done = min(last, cycle + CYCLE_COUNTS - 1) + 1

    def _run_cycle(self, first: int, last: int, cycle_ns: float) -> None:
        """The counts `first` to `last` of a cycle: an output goes high at its ON count and low at its OFF count, which wins."""
        for channel, (on, off) in enumerate(self._running):
            if off & _FULL:
                changes = [(0, 0)]
            elif on & _FULL:
                changes = [(on & ~_FULL, 1)]
            elif on < off:
                changes = [(on, 1), (off, 0)]
            else:
                changes = [(off, 0), (on, 1)] if off < on else [(off, 0)]
            for count, high in changes:
                if first <= count <= last and high != self._high[channel]:
                    self._high[channel] = high
                    self._show_channel(channel, cycle_ns + count * self._count_ns)

    def _show(self, at_us: int) -> None:
        for channel in range(CHANNELS):
            self._show_channel(channel, at_us * 1000)

    def _show_channel(self, channel: int, at_ns: float) -> None:
        mode2 = self._registers[_MODE2]
        if not self.powered:
            level = 0
        elif self._disabled:
            level = int(mode2 & _OFF_LEVEL == 1)
        else:
            level = self._high[channel] ^ int(mode2 & _INVERT != 0)
        if level != self._levels[channel]:
            self._levels[channel] = level
            self._edges[channel].append((round(at_ns), level))

    # --- registers

    def _store(self, at_us: int, register: int, byte: int, written: dict[int, int]) -> None:
        if _LED0 <= register < _LED_END:
            self._store_led((register - _LED0) // 4, (register - _LED0) % 4, byte, written)
        elif _ALL_LED <= register < _PRESCALE:
            for channel in range(CHANNELS):
                self._store_led(channel, register - _ALL_LED, byte, written)
        elif register == _MODE1:
            self._store_mode1(at_us, byte)
        elif register == _MODE2:
            self._registers[_MODE2] = byte & 0x1F
            self._show(at_us)
        elif register == _PRESCALE:
            if self._asleep:
                self._registers[_PRESCALE] = max(byte, _LEAST_PRESCALE)
        elif register <= _ALLCALLADR:
            self._registers[register] = byte & 0xFE

    def _store_led(self, channel: int, index: int, byte: int, written: dict[int, int]) -> None:
        self._registers[_LED0 + 4 * channel + index] = byte & 0x1F if index % 2 else byte
        written[channel] = written.get(channel, 0) | 1 << index
        if self._registers[_MODE2] & _ON_ACK and written[channel] == 0xF:
            self._load([channel])
            del written[channel]

    def _load(self, channels: Iterable[int]) -> None:
        """Take over the registers of channels. That ends a pause after sleep, too (section 7.3.1.1)."""
        for channel in channels:
            on_low, on_high, off_low, off_high = self._registers[_LED0 + 4 * channel : _LED0 + 4 * channel + 4]
            self._loaded[channel] = on_low | on_high << 8, off_low | off_high << 8
            self._registers[_MODE1] &= ~_RESTART

    def _store_mode1(self, at_us: int, byte: int) -> None:
        was_asleep = self._asleep
        self._registers[_MODE1] = byte & ~_RESTART | self._registers[_MODE1] & _RESTART
        if not was_asleep and self._asleep:
            if any(not off & _FULL for _, off in self._loaded):
                self._registers[_MODE1] |= _RESTART
            self._high = [0] * CHANNELS
            self._show(at_us)
        if was_asleep and not self._asleep:
            self._woken_ns = at_us * 1000
            self._done = 0
        if byte & _RESTART and not self._asleep and at_us * 1000 >= self._woken_ns + WAKE_NS:
            self._registers[_MODE1] &= ~_RESTART


def _is_register(number: int) -> bool:
    """Reserved registers are not acknowledged."""
    return number < _LED_END or number >= _ALL_LED
