"""The PC as an emulated MCU: MicroPython's unix port runs the firmware's sources in virtual time.

    with UnixMcu(bits=32) as mcu:
        mcu.send(b"...")
        mcu.run_for(100_000)
        print(mcu.receive())

Computing takes no time here unless `block` says so. The pins follow the model of `pwm.py`. What goes to and fro between
this process and the board is described in `firmware/board_unix.py`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import struct
import subprocess
import tempfile
from pathlib import Path

from marotte.errors import MarotteError
from marotte.images import unix_binary
from marotte.mcu.base import VirtualMcu
from marotte.mcu.pca9685 import Pca9685Chip
from marotte.mcu.pwm import Drive, Pins

ROOT = Path(__file__).resolve().parents[3]
MAX_STRETCH_US = 1 << 28
ANSWER_TIMEOUT_S = 300.0
"""Longest time for an answer: a stretch of virtual time of 268 s has 16000 frames at most."""

HEAP_BYTES = 16 << 20
STDERR_TAIL_LINES = 20
_RECORD = struct.Struct("<BIH")
_SENT, _ATTACHED, _WRITTEN, _DRIVEN, _LET_GO, _QUIET, _I2C, _RESET, _DONE = b"SAPLZQIWD"
_ARRIVAL = struct.Struct("<IBH")
_ARRIVAL_MAX = 0xFFFF
_BYTES, _LEVEL, _ANALOG, _DEVICE, _BLOCK = range(5)
_UNDRIVEN = 2
_GENERAL_CALL = 0


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
        self._flash = tempfile.TemporaryDirectory(prefix="marotte-") if folder is None else None
        self._folder = str(folder) if self._flash is None else self._flash.name
        self._ram = tempfile.TemporaryDirectory(prefix="marotte-")
        self._now_us = 0
        self._resets = 0
        self._waiting: list[tuple[int, int, bytes]] = []
        self._inputs: dict[tuple[int, bytes], bytes] = {}
        self._outside: dict[int, int | None] = {}  # levels at pins from outside
        self._driven: dict[int, int] = {}  # those that the MCU gives them
        self._sent: list[tuple[int, bytes]] = []
        self._pins = Pins()
        self._devices: list[UnixPca9685] = []
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._commands = self._records = -1
        self._process: subprocess.Popen[bytes] | None = None
        self._start()

    @property
    def now_us(self) -> int:
        return self._now_us

    def send(self, data: bytes, at_us: int | None = None) -> None:
        at_us = self._now_us if at_us is None else at_us
        if at_us < self._now_us:
            raise ValueError(f"{at_us} us has passed, it is {self._now_us} us")
        for start in range(0, len(data), _ARRIVAL_MAX):
            self._arrive(at_us, _BYTES, bytes(data[start : start + _ARRIVAL_MAX]))

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
        self._set(_LEVEL, bytes([pin]), bytes([_UNDRIVEN if level is None else level]))
        self._outside[pin] = level
        self._level_changed(self._now_us, pin)

    def set_adc(self, pin: int, ratio: float) -> None:
        """Set the voltage at an analogue input, as a part of the supply, from now on."""
        self._set(_ANALOG, bytes([pin]), min(int(ratio * 4096), 4095).to_bytes(2, "little"))

    def add_pca9685(
        self, bus: int, address: int = 0x40, oe_pin: int | None = None, clock_hz: float = 25e6
    ) -> UnixPca9685:
        """Connect a PCA9685 to I2C bus 0 or 1, its OE to a pin; OE is low where nobody drives it."""
        device = UnixPca9685(self, bus, address, oe_pin, Pca9685Chip(clock_hz))
        self._devices.append(device)
        if oe_pin is not None:
            self._level_changed(self._now_us, oe_pin)
        self._tell_presence(device)
        return device

    def block(self, duration_us: int) -> None:
        """Let the main loop be busy for so long from the next instant on at which it has waited for a frame."""
        self._arrive(self._now_us, _BLOCK, struct.pack("<I", duration_us))

    def reset(self) -> None:
        """Reset the MCU now, as its watchdog would: the firmware begins anew, what stands in flash and kept RAM stays."""
        self._stop()
        self._restart()

    def report(self) -> dict:
        return {
            "kind": self.kind,
            "now_us": self._now_us,
            "image": str(self._binary),
            "image_sha256": hashlib.sha256(self._binary.read_bytes()).hexdigest(),
        }

    def close(self) -> None:
        self._stop()
        self._errors.close()
        self._ram.cleanup()
        if self._flash:
            self._flash.cleanup()

    def _tell_presence(self, device: UnixPca9685) -> None:
        """Tell the board who answers on the device's bus."""
        on_bus = [other for other in self._devices if other.bus == device.bus]
        for address in (device.address, _GENERAL_CALL):
            powered = any(other.chip.powered for other in on_bus if address in (other.address, _GENERAL_CALL))
            self._set(_DEVICE, bytes([device.bus, address]), bytes([powered]))

    def _level_changed(self, at_us: int, pin: int) -> None:
        """Tell devices the level at a pin, which is the MCU's if it drives it."""
        for device in self._devices:
            if device.oe_pin == pin:
                level = self._driven.get(pin)
                device.chip.set_disabled(at_us, bool(self._outside.get(pin) if level is None else level))

    def _start(self) -> None:
        """Start a process, and let it run up to the beginning of its time."""
        command_read, self._commands = os.pipe()
        self._records, record_write = os.pipe()
        words = [str(self._binary), "-X", f"heapsize={HEAP_BYTES}", *self._program]
        words += [f"/dev/fd/{command_read}", f"/dev/fd/{record_write}"]
        words += [str(Path(self._ram.name) / "kept"), str(self._resets)]
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                pass_fds=(command_read, record_write),
                cwd=self._folder,
                env={**os.environ, "MICROPYPATH": str(ROOT)},
                start_new_session=True,  # Ctrl-C is for us: we still have a puppet to stop
            )
        except OSError as error:
            raise MarotteError(f"{self._binary}: cannot be started: {error.strerror}") from error
        finally:
            os.close(command_read)
            os.close(record_write)
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._buffer = b""
        self._read_records(self._now_us)

    def _stop(self) -> None:
        """End the process; doing it twice does no harm."""
        if self._process:
            self._process.kill()
            self._process.wait()
            if self._process.stdout:
                self._process.stdout.close()
        self._process = None
        for descriptor in (self._commands, self._records):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._commands = self._records = -1

    def _restart(self) -> None:
        """Start the firmware anew; the world around it stays."""
        self._resets += 1
        self._pins.reset(self._now_us)
        self._driven.clear()
        for device in self._devices:
            if device.oe_pin is not None:
                self._level_changed(self._now_us, device.oe_pin)
        self._waiting[:0] = [(self._now_us, kind, which + value) for (kind, which), value in self._inputs.items()]
        self._start()

    def _set(self, kind: int, which: bytes, value: bytes) -> None:
        """Set an input, which a reset of the MCU leaves as it is."""
        self._inputs[kind, which] = value
        self._arrive(self._now_us, kind, which + value)

    def _arrive(self, at_us: int, kind: int, data: bytes) -> None:
        place = len(self._waiting)
        while place and self._waiting[place - 1][0] > at_us:
            place -= 1
        self._waiting.insert(place, (at_us, kind, data))

    def _run(self, length_us: int) -> None:
        start_us = self._now_us
        end_us = start_us + length_us
        taken = 0
        while taken < len(self._waiting) and self._waiting[taken][0] <= end_us:
            taken += 1
        arrivals = self._waiting[:taken]
        del self._waiting[:taken]
        body = b"".join(_ARRIVAL.pack(at_us - start_us, kind, len(data)) + data for at_us, kind, data in arrivals)
        try:
            _write_all(self._commands, struct.pack("<II", length_us, len(body)) + body)
        except OSError:
            raise self._failed("it has ended") from None
        self._now_us = self._read_records(start_us)
        if self._now_us < end_us or self._process is None:
            self._waiting[:0] = [arrival for arrival in arrivals if arrival[0] >= self._now_us]
            self._restart()

    def _read_records(self, start_us: int) -> int:
        """Read records of a stretch up to its end, or to a reset, and what was printed in it; return when that was.

        After a reset there is no process.
        """
        place = 0
        while True:
            buffer = self._buffer
            while len(buffer) - place >= _RECORD.size:
                kind, offset_us, count = _RECORD.unpack_from(buffer, place)
                data_at = place + _RECORD.size
                if len(buffer) - data_at < count:
                    break
                place = data_at + count
                at_us = start_us + offset_us
                if kind == _WRITTEN:
                    self._pins.write(at_us, buffer, data_at, place)
                elif kind in (_DONE, _RESET):
                    self._buffer = buffer[place:]
                    self._read_printed(at_us)
                    if kind == _RESET:
                        self._stop()
                    return at_us
                else:
                    self._take(kind, at_us, buffer[data_at:place])
            self._buffer = buffer[place:] + self._read_some()
            place = 0

    def _take(self, kind: int, at_us: int, data: bytes) -> None:
        if kind == _SENT:
            self._read_printed(at_us)
            self._sent.append((at_us, data))
        elif kind == _ATTACHED:
            self._pins.attach(at_us, *struct.unpack("<BII", data))
        elif kind == _DRIVEN:
            self._pins.drive(at_us, data[0], data[1])
            self._driven[data[0]] = data[1]
            self._level_changed(at_us, data[0])
        elif kind == _LET_GO:
            self._pins.drive(at_us, data[0], 0)
            self._driven.pop(data[0], None)
            self._level_changed(at_us, data[0])
        elif kind == _I2C:
            for device in self._devices:
                if device.bus == data[0] and device.chip.powered:
                    device.hear(at_us, data[1], data[2:])
        elif kind == _QUIET:
            self._pins.quiet(at_us)

    def _read_printed(self, at_us: int) -> None:
        assert self._process and self._process.stdout
        printed = self._process.stdout.read()
        if printed:
            self._sent.append((at_us, printed))

    def _read_some(self) -> bytes:
        ready, _, _ = select.select([self._records], [], [], ANSWER_TIMEOUT_S)
        if not ready:
            raise self._failed(f"it has not answered for {ANSWER_TIMEOUT_S:.0f} s")
        data = os.read(self._records, 1 << 16)
        if not data:
            raise self._failed("it has ended")
        return data

    def _failed(self, what: str) -> MarotteError:
        self._stop()
        self._errors.seek(0)
        tail = self._errors.read().decode(errors="replace").splitlines()[-STDERR_TAIL_LINES:]
        return MarotteError(
            "\n".join([f"the firmware on {self._binary} failed: {what}", *(f"    {line}" for line in tail)])
        )


class UnixPca9685:
    """A PCA9685 that `UnixMcu.add_pca9685` has connected."""

    def __init__(self, mcu: UnixMcu, bus: int, address: int, oe_pin: int | None, chip: Pca9685Chip):
        self.bus = bus
        self.address = address
        self.oe_pin = oe_pin
        self.chip = chip
        self._mcu = mcu

    def edges(self, channel: int) -> list[tuple[int, int]]:
        """Changes of the level at an output since power on or `clear_edges` of the MCU, as `UnixMcu.edges` has them."""
        return self.chip.edges(self._mcu.now_us, channel)

    def remove(self) -> None:
        """Pull the chip out: it no longer answers, and its outputs are low."""
        self.chip.set_power(self._mcu.now_us, False)
        self._mcu._tell_presence(self)

    def put_back(self) -> None:
        """Plug it in again, as it is after power on."""
        self.chip.set_power(self._mcu.now_us, True)
        self._mcu._tell_presence(self)

    def hear(self, at_us: int, address: int, data: bytes) -> None:
        """Take a transfer on the bus, to whomever."""
        if address == self.address:
            self.chip.write(at_us, data)
        elif address == _GENERAL_CALL:
            self.chip.general_call(at_us, data)


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
