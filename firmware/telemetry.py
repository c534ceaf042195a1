"""Telemetry: what the MCU tells of its own accord, and its status.

`taps` of a frame are complete only when the motor layer has passed the frame's instant, so they come a frame or two
later, in order. The values wait in rings of FRAMES_KEPT frames; what is not told before it is overwritten is lost.
Nothing here allocates while a puppet plays, but for a status, in which large counts do.
"""

from struct import pack_into

import micropython
from micropython import const

from shared import messages
from shared.formats import DOFS_MAX, FRAMES_KEPT, TAP_BASE, TAP_DERIVATIVES, TAP_MOTOR, TAP_SIGNAL

_PAYLOAD = const(2)  # place of the payload in a body
_TAPS = const(7)  # place of the first value
_MOST = const(2)  # frames told of at once: as many as keep up, without holding the next frame up
_MARGIN = const(2)  # frames before which a ring's place is given up, as the motor ticks go on meanwhile
_HALF_MAX = const(0xFFFF)

_STATUS_FIELDS = messages.find(messages.STATUS)[2]
_STATUS_FORMAT = messages.struct_format(_STATUS_FIELDS)
_STATUS_END = _PAYLOAD + messages.size(_STATUS_FIELDS)
_MOTOR_FIELDS = messages.find(messages.MOTOR_STATUS)[2]
_MOTOR_FORMAT = messages.struct_format(_MOTOR_FIELDS)
_MOTOR_END = _PAYLOAD + messages.size(_MOTOR_FIELDS)


@micropython.viper
def _pack_values(body: ptr8, at: int, count: int, values: ptr16, first: int) -> int:
    """Append `count` 16-bit values from `values[first]` on, little-endian; return the place behind them."""
    i = 0
    while i < count:
        value = int(values[first + i])
        body[at] = value & 255
        body[at + 1] = value >> 8
        at += 2
        i += 1
    return at


@micropython.viper
def _pack_weights(body: ptr8, at: int, count: int, playing: ptr8, w_q28: ptr32) -> int:
    """Append index and weight (Q12, 16 bits) of `count` playing actions; return the place behind them."""
    i = 0
    while i < count:
        action = int(playing[i])
        weight_q12 = (w_q28[action] + 0x8000) >> 16
        body[at] = action
        body[at + 1] = weight_q12 & 255
        body[at + 2] = weight_q12 >> 8
        at += 3
        i += 1
    return at


@micropython.viper
def _pack_pairs(body: ptr8, at: int, count: int, first: ptr32, second: ptr32) -> int:
    """Append `count` pairs of 32-bit words, little-endian; return the place behind them.

    Bits: of a word only bytes are taken, so it does not matter that a 64-bit port reads it without its sign.
    """
    i = 0
    while i < count:
        value = int(first[i])
        n = 0
        while n < 8:
            if n == 4:
                value = int(second[i])
            body[at] = value & 255
            value = value >> 8
            at += 1
            n += 1
        i += 1
    return at


class Telemetry:
    """Tells the host of one puppet; `link` sends."""

    def __init__(self, board, puppet, link):
        self._board = board
        self._puppet = puppet
        self._link = link
        self._heap_free = 0
        self._taps = self._taps_every = self._weights_every = 0
        self._next = 0  # the frame whose taps come next

    def ask(self, taps, taps_every, weights_every):
        """Tell taps (bits TAP_BASE ..) and weights every so many frames from now on; 0 is never."""
        if not (self._taps and self._taps_every):
            self._next = max(0, self._puppet.frame)
        self._taps = taps
        self._taps_every = taps_every
        self._weights_every = weights_every

    def start(self):
        """Begin with frame 0 anew; note how much of the heap is free."""
        self._next = 0
        self._heap_free = self._board.heap_free()

    def report(self):
        """Send what is due after a frame. While the link is silent nothing is."""
        puppet = self._puppet
        frame = puppet.frame - 1
        if puppet.motor.silent:
            self._next = puppet.frame
            return
        if self._taps and self._taps_every:
            self._report_taps(frame)
            if self._taps & TAP_DERIVATIVES and frame % self._taps_every == 0:
                motor = puppet.motor
                motor.derive()
                self._pack_frame(frame)
                length = _pack_pairs(self._link.out, 6, puppet.tables.dofs, motor.slope_q16, motor.bend_q15)
                self._link.send(messages.DERIVATIVES, length, True)
        if self._weights_every and frame % self._weights_every == 0:
            self._pack_frame(frame)
            actions = puppet.actions
            length = _pack_weights(self._link.out, 6, actions.found, actions.playing, actions.w_q28)
            self._link.send(messages.WEIGHTS, length, True)

    def _report_taps(self, last):
        """Send the taps that are complete, of frames up to `last`, at most `_MOST` of them."""
        taps = self._taps & (TAP_BASE | TAP_SIGNAL | TAP_MOTOR)
        if taps == 0:
            return
        tapped = self._puppet.motor.tapped[0]
        newest = max(tapped, last)
        if newest - self._next > FRAMES_KEPT - _MARGIN:
            self._next = newest - (FRAMES_KEPT - _MARGIN)
        most = _MOST
        while most and self._next <= tapped and self._next <= last:
            if self._next % self._taps_every == 0:
                self._send_taps(self._next, taps)
                most -= 1
            self._next += 1

    def _send_taps(self, frame, taps):
        puppet = self._puppet
        out = self._link.out
        self._pack_frame(frame)
        out[6] = taps
        dofs = puppet.tables.dofs
        place = frame % FRAMES_KEPT * DOFS_MAX
        length = _TAPS
        if taps & TAP_BASE:
            length = _pack_values(out, length, dofs, puppet.base_ring_q15, place)
        if taps & TAP_SIGNAL:
            length = _pack_values(out, length, dofs, puppet.signal_ring_q15, place)
        if taps & TAP_MOTOR:
            length = _pack_values(out, length, dofs, puppet.motor.tap_q15, place)
        self._link.send(messages.TAPS, length, True)

    def status(self):
        """Send `status` and `motor_status`."""
        puppet = self._puppet
        motor = puppet.motor
        link = self._link
        if puppet.frame < 0:  # looking through the heap takes 10 ms, and while frames run it does not change
            self._heap_free = self._board.heap_free()
        # fmt: off
        pack_into(
            _STATUS_FORMAT, link.out, _PAYLOAD, puppet.frame, motor.armed, motor.silent,
            puppet.clock.late_max_us, motor.late_frames, puppet.frame_max_us, link.packets, link.damaged,
            puppet.cues.counts[0], puppet.cues.refused, self._heap_free, puppet.clipped,
            puppet.future.cut_short,
        )
        link.send(messages.STATUS, _STATUS_END)
        pack_into(
            _MOTOR_FORMAT, link.out, _PAYLOAD, motor.ticks, motor.late_frames,
            min(motor.tick_max_us, _HALF_MAX), min(motor.tick_late_max_us, _HALF_MAX),
            motor.attached, motor.released, motor.stalled, motor.killed_by,
            puppet.drivers.bus_errors(), puppet.drivers.bus_gone(), min(self._board.watchdog_resets(), 255),
            link.store.state,
        )
        # fmt: on
        link.send(messages.MOTOR_STATUS, _MOTOR_END)

    def _pack_frame(self, frame):
        pack_into("<i", self._link.out, _PAYLOAD, frame)
