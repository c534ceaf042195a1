"""What CPython lacks to run viper kernels as plain Python: the decorator, and the names of the pointer types.

Imported by the shared kernels when there is no `micropython` module; never part of a firmware image. The kernels are
called with the same buffers on both sides, and here their items are read as Python reads them.
"""

from typing import Protocol


class ptr8(Protocol):
    """A buffer of unsigned bytes."""

    def __getitem__(self, index: int, /) -> int: ...

    def __setitem__(self, index: int, value: int, /) -> None: ...


class ptr16(ptr8, Protocol):
    """A buffer of unsigned 16-bit words."""


def viper(function):
    """Stand in for `micropython.viper`: the function runs as it is."""
    return function
