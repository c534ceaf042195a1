"""Started by the host on a PC: `micropython -m firmware.unix_main COMMANDS RECORDS`, two files for the virtual board.

Like a Pico it performs until the host calls for the REPL, and begins anew when the REPL ends.
"""

import sys

from firmware.board_unix import Board
from firmware.main import perform
from firmware.unix_repl import Repl


def main():
    """Perform and serve the REPL, in turns, until the host closes the files."""
    board = Board(open(sys.argv[1], "rb"), open(sys.argv[2], "wb"))
    while True:
        perform(board)
        Repl(board).run()


main()
