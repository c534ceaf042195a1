"""Synthetic recordings of a game pad's stick, and how well what comes is foretold from what has come.

Nobody has moved a stick for these: they are computed, from a seed, in the forms that hands and sticks are known for. A reach
follows the curve of least jerk, with rests between; a sweep is a sine that swells and ebbs. A hand trembles at 9 Hz; a stick has
a dead zone around its middle and a converter of 8 bits, is read at 30 or 60 Hz with some milliseconds of jitter, and sends what
has changed. Jumps are what a score's cues do, which are no motion at all.
"""

import random
from dataclasses import dataclass
from types import SimpleNamespace

import numpy

from marotte.kalman import Kalman, kalman_fields
from shared import formats
from tests.kernels.values import halves, words

FRAME_RATE_HZ = 30
READ_RATES_HZ = (30, 60)
SECONDS = 60
SEEDS = range(4)
AHEAD = 30
"""Frames that are foretold."""
JITTER_S = 0.006
TREMOR, TREMOR_HZ = 0.003, 9.0
DEAD_ZONE = 0.08
STEPS = 255
REST = 0.5
TURN = 0.01
"""To and fro by so much, as a geometric mean, is a turn."""


@dataclass(frozen=True)
class Recording:
    """The targets of one channel, frame by frame, and in which frames one has come."""

    target: numpy.ndarray
    arrived: numpy.ndarray


def reaches(rng, least_s, most_s, rest_s):
    """Return a hand's course, a function of an array of times: reaches of least jerk that take so long, with rests between."""
    begins, durations, places = [], [], [REST]
    now_s = 0.0
    while now_s < SECONDS:
        begins.append(now_s)
        durations.append(rng.uniform(least_s, most_s))
        places.append(REST if rng.random() < 0.3 else rng.random())
        now_s += durations[-1] + (rng.uniform(0, rest_s) if rng.random() < 0.5 else 0.0)
    begins, durations, places = map(numpy.array, (begins, durations, places))

    def course(times_s):
        reach = numpy.searchsorted(begins, times_s, "right") - 1
        x = numpy.clip((times_s - begins[reach]) / durations[reach], 0, 1)
        return places[reach] + (places[reach + 1] - places[reach]) * x**3 * (10 - 15 * x + 6 * x * x)

    return course


def sweeps(rng):
    """Return the course of a sine of 0.2 to 1.5 Hz that swells and ebbs."""
    turns, swell = 2 * numpy.pi * rng.uniform(0.2, 1.5), rng.uniform(0.3, 0.7)
    size, phase = rng.uniform(0.1, 0.45), rng.uniform(0, 6.28)
    return lambda times_s: (
        0.5 + size * numpy.sin(turns * times_s + phase) * (0.6 + 0.4 * numpy.sin(swell * turns * times_s))
    )


def jumps(rng):
    """Return the course of a score's cues, one a second or so."""
    return reaches(rng, 1e-6, 2e-6, 4.0)


KINDS = {
    "reaches of 0.25 to 1.2 s": lambda rng: reaches(rng, 0.25, 1.2, 2.0),
    "quick ones, 0.12 to 0.4 s": lambda rng: reaches(rng, 0.12, 0.4, 1.0),
    "slow ones, 0.8 to 2 s": lambda rng: reaches(rng, 0.8, 2.0, 1.0),
    "sweeps of 0.2 to 1.5 Hz": sweeps,
}
"""What hands do, by what the documentation calls it."""


def recorded(course, rng, read_rate_hz):
    """Return what a stick sends of a course, put into frames."""
    times_s = numpy.array([n / read_rate_hz + rng.uniform(0, JITTER_S) for n in range(SECONDS * read_rate_hz - 1)])
    swell = rng.uniform(0, 6.28)
    tremor = TREMOR * numpy.sin(2 * numpy.pi * TREMOR_HZ * times_s) * (0.5 + 0.5 * numpy.sin(4.4 * times_s + swell))
    off = 2 * (course(times_s) + tremor) - 1
    off = numpy.sign(off) * numpy.maximum(abs(off) - DEAD_ZONE, 0) / (1 - DEAD_ZONE)
    readings = numpy.round(numpy.clip((off + 1) / 2, 0, 1) * STEPS) / STEPS
    return framed(times_s, readings)


def framed(times_s, readings):
    """Return the recording of readings: what differs from the last is sent, and acts in the first frame not before it."""
    frames = SECONDS * FRAME_RATE_HZ
    target, arrived = numpy.full(frames, REST), numpy.zeros(frames, bool)
    sent = numpy.flatnonzero(numpy.diff(readings, prepend=REST))
    for place in sent:
        first = int(numpy.ceil(times_s[place] * FRAME_RATE_HZ))
        if first < frames:
            target[first:] = readings[place]
            arrived[first] = True
    return Recording(target, arrived)


def recordings(make, seeds=SEEDS):
    """Return the recordings of one kind of course, two for each seed: read slowly and quickly."""
    return [
        recorded(make(random.Random(f"course {seed}")), random.Random(f"stick {seed} {rate_hz}"), rate_hz)
        for seed in seeds
        for rate_hz in READ_RATES_HZ
    ]


def velocities(module, recording, kalman=None):
    """Return the velocity per frame that the firmware's filter, `module`, finds in each frame of a recording."""
    fields = kalman_fields(kalman or Kalman(), FRAME_RATE_HZ)
    one = formats.WEIGHT_ONE
    tables = SimpleNamespace(
        lives=1,
        live_rest_q28=words([round(REST * one)]),
        live_predict=b"\1",
        live_process_q16=words([fields["process_q16"]]),
        live_noise_q16=words([fields["noise_q16"]]),
        live_fade_q15=halves([fields["fade_q15"]]),
    )
    estimator = module.Kalman()
    estimator.rest(tables)
    found = []
    for target, arrived in zip(recording.target, recording.arrived, strict=True):
        estimator.step(tables, int(arrived), words([round(target * one)]))
        found.append(estimator.velocity_q28[0] / one - 1)
    return numpy.array(found)


def errors(recording, velocity, fade_s):
    """Return an array [AHEAD, frames]: by how much the target 1, 2, .. frames ahead is foretold wrongly, frame by frame."""
    fade = numpy.exp(-1 / (FRAME_RATE_HZ * fade_s))
    frames = len(recording.target) - AHEAD
    foretold, speed = recording.target[:frames], velocity[:frames]
    wrong = []
    for ahead in range(1, AHEAD + 1):
        speed = speed * fade
        foretold = numpy.clip(foretold + speed, 0, 1)
        wrong.append(foretold - recording.target[ahead : ahead + frames])
    return numpy.array(wrong)


def compared(module, recordings, kalman=None):
    """Return two arrays [AHEAD, frames of all recordings], the errors of holding and of the filter."""
    kalman = kalman or Kalman()
    held = [errors(one, numpy.zeros(len(one.target)), kalman.fade_s) for one in recordings]
    filtered = [errors(one, velocities(module, one, kalman), kalman.fade_s) for one in recordings]
    return numpy.concatenate(held, axis=1), numpy.concatenate(filtered, axis=1)


def turning(recordings):
    """Return which frames of all recordings come before a turn: the target has moved in the last 3 and is back 5 frames later."""
    before = [one.target - numpy.concatenate([numpy.full(3, REST), one.target[:-3]]) for one in recordings]
    after = [numpy.roll(one.target, -5) - one.target for one in recordings]
    return numpy.concatenate([(a * b < -(TURN**2))[:-AHEAD] for a, b in zip(before, after, strict=True)])


def rms(wrong):
    """Return the root of the mean square."""
    return float(numpy.sqrt(numpy.mean(numpy.square(wrong))))
