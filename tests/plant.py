"""A simulated servo with a potentiometer, for closing loops in tests. Synthetic: it is modelled on no particular make.

The servo follows its command as late as its dead time says, along an exponential with a top speed; its load shifts where
it comes to stand; within its dead band, friction included, it does not move. The potentiometer is read with noise,
seeded, by a converter of 12 bits. Positions are floats in the units of the value, 0..1.
"""

import random
from collections import deque

STEP_S = 0.001


class Servo:
    """One servo.

    Args:
        place: where it stands at first.
        load: how far from its command it comes to stand.
        dead_band: the distance from there at which it stops.
        tau_s, delay_s, top_speed: how it follows.
        at0, at1: the potentiometer's ratio at 0 and at 1.
        noise: standard deviation of what the converter reads, as a ratio.
        seed: of that noise.

    Attributes:
        place: where it stands.
        is_blocked: whether something holds it where it is.
        is_broken: whether the potentiometer's wire is, which then reads 0.
    """

    def __init__(
        self,
        place=0.5,
        load=0.0,
        dead_band=0.001,
        tau_s=0.05,
        delay_s=0.02,
        top_speed=3.0,
        at0=0.1,
        at1=0.9,
        noise=0.0004,
        seed=0,
    ):
        self.place = place
        self.load = load
        self.is_blocked = self.is_broken = False
        self._dead_band, self._tau_s, self._top_speed = dead_band, tau_s, top_speed
        self._at0, self._at1, self._noise = at0, at1, noise
        self._random = random.Random(seed)
        self._commands = deque([place] * round(delay_s / STEP_S))
        self._left_s = 0.0

    def run(self, seconds, command):
        """Let time pass; `command` is where the pulses lead it, None while there are none: then it stands."""
        self._left_s += seconds
        while self._left_s >= STEP_S:
            self._left_s -= STEP_S
            self._commands.append(self.place - self.load if command is None else command)
            off = self._commands.popleft() + self.load - self.place
            if abs(off) > self._dead_band and not self.is_blocked and command is not None:
                speed = max(-self._top_speed, min(off / self._tau_s, self._top_speed))
                self.place = max(-0.1, min(self.place + speed * STEP_S, 1.1))

    def ratio_q15(self):
        """Return what the converter reads now."""
        if self.is_broken:
            return 0
        ratio = self._at0 + (self._at1 - self._at0) * self.place + self._random.gauss(0, self._noise)
        return max(0, min(round(ratio * 4096), 4095)) << 3


class Converter:
    """What a board offers to feedback: conversions, of servos by pin, and critical sections.

    A conversion gives what the potentiometer reads when it is started, 0 before the first. `started` lists the pins.
    """

    def __init__(self, servos):
        self.servos = servos
        self.started = []
        self._result_q15 = 0
        self._locked = False

    def adc_start(self, pin):
        self.started.append(pin)
        self._result_q15 = self.servos[pin].ratio_q15()

    def adc_read(self):
        return self._result_q15

    def lock(self):
        assert not self._locked
        self._locked = True
        return 1

    def unlock(self, state):
        assert self._locked and state == 1
        self._locked = False
