"""Started by MicroPython at power on: performs until the host calls for the REPL."""

from firmware.board_rp2040 import Board
from firmware.main import perform

perform(Board())
