"""What every emulated MCU looks like from the host: `VirtualMcu`.

An emulated MCU lives in virtual time. Nothing happens between calls; time passes only inside `run_until`, and a run that is
given the same bytes and levels at the same instants gives the same bytes and edges at the same instants, to the bit.
"""

from abc import ABC, abstractmethod


class VirtualPca9685(ABC):
    """A PCA9685 that has been attached to an emulated MCU's I2C bus (`VirtualMcu.add_pca9685`)."""

    @abstractmethod
    def edges(self, channel: int) -> list[tuple[int, int]]:
        """Changes of the level at output `channel` (0 to 15) since it was attached or `VirtualMcu.clear_edges`: `(t_ns, level)`
        in order. An output that is not driven counts as level 0.
        """

    @abstractmethod
    def registers(self) -> bytes:
        """All 256 registers as they are now, the number of a register being its index; of an absent chip, its last."""

    @abstractmethod
    def remove(self) -> None:
        """Take the chip away from the bus and its supply, now, in the middle of a transfer too: its outputs go low."""

    @abstractmethod
    def put_back(self) -> None:
        """Bring it back, with its registers as after power on: asleep, all outputs off."""


class VirtualMcu(ABC):
    """An emulated MCU in virtual time.

    Times are counted from power on: `*_us` are whole microseconds, `*_ns` whole nanoseconds. Use it as a context manager,
    or call `close`. An emulator that has failed raises `MarotteError` from whichever call meets it first.
    """

    kind: str
    """`"unix"`, `"unix32"` or `"rp2040"`."""

    @property
    @abstractmethod
    def now_us(self) -> int:
        """Virtual time since power on, in microseconds."""

    @property
    def next_action_us(self) -> int | None:
        """When the MCU acts next if nothing comes from outside: `now_us` if it computes (or cannot tell), None if never."""
        return self.now_us

    @abstractmethod
    def send(self, data: bytes, at_us: int | None = None) -> None:
        """Let `data` reach the MCU's link at the instant `at_us` (default: now), after everything sent for earlier instants.

        Bytes sent for one instant arrive in the order of the calls. Raises `ValueError` if `at_us` has passed.
        """

    @abstractmethod
    def run_until(self, t_us: int) -> None:
        """Advance virtual time to `t_us`; an instant that has passed leaves everything as it is."""

    @abstractmethod
    def receive(self) -> list[tuple[int, bytes]]:
        """What the MCU has sent since the last call: `(t_us, data)` in order, `t_us` being the instant it left the MCU."""

    @abstractmethod
    def edges(self, pin: int) -> list[tuple[int, int]]:
        """Changes of the level at output `pin` since power on or `clear_edges`: `(t_ns, level)` in order, level 0 or 1."""

    @abstractmethod
    def clear_edges(self) -> None:
        """Forget the edges seen so far, on all pins."""

    @abstractmethod
    def set_pin(self, pin: int, level: int | None) -> None:
        """Drive input `pin` from outside to `level` (0 or 1) from now on, or let go of it (`None`)."""

    @abstractmethod
    def report(self) -> dict:
        """What this kind of MCU can tell about the run: at least `kind`, `now_us`, `image` (path) and `image_sha256`."""

    @abstractmethod
    def close(self) -> None:
        """End the emulator; calling it twice does no harm."""

    def set_host_reading(self, reading: bool) -> None:  # noqa: B027
        """Whether the host takes what the MCU sends; while it does not, the MCU's buffers fill up. A kind that cannot tell
        the difference ignores it.
        """

    def set_adc(self, pin: int, ratio: float) -> None:
        """Put the analog input `pin` (26 to 28) at `ratio` of the ADC's reference, 0 to 1, from now on; at first it is 0.

        Raises `ValueError` for another pin or ratio, `NotImplementedError` if this kind has no analog inputs.
        """
        raise NotImplementedError(f"the emulated {self.kind} has no analog inputs")

    def add_pca9685(
        self, bus: int, address: int, oe_pin: int | None = None, clock_hz: float = 25_000_000
    ) -> VirtualPca9685:
        """Attach a PCA9685 to I2C bus `bus` (0 or 1) at the 7-bit `address`, from now on, and return it.

        `oe_pin` is the pin that its OE input is connected to (high: outputs off); None ties it low. `clock_hz` is the frequency
        of its own oscillator. Raises `ValueError` if one of them is impossible, `NotImplementedError` if this kind has no I2C.
        """
        raise NotImplementedError(f"the emulated {self.kind} has no I2C")

    def set_i2c_stuck(self, bus: int, stuck: bool) -> None:
        """Whether something holds SDA of I2C bus `bus` low, from now on, so that no transfer gets through.

        Raises `ValueError` for another bus, `NotImplementedError` if this kind has no I2C.
        """
        raise NotImplementedError(f"the emulated {self.kind} has no I2C")

    def run_for(self, duration_us: int) -> None:
        """Advance virtual time by `duration_us`."""
        self.run_until(self.now_us + duration_us)

    def __enter__(self):
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
