"""Range, top speed and top acceleration of every output, tick by tick, whatever is done to the puppet.

Random puppets with random limits and characters are armed, killed, silenced, stopped, blocked and asked for anything. What the
motor layer writes to its drivers, at full resolution, goes back through the calibration, and no step from tick to tick may be
more than the files allow. `make test` takes some twenty thousand ticks, `make soak` a million, and prints how near they came.
"""

import itertools
import math
import random
import time
from dataclasses import dataclass, field
from fractions import Fraction

import numpy
import pytest

import marotte
from marotte.link import VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.session import Session
from shared import formats
from tests.generate import random_puppet, random_target
from tests.motion.playing import Case, load

RATES_HZ = (50, 71, 100, 200, 333)
FRAME_RATES_HZ = (10, 24, 30, 47, 60)
QUICK_TICKS = 4_000
SOAK_TICKS = 200_000
"""For each rate."""

SOAK_PUPPETS = {50: 3, 71: 5, 100: 10, 200: 10, 333: 10}
"""Among how many puppets. At 50 Hz each takes 22 minutes: the MCU's microseconds wrap after 18."""

DEFAULT_SPEED, DEFAULT_ACCEL, DEFAULT_WHEEL_ACCEL = 10, 200, 20
"""Range widths a second, a second squared, and top speeds a second: what holds where the files say nothing."""

ENDS_US = (500, 2500)
FIRST_PIN, KILL_PIN = 2, 22
Q24 = 1 << 24
Q18 = 1 << 18
SETTLED_US = 60_000
"""So long after a kill, longer than the longest period, an attachment begins a run of its own."""


def period_us(rate_hz):
    return math.ceil(Fraction(1_000_000, rate_hz) / 8) * 8


@dataclass
class Output:
    """One output, and what its files allow it."""

    name: str
    pin: int
    relative: bool
    inverted: bool
    low: float
    high: float
    speed: float
    accel: float
    start: float
    tick_us: int
    """The period with which it is written, a whole number of motor ticks."""
    turns: int

    def positions_q24(self, pulses_q18us):
        """Return where it was led, from pulse widths: of a unit some 32nd is lost in them, so this is exact."""
        first, last = (ENDS_US[1], ENDS_US[0]) if self.inverted else ENDS_US
        shares = (numpy.array(pulses_q18us) / Q18 - first) / (last - first)
        return numpy.round(shares * Q24).astype(numpy.int64)


@dataclass
class Found:
    """The worst of some outputs, as fractions of what is allowed."""

    accel: float = 0.0
    speed: float = 0.0
    steps: int = 0
    runs: int = 0
    out_of_range: list[str] = field(default_factory=list)

    def __iadd__(self, other):
        self.accel, self.speed = max(self.accel, other.accel), max(self.speed, other.speed)
        self.steps, self.runs = self.steps + other.steps, self.runs + other.runs
        self.out_of_range += other.out_of_range
        return self


def random_limits(rng, relative):
    """Return limits as a puppet file or an output has them, or part of them."""
    limits = {}
    if rng.random() < 0.8:
        limits["accel"] = round((4 if relative else 1) * (1000 / 4) ** rng.random(), 3)
    if not relative and rng.random() < 0.8:
        limits["speed"] = round(0.05 * 1000 ** rng.random(), 3)
    if rng.random() < 0.4:
        limits["range"] = [round(rng.uniform(-1, 0), 3) if relative else round(rng.uniform(0, 0.4), 3), 0.95]
    return limits


def random_case(rng, rate_hz):
    """Return a case whose outputs all have servo pulses, and its `Output`s."""
    puppet = random_puppet(rng, level="full", gains=False, dofs=rng.choice((3, 6, 16)), actions=rng.choice((2, 8, 16)))
    puppet["frame_rate"] = rng.choice(FRAME_RATES_HZ)
    puppet["when_silent"] = rng.choice(("idle", "rest", "relax"))
    robot = {
        "rate": rate_hz,
        "attach_interval": rng.choice((0, 0.01, 0.1)),
        "link_timeout": rng.choice((0.1, 0.5)),
        "kill.pin": KILL_PIN,
        "kill.switch": "open",
        "output": {},
    }
    outputs = []
    slice_rates = [rng.choice((rate_hz, rate_hz, rate_hz, 50)) for _ in range(8)]
    for number, (name, dof) in enumerate(puppet["dof"].items()):
        relative = dof.get("kind") == "relative"
        if not relative:
            dof["rest"] = rng.choice((0.5, round(rng.uniform(0.4, 0.95), 3)))
        both = [random_limits(rng, relative) for _ in range(2)]
        dof["limits"] = both[0]
        if rng.random() < 0.6:
            dof["character"] = {
                "f": rng.choice((0.2, 10, round(rng.uniform(0.2, 10), 2))),
                "zeta": rng.choice((0.1, 3, round(rng.uniform(0.1, 3), 2))),
                "r": rng.choice((-4, 4, round(rng.uniform(-4, 4), 2))),
            }
        pin = FIRST_PIN + number
        inverted = rng.random() < 0.5
        output_hz = slice_rates[pin // 2 % 8]
        robot["output"][name] = {
            "pin": pin,
            "pulse_us": list(ENDS_US),
            "invert": inverted,
            "rate": output_hz,
            **both[1],
        }
        tick_us = period_us(rate_hz)
        turns = max(1, min(math.floor(Fraction(1_000_000, output_hz) / tick_us + Fraction(1, 2)), 20_971 // tick_us))
        ranges = [limits.get("range", [-1 if relative else 0, 1]) for limits in both]
        default = DEFAULT_WHEEL_ACCEL if relative else DEFAULT_ACCEL
        outputs.append(
            Output(
                name,
                pin,
                relative,
                inverted,
                max(low for low, _ in ranges),
                min(high for _, high in ranges),
                min([limits["speed"] for limits in both if "speed" in limits], default=DEFAULT_SPEED),
                min([limits["accel"] for limits in both if "accel" in limits], default=default),
                0 if relative else dof.get("rest", 0.5),
                turns * tick_us,
                turns,
            )
        )
    score = {"cue": [{"at": 0, "weights": {next(iter(puppet["action"])): 1}}]}  # read, not played
    return Case(f"{rate_hz} Hz", puppet, score, robot), outputs


class Ordeal:
    """A puppet at the mercy of a random host."""

    def __init__(self, rng, case, mcu):
        self.rng = rng
        self.mcu = mcu
        puppet, _, robot = load(case)
        self.actions, self.lives = len(puppet.actions), len(puppet.lives)
        turned = case._replace(puppet=case.puppet | {"dof": dict(reversed(case.puppet["dof"].items()))})
        self.tables = [marotte.build_tables(puppet, robot), marotte.build_tables(load(turned)[0], robot)]
        self.session = Session(VirtualCarrier(mcu))
        self.session.open()
        self.session.upload(self.tables[0])
        self.session.arm()
        self.session.start()
        self.late_frames = 0

    def run_until(self, end_us):
        """Do one thing after the other."""
        deeds = [self.ask] * 8 + [
            self.hurry,
            self.kill,
            self.push_kill_pin,
            self.fall_silent,
            self.block,
            self.begin_anew,
        ]
        while self.mcu.now_us < end_us:
            self.rng.choice(deeds)()
            self.pump(self.rng.choice((5_000, 100_000, 700_000, 2_000_000)))
        self.late_frames = self.session.status()["late_frames"]

    def pump(self, for_us):
        end_us = self.mcu.now_us + for_us
        while self.mcu.now_us < end_us:
            self.session.pump(min(20_000, end_us - self.mcu.now_us))
        self.session.taps.clear()

    def ask(self):
        some = self.rng.sample(range(self.actions), self.rng.randint(1, min(4, self.actions)))
        targets = {action: round(random_target(self.rng) * formats.WEIGHT_ONE) for action in some}
        if self.rng.random() < 0.2:
            targets = dict.fromkeys(range(self.actions), 0) | targets
        self.session.weight_targets(formats.FRAME_NOW, targets)
        if self.lives and self.rng.random() < 0.5:
            live = self.rng.randrange(self.lives)
            self.session.live_targets(formats.FRAME_NOW, {live: round(self.rng.random() * formats.WEIGHT_ONE)})

    def hurry(self):
        tempo_q16 = round(self.rng.uniform(0.25, 4) * formats.TEMPO_ONE)
        self.session.tempo(formats.FRAME_NOW, self.rng.choice((formats.MASTER, 0)), tempo_q16)

    def kill(self):
        self.session.kill()
        self.arm_again()

    def push_kill_pin(self):
        self.session.flush()  # an arm that comes later would be refused
        self.mcu.set_pin(KILL_PIN, 0)
        self.pump(self.rng.choice((25_000, 300_000)))
        self.mcu.set_pin(KILL_PIN, 1)
        self.arm_again()

    def arm_again(self):
        self.pump(self.rng.choice((SETTLED_US, 1_000_000)))
        self.session.arm()

    def fall_silent(self):
        self.session.flush()
        self.mcu.run_for(self.rng.choice((150_000, 800_000, 3_000_000)))
        self.mcu.receive()

    def block(self):
        block_us = self.rng.choice((15_000, 60_000, 200_000, 600_000))
        self.mcu.block(block_us)
        self.pump(block_us + 150_000)  # two in a row would be the watchdog's business

    def exchange(self):
        """Replace the tables by others in which the DOFs come in the opposite order."""
        playing, new = self.tables
        self.session.exchange(new, playing.puppet)
        self.tables = [new, playing]

    def begin_anew(self):
        self.session.stop()
        self.pump(self.rng.choice((0, 30_000, 1_000_000)))
        self.session.start()


def examined(output, drive):
    """Return what an output has done, as `Found`."""
    found = Found()
    times_us, pulses = numpy.array(drive.t_us), drive.value
    positions = output.positions_q24(pulses)
    breaks = numpy.flatnonzero(numpy.diff(times_us) != output.tick_us) + 1
    tick_s = output.tick_us / 1e6
    pose = round((output.start + 1) / 2 * Q24) if output.relative else round(output.start * 32768) << 9
    low, high = ((value + 1) / 2 if output.relative else value for value in (output.low, output.high))
    for begin, end in itertools.pairwise([0, *breaks.tolist(), len(positions)]):
        run = positions[begin:end]
        found.runs += 1
        found.steps += len(run)
        if output.turns == 1:
            # It stands at its pose until it gets its pulses. The pose is known where each tick is written.
            run = numpy.concatenate(([pose, pose], run))
        pose = Q24 // 2 if output.relative else int(run[-1])
        steps = numpy.abs(numpy.diff(run))
        if output.relative:
            found.accel = max(found.accel, steps.max(initial=0) / (output.accel * tick_s * Q24 / 2))
        else:
            bends = numpy.abs(numpy.diff(run, 2))
            found.speed = max(found.speed, steps.max(initial=0) / (output.speed * tick_s * Q24))
            found.accel = max(found.accel, bends.max(initial=0) / (output.accel * tick_s**2 * Q24))
        # Ends of ranges are rounded to Q15.
        if run.min() < round(low * 32768) << 9 or run.max() > round(high * 32768) << 9:
            found.out_of_range.append(f"{output.name}: {run.min() / Q24}..{run.max() / Q24}, allowed {low}..{high}")
    return found


def put_through(seed, rate_hz, ticks):
    """Return `Found` of all outputs of a random puppet, and how many frames were late in the last motion."""
    rng = random.Random(f"{seed} {rate_hz}")
    case, outputs = random_case(rng, rate_hz)
    found = Found()
    with UnixMcu() as mcu:
        ordeal = Ordeal(rng, case, mcu)
        begun_us = mcu.now_us
        ordeal.run_until(begun_us + ticks * period_us(rate_hz))
        drives = mcu.drives()
        assert {output.pin for output in outputs} == set(drives)
        for output in outputs:
            here = examined(output, drives[output.pin])
            assert here.accel <= 1 and here.speed <= 1 and not here.out_of_range, (seed, rate_hz, output, here)
            found += here
    return found, ordeal.late_frames


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_no_output_ever_exceeds_its_limits(rate_hz):
    found, _ = put_through(1, rate_hz, QUICK_TICKS)
    assert found.runs > 9 and found.steps > QUICK_TICKS
    # A test that never came near would show nothing. Accelerations are rounded down, the smallest by some hundredth.
    assert found.accel > 0.9


@pytest.mark.soak
def test_no_output_exceeds_its_limits_in_a_million_ticks(capsys):
    lines = []
    for rate_hz in RATES_HZ:
        found = Found()
        begun_s = time.monotonic()
        for seed in range(100, 100 + SOAK_PUPPETS[rate_hz]):
            here, _ = put_through(seed, rate_hz, SOAK_TICKS // SOAK_PUPPETS[rate_hz])
            found += here
        lines.append(
            f"{rate_hz:7d} {SOAK_TICKS:10d} {found.steps:15d} {found.runs:8d} {found.accel:18.6f} {found.speed:13.6f} "
            f"{time.monotonic() - begun_s:8.0f}"
        )
    with capsys.disabled():
        print("\nrate/Hz      ticks  steps examined     runs  accel, of allowed  speed, of it   time/s")
        print("\n".join(lines))
