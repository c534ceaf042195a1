"""A line with faults between a session and an emulated MCU, in virtual time: the same faults with the same seed."""

import random

SPELL_US = (10_000, 80_000)
"""How long a line stalls or is cut, from .. to."""

DELAY_US = (1_000, 40_000)
HELD_US = 40_000
"""What is overtaken by nothing comes after so long."""


class Direction:
    """One direction of a line. `kind` is one of FAULTS, `rate` the share of packets that it hits; `done` counts hits.

    A packet is what the host sends at once, or what the MCU sends up to a zero. Of stalls and cuts, `rate` is the share
    of packets with which one begins; of "noise" it is the share of bytes.
    """

    def __init__(self, kind, rate, seed):
        self.done = 0
        self.is_on = False
        self._hit = FAULTS[kind]
        self._rate = rate
        self._rng = random.Random(seed)
        self._held = None
        self._until_us = 0

    def carry(self, now_us, data):
        """Return what arrives of a packet, and of one held back before it, and when: `(at_us, data)` in the order of arrival."""
        held = [] if self._held is None else [self._held[1]]
        self._held = None
        parts = self._hit(self, now_us, data) if self.is_on else [(now_us, data)]
        return [(at_us, part) for at_us, part in parts if part] + [(now_us, part) for part in held]

    def late(self, now_us):
        """Return the packet that has been held back for long enough, or until the faults ended; None if there is none."""
        if self._held and (not self.is_on or now_us - self._held[0] >= HELD_US):
            data, self._held = self._held[1], None
            return data
        return None

    def _chance(self):
        hit = self._rng.random() < self._rate
        self.done += hit
        return hit

    def _drop(self, now_us, data):
        if self._chance():
            place = self._rng.randrange(len(data))
            data = data[:place] + data[place + self._rng.choice((1, 1, 2, 5)) :]
        return [(now_us, data)]

    def _flip(self, now_us, data):
        if self._chance():
            spoilt = bytearray(data)
            for _ in range(self._rng.choice((1, 1, 2, 3))):
                spoilt[self._rng.randrange(len(spoilt))] ^= 1 << self._rng.randrange(8)
            data = bytes(spoilt)
        return [(now_us, data)]

    def _insert(self, now_us, data):
        if self._chance():
            place = self._rng.randrange(len(data) + 1)
            more = self._rng.choice((b"\0", self._rng.randbytes(1), self._rng.randbytes(3)))
            data = data[:place] + more + data[place:]
        return [(now_us, data)]

    def _duplicate(self, now_us, data):
        if not self._chance():
            return [(now_us, data)]
        return [(now_us, data), (now_us + self._rng.choice((0, self._rng.randrange(*DELAY_US))), data)]

    def _reorder(self, now_us, data):
        if self._chance():
            self._held = (now_us, data)
            return []
        return [(now_us, data)]

    def _delay(self, now_us, data):
        return [(now_us + (self._rng.randrange(*DELAY_US) if self._chance() else 0), data)]

    def _stall(self, now_us, data):
        if now_us >= self._until_us and self._chance():
            self._until_us = now_us + self._rng.randrange(*SPELL_US)
        return [(max(now_us, self._until_us), data)]

    def _disconnect(self, now_us, data):
        if now_us >= self._until_us and self._chance():
            self._until_us = now_us + self._rng.randrange(*SPELL_US)
        return [] if now_us < self._until_us else [(now_us, data)]

    def _noise(self, now_us, data):
        out = bytearray()
        for byte in data:
            if not self._chance():
                out.append(byte)
                continue
            fault = self._rng.randrange(3)
            if fault == 0:
                out.append(byte ^ 1 << self._rng.randrange(8))
            elif fault == 1:
                out += bytes((byte, self._rng.randrange(256)))
        return [(now_us, bytes(out))]


FAULTS = {
    "drop": Direction._drop,
    "flip": Direction._flip,
    "insert": Direction._insert,
    "duplicate": Direction._duplicate,
    "reorder": Direction._reorder,
    "delay": Direction._delay,
    "stall": Direction._stall,
    "disconnect": Direction._disconnect,
    "noise": Direction._noise,
}


class FaultyLine:
    """An emulated MCU as a session's carrier, with one kind of fault `to_mcu` and one `from_mcu`, None for none. Off at first.

    `bytes_to` and `bytes_from` count what the two sides have sent.
    """

    def __init__(self, mcu, to_mcu=None, from_mcu=None, rate=0.0, seed=0):
        self.mcu = mcu
        self.bytes_to = self.bytes_from = 0
        self.to_mcu = Direction(to_mcu or "drop", rate if to_mcu else 0, f"{seed} to")
        self.from_mcu = Direction(from_mcu or "drop", rate if from_mcu else 0, f"{seed} from")
        self._begun = b""  # a packet from the MCU that has no end yet
        self._coming: list[tuple[int, bytes]] = []

    @property
    def done(self):
        """How many faults there were."""
        return self.to_mcu.done + self.from_mcu.done

    def switch(self, is_on):
        """Let faults begin or end; a line that is cut or stalls is whole again then."""
        now_us = self.mcu.now_us
        self.to_mcu.is_on = self.from_mcu.is_on = is_on
        self._coming = [(min(at_us, now_us) if not is_on else at_us, data) for at_us, data in self._coming]

    def now_us(self):
        return self.mcu.now_us

    def write(self, data):
        self.bytes_to += len(data)
        for at_us, part in self.to_mcu.carry(self.mcu.now_us, data):
            self.mcu.send(part, at_us)

    def read(self, wait_us):
        late = self.to_mcu.late(self.mcu.now_us)
        if late:
            self.mcu.send(late)
        self.mcu.run_for(wait_us)
        now_us = self.mcu.now_us
        for at_us, data in self.mcu.receive():
            self.bytes_from += len(data)
            *packets, self._begun = (self._begun + data).split(b"\0")
            for packet in packets:
                self._coming += self.from_mcu.carry(at_us, packet + b"\0")
        late = self.from_mcu.late(now_us)
        if late:
            self._coming.append((now_us, late))
        self._coming.sort(key=lambda entry: entry[0])  # stable
        due = [data for at_us, data in self._coming if at_us <= now_us]
        self._coming = [(at_us, data) for at_us, data in self._coming if at_us > now_us]
        return b"".join(due)

    def close(self):
        self.mcu.close()
