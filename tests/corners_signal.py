"""Puppets and scores in which the signal processing of `docs/motion.md` is hardest to keep.

Like `tests.corners`, with band gains within `reach` of 0. All are valid, last `FRAMES` frames, and have their last news before
frame `LAST_NEWS`, so that they come to rest.
"""

import math
import random

from tests.corners import Corner

FRAMES = 440
LAST_NEWS = 150


def signal_corners(reach):
    """Return the list of cases."""
    cases = [
        _everything_at_once,
        _weights_in_every_frame,
        _streamed_channel,
        _tempos_in_every_frame,
        _gains_in_every_frame,
        _ends_of_gestures_in_sight,
        _flat_and_back,
        _news_just_before_flat,
        _fastest_wiggle,
        _slowest_sway,
        _wheels_turning_round,
        _beyond_both_ends,
        _slowest_weights,
        _news_at_the_beginning,
        _leaps_of_the_master,
        _saws_and_jumps,
        _offsets_warping,
        _moods,
    ]
    return [_corner(*case(reach)) for case in cases]


def _corner(name, puppet, cues):
    frame_rate = puppet.setdefault("frame_rate", 30)
    for cue in cues:
        cue["at"] = cue.pop("frame") * 10**6 // frame_rate / 10**6
    return Corner(name, {"name": name, "seed": 1999} | puppet, {"cue": cues})


def _ends(reach, first=1):
    """Return the gains that make the most of every band, alternately up and down."""
    return [reach * first * (-1) ** band for band in range(7)]


def _puppet(actions, **options):
    dofs = sorted({dof for action in actions.values() for dof, *_ in action["map"]})
    return {"dof": {dof: {} for dof in dofs}, "action": actions} | options


def _everything_at_once(reach):
    """All 64 actions at weight 4 on 8 DOFs; all leave while gains change their signs."""
    actions = {
        f"ACTION_{i}": {"tempo": 0.1 * (i + 1), "map": [[f"DOF_{j}", 1, 0, f"noise{i % 16 + 1}"] for j in range(8)]}
        for i in range(64)
    }
    cues = [
        {"frame": 3, "gains": _ends(reach)},
        {"frame": 20, "weights": dict.fromkeys(actions, 4)},
        {"frame": 100, "weights": dict.fromkeys(list(actions)[:50], 0), "gains": _ends(reach, -1)},
    ]
    return "everything at once", _puppet(actions), cues


def _weights_in_every_frame(reach):
    """The future changes before it could ever have been computed in whole."""
    actions = {
        "UP": {"tau": 0.1, "tempo": 0.31, "map": [["NECK", 0.5, 1, "rsin"], ["EYE", 0, 1, "noise1"]]},
        "DOWN": {"tau": [0.3, 1], "tempo": 1.7, "map": [["NECK", 0.5, 0, "noise2"]]},
    }
    rng = random.Random(1)
    cues = [{"frame": 0, "gains": [1, 1, 1, reach, reach, reach, reach]}]
    cues += [
        {"frame": n, "weights": {"UP": round(rng.uniform(0.1, 4), 3), "DOWN": round(rng.random(), 3)}}
        for n in range(LAST_NEWS)
    ]
    return "weights in every frame", _puppet(actions, frame_rate=60), cues


def _streamed_channel(reach):
    """A gaze that is followed with every frame, as a camera would send it."""
    actions = {"LOOK": {"map": [["EYE", 0, 1, "live(GAZE)"], ["NECK", 0.2, 0.8, "0.8*live(GAZE) + 0.2*noise1(2*t)"]]}}
    rng = random.Random(2)
    cues = [{"frame": 0, "weights": {"LOOK": 1}, "gains": _ends(reach)}]
    gaze = 0.5
    for n in range(2, LAST_NEWS):
        gaze = min(max(gaze + rng.uniform(-0.05, 0.05), 0), 1) if n % 40 else rng.random()
        cues.append({"frame": n, "live": {"GAZE": round(gaze, 4)}})
    return "streamed channel", _puppet(actions, live={"GAZE": {"tau": 0.05}}), cues


def _tempos_in_every_frame(reach):
    actions = {
        "SLIDE": {"tempo": 0.5, "map": [["NECK", 0, 1, "rsin"]]},
        "GLIDE": {"entry": "start", "tempo": 0.2, "warp": 5, "map": [["HEAD", 0, 1, "noise5"]]},
    }
    rng = random.Random(3)
    cues = [{"frame": 1, "weights": dict.fromkeys(actions, 1), "gains": [reach] * 7}]
    cues += [
        {"frame": n, "tempo": {rng.choice(("SLIDE", "GLIDE", "global")): round(rng.uniform(0.25, 2), 4)}}
        for n in range(5, LAST_NEWS)
    ]
    return "tempos in every frame", _puppet(actions, frame_rate=25), cues


def _gains_in_every_frame(reach):
    """The filter is another one in every frame, while the future stays as it is."""
    actions = {"SWAY": {"tempo": 0.8, "map": [["NECK", 0.3, 0.7, "rsin"], ["EYE", 0.6, 0.4, "noise4(3*t)"]]}}
    rng = random.Random(4)
    cues = [{"frame": 0, "weights": {"SWAY": 1}}]
    cues += [{"frame": n, "gains": [round(rng.uniform(-reach, reach), 3) for _ in range(7)]} for n in range(300)]
    return "gains in every frame", _puppet(actions), cues


def _ends_of_gestures_in_sight(reach):
    """Ends are foreseen from afar; HOLD takes over where the gesture leaves the DOF; a call while one fades."""
    actions = {
        "NOD": {
            "entry": "start",
            "cycles": 3,
            "tempo": 0.9,
            "tau": 0.15,
            "map": [["NECK", 0.2, 0.9, "rsin"], ["EYE", 1, 0, "rcos"]],
        },
        "BOW": {"entry": "start", "cycles": 1, "tempo": 0.21, "tau": [0.1, 0.5], "map": [["BACK", 0, 1, "const(1)"]]},
        "LOOK": {"tempo": 0.3, "map": [["EYE", 0, 1, "noise2"]]},
    }
    cues = [
        {"frame": 0, "gains": [1, 1, reach, reach, reach, reach, reach]},
        {"frame": 10, "weights": {"NOD": 1, "BOW": 2}},
        {"frame": 40, "weights": {"LOOK": 0.5}},
        {"frame": 120, "weights": {"NOD": 2}},
        {"frame": 149, "weights": {"LOOK": 0}},
    ]
    return "ends of gestures in sight", _puppet(actions), cues


def _flat_and_back(reach):
    """Gains are all 1 again while an offset is dying out, and news come just before and after."""
    actions = {
        "SWAY": {"tempo": 0.4, "tau": 0.3, "map": [["NECK", 0, 1, "rsin"]]},
        "POSE": {"map": [["NECK", 1, 0, "const(1)"]]},
    }
    cues = [
        {"frame": 0, "weights": {"SWAY": 1}, "gains": _ends(reach)},
        {"frame": 30, "weights": {"POSE": 1}, "gains": [1] * 7},
        {"frame": 70, "weights": {"POSE": 0}},
        {"frame": 84, "weights": {"POSE": 3}, "gains": [reach] * 7},
        {"frame": 86, "gains": [1] * 7},
        {"frame": 148, "weights": {"POSE": 0}},
        {"frame": 149, "gains": _ends(reach, -1)},
        {"frame": 240, "gains": [1] * 7},
        {"frame": 330, "gains": _ends(reach)},
    ]
    return "flat and back", _puppet(actions), cues


def _news_just_before_flat(reach):
    """Gains come to 1 in the frame after one that brings news: of what that adds to the offset nothing may be left."""
    actions = {
        "POSE": {"tau": 0.5, "map": [["NECK", 0, 1, "const(1)"]]},
        "BACK": {"map": [["NECK", 1, 0, "const(1)"]]},
    }
    # From `reach` on, differences fall by exp(-1 / 7.5) in each frame, to 2^-10.
    arrival = 60 + math.ceil(7.5 * math.log((reach - 1) * 1024)) - 1
    cues = [
        {"frame": 0, "weights": {"BACK": 1}, "gains": [1, 1, *[reach] * 5]},
        {"frame": 60, "gains": [1] * 7},
        {"frame": arrival - 1, "weights": {"POSE": 4}},
    ]
    return "news just before flat", _puppet(actions), cues


def _fastest_wiggle(reach):
    """From one end to the other in every frame: the largest sums of a filter."""
    actions = {"WIGGLE": {"tempo": 5, "tau": 0.03, "map": [["TAIL", 0, 1, "rcos"], ["WHEEL", -1, 1, "rcos"]]}}
    puppet = _puppet(actions, frame_rate=10)
    puppet["dof"]["WHEEL"] = {"kind": "relative", "signal": True}
    cues = [
        {"frame": 0, "weights": {"WIGGLE": 4}, "gains": _ends(reach, -1)},
        {"frame": 200, "gains": [0.1, *_ends(reach)[1:]]},
        {"frame": 300, "gains": [-0.4, 1, 1, 1, 1, 1, 1]},
    ]
    return "fastest wiggle", puppet, cues


def _slowest_sway(reach):
    """At the peak of the lowest band, whose window holds a single period."""
    actions = {"SWAY": {"tempo": 0.12, "map": [["NECK", 0.4, 0.6, "rsin"], ["WHEEL", 0.2, -0.2, "rcos"]]}}
    puppet = _puppet(actions)
    puppet["dof"]["WHEEL"] = {"kind": "relative", "signal": True}
    cues = [
        {"frame": 2, "weights": {"SWAY": 1}},
        {"frame": 30, "gains": [1, 1, 1, 1, 1, 1, reach]},
        {"frame": 220, "gains": [1, 1, 1, 1, 1, -reach, -reach]},
    ]
    return "slowest sway", puppet, cues


def _wheels_turning_round(reach):
    """From full speed forward to full speed backward and to a stand."""
    actions = {
        "FORWARD": {"tau": 0.1, "map": [["LEFT", 0, 1, "const(1)"], ["RIGHT", 0, 1, "const(1)"]]},
        "BACKWARD": {"tau": 0.25, "map": [["LEFT", 0, -1, "const(1)"], ["RIGHT", -1, 0.5, "noise3(t)"]]},
    }
    puppet = _puppet(actions, frame_rate=50)
    puppet["dof"] = {name: {"kind": "relative", "signal": True} for name in puppet["dof"]}
    cues = [
        {"frame": 0, "gains": [1, *_ends(reach)[1:]]},
        {"frame": 20, "weights": {"FORWARD": 1}},
        {"frame": 60, "weights": {"FORWARD": 0, "BACKWARD": 1}},
        {"frame": 130, "weights": {"BACKWARD": 0}},
    ]
    return "wheels turning round", puppet, cues


def _beyond_both_ends(reach):
    """Poses at the ends, which every gain overshoots."""
    actions = {
        "TOP": {"tau": 0.2, "map": [["A", 0, 1, "const(1)"], ["B", 1, 0, "const(1)"]]},
        "BOTTOM": {"tau": 0.1, "map": [["A", 1, 0, "const(1)"], ["B", 0, 1, "const(1)"]]},
    }
    puppet = _puppet(actions)
    puppet["dof"] = {"A": {"rest": 0}, "B": {"rest": 1}}
    cues = [
        {"frame": 0, "gains": [reach] * 7},
        {"frame": 20, "weights": {"TOP": 1}},
        {"frame": 60, "weights": {"TOP": 0, "BOTTOM": 1}},
        {"frame": 61, "gains": [-reach] * 7},
        {"frame": 110, "weights": {"BOTTOM": 0, "TOP": 0.5}},
    ]
    return "beyond both ends", puppet, cues


def _slowest_weights(reach):
    """Weights that are under way all the time, there and back."""
    actions = {
        "DRIFT": {"tau": 10, "map": [["NECK", 0, 1, "const(0.9)"]]},
        "SWAY": {"tau": [10, 3], "map": [["NECK", 0, 1, "rsin"]]},
    }
    cues = [
        {"frame": 0, "gains": [1, 1, 1, 1, reach, reach, reach], "weights": {"DRIFT": 4}},
        {"frame": 60, "weights": {"SWAY": 4}},
        {"frame": 140, "weights": {"DRIFT": 0, "SWAY": 0.01}},
    ]
    return "slowest weights", _puppet(actions, frame_rate=10), cues


def _news_at_the_beginning(reach):
    """In frames 0, 1 and 2, when all of the past is the first frame."""
    actions = {
        "A": {"tau": 0.03, "tempo": 2, "map": [["NECK", 0, 1, "rcos"]]},
        "B": {"tau": 0.05, "map": [["NECK", 1, 0, "const(0.8)"]]},
    }
    cues = [
        {"frame": 0, "gains": _ends(reach), "weights": {"A": 4}},
        {"frame": 1, "weights": {"B": 3}},
        {"frame": 2, "weights": {"A": 0}},
        {"frame": 3, "weights": {"B": 0, "A": 0.3}},
    ]
    return "news at the beginning", _puppet(actions), cues


def _leaps_of_the_master(reach):
    """The global tempo leaps between its ends, with every phase going on."""
    actions = {
        "SINE": {"tempo": 0.7, "map": [["A", 0, 1, "rsin"], ["B", 1, 0, "noise2"]]},
        "OWN": {"entry": "start", "tempo": 1.3, "warp": 3, "map": [["C", 0.2, 0.8, "rcos"]]},
    }
    cues = [{"frame": 0, "weights": {"SINE": 1}, "gains": _ends(reach, -1)}, {"frame": 17, "weights": {"OWN": 1}}]
    cues += [
        {"frame": n, "tempo": {"global": tempo}} for n, tempo in ((30, 4), (60, 0.25), (61, 4), (90, 0.25), (149, 1))
    ]
    return "leaps of the master", _puppet(actions), cues


def _saws_and_jumps(reach):
    """Curves with edges, in which one sample decides where a frame falls; random streams beside them."""
    functions = {"SAW": {"table": [round(i / 255, 4) for i in range(256)]}, "PAIR": {"table": [0, 1]}}
    actions = {
        "EDGES": {"tempo": 0.37, "map": [["A", 0.1, 0.9, "table(SAW, t/4)"], ["B", 0, 1, "PAIR"]]},
        "STEEP": {"tempo": 0.2, "map": [["C", 0.2, 0.8, "8*noise4(t) - 3.5"], ["LID", 0, 1, "blink(0.9, 0.5)"]]},
    }
    cues = [
        {"frame": 0, "weights": dict.fromkeys(actions, 1), "gains": [reach] * 7},
        {"frame": 100, "tempo": {"EDGES": 0.5}},
        {"frame": 140, "gains": [0] * 7},
    ]
    return "saws and jumps", _puppet(actions, function=functions), cues


def _offsets_warping(reach):
    """Half a period to be warped away, at the limit of half the tempo, and in the far future not at it."""
    actions = {
        f"WARP_{i}": {"entry": "start", "tempo": 0.31, "warp": warp_s, "map": [[f"DOF_{i}", 0.1, 0.9, "rsin"]]}
        for i, warp_s in enumerate((0.05, 0.5, 10))
    }
    cues = [{"frame": 0, "gains": _ends(reach)}, {"frame": 48, "weights": dict.fromkeys(actions, 1)}]
    cues += [{"frame": 120, "tempo": dict.fromkeys(actions, 1.1)}]
    return "offsets warping", _puppet(actions), cues


def _moods(reach):
    """Moods, which bring gains and a tempo in one frame, and cues that overrule them."""
    actions = {"FIDGET": {"tempo": 1.1, "map": [["NECK", 0.2, 0.8, "noise1"], ["EYE", 0, 1, "noise2(2*t)"]]}}
    moods = {
        "NERVOUS": {"gains": [reach, reach, 1.4, 1, 1, 1, 1], "tempo": 1.3},
        "SLEEPY": {"gains": [0, 0, 0, 0.5, 0.5, 1, 1], "tempo": 0.5},
        "PLAIN": {"tempo": 1},
        "INVERTED": {"gains": [-reach] * 7},
    }
    cues = [
        {"frame": 0, "weights": {"FIDGET": 1}, "mood": "NERVOUS"},
        {"frame": 50, "mood": "SLEEPY"},
        {"frame": 90, "mood": "INVERTED", "gains": _ends(reach)},
        {"frame": 110, "mood": "INVERTED"},
        {"frame": 140, "mood": "PLAIN"},
        {"frame": 200, "mood": "INVERTED"},
    ]
    return "moods", _puppet(actions, mood=moods), cues
