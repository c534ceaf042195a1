"""What every emulated MCU looks like from the host: `VirtualMcu`.

An emulated MCU lives in virtual time. Nothing happens between calls; time passes only inside `run_until`, and a run that is
given the same bytes and levels at the same instants gives the same bytes and edges at the same instants, to the bit.
"""

from abc import ABC, abstractmethod


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

    def run_for(self, duration_us: int) -> None:
        """Advance virtual time by `duration_us`."""
        self.run_until(self.now_us + duration_us)

    def __enter__(self):
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
