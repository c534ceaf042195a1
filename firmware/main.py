"""The firmware's main loop: frames when they are due, the link in between.

`perform` runs until the host calls for the REPL (`\\r`, Ctrl-C at the start of a packet, as mpremote sends them), and
leaves the board safe: no pulses, nothing moving.
"""

import gc

from firmware.link import Link
from firmware.puppet import Puppet

_IDLE_US = 20000


def perform(board):
    """Run a puppet on a board. All that it needs is allocated before the loop begins."""
    puppet = Puppet(board)
    link = Link(board, puppet)
    gc.collect()
    try:
        while not link.poll():
            longest_us = _IDLE_US
            if puppet.frame >= 0:
                longest_us = puppet.clock.until_us(board.ticks_us())
                if longest_us <= 0:
                    puppet.step(link.silent)
                    link.report()
                    continue
                if puppet.prepare():
                    continue
            board.wait(longest_us)
    finally:
        puppet.motor.kill()
        board.close()
