"""Started by MicroPython at power on: performs until the host calls for the REPL."""

room = [bytearray(8192)]  # before all that stays; see `perform`

from firmware.board_rp2040 import Board  # noqa: E402
from firmware.main import perform  # noqa: E402

perform(Board(), room)
