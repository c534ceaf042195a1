"""Started by MicroPython at power on: performs until the host calls for the REPL."""

room = [bytearray(8192)]  # before all that stays; see `perform`

import micropython  # noqa: E402

micropython.kbd_intr(-1)  # a host may be speaking already, and a byte 3 of a packet is no Ctrl-C

from firmware.board_rp2040 import Board  # noqa: E402
from firmware.main import perform  # noqa: E402

perform(Board(), room)
