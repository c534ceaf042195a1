"""Memory and integers as the MCU has them, with bounds: what `tests.checked` puts into kernels."""

from array import array


class IntegerRange(ArithmeticError):
    """An integer does not fit the bits it has on the MCU."""


class Pointer:
    """A view of memory like viper's pointers, with bounds: indices from 0 and no length.

    Args:
        memory: an object with the buffer protocol, a list of ints for `ptr32`, or None for a null
            pointer, of which no element may be touched.
        bits: 8 or 16, read without sign, or 32, read with sign.

    A store must fit the element's width, with or without sign for 8 and 16 bits, with it for 32.
    """

    __slots__ = ("_bits", "_elements")

    def __init__(self, memory, bits):
        self._bits = bits
        self._elements = _elements(memory, bits)

    def __getitem__(self, index):
        return self._elements[self._checked(index)]

    def __setitem__(self, index, value):
        high = 1 << (self._bits - 1 if self._bits == 32 else self._bits)
        if not -(1 << (self._bits - 1)) <= value < high:
            raise IntegerRange(f"{value} stored through ptr{self._bits}")
        index = self._checked(index)
        if isinstance(self._elements, memoryview) and self._bits < 32:
            value &= high - 1
        self._elements[index] = value

    def _checked(self, index):
        if not isinstance(index, int):
            raise TypeError(f"ptr{self._bits} has no element {index!r}")
        if not 0 <= index < len(self._elements):
            raise IndexError(f"ptr{self._bits} index {index} outside 0..{len(self._elements) - 1}")
        return index


def _elements(memory, bits):
    """Return a sequence that reads and writes the elements of `memory` in place."""
    if memory is None:
        return ()
    if isinstance(memory, Pointer):
        memory = memory._elements
    if isinstance(memory, (list, tuple)):
        return memory
    if isinstance(memory, int):
        raise TypeError(f"ptr{bits} of an address, {memory:#x}: only objects have bounds")
    if isinstance(memory, array) and memory.typecode in "lLqQfd":
        raise TypeError(f"ptr{bits} of array({memory.typecode!r}), whose elements differ between ports")
    octets = memoryview(memory).cast("B") if len(memory) else memoryview(b"")
    whole = len(octets) - len(octets) % (bits // 8)
    return octets[:whole].cast({8: "B", 16: "H", 32: "i"}[bits]) if whole else ()


class CheckedPlace:
    """One place of a source whose integers are checked.

    Args:
        where: the place as errors name it.
        function: qualified name of the function that it is in.
        bits: what its integers must fit, sign included.
        folds: whether an unsigned pattern of so many bits goes on as the signed one.

    Attributes:
        least, greatest: of the integers seen; nothing has been `reached` while least > greatest.
    """

    def __init__(self, where, function, bits, folds):
        self.function = function
        self.least, self.greatest = 1 << bits, -(1 << bits)
        self._where = where
        self._low, self._high = -(1 << (bits - 1)), (1 << (bits - 1)) - 1
        self._folds = folds

    @property
    def reached(self):
        return self.least <= self.greatest

    def check(self, value):
        """Return an integer that fits; for viper, where there is nothing else."""
        if not isinstance(value, int):
            raise TypeError(f"{self._where} gives {value!r}, not an integer")
        if self._folds and self._high < value <= 2 * self._high + 1:
            value -= 2 * (self._high + 1)
        if not self._low <= value <= self._high:
            raise IntegerRange(f"{self._where} gives {value}, outside {self._low}..{self._high}")
        if value < self.least:
            self.least = value
        if value > self.greatest:
            self.greatest = value
        return value

    def check_if_int(self, value):
        """Return any object, an integer only if it fits; for bytecode."""
        return self.check(value) if type(value) is int else value

    def check_count(self, count):
        """Return a shift count that every port takes alike."""
        if not 0 <= count <= 31:
            raise IntegerRange(f"{self._where} shifts by {count}, outside 0..31")
        return count
