"""The PC as an emulated MCU: MicroPython's unix port runs the firmware's sources in virtual time.

    with UnixMcu(bits=32) as mcu:
        mcu.send(b"...")
        mcu.run_for(100_000)
        print(mcu.receive())

Computing takes no time here unless `block` says so. The pins follow the model of `pwm.py`, devices on the I2C buses those in
files of their own; `unix_process.py` runs the firmware. Nothing runs before virtual time does.
"""

from __future__ import annotations

import hashlib
import struct
import tempfile
from pathlib import Path

from marotte.images import unix_binary
from marotte.mcu import unix_process as unix
from marotte.mcu.base import VirtualMcu, VirtualPca9685
from marotte.mcu.pca9685 import CHANNELS, Pca9685Chip
from marotte.mcu.pwm import Drive, Pins

MAX_STRETCH_US = 1 << 28
PINS = range(30)
ANALOG_PINS = range(26, 29)
I2C_BUSES = range(2)
I2C_ADDRESSES = range(0x08, 0x78)
_GENERAL_CALL = 0
_UNDRIVEN = 2
_STEPS = 4096  # of an analogue input


class UnixMcu(VirtualMcu):
    """MicroPython's unix port with the firmware of this checkout.

    Its words have 64 or 32 `bits`; `binary` names another `micropython` than the one that is built for them.
    `folder` is its working directory, which stands in for the flash; default is an empty one that goes with the MCU.
    `program` is a script to run instead of the firmware's `unix_main.py`, with the same arguments.
    Raises MarotteError if there is no binary, and later if the firmware fails.
    """

    def __init__(
        self, bits: int = 64, binary: Path | None = None, folder: Path | None = None, program: Path | None = None
    ):
        self.kind = "unix" if bits == 64 else "unix32"
        self._binary = Path(binary) if binary else unix_binary(bits)
        self._program = [str(program)] if program else ["-m", "firmware.unix_main"]
        self._ram = tempfile.TemporaryDirectory(prefix="marotte-")  # for what a reset leaves
        self._flash = tempfile.TemporaryDirectory(prefix="marotte-") if folder is None else None
        self._folder = str(folder) if self._flash is None else self._flash.name
        self._now_us = 0
        self._resets = 0
        self._waiting: list[tuple[int, int, bytes]] = []
        self._inputs: dict[tuple[int, bytes], bytes] = {}
        self._outside: dict[int, int | None] = {}  # levels at pins from outside
        self._driven: dict[int, int] = {}  # those that the MCU gives them
        self._sent: list[tuple[int, bytes]] = []
        self._pins = Pins()
        self._devices: list[UnixPca9685] = []
        self._stuck: set[int] = set()
        self._process = self._start()

    @property
    def now_us(self) -> int:
        return self._now_us

    def send(self, data: bytes, at_us: int | None = None) -> None:
        at_us = self._now_us if at_us is None else at_us
        if at_us < self._now_us:
            raise ValueError(f"{at_us} us has passed, it is {self._now_us} us")
        for start in range(0, len(data), unix.ARRIVAL_MAX):
            self._arrive(at_us, unix.BYTES, bytes(data[start : start + unix.ARRIVAL_MAX]))

    def run_until(self, t_us: int) -> None:
        while self._now_us < t_us:
            self._run(min(t_us - self._now_us, MAX_STRETCH_US))

    def receive(self) -> list[tuple[int, bytes]]:
        sent, self._sent = self._sent, []
        return sent

    def edges(self, pin: int) -> list[tuple[int, int]]:
        return self._pins.edges(pin, self._now_us)

    def clear_edges(self) -> None:
        self._pins.clear_edges(self._now_us)
        for device in self._devices:
            device.chip.clear_edges(self._now_us)

    def drives(self) -> dict[int, Drive]:
        """Return what was written to each PWM pin, in `pulse_q18us`, since power on or `clear_drives`."""
        return self._pins.drives()

    def clear_drives(self) -> None:
        """Forget what was written so far. It takes room: some 16 bytes for each output and motor tick."""
        self._pins.clear_drives(self._now_us)

    def set_pin(self, pin: int, level: int | None) -> None:
        if pin not in PINS:
            raise ValueError(f"pin must be {PINS[0]} to {PINS[-1]}, not {pin!r}")
        if level not in (0, 1, None):
            raise ValueError(f"level must be 0, 1 or None, not {level!r}")
        self._set(unix.LEVEL, bytes([pin]), bytes([_UNDRIVEN if level is None else level]))
        self._outside[pin] = level
        self._level_changed(self._now_us, pin)

    def set_adc(self, pin: int, ratio: float) -> None:
        if pin not in ANALOG_PINS:
            raise ValueError(f"pin must be {ANALOG_PINS[0]} to {ANALOG_PINS[-1]}, not {pin!r}")
        if not 0 <= ratio <= 1:
            raise ValueError(f"ratio must be 0 to 1, not {ratio!r}")
        self._set(unix.ANALOG, bytes([pin]), min(int(ratio * _STEPS), _STEPS - 1).to_bytes(2, "little"))

    def add_pca9685(
        self, bus: int, address: int, oe_pin: int | None = None, clock_hz: float = 25_000_000
    ) -> UnixPca9685:
        """See `VirtualMcu.add_pca9685`. Bus 1 is where SDA is pin 2, 6, 10 .., as on a Pico. All-call is not answered."""
        if bus not in I2C_BUSES:
            raise ValueError(f"bus must be 0 or 1, not {bus!r}")
        if address not in I2C_ADDRESSES:
            raise ValueError(f"address must be {I2C_ADDRESSES[0]:#04x} to {I2C_ADDRESSES[-1]:#04x}, not {address:#04x}")
        if oe_pin is not None and oe_pin not in PINS:
            raise ValueError(f"oe_pin must be {PINS[0]} to {PINS[-1]} or None, not {oe_pin!r}")
        if clock_hz <= 0:
            raise ValueError(f"clock_hz must be more than 0, not {clock_hz!r}")
        device = UnixPca9685(self, bus, address, oe_pin, Pca9685Chip(clock_hz))
        self._devices.append(device)
        if oe_pin is not None:
            self._level_changed(self._now_us, oe_pin)
        self._tell_presence(bus)
        return device

    def set_i2c_stuck(self, bus: int, stuck: bool) -> None:
        if bus not in I2C_BUSES:
            raise ValueError(f"bus must be 0 or 1, not {bus!r}")
        (self._stuck.add if stuck else self._stuck.discard)(bus)
        self._tell_presence(bus)

    def block(self, duration_us: int) -> None:
        """Let the main loop be busy for so long from the next instant on at which it has waited for a frame."""
        self._arrive(self._now_us, unix.BLOCK, struct.pack("<I", duration_us))

    def reset(self) -> None:
        """Reset the MCU now, as its watchdog would: the firmware begins anew, what stands in flash and kept RAM stays."""
        self._process.close()
        self._restart()

    def report(self) -> dict:
        return {
            "kind": self.kind,
            "now_us": self._now_us,
            "image": str(self._binary),
            "image_sha256": hashlib.sha256(self._binary.read_bytes()).hexdigest(),
            "resets": self._resets,
        }

    def close(self) -> None:
        self._process.close()
        self._ram.cleanup()
        if self._flash:
            self._flash.cleanup()

    def _start(self) -> unix.UnixProcess:
        kept = Path(self._ram.name) / "kept"
        return unix.UnixProcess(self._binary, self._program, self._folder, kept, self._resets)

    def _restart(self) -> None:
        """Start the firmware anew; the world around it stays."""
        self._resets += 1
        self._pins.reset(self._now_us)
        self._driven.clear()
        for device in self._devices:
            if device.oe_pin is not None:
                self._level_changed(self._now_us, device.oe_pin)
        self._waiting[:0] = [(self._now_us, kind, which + value) for (kind, which), value in self._inputs.items()]
        self._process = self._start()

    def _set(self, kind: int, which: bytes, value: bytes) -> None:
        """Set an input, which a reset of the MCU leaves as it is."""
        self._inputs[kind, which] = value
        self._arrive(self._now_us, kind, which + value)

    def _arrive(self, at_us: int, kind: int, data: bytes) -> None:
        place = len(self._waiting)
        while place and self._waiting[place - 1][0] > at_us:
            place -= 1
        self._waiting.insert(place, (at_us, kind, data))

    def _tell_presence(self, bus: int) -> None:
        """Tell the board who answers on a bus."""
        there: dict[int, bool] = {}
        for device in self._devices:
            if device.bus == bus:
                answers = device.chip.powered and bus not in self._stuck
                for address in (device.address, _GENERAL_CALL):
                    there[address] = there.get(address, False) or answers
        for address, answers in there.items():
            self._set(unix.DEVICE, bytes([bus, address]), bytes([answers]))

    def _level_changed(self, at_us: int, pin: int) -> None:
        """Tell devices the level at a pin, which is the MCU's if it drives it."""
        for device in self._devices:
            if device.oe_pin == pin:
                level = self._driven.get(pin)
                device.chip.set_disabled(at_us, bool(self._outside.get(pin) if level is None else level))

    def _run(self, length_us: int) -> None:
        start_us = self._now_us
        end_us = start_us + length_us
        count = 0
        while count < len(self._waiting) and self._waiting[count][0] <= end_us:
            count += 1
        arrivals = self._waiting[:count]
        del self._waiting[:count]
        self._process.begin(length_us, [(at_us - start_us, kind, data) for at_us, kind, data in arrivals])
        write = self._pins.write
        kind = at_us = -1
        for kind, offset_us, data in self._process.records():
            at_us = start_us + offset_us
            if kind == unix.WRITTEN:
                write(at_us, data)
            else:
                self._take(kind, at_us, data)
        self._now_us = at_us
        if kind == unix.RESET:
            self._process.close()
            self._waiting[:0] = [arrival for arrival in arrivals if arrival[0] >= at_us]
            self._restart()

    def _take(self, kind: int, at_us: int, data: bytes) -> None:
        if kind in (unix.SENT, unix.DONE, unix.RESET):
            printed = self._process.printed()
            self._sent += [(at_us, part) for part in (printed, data) if part]
        elif kind == unix.ATTACHED:
            self._pins.attach(at_us, *struct.unpack("<BII", data))
        elif kind == unix.ENDED:
            self._pins.end(at_us, data[0])
        elif kind in (unix.DRIVEN, unix.LET_GO):
            pin, level = data if kind == unix.DRIVEN else (data[0], None)
            self._pins.drive(at_us, pin, level or 0)
            self._driven.pop(pin, None)
            if level is not None:
                self._driven[pin] = level
            self._level_changed(at_us, pin)
        elif kind == unix.QUIET:
            self._pins.quiet(at_us)
        elif kind == unix.I2C:
            for device in self._devices:
                if device.bus == data[0]:
                    device.hear(at_us, data[1], data[2:])


class UnixPca9685(VirtualPca9685):
    """A PCA9685 on a bus of a `UnixMcu`."""

    def __init__(self, mcu: UnixMcu, bus: int, address: int, oe_pin: int | None, chip: Pca9685Chip):
        self.bus = bus
        self.address = address
        self.oe_pin = oe_pin
        self.chip = chip
        self._mcu = mcu

    def edges(self, channel: int) -> list[tuple[int, int]]:
        if not 0 <= channel < CHANNELS:
            raise ValueError(f"channel must be 0 to {CHANNELS - 1}, not {channel!r}")
        return self.chip.edges(self._mcu.now_us, channel)

    def registers(self) -> bytes:
        return self.chip.registers()

    def remove(self) -> None:
        self.chip.set_power(self._mcu.now_us, False)
        self._mcu._tell_presence(self.bus)

    def put_back(self) -> None:
        self.chip.set_power(self._mcu.now_us, True)
        self._mcu._tell_presence(self.bus)

    def hear(self, at_us: int, address: int, data: bytes) -> None:
        """Take a transfer on the bus, to whomever."""
        if self.chip.powered and address == self.address:
            self.chip.write(at_us, data)
        elif self.chip.powered and address == _GENERAL_CALL:
            self.chip.general_call(at_us, data)
