"""The signal tap against the float64 reference: the bounds of `docs/motion.md`, and what the paper promises of its seven bands.

`make test` plays a dozen random scores and all corners, `make soak` a thousand scores and the corners with gains up to 4. Random
draws in which the reference stands at the edge of a decision, or no DOF has signal processing, are replaced by the next one.
"""

import random
import tomllib
from fractions import Fraction
from pathlib import Path

import numpy
import pytest

from marotte.mcu.unix import UnixMcu
from tests.corners_signal import FRAMES as CORNER_FRAMES
from tests.corners_signal import signal_corners
from tests.motion.bounds import MOVING, STRONG_SUM, Worst, rest_bounds, signal_errors
from tests.motion.exchanging import Stage, puppet_of, score_of
from tests.motion.playing import Case, play, random_gains_case, tap
from tests.motion.test_exchange import shuffled
from tests.reference_signal import BANDS, WINDOW, render_signal

QUICK_SEEDS, SOAK_SEEDS = range(12), range(1000, 2000)
SECONDS = 6
PET_SECONDS = 21
PUPPETS = Path(__file__).parents[2] / "puppets"
REST_FRAMES = WINDOW + 46
DRAWS = 40
BOUNDS = {"rest": "rest", "moving": "1/50", "wide": "1/15", "flat": "one unit", "step": "a step at news"}
EXCHANGE_SEEDS, EXCHANGES = (2, 4, 9), 4
QUICK_CORNERS, SOAK_CORNERS = signal_corners(2), signal_corners(4)

FRAME_RATE_HZ, PERIOD_FRAMES = 32, 256
"""With these, phases of whole 1/256 periods in every frame are exact."""

SETTLING_FRAMES = 80
"""Gains arrive within 0.25 s * ln(8 * 1024), 72.1 frames at 32 a second."""


def reach_of(seed):
    """Return how far from 0 the gains of a seed's case go: every other one keeps to the tighter bound."""
    return 2 if seed % 2 == 0 else 4


def decided_case(seed):
    """Return the seed's first case in which every decision is clear and something is processed, and the expected `Signal`."""
    for draw in range(DRAWS):
        case = random_gains_case(seed, SECONDS, reach_of(seed), draw)
        expected = render_signal(case.puppet, case.score, SECONDS * case.puppet.get("frame_rate", 30) + REST_FRAMES)
        if expected.is_decided and expected.is_processed.any():
            return case, expected
    raise AssertionError(f"seed {seed}: {DRAWS} draws in a row will not do")


def played(case, frames):
    """Return the taps (base, signal) of so many frames."""
    rendering = play(case, Fraction(frames, case.puppet.get("frame_rate", 30)))
    return tap(rendering, "base"), tap(rendering, "signal")


def is_relative(puppet):
    return numpy.array([dof.get("kind") == "relative" for dof in puppet["dof"].values()])


def errors_of(case, expected):
    """Play a case and return its `Worst` by bound; DOFs without signal processing are held to their base."""
    base, signal = played(case, len(expected.base))
    aside = ~expected.is_processed
    assert numpy.array_equal(signal[:, aside], base[:, aside]), f"{case.name}: signals of DOFs that have none"
    return signal_errors(base, signal, expected, is_relative(case.puppet))


def complaints(name, errors):
    """Return a line for each bound that was exceeded."""
    return [
        f"{name}: {worst.fraction:.3f} of {BOUNDS[kind]} in frame {worst.frame}, DOF {worst.dof}"
        for kind, worst in errors.items()
        if worst.fraction > 1
    ]


def assert_within_bounds(name, errors):
    broken = complaints(name, errors)
    assert not broken


@pytest.mark.parametrize("seed", QUICK_SEEDS)
def test_signal_of_random_puppets_keeps_the_bounds(seed):
    case, expected = decided_case(seed)
    assert_within_bounds(case.name, errors_of(case, expected))


def test_signal_of_the_pet_keeps_the_bounds():
    puppet, score = (tomllib.loads((PUPPETS / name).read_text()) for name in ("pet.toml", "pet-score.toml"))
    expected = render_signal(puppet, score, PET_SECONDS * puppet["frame_rate"])
    assert (expected.gains != 1).any(axis=1).mean() > 0.3, "its moods are to be seen"
    assert_within_bounds("pet", errors_of(Case("pet", puppet, score), expected))


@pytest.mark.parametrize("corner", QUICK_CORNERS, ids=lambda corner: corner.name)
def test_signal_of_corners_keeps_the_bounds(corner):
    assert_corner_keeps_the_bounds(corner)


@pytest.mark.soak
@pytest.mark.parametrize("corner", SOAK_CORNERS, ids=lambda corner: corner.name)
def test_signal_of_corners_with_the_greatest_gains_keeps_the_bounds(corner):
    assert_corner_keeps_the_bounds(corner)


def assert_corner_keeps_the_bounds(corner):
    case = Case(*corner)
    expected = render_signal(case.puppet, case.score, CORNER_FRAMES)
    assert expected.is_decided, "a decision of this corner is too close to call"
    assert_within_bounds(case.name, errors_of(case, expected))


@pytest.mark.soak
def test_signal_of_a_thousand_random_scores_keeps_the_bounds(capsys):
    worst = dict.fromkeys(BOUNDS, ("", Worst()))
    compared = dict.fromkeys(BOUNDS, 0)
    clamped, broken = 0, []
    for seed in SOAK_SEEDS:
        case, expected = decided_case(seed)
        clamped += expected.is_clamped.sum()
        errors = errors_of(case, expected)
        broken += complaints(case.name, errors)
        for kind, found in errors.items():
            compared[kind] += found.compared
            worst[kind] = max(worst[kind], (case.name, found), key=lambda named: named[1].fraction)
    with capsys.disabled():
        print(f"\nsignal tap: {len(SOAK_SEEDS)} random scores, {clamped} values clamped")
        for kind, (name, found) in worst.items():
            where = f"{name}, frame {found.frame}, DOF {found.dof}"
            print(f"  {found.fraction:.3f} of {BOUNDS[kind]}, worst of {compared[kind]}: {where}")
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize("seed", EXCHANGE_SEEDS)
def test_signal_keeps_the_bounds_while_tables_are_exchanged(seed):
    """For the same ones, and for others in which the names stand elsewhere: neither changes what is to come."""
    case, expected = decided_case(seed)
    rng = random.Random(seed)
    puppet = puppet_of(case.puppet)
    frames = len(expected.base)
    with UnixMcu() as mcu:
        stage = Stage(mcu, puppet, score_of(case.score, puppet))
        for n in range(EXCHANGES):
            stage.play_for(rng.randrange(1_000_000))
            stage.exchange(puppet if n % 2 else puppet_of(shuffled(rng, case.puppet)))
        last_exchange = len(stage.seen)
        stage.play_until(frames - 1)
    seen_q15 = numpy.array([[taps[dof] for dof in puppet.dofs] for taps in stage.seen[:frames]])
    relative = is_relative(case.puppet)
    base, signal, _ = numpy.moveaxis(numpy.where(relative[:, None], seen_q15 / 16384 - 1, seen_q15 / 32768), -1, 0)
    is_at_rest = expected.is_at_rest & (numpy.arange(frames) >= last_exchange + WINDOW)[:, None]
    assert_within_bounds(case.name, signal_errors(base, signal, expected._replace(is_at_rest=is_at_rest), relative))


def broken_bounds(signal, base, expected, relative):
    """Return the bounds that a signal breaks, all of which compare something."""
    errors = signal_errors(base, signal, expected, relative)
    assert all(worst.compared for worst in errors.values())
    return {kind for kind, worst in errors.items() if worst.fraction > 1}


def test_signals_that_are_wrong_are_told():
    """What the bounds are for: the base instead, constant errors, a delay of one frame, gains of 1 that leave a trace."""
    case = Case(*next(corner for corner in QUICK_CORNERS if corner.name == "flat and back"))
    expected = render_signal(case.puppet, case.score, CORNER_FRAMES)
    is_flat = (expected.gains == 1).all(axis=1)[:, None]
    base = numpy.round(expected.base * 32768) / 32768
    right = numpy.where(is_flat, base, numpy.round(expected.signal * 32768) / 32768)
    wrong = [
        (right, set()),
        (base, {"rest", "moving"}),
        (right + numpy.where(is_flat, 0, 1 / 45), {"rest", "moving"}),
        (right + numpy.where(expected.is_at_rest, 1 / 100, 0), {"rest"}),
        (right + numpy.where(is_flat, 2 / 32768, 0), {"flat"}),
        (numpy.concatenate([right[:1], right[:-1]]), {"moving", "flat"}),
    ]
    for signal, bounds in wrong:
        assert broken_bounds(signal, base, expected, numpy.array([False])) == bounds


def test_news_that_jerk_are_told():
    case = Case(*next(corner for corner in QUICK_CORNERS if corner.name == "wheels turning round"))
    expected = render_signal(case.puppet, case.score, CORNER_FRAMES)
    late = numpy.concatenate([expected.offset[:1] * 0, expected.offset[:-1]])
    errors = signal_errors(expected.base, expected.signal - expected.offset + late, expected, is_relative(case.puppet))
    assert errors["step"].fraction > 10


def test_most_values_of_the_random_cases_are_compared():
    """And the cases have what the bounds are about: motion, rest, news, gains of 1, and signals that are clamped."""
    compared = numpy.zeros(4, int)
    values = clamped = 0
    for seed in QUICK_SEEDS:
        case, expected = decided_case(seed)
        errors = signal_errors(expected.base, expected.signal, expected, is_relative(case.puppet))
        assert max(worst.fraction for worst in errors.values()) < 1e-6
        compared += [worst.compared for worst in errors.values()]
        values += expected.is_processed.sum() * len(expected.base)
        clamped += expected.is_clamped.sum()
    rest, moving, flat, step = compared
    assert rest + moving > 0.6 * values and min(rest, flat) > 500 and step > 50 and clamped > 100


def one_action_each(dofs, curves=None, **actions):
    """Return a puppet whose actions each move one relative DOF of their name, which have signal processing, around 0."""
    return {
        "name": "measured",
        "frame_rate": FRAME_RATE_HZ,
        "dof": {name: {"kind": "relative", "signal": True} for name in dofs},
        "function": curves or {},
        "action": actions,
    }


def settings_score(actions, settings):
    """Return a score with all actions from frame 0 on and one setting of gains after another, and when each is at rest."""
    begin = 2 * WINDOW  # the weights are gone through the window, and the news are long ago
    spans = []
    cues = [{"at": 0, "weights": dict.fromkeys(actions, 1)}]
    for gains in settings:
        cues.append({"at": begin / FRAME_RATE_HZ, "gains": gains})
        spans.append(slice(begin + SETTLING_FRAMES, begin + SETTLING_FRAMES + PERIOD_FRAMES))
        begin = spans[-1].stop
    return {"cue": cues}, spans


def responses(k, frequencies):
    """Return what band `k` lets through of some frequencies in cycles per frame: powers of cosines, after its kernels."""
    smoothed = numpy.ones(len(frequencies))
    for i in range(k):
        smoothed = smoothed * numpy.cos(numpy.pi * frequencies * 2**i) ** 4
    return smoothed * (1 - numpy.cos(numpy.pi * frequencies * 2**k) ** 4)


def test_impulses_come_out_as_the_bands_of_the_definition():
    """A period of 256 frames holds one impulse, so each frequency of its spectrum can be compared, and each frame."""
    curve = {"IMPULSE": {"table": [1 if i == 100 else 0 for i in range(PERIOD_FRAMES)]}}
    action = {"tempo": FRAME_RATE_HZ / PERIOD_FRAMES, "tau": 0.05, "map": [["WHEEL", -0.25, 0.25, "IMPULSE"]]}
    puppet = one_action_each(["WHEEL"], curve, WHEEL=action)
    settings = [[(3, -2)[k % 2] if band == k else 1 for band in range(BANDS)] for k in range(BANDS)]
    score, spans = settings_score(["WHEEL"], settings)
    base, signal = played(Case("impulses", puppet, score), spans[-1].stop)
    frequencies = numpy.fft.fftfreq(PERIOD_FRAMES)
    peaks_hz = []
    for k, (gains, span) in enumerate(zip(settings, spans, strict=True)):
        frames = numpy.arange(span.start, span.stop)
        impulse = numpy.where(frames % PERIOD_FRAMES == 100, 0.25, -0.25)
        assert abs(base[span, 0] - impulse).max() <= 1 / 2048
        passed = (gains[k] - 1) * responses(k, frequencies) * numpy.fft.fft(impulse)
        expected = impulse + numpy.fft.ifft(passed).real
        error = abs(signal[span, 0] - expected).max()
        assert error <= rest_bounds(numpy.array([gains]))[0], f"band {k}"
        spectrum = abs(numpy.fft.rfft(signal[span, 0] - base[span, 0]))
        peaks_hz.append(spectrum.argmax() * 30 / PERIOD_FRAMES)
    # As if at 30 frames a second. The frequencies that are there are 0.117 apart, and the tops are flat.
    for peak_hz, expected_hz in zip(peaks_hz, (15, 4.2, 2.0, 0.99, 0.49, 0.25, 0.12), strict=True):
        assert abs(peak_hz - expected_hz) < 0.12 + 0.05 * expected_hz


def test_bands_respond_to_sines_as_the_kernels_say():
    """In amplitude and in phase, of which a symmetric filter changes none."""
    cycles = numpy.array([1, 2, 3, 4, 6, 8, 11, 17, 24, 32, 36, 48, 64, 90, 112, 127])
    names = [f"WHEEL_{count}" for count in cycles]
    actions = {
        name: {"tempo": count * FRAME_RATE_HZ / PERIOD_FRAMES / 2, "tau": 0.05, "map": [[name, -0.4, 0.4, "rsin(2*t)"]]}
        for name, count in zip(names, cycles.tolist(), strict=True)
    }
    settings = [[(2, -1)[k % 2] if band == k else 1 for band in range(BANDS)] for k in range(BANDS)]
    score, spans = settings_score(names, settings)
    _, signal = played(Case("sines", one_action_each(names, **actions), score), spans[-1].stop)
    for k, (gains, span) in enumerate(zip(settings, spans, strict=True)):
        frames = numpy.arange(span.start, span.stop)
        phasors = numpy.exp(-2j * numpy.pi * numpy.outer(frames, cycles) / PERIOD_FRAMES)
        found = 2j * (signal[span] * phasors).mean(axis=0) / 0.4
        expected = 1 + (gains[k] - 1) * responses(k, cycles / PERIOD_FRAMES)
        # Errors within the bound of each frame move the amplitude of a sine by twice the bound at most.
        bound = 2 * rest_bounds(numpy.array([gains]))[0] / 0.4
        assert abs(found - expected).max() <= bound, f"band {k}"


DELAY_GAINS = {
    "boosted": [2, 2, 2, 1.5, 1.5, 1, 1],
    "cut": [0, 0.2, 0.5, 0.5, 1, 1, 1],
    "boosted low": [1, 1, 1, 1, 2, 2, 2],
    "cut low": [1, 1, 1, 1, 0.5, 0.2, 0],
}


def test_signal_has_no_delay_against_the_base():
    """Their correlation over a period is greatest without a shift, and falls alike to both sides."""
    motions = {
        "SLOW": "0.5*rsin(t) + 0.3*rsin(5*t + 0.2) + 0.2*rsin(14*t + 0.7)",
        "MIDDLE": "0.4*rsin(2*t) + 0.4*rsin(6*t + 0.1) + 0.2*rsin(13*t + 0.4)",
        "FAST": "0.3*rsin(3*t) + 0.3*rsin(9*t + 0.9) + 0.4*rsin(16*t + 0.6)",
    }
    actions = {
        name: {"tempo": (n + 1) * FRAME_RATE_HZ / PERIOD_FRAMES, "tau": 0.05, "map": [[name, -0.4, 0.4, motion]]}
        for n, (name, motion) in enumerate(motions.items())
    }
    score, spans = settings_score(list(motions), list(DELAY_GAINS.values()))
    base, signal = played(Case("delay", one_action_each(motions, **actions), score), spans[-1].stop)
    for gains, span in zip(DELAY_GAINS, spans, strict=True):
        spectra = numpy.fft.fft(signal[span], axis=0) * numpy.conj(numpy.fft.fft(base[span], axis=0))
        spectra[0] = 0
        for name, correlation in zip(motions, numpy.fft.ifft(spectra, axis=0).real.T, strict=True):
            assert correlation.argmax() == 0, f"{name}, {gains}"
            before, top, after = correlation[[-1, 0, 1]]
            lag_frames = (before - after) / (2 * (before - 2 * top + after))
            assert abs(lag_frames) < 0.02, f"{name}, {gains}"


def test_base_responds_in_the_frame_in_which_a_target_arrives():
    puppet = {
        "name": "prompt",
        "dof": {"NECK": {}},
        "action": {"UP": {"map": [["NECK", 0, 1, "const(1)"]]}, "DOWN": {"map": [["NECK", 1, 0, "const(1)"]]}},
    }
    cues = [
        {"at": 0, "gains": [2, -2, 2, -2, 2, -2, 2]},
        {"at": 1, "weights": {"UP": 1}},
        {"at": 3, "weights": {"DOWN": 1}},
    ]
    base, _ = played(Case("prompt", puppet, {"cue": cues}), 120)
    assert (base[:30] == 0.5).all() and base[30, 0] > 0.505
    assert base[90, 0] < base[89, 0] - 0.005


def test_news_does_not_jerk_the_signal(capsys):
    """The lowest bands, which see 254 frames ahead, are boosted: without the offset the signal would leap at each news."""
    actions = {
        "UP": {"tau": 2, "map": [["NECK", 0.2, 0.9, "const(1)"]]},
        "SWAY": {"tempo": 0.2, "tau": 1, "map": [["NECK", 0.35, 0.65, "rsin"]]},
    }
    puppet = {"name": "calm", "dof": {"NECK": {}}, "action": actions}
    cues = [{"at": 0, "gains": [1, 1, 1, 1, 2, 2, 2], "weights": {"SWAY": 1}}]
    cues += [{"at": 4 + 2.3 * n, "weights": {"UP": n % 2 * 3 + 0.1}} for n in range(5)]
    case = Case("calm", puppet, {"cue": cues})
    expected = render_signal(puppet, case.score, 480)
    base, signal = played(case, 480)

    def largest_step(base, signal):
        """At news, and in the frame behind them, in which the bands are those of the new future."""
        steps = numpy.abs(numpy.diff(signal - base, axis=0)).max(axis=1)
        return max(steps[n - 1 : n + 1].max() for n in expected.news[1:])

    allowed, found = largest_step(expected.base, expected.signal), largest_step(base, signal)
    leap = max(abs(expected.offset[n]).max() for n in expected.news[1:])
    with capsys.disabled():
        print(f"\nlargest step at news: {found:.4f}; of the definition {allowed:.4f}, without an offset {leap:.4f}")
    assert expected.weight_sums.min() > STRONG_SUM and leap > 2 * (allowed + MOVING)
    assert found <= allowed + MOVING


def test_signals_end_at_the_ends_of_their_ranges():
    puppet = {
        "name": "clamped",
        "dof": {"NECK": {}, "WHEEL": {"kind": "relative", "signal": True}},
        "action": {"SWAY": {"tempo": 2, "map": [["NECK", 0, 1, "rsin"], ["WHEEL", -1, 1, "rsin"]]}},
    }
    case = Case("clamped", puppet, {"cue": [{"at": 0, "weights": {"SWAY": 1}, "gains": [2] * BANDS}]})
    expected = render_signal(puppet, case.score, 300)
    _, signal = played(case, 300)
    for j, (low, high) in enumerate(((0, 1), (-1, 1))):
        far = abs(expected.signal[:, j] - numpy.clip(expected.signal[:, j], low + 0.05, high - 0.05)) >= 0.05
        assert far.sum() > 60 and expected.is_clamped[:, j].sum() > 60
        assert signal[:, j].min() == low and signal[:, j].max() == high


def test_signal_processing_begins_and_ends_with_the_tables_that_ask_for_it():
    """While nobody asks, no future is computed; once the past has filled again the signal is that of tables that always asked."""
    puppet = {
        "name": "late",
        "frame_rate": 30,
        "dof": {"A": {"signal": True}},
        "action": {"MOVE": {"tempo": 0.5, "map": [["A", 0.2, 0.8, "rsin"]]}},
    }
    score = {"cue": [{"at": 0.0, "weights": {"MOVE": 1}, "gains": [2, 2, 2, 2, -1, 0, 1.5]}]}
    aside = {**puppet, "dof": {"A": {"signal": False}}}
    expected = render_signal(puppet, score, 700)
    with UnixMcu() as mcu:
        stage = Stage(mcu, puppet_of(aside), score_of(score, puppet_of(aside)))
        stage.play_until(60)
        stage.exchange(puppet_of(puppet))
        begun = len(stage.seen)
        stage.play_until(begun + 2 * WINDOW + 40)
        stage.exchange(puppet_of(aside))
        ended = len(stage.seen)
        stage.play_until(ended + 30)
    base, signal = numpy.array([taps["A"][:2] for taps in stage.seen]).T / 32768
    assert numpy.array_equal(signal[:60], base[:60])
    assert numpy.array_equal(signal[ended + 5 :], base[ended + 5 :])
    settled = slice(begun + WINDOW + 40, begun + 2 * WINDOW + 30)
    limit = rest_bounds(expected.gains)[settled]
    assert (numpy.abs(signal[settled] - expected.signal[settled, 0]) <= limit).all()
    assert numpy.abs(signal[settled] - base[settled]).max() > 0.1
