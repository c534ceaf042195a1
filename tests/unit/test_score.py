"""Scores: cues in frames, their order, and the mistakes in their files."""

from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.puppet_file import load_puppet
from marotte.score import Cue, Score, Step, load_score, read_score, resumed, state
from marotte.tomlfile import FileMistakes

PUPPETS = Path(__file__).parents[2] / "puppets"

PUPPET = """
frame_rate = 10
[dof.NECK]
[action.A]
map = [["NECK", 0, 1, "rsin"]]
[action.B]
map = [["NECK", 0, 1, "rcos"]]
[action.C]
map = [["NECK", 0, 1, "live(GAZE)"]]
[behaviour.AB]
A = 0.5
B = 1
[behaviour.ONLY_C]
C = 2
[mood.FAST]
tempo = 2
[mood.PLAIN]
gains = [1, 1, 1, 1, 1, 1, 1]
[mood.NERVOUS]
gains = [2.5, 2, 1.4, 1, -1, 0, -4]
"""


@pytest.fixture
def puppet(tmp_path):
    path = tmp_path / "puppet.toml"
    path.write_text(PUPPET)
    return load_puppet(path)


def steps_of(tmp_path, puppet, text):
    path = tmp_path / "score.toml"
    path.write_text(text)
    return {step.frame: step for step in load_score(path, puppet).steps(puppet)}


def mistakes_of(tmp_path, puppet, text):
    path = tmp_path / "score.toml"
    path.write_text(text)
    _, mistakes = read_score(path, puppet)
    if mistakes:
        with pytest.raises(FileMistakes):
            load_score(path, puppet)
    return [str(mistake).removeprefix(str(path)) for mistake in mistakes]


@pytest.mark.parametrize(
    ("at", "rate_hz", "frame"),
    [
        ("0", 30, 0),
        ("0.0", 30, 0),
        ("1.1", 100, 110),  # 1.1 is a little more than 11/10 as a float
        ("0.1", 30, 3),
        ("0.3", 10, 3),
        ("0.7", 10, 7),
        ("0.30001", 10, 4),
        ("0.01", 10, 1),
        ("4.35", 60, 261),
        ("1e1", 30, 300),
        ("86400.033333333333333333", 30, 2592001),
        ("86400.033333333333333334", 30, 2592002),
    ],
)
def test_cue_frame_is_the_first_not_before_its_time(tmp_path, at, rate_hz, frame):
    (tmp_path / "p.toml").write_text("[dof.NECK]\n[mood.M]\ntempo = 1\n")
    (tmp_path / "s.toml").write_text(f'[[cue]]\nat = {at}\nmood = "M"\n')
    score = load_score(tmp_path / "s.toml", load_puppet(tmp_path / "p.toml"))
    assert score.cues[0].frame(rate_hz) == frame


@given(at_s=st.fractions(0, 1000), rate_hz=st.integers(10, 60))
def test_cue_frame_holds_for_any_time(at_s, rate_hz):
    frame = Cue(at_s).frame(rate_hz)
    assert Fraction(frame, rate_hz) >= at_s > Fraction(frame - 1, rate_hz)


def test_score_weights_leave_the_others(tmp_path, puppet):
    steps = steps_of(tmp_path, puppet, "[[cue]]\nat=0\nweights={A=1}\n[[cue]]\nat=1\nweights={B=0.5}\n")
    assert (steps[0].weights, steps[10].weights) == ({0: 1.0}, {1: 0.5})


def test_score_behaviour_sets_all_others_to_zero(tmp_path, puppet):
    text = '[[cue]]\nat=0\nbehaviour="AB"\nweights={C=1}\n[[cue]]\nat=1\nbehaviour="ONLY_C"\n'
    steps = steps_of(tmp_path, puppet, text)
    assert steps[0].weights == {0: 0.5, 1: 1.0, 2: 1.0}
    assert steps[10].weights == {0: 0.0, 1: 0.0, 2: 2.0}


def test_score_behaviour_is_sent_again_for_what_it_names(tmp_path, puppet):
    steps = steps_of(tmp_path, puppet, '[[cue]]\nat=0\nbehaviour="ONLY_C"\n[[cue]]\nat=1\nbehaviour="ONLY_C"\n')
    assert steps[10].weights == {2: 2.0}


def test_score_cues_of_one_frame_act_in_order_of_time_then_file(tmp_path, puppet):
    text = """
    [[cue]]
    at = 0.98
    weights = { A = 3 }
    live = { GAZE = 0.1 }
    [[cue]]
    at = 0.95
    behaviour = "AB"
    tempo = { global = 4, A = 3, B = 0.5 }
    [[cue]]
    at = 0.98
    live = { GAZE = 0.9 }
    mood = "FAST"
    tempo = { A = 7 }
    """
    steps = steps_of(tmp_path, puppet, text)
    assert list(steps) == [10]
    assert (steps[10].weights, steps[10].lives, steps[10].master_tempo) == ({0: 3.0, 1: 1.0}, {0: 0.9}, 2.0)
    assert steps[10].tempos == {0: 7.0, 1: 0.5}


def test_score_within_a_cue_behaviour_comes_first_and_tempo_last(tmp_path, puppet):
    text = '[[cue]]\nat=0\ntempo={global=0.5}\nmood="FAST"\nweights={A=0}\nbehaviour="AB"\n'
    step = steps_of(tmp_path, puppet, text)[0]
    assert (step.weights, step.master_tempo) == ({0: 0.0, 1: 1.0}, 0.5)


def test_score_behaviour_in_the_same_frame_undoes_earlier_weights(tmp_path, puppet):
    text = '[[cue]]\nat=0\nweights={A=1}\n[[cue]]\nat=0\nbehaviour="ONLY_C"\n'
    assert steps_of(tmp_path, puppet, text)[0].weights == {0: 0.0, 2: 2.0}


def test_score_mood_without_tempo_leaves_it(tmp_path, puppet):
    assert steps_of(tmp_path, puppet, '[[cue]]\nat=0\nmood="PLAIN"\n')[0].master_tempo is None


ONES = (1.0,) * 7
NERVOUS = (2.5, 2.0, 1.4, 1.0, -1.0, 0.0, -4.0)


@pytest.mark.parametrize(
    ("cues", "gains"),
    [
        ('[[cue]]\nat=0\nmood="NERVOUS"\n', NERVOUS),
        ('[[cue]]\nat=0\nmood="FAST"\n', ONES),
        ("[[cue]]\nat=0\ntempo={global=2}\n", None),
        ('[[cue]]\nat=0\ngains=[0,0,0,0,0,0,0]\nmood="NERVOUS"\n', (0.0,) * 7),
        ('[[cue]]\nat=0\ngains=[0,0,0,0,0,0,0]\n[[cue]]\nat=0\nmood="NERVOUS"\n', NERVOUS),
        ('[[cue]]\nat=0\nmood="NERVOUS"\n[[cue]]\nat=0\nmood="FAST"\n', ONES),
        ('[[cue]]\nat=0\nmood="NERVOUS"\n[[cue]]\nat=0\nweights={A=1}\n', NERVOUS),
    ],
)
def test_score_gains_come_from_the_last_mood_or_gains_and_a_mood_without_them_sets_all_to_1(
    tmp_path, puppet, cues, gains
):
    assert steps_of(tmp_path, puppet, cues)[0].gains == gains


def test_score_steps_come_in_order_of_frames(tmp_path, puppet):
    steps = steps_of(tmp_path, puppet, "[[cue]]\nat=2\nweights={A=1}\n[[cue]]\nat=1\nweights={A=2}\n")
    assert list(steps) == [10, 20]


def test_score_of_the_pet_uses_behaviours_weights_and_live_channels():
    puppet = load_puppet(PUPPETS / "pet.toml")
    score = load_score(PUPPETS / "pet-score.toml", puppet)
    assert score.length_s == 20
    for part in ("behaviour", "weights", "lives", "mood"):
        assert any(getattr(cue, part) for cue in score.cues)


def test_cue_summary_names_everything():
    cue = Cue(Fraction(1), "HAPPY", {"A": 0.5}, "FAST", (1, 2, 1, 1, 1, 1, 1), {"GAZE": 0.25}, {"A": 2}, 1.5)
    assert cue.summary() == "HAPPY, mood FAST, A 0.5, GAZE 0.25, tempo of A 2, tempo 1.5, gains 1 2 1 1 1 1 1"


def test_score_without_cues_has_no_steps(puppet):
    assert (Score().steps(puppet), Score().length_s) == ([], 0.0)


MISTAKES = [
    ("", ": has no cue, expected at least one [[cue]]"),
    ("[[cue]]\nweights={A=1}", ':1 cue[0]: has no "at"; expected at = SECONDS'),
    ("[[cue]]\nat=-1", ":2 cue[0].at: found -1, expected a number in 0..1e+07"),
    ('[[cue]]\nat="now"', ':2 cue[0].at: found "now", expected a number'),
    ("[[cue]]\nat=nan", ":2 cue[0].at: found NaN, expected a number"),
    ("[[cue]]\nat=1e999999999", ":2 cue[0].at: found 1E+999999999, expected a number"),
    ('[[cue]]\nat=0\nbehaviour="ABB"', ':3 cue[0].behaviour: unknown behaviour "ABB"; did you mean "AB"?'),
    ("[[cue]]\nat=0\nbehaviour=1", ":3 cue[0].behaviour: found 1, expected a text"),
    ('[[cue]]\nat=0\nmood="FART"', ':3 cue[0].mood: unknown mood "FART"; did you mean "FAST"?'),
    ("[[cue]]\nat=0\nweights={Z=1}", ":3 cue[0].weights.Z: unknown action"),
    ("[[cue]]\nat=0\nweights={A=4.5}", ":3 cue[0].weights.A: found 4.5, expected a number in 0..4"),
    ("[[cue]]\nat=0\nweights=[1]", ":3 cue[0].weights: found [1], expected a table"),
    ("[[cue]]\nat=0\nlive={GASE=1}", ':3 cue[0].live.GASE: unknown live channel; did you mean "GAZE"?'),
    ("[[cue]]\nat=0\nlive={GAZE=1.5}", ":3 cue[0].live.GAZE: found 1.5, expected a number in 0..1"),
    ("[[cue]]\nat=0\ntempo={global=5}", ":3 cue[0].tempo.global: found 5, expected a number in 0.25..4"),
    ("[[cue]]\nat=0\ntempo={A=9}", ":3 cue[0].tempo.A: found 9, expected a number in 0.05..8"),
    ("[[cue]]\nat=0\ntempo={globe=1}", ':3 cue[0].tempo.globe: unknown action; did you mean "global"?'),
    ("[[cue]]\nat=0\ngains=[1,1]", ":3 cue[0].gains: found 2 values, expected 7"),
    ("[[cue]]\nat=0\nweight={A=1}", ':3 cue[0].weight: unknown key; did you mean "weights"?'),
    ("[cue]\nat=0", ":1 cue: found a table, expected tables, each headed [[cue]]"),
    ("cue=[1]", ":1 cue[0]: found 1, expected a table headed [[cue]]"),
    ("[[cue]]\nat=0\n[[cues]]\nat=1", 'cues: unknown key; did you mean "cue"?'),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[expected[:50] for _, expected in MISTAKES])
def test_score_mistake_is_named_and_placed(tmp_path, puppet, text, expected):
    found = mistakes_of(tmp_path, puppet, text)
    assert any(expected in line for line in found), found


def test_score_reports_all_mistakes(tmp_path, puppet):
    text = '[[cue]]\nat=-1\nbehaviour="X"\n[[cue]]\nweights={A=9}\nlive={GAZE=2}\n'
    assert len(mistakes_of(tmp_path, puppet, text)) == 5


TIMES = st.integers(0, 40).map(lambda tenth: Fraction(tenth, 20))
CUES = st.builds(
    Cue,
    TIMES,
    st.sampled_from([None, "AB", "ONLY_C"]),
    st.dictionaries(st.sampled_from("ABC"), st.sampled_from([0.0, 0.5, 4.0])),
    st.sampled_from([None, "FAST", "PLAIN", "NERVOUS"]),
    st.sampled_from([None, (0.5,) * 7]),
)


@given(cues=st.lists(CUES, max_size=12))
def test_score_steps_lead_to_the_targets_and_gains_of_the_definition(tmp_path_factory, cues):
    path = tmp_path_factory.getbasetemp() / "steps.toml"
    path.write_text(PUPPET)
    puppet = load_puppet(path)
    names = list(puppet.actions)
    steps = {step.frame: step for step in Score(tuple(cues)).steps(puppet)}
    sent = dict.fromkeys(names, 0.0)
    sent_gains = ONES
    for frame in range(25):
        if frame in steps:
            sent.update((names[index], target) for index, target in steps[frame].weights.items())
            sent_gains = steps[frame].gains or sent_gains
        expected = dict.fromkeys(names, 0.0)
        gains = ONES
        for cue in sorted(cues, key=lambda cue: cue.at_s):
            if cue.at_s * 10 <= frame:
                if cue.behaviour:
                    expected = {name: puppet.behaviours[cue.behaviour].get(name, 0.0) for name in names}
                expected.update(cue.weights)
                if cue.mood:
                    gains = puppet.moods[cue.mood].gains or ONES
                gains = cue.gains or gains
        assert (sent, sent_gains) == (expected, gains)


def test_state_is_what_all_cues_until_then_have_set(puppet):
    steps = [
        Step(0, {0: 1.0}, {0: 0.25}, None),
        Step(10, {0: 0.0, 1: 2.0}, {}, 1.5, {2: 3.0}, NERVOUS),
        Step(11, {2: 4.0}, {0: 1.0}, None),
    ]
    assert state(steps, puppet, -1) == Step(-1, {0: 0.0, 1: 0.0, 2: 0.0}, {0: puppet.lives["GAZE"].rest}, 1.0, {}, ONES)
    assert state(steps, puppet, 10) == Step(10, {0: 0.0, 1: 2.0, 2: 0.0}, {0: 0.25}, 1.5, {2: 3.0}, NERVOUS)
    now, *later = resumed(steps, puppet, 10)
    assert (now.frame, now.weights, later) == (-1, {0: 0.0, 1: 2.0, 2: 0.0}, steps[2:])


def test_state_leaves_gestures_alone(tmp_path):
    (tmp_path / "p.toml").write_text(
        '[dof.D]\n[action.G]\nentry="start"\ncycles=2\nmap=[["D",0,1,"rsin"]]\n[action.A]\nmap=[["D",0,1,"rsin"]]\n'
    )
    assert state([Step(0, {0: 1.0}, {}, None)], load_puppet(tmp_path / "p.toml"), 5).weights == {1: 0.0}
