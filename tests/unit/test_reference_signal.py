"""The signal tap's oracle against its definitions taken word by word, and against values worked out by other means."""

import functools
import itertools
import math
import random

import numpy
import pytest

from tests.generate import random_puppet, random_score
from tests.reference import ReferencePuppet, render
from tests.reference_future import FarSightedPuppet
from tests.reference_signal import BANDS, KERNEL, WINDOW, apply_gains, band_pass, glide, render_signal, settle, taps

FLAT = [1] * BANDS
GAINS = [[2.5, 2, 1.4, 1, 1, 1, 1], [0] * BANDS, [-4, 4, -4, 4, -4, 4, -4], [1, 1, 1, 1, 1, 1, -3], FLAT]


def swaying_puppet(function="rsin", tempo=0.7, **options):
    action = {"tempo": tempo, "tau": 0.1, "map": [["NECK", 0, 1, function]]}
    return {"dof": {"NECK": {}}, "action": {"SWAY": action}} | options


def random_files(seed, seconds=10, **options):
    rng = random.Random(seed)
    puppet = random_puppet(rng, "full", **options)
    return puppet, random_score(rng, puppet, seconds, "full")


def responses(frequencies_hz, frame_rate_hz):
    """Return the response of every band, [frequencies, 7], measured on cosines, whose middle is at their top."""
    frames = numpy.arange(-WINDOW, WINDOW + 1)
    cosines = numpy.cos(2 * math.pi * numpy.outer(frames, frequencies_hz) / frame_rate_hz)
    return band_pass(cosines)[0, :BANDS].T


def test_frequency_peaks_of_the_bands_are_those_of_the_definition():
    frequencies_hz = numpy.arange(0.02, 15.001, 0.005)
    peaks_hz = frequencies_hz[responses(frequencies_hz, 30).argmax(axis=0)]
    assert peaks_hz == pytest.approx([15, 4.2, 2.0, 0.99, 0.49, 0.25, 0.12], abs=0.02)
    assert peaks_hz[-1] == pytest.approx(0.12, abs=0.006)


def test_bands_respond_as_powers_of_cosines():
    """The kernel's response is cos(w/2)^4, each further one that of twice the frequency."""
    frequencies_hz = numpy.linspace(0, 15, 50)
    w = 2 * math.pi * frequencies_hz / 30
    lower = numpy.cumprod([numpy.ones(50), *(numpy.cos(w * 2**k / 2) ** 4 for k in range(BANDS))], axis=0)
    expected = -numpy.diff(lower, axis=0).T
    assert responses(frequencies_hz, 30) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("gains", GAINS)
def test_cascade_is_a_symmetric_filter_of_509_taps_with_gain_1_at_rest(gains):
    filter_taps = taps(gains)
    assert filter_taps.shape == (2 * WINDOW + 1,)
    assert filter_taps == pytest.approx(filter_taps[::-1], abs=1e-15)
    assert filter_taps.sum() == pytest.approx(1)
    values = numpy.random.default_rng(1).random(1200)
    filtered = apply_gains(band_pass(values), numpy.broadcast_to(gains, (len(values) - 2 * WINDOW, BANDS)))
    assert filtered == pytest.approx(numpy.convolve(values, filter_taps, "valid"), abs=1e-12)


def test_all_gains_1_give_the_base():
    for seed in range(10):
        rng = random.Random(seed)
        puppet = random_puppet(rng, "full", gains=False)
        score = random_score(rng, puppet, 10, "full", gains=False)
        base, _ = render(puppet, score, 100)
        found = render_signal(puppet, score, 100)
        assert (found.base == base).all()
        assert found.signal == pytest.approx(base, abs=1e-14)
        assert not found.offset.any()


def test_gains_glide_to_their_targets_and_arrive_exactly():
    targets = numpy.tile([[2.0, 1, 0, -4, 1.0005, 4, 1]], (120, 1))
    gains, rest = glide(targets, 30)
    n = numpy.arange(1, 121)[:, None]
    expected = targets + (1 - targets) * math.exp(-1 / 7.5) ** n
    assert gains == pytest.approx(expected, abs=2**-10)
    # The longest way is 5, and exp(-n / 7.5) is below 2^-10 / 5 after 65 frames.
    assert not rest[63] and rest[64:].all() and (gains[64:] == targets[64:]).all()
    assert (gains[0, [1, 4, 6]] == [1, 1.0005, 1]).all()


def test_mood_without_gains_sets_all_to_1_and_gains_overrule_the_mood():
    puppet = swaying_puppet(mood={"NERVOUS": {"gains": [2] * BANDS}, "CALM": {"tempo": 0.5}})
    moods = [
        {"at": 0, "mood": "NERVOUS"},
        {"at": 4, "mood": "CALM"},
        {"at": 8, "gains": [3] * BANDS, "mood": "NERVOUS"},
    ]
    found = render_signal(puppet, {"cue": moods}, 360)
    assert [found.gains[n].tolist() for n in (119, 239, 359)] == [[2] * BANDS, FLAT, [3] * BANDS]


def test_offset_dies_out_as_a_critically_damped_step():
    steps = numpy.zeros((90, 1))
    steps[10] = 1
    offset = settle(steps, numpy.zeros(90, bool), 30)[:, 0]
    t_s = numpy.arange(80) / 30
    assert not offset[:10].any()
    assert offset[10:] == pytest.approx((1 + t_s / 0.15) * numpy.exp(-t_s / 0.15), abs=1e-12)


def test_offset_is_gone_in_a_frame_in_which_all_gains_are_1():
    steps = numpy.ones((6, 2))
    offset = settle(steps, numpy.array([False, False, True, False, True, True]), 30)
    assert offset[1, 0] > 1 and (offset[3] == 1).all() and not offset[[2, 4, 5]].any()


def literal_signal(puppet, score, frames):
    """Return (base, signal) of the DOFs with signal processing by the definitions, with nothing made quick.

    The future in frame `n` is what a puppet comes to that never gets a cue after frame `n`, played from its beginning.
    """
    frame_rate = puppet.get("frame_rate", 30)
    cues = ReferencePuppet(puppet, score).cues

    @functools.cache
    def course(last):
        known = {"cue": [cue for frame in cues if frame <= last for cue in cues[frame]]}
        return render(puppet, known, last + WINDOW + 2)[0]

    def filtered(values, gains, n):
        @functools.cache
        def smooth(k, m):
            if k == 0:
                return values[max(m, 0)]
            return sum(weight * smooth(k - 1, m + (place << (k - 1))) for place, weight in KERNEL.items())

        return smooth(BANDS, n) + sum(gains[k] * (smooth(k, n) - smooth(k + 1, n)) for k in range(BANDS))

    gains = numpy.ones(BANDS)
    targets = gains
    e = v = numpy.zeros(len(puppet["dof"]))
    base = course(frames - 1)[:frames]
    lowest = [-1 if dof.get("kind") == "relative" else 0 for dof in puppet["dof"].values()]
    signal = []
    for n in range(frames):
        for cue in cues.get(n, ()):
            if "mood" in cue:
                targets = numpy.array(puppet["mood"][cue["mood"]].get("gains", FLAT))
            targets = numpy.array(cue.get("gains", targets))
        gains = gains + (targets - gains) * (1 - math.exp(-1 / (frame_rate * 0.25)))
        gains = numpy.where(abs(targets - gains) < 2**-10, targets, gains)
        corr = filtered(course(n), gains, n) - base[n]
        k, tau = math.exp(-1 / (frame_rate * 0.15)), 0.15
        e, v = k * (e + (v + e / tau) / frame_rate), k * (v - (v + e / tau) / (frame_rate * tau))
        if n:
            e = e + (filtered(course(n - 1), gains, n) - course(n - 1)[n]) - corr
        if (gains == 1).all():
            e = v = numpy.zeros(len(e))
        signal.append(numpy.clip(base[n] + corr + e, lowest, 1))
    return base, numpy.array(signal)


def busy_score(puppet, frames):
    """Return a score with news of every kind, for a puppet of 10 frames a second, and gains from its fifth frame on."""
    rng = random.Random(3)
    actions = list(puppet["action"])
    cues = [{"at": 0.4, "gains": GAINS[2]}, {"at": 0, "weights": dict.fromkeys(actions, 1)}]
    for n, kind in zip(range(7, frames, 6), itertools.cycle(("weights", "live", "tempo", "global", "gains", "mood"))):
        action = rng.choice(actions)
        cue = {
            "weights": {"weights": {action: rng.choice((0, 1, 3))}},
            "live": {"live": {"GAZE": rng.random()}},
            "tempo": {"tempo": {action: rng.uniform(0.1, 4)}},
            "global": {"tempo": {"global": rng.uniform(0.3, 3)}},
            "gains": {"gains": [rng.uniform(-2, 2) for _ in range(BANDS)]},
            "mood": {"mood": "NERVOUS"},
        }[kind]
        cues.append({"at": n / 10} | cue)
    return {"cue": cues}


def busy_puppet():
    actions = {
        "NOD": {"entry": "start", "cycles": 2, "tempo": 1.3, "tau": 0.2, "map": [["NECK", 0.2, 0.9, "rsin"]]},
        "LOOK": {
            "tempo": 0.4,
            "warp": 2,
            "map": [["NECK", 0, 1, "0.5*live(GAZE) + 0.5*noise3(2*t)"], ["EYE", 1, 0, "SAW"]],
        },
        "ROLL": {
            "tau": [0.1, 1],
            "map": [["WHEEL", -1, 1, "noise1"], ["EYE", 0, 1, "clamp(live(GAZE) - 0.2, hi=0.5)"]],
        },
    }
    return {
        "frame_rate": 10,
        "dof": {"NECK": {}, "EYE": {"rest": 0.1}, "WHEEL": {"kind": "relative", "signal": True}},
        "function": {"SAW": {"table": [0, 0.3, 1]}},
        "action": actions,
        "mood": {"NERVOUS": {"gains": GAINS[0], "tempo": 1.4}},
    }


def test_signal_is_that_of_the_definitions_taken_word_by_word():
    puppet = busy_puppet()
    frames = 80
    score = busy_score(puppet, frames)
    base, signal = literal_signal(puppet, score, frames)
    found = render_signal(puppet, score, frames)
    assert len(found.news) >= 9 and found.is_processed.all() and found.is_clamped.any() and not found.is_clamped.all()
    assert found.base == pytest.approx(base, abs=1e-12)
    assert found.signal == pytest.approx(signal, abs=1e-11)


def test_future_foreseen_is_what_comes():
    """Of random puppets, from frames in the middle of everything, played on without cues."""
    compared = 0
    for seed in range(40):
        puppet, score = random_files(seed, 3)
        seer = FarSightedPuppet(puppet, score)
        for stop in (1, 7, 40, 90):
            seer.advance_to(stop - 1)
            seer.step()
            foreseen, weight_sums = seer.foresee(60)
            known = {"cue": [cue for frame in seer.cues if frame < stop for cue in seer.cues[frame]]}
            base, sums = render(puppet, known, stop + 60)
            assert weight_sums == pytest.approx(sums[stop:], abs=1e-12)
            # The far future is as right as the phases are, and sums of weights near 0 magnify rounding.
            errors = abs(foreseen - base[stop:])[:, seer.is_processed] * numpy.minimum(
                1, sums[stop:][:, seer.is_processed]
            )
            assert errors.max(initial=0) < 1e-9, seed
            compared += errors.size
    assert compared > 20_000


def test_future_has_the_end_of_a_gesture_and_hold_where_it_left():
    puppet = swaying_puppet("const(0.9)")
    puppet["action"]["SWAY"] |= {"entry": "start", "cycles": 1, "tempo": 0.5}
    seer = FarSightedPuppet(puppet, {"cue": [{"at": 0, "weights": {"SWAY": 1}}]})
    seer.step()
    foreseen, weight_sums = seer.foresee(WINDOW)
    # It ends in frame 60. HOLD, below 1/256 after 1.9 s, takes over at the base of frame 59.
    assert foreseen[58:, 0] == pytest.approx(0.9, abs=0.4 / 256) and foreseen[-1, 0] == foreseen[58, 0]
    assert weight_sums[58:70].min() < 0.9 and weight_sums[-1] == 1


def test_dof_takes_part_by_its_key_or_its_kind_but_never_if_it_blinks():
    mappings = [
        ["LID", 0, 1, "blink"],
        ["LID_TOO", 0, 1, "WINK"],
        *([name, 0, 1, "rsin"] for name in ("A", "B", "C", "D")),
    ]
    puppet = {
        "dof": {
            "LID": {},
            "LID_TOO": {"signal": False},
            "A": {},
            "B": {"signal": False},
            "C": {"kind": "relative"},
            "D": {"kind": "relative", "signal": True},
        },
        "function": {"WINK": {"expr": "rtrigsin(0.5, 1)"}},
        "action": {"ALL": {"map": mappings}},
    }
    score = {"cue": [{"at": 0, "weights": {"ALL": 1}, "gains": GAINS[0]}]}
    found = render_signal(puppet, score, 200)
    assert found.is_processed.tolist() == [False, False, True, False, False, True]
    assert [(found.signal[:, j] != found.base[:, j]).any() for j in range(6)] == found.is_processed.tolist()


def test_news_does_not_jerk_the_signal():
    """A weight that rises slowly leaves the signal's course through the frame in which it is told, whatever it foretells."""
    puppet = swaying_puppet("const(1)")
    puppet["action"]["SWAY"]["tau"] = 3
    score = {"cue": [{"at": 0, "gains": [1, 1, 1, 1, 1, 3, 4]}, {"at": 10, "weights": {"SWAY": 1}}]}
    found = render_signal(puppet, score, 600)
    assert found.news == [300]
    assert found.signal[299, 0] == 0.5
    # Without the offset it would leap as far as the offset takes up.
    assert found.offset[300, 0] > 0.1
    assert abs(found.signal[300, 0] - 0.5) < 1e-3
    assert abs(numpy.diff(found.signal[:, 0], 2)).max() < 0.02


def test_nothing_is_added_in_frame_0():
    score = {"cue": [{"at": 0, "weights": {"SWAY": 1}, "gains": GAINS[0]}]}
    assert not render_signal(swaying_puppet(), score, 100).offset.any()


def test_rest_begins_254_frames_after_the_last_news():
    puppet = swaying_puppet()
    score = {"cue": [{"at": 0, "gains": GAINS[0]}, {"at": 1, "weights": {"SWAY": 1}}, {"at": 4, "gains": GAINS[3]}]}
    found = render_signal(puppet, score, 500)
    assert numpy.flatnonzero(found.is_at_rest).tolist() == list(range(30 + WINDOW, 500))
    assert found.news == [30]
    # Once the whole window is, the signal is the sine, each band of it amplified.
    rest = taps(GAINS[3])
    w = 2 * math.pi * round(0.7 * 65536) / 65536 / 30
    gain = (rest * numpy.cos(w * numpy.arange(-WINDOW, WINDOW + 1))).sum()
    expected = (0.5 + 0.5 * gain * numpy.sin(w * numpy.arange(400, 500))).clip(0, 1)
    assert found.signal[400:, 0] == pytest.approx(expected, abs=1e-9)
