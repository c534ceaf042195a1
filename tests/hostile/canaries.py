"""For MicroPython: the firmware with every array of its between two canaries, on a board that performs as ever.

Viper writes wherever an index leads it. So before the firmware is imported, `array` and `bytearray` are replaced by ones that
give a view of the middle of a longer array, whose ends hold a pattern: lengths and contents are as before, and whatever is
written outside an array near it changes the pattern. The firmware itself knows nothing of this.

On a PC this file is the program of `UnixMcu`, with its arguments; on an RP2040 it is sent to the raw REPL.
"""

import builtins
import gc
import sys
from array import array

PATTERN = {"B": 0xA5, "H": 0xA5C3, "i": 0x25A5C3A5}
COLLECTED = 64
"""Elements of an array for which an RP2040 tidies its heap up."""
plain_bytearray = bytearray
guarded = {kind: [] for kind in PATTERN}
"""All arrays of each kind with their canaries, in the order of their making."""


def between_canaries(kind, data, width):
    """Return a view of an array of `kind` with the numbers of `data`, and `width` elements of the pattern on both sides."""
    count = len(data)
    if sys.platform == "rp2" and count >= COLLECTED:
        gc.collect()  # it has little more room than it needs
    if isinstance(data, range):
        whole = array(kind, range(data[0] - width, data[0] + count + width))  # without anything else of that size
    else:
        whole = array(kind, range(count + 2 * width))
        for place in range(count):
            whole[width + place] = data[place]
    for place in range(width):
        whole[place] = whole[width + count + place] = PATTERN[kind]
    guarded[kind].append(whole)
    return memoryview(whole)[width : width + count]


class _Module:
    """Stands in for the module `array`; its members are functions of its own, as methods cannot be imported."""


def install(width):
    """Let all that is imported from now on have its arrays between canaries; the firmware is imported anew."""
    module = _Module()

    def array_between(kind, data=()):
        if not data:
            return array(kind)  # one that grows: no view can do that
        return between_canaries(kind, data if isinstance(data, range) else array(kind, data), width)

    def bytes_between(*data):
        plain = bytes(*data)
        return between_canaries("B", plain, width) if plain else plain_bytearray()

    module.array = array_between

    for name in list(sys.modules):
        if name.split(".")[0] in ("firmware", "shared"):
            del sys.modules[name]
    for name in ("perform", "Board", "room"):  # by which an RP2040's main program would hold all of it fast
        globals().pop(name, None)
    gc.collect()
    sys.modules["array"] = module
    builtins.bytearray = bytes_between


def uninstall():
    """Let arrays be as they are."""
    del sys.modules["array"]
    builtins.bytearray = plain_bytearray


def report(width):
    """Print how many arrays there are, and every one whose canaries have changed: its number, kind, length and what is wrong."""
    print("arrays", sum(len(arrays) for arrays in guarded.values()))
    for kind, arrays in guarded.items():
        for number, whole in enumerate(arrays):
            count = len(whole) - 2 * width
            ends = list(range(-width, 0)) + list(range(count, count + width))
            bad = [place for place in ends if whole[width + place] != PATTERN[kind]]
            if bad:
                print("broken", number, kind, count, bad[:8])
    print("end of report")


def plant(fault):
    """Carry out a line of Python that takes away one of the firmware's checks, to see that its lack is noticed."""
    if fault:
        exec(fault, {})


def perform_on_pc(width, fault):
    """Perform between canaries as `firmware/unix_main.py` does, and report each time that the host calls for the REPL."""
    from firmware.board_unix import Board
    from firmware.main import perform

    plant(fault)
    commands, records, kept, resets = sys.argv[1:5]
    board = Board(open(commands, "rb"), open(records, "wb"), kept, int(resets))  # noqa: PTH123, SIM115
    while True:
        perform(board)
        report(width)


def perform_on_pico(width, fault):
    """Perform between canaries, twice, so that what is kept on the flash is played the second time; report, and end."""
    from firmware.board_rp2040 import Board
    from firmware.main import perform

    plant(fault)
    imported = {kind: len(arrays) for kind, arrays in guarded.items()}
    for _ in range(2):
        perform(Board())
        report(width)
        for kind, arrays in guarded.items():
            del arrays[imported[kind] :]
    uninstall()
