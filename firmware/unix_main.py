"""Started by the host on a PC, with two files for the virtual board, one for what resets leave, and the number of resets:

    micropython -m firmware.unix_main COMMANDS RECORDS KEPT RESETS

Like a Pico it performs until the host calls for the REPL, and begins anew when the REPL ends.
"""

import sys

from firmware.board_unix import Board
from firmware.main import perform
from firmware.unix_repl import Repl


def main():
    """Perform and serve the REPL, in turns, until the host closes the files."""
    commands, records, kept, resets = sys.argv[1:]
    board = Board(open(commands, "rb"), open(records, "wb"), kept, int(resets))
    while True:
        perform(board)
        Repl(board).run()


main()
