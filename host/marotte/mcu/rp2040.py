"""The emulated RP2040 in virtual time: `Rp2040Mcu` drives a Node process that runs `emulator/main.mjs`."""

from __future__ import annotations

import base64
import hashlib
import os
import stat
from pathlib import Path

from marotte.errors import MarotteError
from marotte.mcu import rp2040_parts
from marotte.mcu.base import VirtualMcu, VirtualPca9685
from marotte.mcu.emulator_process import EmulatorProcess

LINKS = ("usb", "uart")
PIN_COUNT = 30
ANALOG_PINS = range(26, 29)
I2C_BUSES = range(2)
I2C_ADDRESSES = range(0x08, 0x78)

RUN_PIECE_US = 1_000_000
"""Longest stretch of virtual time in one request, so that Ctrl-C and a dead emulator are noticed soon."""


class Rp2040Pca9685(VirtualPca9685):
    """A PCA9685 on the emulated RP2040's I2C bus (`emulator/pca9685.mjs`)."""

    def __init__(self, process: EmulatorProcess, device: int):
        self._process = process
        self._device = device

    def edges(self, channel: int) -> list[tuple[int, int]]:
        if not 0 <= channel < 16:
            raise ValueError(f"channel must be 0 to 15, not {channel!r}")
        return _pairs(self._process.ask(op="device_edges", device=self._device, channel=channel)["edges"])

    def registers(self) -> bytes:
        return bytes(self._process.ask(op="device_registers", device=self._device)["registers"])

    def remove(self) -> None:
        self._process.ask(op="device_present", device=self._device, present=False)

    def put_back(self) -> None:
        self._process.ask(op="device_present", device=self._device, present=True)


class Rp2040Mcu(VirtualMcu):
    """A Raspberry Pi Pico without a board: the real image, run instruction by instruction.

    `image` is a UF2 file (default: our own image, built on first use). `link` says which line `send` and `receive` mean:
    `"usb"`, the serial port over USB, or `"uart"`, UART0. `flash` names a file of 2 MiB that keeps the flash's contents from run
    to run: it is read at the start if it exists, overlaid with the image, and written by `close`. `core` is `"compiled"` or
    `"js"`, the slow interpreter of rp2040js. With `timed_flash` false, erasing and programming take no time.

    Raises MarotteError if `flash` can be no file, if the emulator cannot be put together or started, or fails on the way.
    """

    kind = "rp2040"

    def __init__(
        self,
        image: Path | str | None = None,
        link: str = "usb",
        flash: Path | str | None = None,
        *,
        core: str = "compiled",
        timed_flash: bool = True,
    ):
        if core not in ("compiled", "js"):
            raise ValueError(f'core must be "compiled" or "js", not {core!r}')
        self.link = _checked_link(link)
        self._flash = None if flash is None else _checked_flash(flash)
        self._image = _checked_image(image)
        self._image_sha256 = hashlib.sha256(self._image.read_bytes()).hexdigest()
        self._now_us = 0
        self._next_us: int | None = 0
        self._to_send: list[tuple[int, str, str]] = []
        self._received: dict[str, list[tuple[int, bytes]]] = {name: [] for name in LINKS}
        words: list[str | Path] = ["--image", self._image, "--bootrom", rp2040_parts.boot_rom()]
        words += ["--core", "js" if core == "js" else rp2040_parts.cpu_core()]
        if self._flash is not None:
            words += ["--flash", self._flash]
        if not timed_flash:
            words.append("--untimed-flash")
        rp2040_parts.node_packages()
        self._process = EmulatorProcess([rp2040_parts.node(), rp2040_parts.EMULATOR / "main.mjs", *words])

    @property
    def now_us(self) -> int:
        return self._now_us

    @property
    def next_action_us(self) -> int | None:
        """When the chip acts next if nothing comes from outside: now if it computes, None if it sleeps for good."""
        if self._to_send:
            return self._now_us
        return self._next_us

    def send(self, data: bytes, at_us: int | None = None, link: str | None = None) -> None:
        """Let `data` reach the chip; see `VirtualMcu.send`. `link` is another line than that of this object.

        Over USB, bytes wait on the PC until the firmware takes them. Over the UART they follow each other at the rate that
        the firmware has set, and are lost, as on a wire, if it has set none or lets its receiver overflow.
        """
        at = self._now_us if at_us is None else at_us
        if at < self._now_us:
            raise ValueError(f"at_us={at} has passed: it is {self._now_us} us")
        line = self.link if link is None else _checked_link(link)
        if data:
            self._to_send.append((at * 1000, line, base64.b64encode(data).decode()))

    def run_until(self, t_us: int) -> None:
        while self._now_us < t_us:
            piece_end_us = min(t_us, self._now_us + RUN_PIECE_US)
            answer = self._process.ask(op="run", until=piece_end_us * 1000, send=self._to_send)
            self._to_send = []
            self._now_us = piece_end_us
            self._next_us = None if answer["next"] is None else answer["next"] // 1000
            for t_ns, line, data in answer["out"]:
                self._received[line].append((t_ns // 1000, base64.b64decode(data)))

    def receive(self, link: str | None = None) -> list[tuple[int, bytes]]:
        """What the chip has sent; see `VirtualMcu.receive`. The instant is that of a USB packet's or UART character's end."""
        line = self.link if link is None else _checked_link(link)
        received = self._received[line]
        self._received[line] = []
        return received

    def edges(self, pin: int) -> list[tuple[int, int]]:
        """Changes of what the chip drives at `pin` (0 to 29); a pin that is let go of counts as level 0."""
        return _pairs(self._process.ask(op="edges", pin=_checked_pin(pin))["edges"])

    def clear_edges(self) -> None:
        self._process.ask(op="clear_edges")

    def set_pin(self, pin: int, level: int | None) -> None:
        if level not in (0, 1, None):
            raise ValueError(f"level must be 0, 1 or None, not {level!r}")
        self._process.ask(op="pin", pin=_checked_pin(pin), level=level)

    def set_adc(self, pin: int, ratio: float) -> None:
        if pin not in ANALOG_PINS:
            raise ValueError(f"pin must be {ANALOG_PINS[0]} to {ANALOG_PINS[-1]}, not {pin!r}")
        if not 0 <= ratio <= 1:
            raise ValueError(f"ratio must be 0 to 1, not {ratio!r}")
        self._process.ask(op="adc", pin=pin, ratio=ratio)

    def add_pca9685(
        self, bus: int, address: int, oe_pin: int | None = None, clock_hz: float = 25_000_000
    ) -> Rp2040Pca9685:
        """See `VirtualMcu.add_pca9685`. The bus lies at the pins that the firmware gives to the I2C controller."""
        if address not in I2C_ADDRESSES:
            raise ValueError(f"address must be {I2C_ADDRESSES[0]:#04x} to {I2C_ADDRESSES[-1]:#04x}, not {address:#04x}")
        if clock_hz <= 0:
            raise ValueError(f"clock_hz must be more than 0, not {clock_hz!r}")
        pin = None if oe_pin is None else _checked_pin(oe_pin)
        answer = self._process.ask(
            op="add_pca9685", bus=_checked_bus(bus), address=address, oe_pin=pin, clock_hz=clock_hz
        )
        return Rp2040Pca9685(self._process, answer["device"])

    def set_i2c_stuck(self, bus: int, stuck: bool) -> None:
        self._process.ask(op="i2c_stuck", bus=_checked_bus(bus), stuck=bool(stuck))

    def set_host_reading(self, reading: bool) -> None:
        """Whether the PC takes what the chip sends over USB; while it does not, the chip's buffers fill up."""
        self._process.ask(op="host_reading", reading=bool(reading))

    def report(self) -> dict:
        """See `VirtualMcu.report`; besides those: `instructions`, `cycles` (asleep or not), `clk_hz`, `resets`,
        `flash_erases`, `flash_programs` (pages), `uart_lost` (characters that came when the UART could not take them).
        """
        facts = {
            "kind": self.kind,
            "now_us": self._now_us,
            "image": str(self._image),
            "image_sha256": self._image_sha256,
        }
        return facts | self._process.ask(op="report")

    def state(self) -> dict:
        """The CPU's registers and a hash of the RAM, for comparing two runs."""
        return self._process.ask(op="state")

    def save_flash(self, path: Path | str) -> None:
        """Write the flash's contents to a file."""
        self._process.ask(op="save_flash", path=str(path))

    def close(self) -> None:
        if self._flash is not None and self._process.alive:
            self.save_flash(self._flash)
        self._process.close()


def _checked_link(link: str) -> str:
    if link not in LINKS:
        raise ValueError(f"link must be one of {', '.join(LINKS)}, not {link!r}")
    return link


def _checked_pin(pin: int) -> int:
    if not 0 <= pin < PIN_COUNT:
        raise ValueError(f"pin must be 0 to {PIN_COUNT - 1}, not {pin!r}")
    return pin


def _checked_bus(bus: int) -> int:
    if bus not in I2C_BUSES:
        raise ValueError(f"bus must be 0 or 1, not {bus!r}")
    return bus


def _pairs(flat: list[int]) -> list[tuple[int, int]]:
    return list(zip(flat[0::2], flat[1::2], strict=True))


def _checked_image(image: Path | str | None) -> Path:
    if image is None:
        from marotte.images import rp2040_image

        return rp2040_image().path
    if not Path(image).is_file():
        raise MarotteError(f"{image}: no such image: expected a UF2 file")
    return Path(image)


def _checked_flash(flash: Path | str) -> Path:
    """Return the path of a file that can be read now, if it exists, and written at the end."""
    path = Path(flash)
    reason = None
    try:
        if stat.S_ISREG(path.stat().st_mode) or path.is_dir():
            path.open("r+b").close()
        else:
            reason = "is no file"
    except FileNotFoundError as error:
        if not path.parent.is_dir():
            reason = _reason(error)
        elif not os.access(path.parent, os.W_OK | os.X_OK):
            reason = "permission denied"
    except OSError as error:
        reason = _reason(error)
    if reason:
        raise MarotteError(f"{path}: cannot keep the flash: {reason}")
    return path


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
