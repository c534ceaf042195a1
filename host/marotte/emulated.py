"""The kinds of emulated MCU, by name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from marotte.errors import MarotteError
from marotte.mcu.base import VirtualMcu

KINDS = ("unix", "unix32", "rp2040")
"""MicroPython on this machine with words of 64 and of 32 bits, and the RP2040 instruction by instruction."""


@contextmanager
def open_mcu(kind: str) -> Iterator[VirtualMcu]:
    """Yield an emulated MCU of a kind, just switched on, and close it at the end. Raises MarotteError."""
    # Imported here, as each kind brings along all that it takes to build and run it.
    if kind == "rp2040":
        from marotte.mcu.rp2040 import Rp2040Mcu

        virtual: VirtualMcu = Rp2040Mcu()
    elif kind in KINDS:
        from marotte.mcu.unix import UnixMcu

        virtual = UnixMcu(bits=32 if kind == "unix32" else 64)
    else:
        raise MarotteError(f'unknown MCU "{kind}", expected one of {", ".join(KINDS)}')
    with virtual:
        yield virtual
