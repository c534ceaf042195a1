"""Puppets and scores in which tempo matching, gestures and blinks are hardest to keep to the definitions of `docs/motion.md`.

Like `tests.corners`, but of the `"full"` level of `tests.generate`. All are valid and last at most `tests.corners.SECONDS`.
"""

from tests.corners import Corner


def full_corners():
    """Return the list of cases."""
    return [
        _reentry_while_fading(),
        _tempo_change_and_entry_in_one_frame(),
        *(_warp_limit(frame_rate, tempo) for frame_rate, tempo in ((10, 0.05), (60, 0.05), (30, 0.31))),
        _gesture_called_again_while_fading(),
        _blink_after_reentry(),
        _longest_gesture(),
        _tempos_of_sleepers(),
        _tempos_at_every_frame(),
        _phases_across_the_repeat(),
        _one_of_each_function(),
    ]


def _puppet(name, actions, **options):
    dofs = sorted({dof for action in actions.values() for dof, *_ in action["map"]})
    return {"name": name, "seed": 1999, "dof": {dof: {} for dof in dofs}, "action": actions} | options


def _weights(*steps):
    """Return cues from pairs (time in seconds, weights)."""
    return [{"at": at_s, "weights": weights} for at_s, weights in steps]


def _tempos(*steps):
    """Return cues from pairs (time in seconds, tempos)."""
    return [{"at": at_s, "tempo": tempos} for at_s, tempos in steps]


def _corner(name, actions, cues, **options):
    return Corner(name, _puppet(name, actions, **options), {"cue": cues})


def _reentry_while_fading():
    """Called again while its weight is strong an action's phase goes on; called again when it is faint, it begins anew."""
    actions = {
        f"{speed}_{entry}": {
            "entry": entry,
            "tempo": 0.83,
            "tau": tau_s,
            "warp": 10,
            "map": [[f"DOF_{speed}_{entry}", 0, 1, "rsin"]],
        }
        for entry in ("sync", "start")
        for speed, tau_s in (("FAST", 0.1), ("SLOW", 0.4))
    }
    # A weight falls below 1/256 after 7.6 tau: 0.8 s and 3 s.
    calls = [
        (0.4, 1),
        (2.2, 0),
        (2.7, 1),
        (5, 0),
        (6.5, 1),
        (9.3, 0),
        (13.1, 1),
        (20, 0),
        (20.1, 0.3),
        (20.2, 0),
        (24, 2),
    ]
    return _corner(
        "re-entry while fading", actions, _weights(*((at_s, dict.fromkeys(actions, target)) for at_s, target in calls))
    )


def _tempo_change_and_entry_in_one_frame():
    """The change comes first, so an entering action begins at its new nominal phase, or with its own time at the new tempo."""
    actions = {
        name: {"entry": entry, "tempo": 0.7, "warp": 2, "tau": 0.1, "map": [[f"DOF_{name}", 0.1, 0.9, "rcos"]]}
        for name, entry in (("SYNC", "sync"), ("START", "start"))
    }
    cues = []
    for at_s, target, tempo in ((1.3, 1, 2.3), (6, 0, 0.4), (9.1, 1, 0.11), (14, 0, 1), (14.2, 1, 3.9), (21, 0.5, 0.6)):
        cues.append(
            {
                "at": at_s,
                "weights": dict.fromkeys(actions, target),
                "tempo": dict.fromkeys(actions, tempo) | {"global": 1.1},
            }
        )
    return _corner("tempo change and entry in one frame", actions, cues)


def _warp_limit(frame_rate, tempo):
    """A large offset at a slow tempo and a short warp: the time may only slow to half, or speed up to one and a half."""
    actions = {
        f"WARP_{i}": {"entry": "start", "tempo": tempo, "warp": 0.05, "map": [[f"DOF_{i}", 0, 1, "rsin"]]}
        for i in range(6)
    }
    cues = _weights(*((1.1 + 3.7 * i, {f"WARP_{i}": 1}) for i in range(6)))
    cues += _tempos((0.5, {"global": 0.4}), (12, {"global": 3.1}), (24, {"global": 0.25}))
    return _corner(f"warp limit at tempo {tempo}, {frame_rate} Hz", actions, cues, frame_rate=frame_rate)


def _gesture_called_again_while_fading():
    """A gesture that is called again goes on for as many periods more, with or without an entry."""
    actions = {
        f"NOD_{cycles}": {
            "entry": "start",
            "cycles": cycles,
            "tempo": 1.7,
            "tau": [0.1, 0.5],
            "map": [[f"DOF_{cycles}", 0.2, 0.8, "rsin"]],
        }
        for cycles in (1, 2, 5)
    }
    # One period lasts 0.59 s; after its end a gesture is above 1/256 for some 4 s.
    calls = [0.5, 2.1, 2.8, 4.6, 4.9, 9.7, 15, 15.62, 22.3, 22.9, 26.1]
    return _corner(
        "gesture called again while fading", actions, _weights(*((at_s, dict.fromkeys(actions, 1)) for at_s in calls))
    )


def _blink_after_reentry():
    """Blinks are idle and their last one long ago after an entry, but their streams go on."""
    mappings = [["LID", 0, 1, "blink(0.9, 1.2)"], ["BROW", 0, 1, "rtrigsin(0.85, 0.4)"], ["EAR", 1, 0, "blink(0, 0)"]]
    actions = {
        "BLINKS": {"tempo": 1.3, "tau": 0.1, "map": mappings},
        "OWN_TIME": {"entry": "start", "tempo": 2.1, "tau": 0.1, "map": [["NOSE", 0, 1, "blink(0.8, 3)"]]},
    }
    calls = [(0.3, 1), (4.21, 0), (4.4, 1), (7.9, 0), (9.93, 0.7), (14.1, 0), (17.3, 4), (25.2, 0), (25.9, 1)]
    cues = _weights(*((at_s, dict.fromkeys(actions, target)) for at_s, target in calls))
    cues += _tempos((11.3, {"BLINKS": 3.3}), (19.1, {"OWN_TIME": 0.4, "global": 1.7}))
    return _corner("blink after re-entry", actions, cues)


def _longest_gesture():
    """1000 cycles at the fastest tempo are over after 31.25 s, here after 30 of them have been played at the slowest."""
    actions = {
        "FLUTTER": {"entry": "start", "cycles": 1000, "tempo": 8, "tau": 0.03, "map": [["TAIL", 0, 1, "rsin"]]},
        "WAG": {"entry": "start", "cycles": 900, "tempo": 8, "tau": 0.03, "map": [["TAIL", 0, 0.5, "noise7"]]},
    }
    cues = [{"at": 0.2, "weights": dict.fromkeys(actions, 1), "tempo": {"global": 4}}]
    return _corner("gesture of 1000 cycles", actions, cues, frame_rate=60)


def _tempos_of_sleepers():
    """An action that sleeps takes a new tempo without a trace of the phase that it had when it fell asleep."""
    actions = {
        f"{entry}_{function}".upper(): {
            "entry": entry,
            "tempo": 0.9,
            "tau": 0.05,
            "warp": 5,
            "map": [[f"DOF_{entry}_{function}", 0, 1, function]],
        }
        for entry in ("sync", "start")
        for function in ("rsin", "noise3")
    }
    both = [(1, 1), (3.2, 0), (9.1, 1), (12.3, 0), (21.7, 1)]
    cues = _weights(*((at_s, dict.fromkeys(actions, target)) for at_s, target in both))
    cues += _tempos(
        *((at_s, dict.fromkeys(actions, tempo)) for at_s, tempo in ((0.4, 2.3), (6.3, 0.37), (7, 5.1), (16, 0.05)))
    )
    return _corner("tempos of sleeping actions", actions, cues)


def _tempos_at_every_frame():
    """A new tempo with every frame: offsets are made anew again and again, and none of the phase may be lost."""
    actions = {
        "SLIDE": {"tempo": 1, "warp": 0.5, "map": [["NECK", 0, 1, "rsin"]]},
        "GLIDE": {"entry": "start", "tempo": 1, "warp": 10, "map": [["HEAD", 0, 1, "noise5"]]},
    }
    cues = _weights((0.1, dict.fromkeys(actions, 1)))
    for n in range(10, 290):
        tempo = round(1.2 + 1.1 * ((n * 37) % 101) / 101, 4)
        cues += _tempos((round(n / 10, 1), {"SLIDE": tempo, "GLIDE": round(2.5 - tempo, 4)}))
    return _corner("a tempo with every frame", actions, cues, frame_rate=10)


def _phases_across_the_repeat():
    """Own times that lie behind the master's count down from 4096 periods."""
    actions = {
        "LATE": {
            "entry": "start",
            "tempo": 8,
            "warp": 0.3,
            "map": [["NECK", 0, 1, "noise1"], ["EAR", 0, 1, "rtrigsin(0.5, 0.3)"]],
        },
        "SLOW": {"entry": "start", "tempo": 7.9, "map": [["HEAD", 0, 1, "noise9(t/16)"]]},
    }
    cues = [{"at": 0, "tempo": {"global": 4}}]
    cues += _weights((11.03, {"LATE": 1}), (12.57, {"SLOW": 1}))
    cues += _tempos((18.2, {"LATE": 0.05}), (23.9, {"LATE": 7.7, "SLOW": 0.3}))
    return _corner("phases behind the master's", actions, cues, frame_rate=50)


def _one_of_each_function():
    """Every kind of function on a DOF of its own, with phases backwards, scaled to both ends and shifted."""
    texts = {
        "CURVE": "SAW",
        "CURVE_BACK": "table(SAW, -16*t + 0.3)",
        "TWO": "table(PAIR, t/16)",
        "FAST": "0.5*rsin(16*t - 0.25) + 0.5*rcos(-16*t)",
        "MIXED": "clamp(lerp(noise2(t/2), live(GAZE), 0.5*rsin(t)) - 0.2, lo=0.1, hi=0.8)",
        "EXTREME": "max(min(noise16(3*t), 0.75), abs(rcos(t) - 0.5))",
        "STEEP": "8*noise4(t) - 3.5",
        "BLINK": "blink",
        "TRIGGERED": "rtrigsin(0.9, 0)",
        "NAMED": "CUSTOM",
    }
    functions = {
        "SAW": {"table": [round(i / 255, 4) for i in range(256)]},
        "PAIR": {"table": [0, 1]},
        "CUSTOM": {"expr": "0.7*rsin(2*t + 0.25) + 0.3*noise1(t/2)"},
    }
    actions = {name: {"tempo": 0.37, "map": [[f"DOF_{name}", 0, 1, text]]} for name, text in texts.items()}
    cues = [{"at": 0.2, "weights": dict.fromkeys(actions, 1)}]
    cues += [{"at": at_s, "live": {"GAZE": at_s % 2}} for at_s in range(1, 28, 3)]
    cues += _tempos((9.4, dict.fromkeys(actions, 2.9)), (20, {"global": 0.6}))
    return _corner("one of each function", actions, cues, function=functions)
