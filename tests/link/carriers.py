"""Carriers for the tests of the host's link: one that loses and damages bytes, and one with a scripted MCU at its end."""

import random
import zlib
from collections.abc import Callable

from marotte.link import wire_packet
from shared import codec, messages


class FaultyCarrier:
    """Passes on what another carrier carries, with bytes dropped, flipped and doubled, each with the probability `share`.

    `faults` are the kinds to choose from: "drop", "flip", "double". Nothing is damaged while `share` is 0.
    """

    def __init__(self, carrier, seed, faults):
        self.share = 0.0
        self.done = 0
        self._carrier = carrier
        self._rng = random.Random(seed)
        self._faults = faults

    def now_us(self):
        return self._carrier.now_us()

    def write(self, data):
        self._carrier.write(self._spoilt(data))

    def read(self, wait_us):
        return self._spoilt(self._carrier.read(wait_us))

    def close(self):
        self._carrier.close()

    def _spoilt(self, data):
        out = bytearray()
        for byte in data:
            if self._rng.random() >= self.share:
                out.append(byte)
                continue
            self.done += 1
            fault = self._rng.choice(self._faults)
            if fault == "flip":
                out.append(byte ^ 1 << self._rng.randrange(8))
            elif fault == "double":
                out += bytes((byte, byte))
        return bytes(out)


class ScriptedCarrier:
    """An MCU that does as a test says: `script(packet_number, message_id, seq)` returns its answer and the delay of it in us.

    Packets are numbered in the order of their arrival, repetitions included. `arrived` collects `(message_id, seq, at_us)`.
    """

    def __init__(self, script: Callable[[int, int, int], tuple[bytes, int]]):
        self.arrived: list[tuple[int, int, int]] = []
        self._script = script
        self._now_us = 0
        self._answers: list[tuple[int, bytes]] = []

    def now_us(self):
        return self._now_us

    def write(self, data):
        for wire in data.split(b"\0"):
            if not wire:
                continue
            body = bytearray(wire)
            length = codec.decode(body, len(body))
            assert zlib.crc32(body[: length - 4]) == int.from_bytes(body[length - 4 : length], "little")
            self.arrived.append((body[0], body[1], self._now_us))
            answer, delay_us = self._script(len(self.arrived) - 1, body[0], body[1])
            self._answers.append((self._now_us + delay_us, answer))

    def read(self, wait_us):
        self._now_us += wait_us
        due = [answer for at_us, answer in sorted(self._answers, key=lambda entry: entry[0]) if at_us <= self._now_us]
        self._answers = [entry for entry in self._answers if entry[0] > self._now_us]
        return b"".join(due)

    def close(self):
        pass


def ack(seq, status=messages.OK, detail=0):
    """The bytes of an acknowledgement."""
    payload = bytes((seq, status)) + detail.to_bytes(2, "little")
    return wire_packet(messages.ACK, 0, payload)
