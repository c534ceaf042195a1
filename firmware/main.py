"""The firmware's main loop: frames when they are due, the link in between.

`perform` runs until the host calls for the REPL (`\\r`, Ctrl-C at the start of a packet, as mpremote sends them), and
leaves the board safe: no pulses, nothing moving.
"""

import gc

import micropython

from firmware import store
from firmware.clock import ticks_diff
from firmware.link import Link
from firmware.puppet import Puppet
from shared.formats import KILLED_BY_HOST

_IDLE_US = 20000
_PACKETS = 8  # that are carried out in one pass, at most
_LATE_US = 1500  # by which a frame may wait for what has come
_OVERDUE_US = 20000  # by which frames are late where they take all the time
_WATCHDOG_MS = 2000  # a main loop or ticks that stand still for so long reset the board


def _take(board, puppet, link):
    """Carry out what has come, until a frame is due; return how many bytes wait, -1 if the REPL is called for.

    If a frame is late already, it comes first, and only a kill does not wait for it; but where frames take all the time there is,
    a packet has its turn before each of them.
    """
    if puppet.frame >= 0 and -_OVERDUE_US < puppet.clock.until_us(board.ticks_us()) < -_LATE_US:
        return link.inbox.look()
    for _ in range(_PACKETS):
        waiting = link.poll()
        if waiting <= 0 or (puppet.frame >= 0 and puppet.clock.until_us(board.ticks_us()) <= 0):
            break
    return waiting


def _pass(board, puppet, link):
    """Take what has come, compute the frame if one is due, do what the motors need.

    Returns how long there is nothing more to do, in microseconds, 0 or less for nothing of the kind; None if the host calls for
    the REPL. Runs with the heap locked: nothing allocates while a puppet plays (`Link` unlocks it for tables). And
    MicroPython then keeps the locals of larger functions on the stack, instead of looking through the heap for room, which costs
    200 us a call once it is half full.
    """
    waiting = _take(board, puppet, link)
    if waiting < 0:
        return None
    if puppet.frame >= 0 and puppet.clock.until_us(board.ticks_us()) <= 0:
        puppet.step()
        waiting = link.inbox.look()
        link.report()
    puppet.motor.attend()
    if waiting:  # that has its turn before the work between frames
        return 0
    longest_us = min(_IDLE_US, ticks_diff(board.tick_due_us(), board.ticks_us()) + 1)
    if puppet.frame >= 0:
        longest_us = min(longest_us, puppet.clock.until_us(board.ticks_us()))
    return longest_us


def perform(board, room=None):
    """Run a puppet on a board. All that it needs is allocated before the loop begins.

    `room` is a list with a buffer at the low end of the heap, which is freed then: what is allocated later, for a moment, is
    found there without a search through all that stays.
    """
    gc.collect()
    puppet = Puppet(board)
    gc.collect()  # garbage between what stays would leave a heap full of holes
    motor = puppet.motor
    link = Link(board, puppet)
    try:
        if room:
            room.clear()
        store.load(link.commands)
        gc.collect()
        if puppet.frame >= 0:
            puppet.start()  # again, as reading and collecting have taken their time
        board.watchdog(_WATCHDOG_MS)
        puppet.look = link.inbox.look
        longest_us = 0
        while longest_us is not None:
            if longest_us > 0 and not puppet.prepare():
                board.wait(longest_us)
            micropython.heap_lock()
            try:
                longest_us = _pass(board, puppet, link)
            finally:
                micropython.heap_unlock()
            motor.maintain()
    finally:
        motor.kill(KILLED_BY_HOST)
        board.close()
