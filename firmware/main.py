"""The firmware's main loop: frames when they are due, the link in between.

`perform` runs until the host calls for the REPL (`\\r`, Ctrl-C at the start of a packet, as mpremote sends them), and
leaves the board safe: no pulses, nothing moving.
"""

import gc

from firmware import store
from firmware.clock import ticks_diff
from firmware.link import Link
from firmware.puppet import Puppet
from shared.formats import KILLED_BY_HOST

_IDLE_US = 20000
_WATCHDOG_MS = 2000  # a main loop or ticks that stand still for so long reset the board; a USB write may take 1100


def perform(board):
    """Run a puppet on a board. All that it needs is allocated before the loop begins."""
    puppet = Puppet(board)
    motor = puppet.motor
    link = Link(board, puppet)
    try:
        store.load(link.commands)
        gc.collect()
        if puppet.frame >= 0:
            puppet.start()  # again, as reading and collecting have taken their time
        board.watchdog(_WATCHDOG_MS)
        while not link.poll():
            if puppet.frame >= 0 and puppet.clock.until_us(board.ticks_us()) <= 0:
                puppet.step()
                link.report()
            motor.attend()
            longest_us = min(_IDLE_US, ticks_diff(board.tick_due_us(), board.ticks_us()) + 1)
            if puppet.frame >= 0:
                longest_us = min(longest_us, puppet.clock.until_us(board.ticks_us()))
                if longest_us <= 0 or puppet.prepare():
                    continue
            board.wait(longest_us)
    finally:
        motor.kill(KILLED_BY_HOST)
        board.close()
