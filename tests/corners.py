"""Puppets and scores in which the definitions of `docs/motion.md` are hardest to keep.

All of them are of the `"core"` level of `tests.generate`, valid, and last `SECONDS`.
"""

from typing import NamedTuple

SECONDS = 30

# The start of noise table 1 is 0 for this seed, where the definition takes 1.
_SEED_OF_ZERO_STREAM = -0x85EBCA77 * pow(0x9E3779B1, -1, 2**32) % 2**32


class Corner(NamedTuple):
    """A named case: a puppet and a score as `tomllib` gives them."""

    name: str
    puppet: dict
    score: dict


def corners():
    """Return the list of cases."""
    return [
        *(_faint_hand_over(frame_rate, 0.01) for frame_rate in (10, 30, 60)),
        _faint_hand_over(10, 0.0005),
        _everything_at_once(),
        _zero_stream(),
        _fastest_phases(),
        _slowest_phases(),
        _cues_of_one_frame(),
        _holds_taking_over(),
        _crossed_ranges(),
        _nothing_mapped(),
    ]


def _puppet(name, dofs, actions, **options):
    return {"name": name, "seed": 1999, "dof": dofs, "action": actions} | options


def _cues(*cues):
    """Return a score from pairs (time in seconds, weights)."""
    return {"cue": [{"at": at_s, "weights": weights} for at_s, weights in cues]}


def _faint_hand_over(frame_rate, target):
    """The fastest action leaves to the slowest and faintest while HOLD is gone: the sum falls to some 1e-6."""
    actions = {
        "FAST": {"tau": 0.03, "map": [["NECK", 0, 1, "const(1)"]]},
        "SLOW": {"tau": 10, "map": [["NECK", 0, 1, "const(0)"]]},
    }
    name = f"faint hand-over to {target} at {frame_rate} Hz"
    score = _cues((0, {"FAST": 1}), (20, {"FAST": 0, "SLOW": target}))
    return Corner(name, _puppet(name, {"NECK": {}}, actions, frame_rate=frame_rate), score)


def _everything_at_once():
    """All 64 actions at weight 4 on the same 8 of 16 DOFs: 512 mappings, the largest sums."""
    dofs = {f"DOF_{j}": {"kind": "relative" if j % 4 == 3 else "absolute"} for j in range(16)}
    actions = {
        f"ACTION_{i}": {"tempo": 0.1 * (i + 1), "map": [[f"DOF_{j}", 1, 0, f"noise{i % 16 + 1}"] for j in range(8)]}
        for i in range(64)
    }
    score = _cues((0.5, dict.fromkeys(actions, 4)), (20, dict.fromkeys(actions, 0)))
    return Corner("everything at once", _puppet("everything at once", dofs, actions), score)


def _zero_stream():
    dofs = {"NECK": {}}
    actions = {"SWAY": {"tempo": 0.7, "map": [["NECK", 0, 1, "noise1"]]}}
    puppet = _puppet("zero stream", dofs, actions, seed=_SEED_OF_ZERO_STREAM, noise_spread=1)
    return Corner("zero stream", puppet, _cues((0, {"SWAY": 1})))


def _fastest_phases():
    """32 periods a second at 10 frames a second: 3.2 in a frame, and the phases pass 900."""
    actions = {
        "SINE": {"tempo": 8, "map": [["A", 0, 1, "rsin"], ["B", 0, 1, "rcos"]]},
        "NOISE": {"tempo": 7.9997, "map": [["C", 0, 1, "noise16"], ["B", 1, 0, "noise2"]]},
    }
    score = _cues((0, {"SINE": 1, "NOISE": 0.5}))
    score["cue"][0]["tempo"] = {"global": 4}
    puppet = _puppet("fastest phases", {"A": {}, "B": {}, "C": {}}, actions, frame_rate=10)
    return Corner("fastest phases", puppet, score)


def _slowest_phases():
    """A hundredth of a period in 30 frames, at tempos that are no multiples of 1/65536."""
    actions = {"CREEP": {"tempo": 0.05, "map": [["A", 0, 1, "rcos"], ["B", 1, 0, "noise3"]]}}
    score = _cues((0, {"CREEP": 4}))
    score["cue"][0]["tempo"] = {"global": 0.25}
    score["cue"] += [{"at": 10.1, "tempo": {"global": 0.3333}}, {"at": 20.07, "tempo": {"global": 0.9999}}]
    return Corner("slowest phases", _puppet("slowest phases", {"A": {}, "B": {}}, actions, frame_rate=60), score)


def _cues_of_one_frame():
    """Cues of one frame in an order other than the file's, overruling each other; awkward decimals."""
    actions = {
        name: {"tau": 0.05, "map": [["NECK", 0, 1, f"const({value})"]]} for name, value in (("A", 0.9), ("B", 0.1))
    }
    score = _cues(
        (1.09, {"A": 1}),
        (1.07, {"A": 4, "B": 2}),
        (1.09, {"B": 0}),
        (1.1, {"A": 0, "B": 1}),
        (2.000001, {"A": 1}),
        (2, {"A": 3}),
        (0.1, {"B": 1}),
        (0, {"B": 4}),
        (29.9, {"A": 0, "B": 0}),
    )
    return Corner("cues of one frame", _puppet("cues of one frame", {"NECK": {}}, actions, frame_rate=10), score)


def _holds_taking_over():
    """HOLD comes back while strong, while faint, and on a wheel; actions leave one after another."""
    actions = {
        "A": {"tau": 0.1, "tempo": 0.31, "map": [["NECK", 0, 1, "rsin"], ["WHEEL", -1, 1, "rcos"]]},
        "B": {"tau": [0.5, 0.05], "tempo": 0.17, "map": [["NECK", 1, 0.5, "noise5"]]},
    }
    dofs = {"NECK": {"rest": 0}, "WHEEL": {"kind": "relative"}}
    steps = [
        (0, 1, 0),
        (0.2, 0, 0),
        (1.5, 1, 1),
        (4, 0, 1),
        (6.1, 0, 0),
        (6.2, 1, 0),
        (9, 0, 0),
        (9.9, 0, 1),
        (15, 0, 0),
    ]
    score = _cues(*((at_s, {"A": a, "B": b}) for at_s, a, b in steps))
    return Corner("holds taking over", _puppet("holds taking over", dofs, actions), score)


def _crossed_ranges():
    """LOW above HIGH, LOW equal to HIGH, whole ranges, and live channels at both ends."""
    dofs = {"A": {"rest": 1}, "B": {}, "C": {"kind": "relative"}}
    actions = {
        "DOWN": {"map": [["A", 1, 0, "live(GAZE)"], ["B", 1, 0, "rsin"], ["C", 1, -1, "live(TURN)"]]},
        "FLAT": {"map": [["A", 0.3, 0.3, "noise4"], ["C", -1, -1, "const(1)"]]},
    }
    score = _cues((0, {"DOWN": 1}), (10, {"FLAT": 0.5}), (20, {"DOWN": 0}))
    score["cue"] += [{"at": at_s, "live": {"GAZE": at_s % 2, "TURN": 1 - at_s % 2}} for at_s in range(1, 30, 3)]
    puppet = _puppet("crossed ranges", dofs, actions, live={"GAZE": {"rest": 1, "tau": [0.03, 10]}})
    return Corner("crossed ranges", puppet, score)


def _nothing_mapped():
    dofs = {"A": {"rest": 0.123456}, "B": {"kind": "relative"}, "C": {}}
    actions = {"ONLY": {"map": [["C", 0, 1, "rsin"]]}}
    return Corner("nothing mapped", _puppet("nothing mapped", dofs, actions), _cues((0, {"ONLY": 0})))
