"""The prompter: steps reach the MCU before their frames, and its queue never overflows."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marotte.prompter import AHEAD_FRAMES, Prompter
from marotte.score import Step

QUEUE_MAX = 20


class FakeSession:
    """Keeps what it is told, frame by frame, and how many targets wait."""

    def __init__(self):
        self.sent = []

    def weight_targets(self, frame, targets_q28):
        self.sent += [(frame, "weight", action, target) for action, target in targets_q28.items()]

    def live_targets(self, frame, targets_q28):
        self.sent += [(frame, "live", live, target) for live, target in targets_q28.items()]

    def tempo(self, frame, action, tempo_q16):
        self.sent.append((frame, "tempo", action, tempo_q16))

    def gains(self, frame, gains4_q16):
        self.sent += [(frame, "gain", band, gain) for band, gain in gains4_q16.items()]

    def waiting(self, reached):
        return sum(frame > reached for frame, *_ in self.sent)


def test_prompter_sends_everything_in_fixed_point():
    session = FakeSession()
    prompter = Prompter(
        session, [Step(3, {0: 0.5, 7: 1e-12}, {1: 0.25}, 1.5, {6: 0.05}, (-4, -1.5, 0, 1, 1.00001, 2.5, 4))]
    )
    prompter.reached(-1)
    gains4_q16 = [0, 5 << 15, 4 << 16, 5 << 16, (5 << 16) + 1, 13 << 15, 8 << 16]
    expected = [(3, "weight", 0, 1 << 27), (3, "weight", 7, 1)]
    expected += [(3, "gain", band, gain) for band, gain in enumerate(gains4_q16)]
    expected += [(3, "live", 1, 1 << 26)]
    expected += [(3, "tempo", 255, 98304), (3, "tempo", 6, 3277)]
    assert session.sent == expected
    assert prompter.is_done


def test_prompter_sends_nothing_too_early():
    session = FakeSession()
    prompter = Prompter(session, [Step(AHEAD_FRAMES + 1, {0: 1.0}, {}, None)])
    assert prompter.reached(0) == []
    assert len(prompter.reached(1)) == 1


@pytest.mark.parametrize("size", [1, 7, QUEUE_MAX])
def test_prompter_waits_for_room(size):
    session = FakeSession()
    steps = [Step(frame, dict.fromkeys(range(size), 1.0), {}, None) for frame in range(50)]
    prompter = Prompter(session, steps, QUEUE_MAX)
    for reached in range(-1, 50):
        prompter.reached(reached)
        assert session.waiting(reached) <= QUEUE_MAX
        assert max((frame for frame, *_ in session.sent), default=-1) >= min(reached + 1, 49)
    assert prompter.is_done


@given(
    frames=st.lists(
        st.tuples(
            st.integers(1, 5), st.integers(0, 4), st.integers(0, 4), st.booleans(), st.integers(0, 4), st.booleans()
        ),
        max_size=30,
    ),
    strides=st.lists(st.integers(1, 4), min_size=1, max_size=10),
)
def test_prompter_sends_each_step_once_and_in_time(frames, strides):
    session = FakeSession()
    steps, frame = [], -1
    for gap, weights, lives, has_tempo, tempos, has_gains in frames:
        frame += gap
        steps.append(
            Step(
                frame,
                dict.fromkeys(range(weights), 1.0),
                dict.fromkeys(range(lives), 0.5),
                1.0 if has_tempo else None,
                dict.fromkeys(range(tempos), 2.0),
                (0.5,) * 7 if has_gains else None,
            )
        )
    prompter = Prompter(session, steps, QUEUE_MAX)
    sent, reached, turn = [], -1, 0
    while reached < frame:
        sent += prompter.reached(reached)
        assert session.waiting(reached) <= QUEUE_MAX
        reached += strides[turn % len(strides)]
        turn += 1
    while not prompter.is_done:  # what had to wait for room, and is late
        sent += prompter.reached(reached)
    assert sent == steps
