"""What CPython lacks to run viper kernels as plain Python: the decorator and the pointer casts.

Imported by the shared kernels when there is no `micropython` module; never part of a firmware image.
The casts give views whose items read as the hardware would read them; they check the bounds, which viper does not.
"""


def viper(function):
    """Stand in for `micropython.viper`: the function runs as it is."""
    return function


def ptr8(buffer):
    """View a buffer as unsigned bytes."""
    return memoryview(buffer).cast("B")


def ptr16(buffer):
    """View a buffer as unsigned 16-bit words."""
    return memoryview(buffer).cast("B").cast("H")


def ptr32(buffer):
    """View a buffer as signed 32-bit words."""
    return memoryview(buffer).cast("B").cast("i")
