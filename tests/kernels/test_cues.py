"""The queue of stamped targets: what is stored, what is refused, and what acts in which frame."""

import struct
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import integers, words

MODULE = load_checked("firmware/cues.py")
ROOM = 8
LATEST_FRAME = (1 << 31) - 1
NOW = 128

# What the firmware lets through, by kind of target: first index, number of indices, least and greatest value.
LIMITS = {
    MODULE.WEIGHT: (0, formats.ACTIONS_MAX, 0, formats.WEIGHT_MAX),
    MODULE.LIVE: (0, formats.LIVES_MAX, 0, formats.WEIGHT_ONE),
    MODULE.TEMPO: (formats.MASTER, 1, formats.MASTER_TEMPO_MIN_Q16, formats.MASTER_TEMPO_MAX_Q16),
    MODULE.GAIN: (0, formats.BANDS, 0, formats.GAIN4_MAX),
}


class Target(NamedTuple):
    """One entry of the queue."""

    frame: int
    kind: int
    index: int
    value: int


class Queue:
    """The arrays of a queue that holds some targets already."""

    def __init__(self, targets=()):
        columns = zip(*targets, strict=True) if targets else ((), (), (), ())
        frames, kinds, indices, values = ([*column, *[0] * (ROOM - len(targets))] for column in columns)
        self.arrays = words(frames), bytearray(kinds), bytearray(indices), words(values)

    def targets(self, count):
        return [Target(*entry) for entry in zip(*self.arrays, strict=True)][:count]


def put(stamp, items, kind, limits, before=()):
    """Return (result, targets behind those before) of a payload."""
    payload = struct.pack("<I", stamp) + b"".join(struct.pack("<BI", *item) for item in items)
    queue = Queue(before)
    result = MODULE._put(b"\xee\xee" + payload, 2, len(items), kind, *limits, *queue.arrays, len(before))
    count = len(before) + len(items)
    assert queue.targets(len(before)) == list(before)
    return result, queue.targets(count)[len(before) :]


stamps = integers(0, 0xFFFFFFFF, LATEST_FRAME, LATEST_FRAME + 1)
kinds = st.sampled_from(list(LIMITS))


@st.composite
def payloads(draw):
    """A stamp, items (index, value) and a kind; many within their limits."""
    kind = draw(kinds)
    first, indices, least, most = LIMITS[kind]
    good = st.tuples(integers(first, first + indices - 1), integers(least, most))
    wild = st.tuples(integers(0, 255), integers(0, 0xFFFFFFFF, most + 1, max(least - 1, 0), 1 << 31))
    return draw(stamps), draw(st.lists(good, max_size=4) | st.lists(good | wild, max_size=4)), kind


@given(payloads())
def test_targets_are_stored_whole_or_refused_by_their_first_bad_field(payload):
    stamp, items, kind = payload
    first, indices, least, most = LIMITS[kind]
    is_now = stamp == 0xFFFFFFFF
    bad = [0] if stamp > LATEST_FRAME and not is_now else []
    for n, (index, value) in enumerate(items):
        bad += [1 + 2 * n] if not first <= index < first + indices else []
        bad += [2 + 2 * n] if not least <= value <= most else []
    result, stored = put(stamp, items, kind, LIMITS[kind], before=[Target(5, MODULE.WEIGHT, 1, 2)])
    if bad:
        assert result == bad[0]
    else:
        assert result == -1
        frame, kind = (0, kind | NOW) if is_now else (stamp, kind)
        assert stored == [Target(frame, kind, *item) for item in items]


queued = (
    st.builds(
        Target,
        integers(0, LATEST_FRAME, 99, 100, 101),
        st.sampled_from([MODULE.WEIGHT, MODULE.LIVE, MODULE.WEIGHT | NOW, MODULE.LIVE | NOW]),
        st.integers(0, 3),
        integers(0, formats.WEIGHT_MAX),
    )
    | st.builds(
        Target,
        integers(0, LATEST_FRAME, 99, 100, 101),
        st.sampled_from([MODULE.TEMPO, MODULE.TEMPO | NOW]),
        st.just(formats.MASTER),
        integers(formats.MASTER_TEMPO_MIN_Q16, formats.MASTER_TEMPO_MAX_Q16),
    )
    | st.builds(
        Target,
        integers(0, LATEST_FRAME, 99, 100, 101),
        st.sampled_from([MODULE.TEMPO, MODULE.TEMPO | NOW]),
        st.integers(0, 3),
        integers(formats.TEMPO_MIN_Q16, formats.TEMPO_MAX_Q16),
    )
    | st.builds(
        Target,
        integers(0, LATEST_FRAME, 99, 100, 101),
        st.sampled_from([MODULE.GAIN, MODULE.GAIN | NOW]),
        st.integers(0, formats.BANDS - 1),
        integers(0, formats.GAIN4_MAX),
    )
)


@given(
    st.lists(queued, max_size=ROOM),
    integers(0, LATEST_FRAME, 100),
    st.tuples(st.integers(0, 10), st.integers(0, 1)),
    st.integers(0, 1),
)
def test_targets_act_in_their_frame_in_order_and_the_rest_waits(targets, frame, before, consume):
    queue = Queue(targets)
    arrays = words([-1] * 4), words([-2] * 4), words([-3]), words([-4] * 4), words([-5] * 7)
    counts = words([*before, 0, 0])
    count = MODULE._apply(frame, consume, len(targets), *queue.arrays, *arrays, counts)

    due = [target for target in targets if target.frame <= frame]
    left = [target for target in targets if target.frame > frame] if consume else targets
    assert queue.targets(count) == left, "all of them if they are to act again"
    expected = [-1] * 4, [-2] * 4, [-3], [-4] * 4, [-5] * 7
    changes = news = streamed = 0
    for target in due:
        kind = target.kind & ~NOW
        if kind == MODULE.TEMPO and target.index == formats.MASTER:
            expected[2][0] = target.value
        else:
            expected[{MODULE.WEIGHT: 0, MODULE.LIVE: 1, MODULE.TEMPO: 3, MODULE.GAIN: 4}[kind]][target.index] = (
                target.value
            )
            changes += kind == MODULE.TEMPO
        news += kind != MODULE.GAIN
        streamed |= 1 << target.index if kind == MODULE.LIVE else 0
    assert tuple(map(list, arrays)) == expected
    late = sum(target.frame < frame and not target.kind & NOW for target in due) if consume else 0
    assert MODULE._is_news(frame, len(targets), *Queue(targets).arrays[:2]) == (news > 0)
    assert list(counts) == [before[0] + late, before[1] + changes, news, streamed]


def test_count_of_late_targets_stays_where_it_needs_no_memory():
    counts = words([(1 << 30) - 2, 0, 0, 0])
    queue = Queue([Target(5, MODULE.WEIGHT, 0, 0)] * 3)
    rest = words([0]), words([0]), words([0]), words([0]), words([0])
    assert MODULE._apply(6, 1, 3, *queue.arrays, *rest, counts) == 0
    assert counts[0] == (1 << 30) - 1


@pytest.mark.parametrize(("frame", "acts"), [(99, False), (100, True), (101, True)])
def test_target_acts_from_its_frame_on(frame, acts):
    queue = Queue([Target(100, MODULE.WEIGHT, 2, 77)])
    weights, counts = words([0] * 4), words([0, 0, 0, 0])
    rest = words([0]), words([0]), words([0]), words([0])
    assert MODULE._apply(frame, 1, 1, *queue.arrays, weights, *rest, counts) == (not acts)
    assert (weights[2], list(counts)) == (77 * acts, [int(frame > 100), 0, int(acts), 0])


places = st.lists(st.integers(0, 3), max_size=4, unique=True).flatmap(
    lambda kept: st.permutations([*kept, *[formats.NEW] * (4 - len(kept))])
)


@given(st.lists(queued, max_size=ROOM), places, places)
def test_waiting_targets_follow_what_keeps_its_name_and_are_dropped_with_what_is_gone(targets, keep_action, keep_live):
    queue = Queue(targets)
    count = MODULE._renumber(len(targets), *queue.arrays, bytes(keep_action), 4, bytes(keep_live), 4)
    expected = []
    for target in targets:
        keep = keep_live if target.kind & ~NOW == MODULE.LIVE else keep_action
        if target.index == formats.MASTER or target.kind & ~NOW == MODULE.GAIN:
            expected.append(target)
        elif target.index in keep:
            expected.append(target._replace(index=keep.index(target.index)))
    assert queue.targets(count) == expected


def test_queue_refuses_what_does_not_fit_and_tells_its_room():
    cues = MODULE.Cues()
    payload = struct.pack("<i", 7) + struct.pack("<BI", 1, 2) * 40
    body = b"\0\0" + payload
    for n in range(6):
        assert cues.put(MODULE.WEIGHT, body, 2, len(payload), 64) == 0
        assert cues.count == 40 * (n + 1)
    assert cues.put(MODULE.WEIGHT, body, 2, len(payload), 64) != 0
    assert (cues.count, cues.detail) == (240, formats.QUEUE_MAX - 240)
    assert cues.put(MODULE.WEIGHT, body, 2, 4 + 16 * 5, 64) == 0
    assert cues.count == formats.QUEUE_MAX
    weights = words([0] * 64)
    cues.apply(7, weights, words([0]), words([0]), words([0]), words([0]))
    assert (cues.count, weights[1]) == (0, 2)


def test_queue_tells_of_the_last_frame_what_is_news_and_which_channels_got_targets():
    cues = MODULE.Cues()
    arrays = words([0] * 4), words([0] * 16), words([0]), words([0] * 4), words([0] * 7)
    told = []
    for kind, index, value, indices in (
        (MODULE.LIVE, 15, 5, 16),
        (MODULE.GAIN, 6, formats.GAIN4_MAX, formats.BANDS),
        (MODULE.TEMPO, formats.MASTER, formats.TEMPO_ONE, 4),
    ):
        payload = struct.pack("<iBI", -1, index, value)
        assert cues.put(kind, b"\0\0" + payload, 2, len(payload), indices) == 0
        cues.apply(9, *arrays)
        told.append(list(cues.counts[2:]))
        cues.apply(10, *arrays)
        told.append(list(cues.counts[2:]))
    assert told == [[1, 1 << 15], [0, 0], [0, 0], [0, 0], [1, 0], [0, 0]]
    assert cues.arrivals == 3
    assert (arrays[1][15], arrays[4][6], arrays[2][0]) == (5, formats.GAIN4_MAX, formats.TEMPO_ONE)
    assert cues.put(MODULE.GAIN, struct.pack("<BBiBI", 0, 0, -1, 7, 0), 2, 9, formats.BANDS) != 0
    assert (cues.detail, cues.arrivals) == (1, 3), "what is refused does not arrive"


def test_queue_foresees_what_acts_without_losing_it():
    cues = MODULE.Cues()
    weights = words([0] * 4)
    rest = words([0]), words([0]), words([0]), words([0] * 7)
    for kind, frame, index, value, indices in ((MODULE.GAIN, 5, 0, 1, formats.BANDS), (MODULE.WEIGHT, 7, 2, 9, 4)):
        payload = struct.pack("<iBI", frame, index, value)
        assert cues.put(kind, b"\0\0" + payload, 2, len(payload), indices) == 0
    assert [cues.has_news(frame) for frame in (4, 5, 6, 7, 8)] == [False, False, False, True, True]
    cues.apply(7, weights, *rest, consume=False)
    assert (weights[2], cues.count, cues.counts[0], cues.counts[2]) == (9, 2, 0, 1)
    weights[2] = 0
    cues.apply(7, weights, *rest)
    assert (weights[2], cues.count, cues.counts[0], cues.counts[2]) == (9, 0, 1, 1), "the gain came late"
