"""Random valid puppets and scores, the same ones for the same seed, and their TOML texts.

Levels: `"core"` has absolute and relative DOFs, `rsin rcos noise1..16 const live`, masks, weights,
behaviours, live channels and the global tempo; `"full"` adds expressions, tables, blinks, gestures,
entries, warps, moods, gains and tempo cues of single actions. What belongs to the motor layer, and robots, are drawn
apart, as the motion does not depend on them.

All numbers are short decimals, so a text read back by `tomllib` is the dict again.
"""

import json
import re

from tests.generate_expressions import random_expression

_MAPPINGS_LIMIT = 512
_CHANNELS = ("GAZE_YAW", "GAZE_PITCH", "SPEED", "TURN")
_NOISES = tuple(f"noise{k}" for k in range(1, 17))
_CHANNEL_PAIRS = tuple(((2 * k, 2 * k + 1), (2 * k + 16, 2 * k + 17)) for k in range(8))
_TRIGGERED = ("blink", "rtrigsin")
_OUTPUT_PINS = {*range(2, 23), *range(26, 29)}


def random_puppet(rng, level="core", dofs=None, actions=None, gains=True):
    """Return a random puppet as `tomllib` would give it.

    Args:
        rng: a `random.Random`.
        level: `"core"` or `"full"`.
        dofs, actions: how many, 1..16 and 1..64; drawn where None, small numbers more often.
        gains: whether moods of the `"full"` level have band gains.
    """
    dofs = dofs or rng.choice((1, 2, 3, 5, 10, 16, rng.randint(1, 16)))
    actions = actions or rng.choice((1, 2, 4, 8, 16, 64, rng.randint(1, 64)))
    puppet = {"name": f"random {level} {rng.randrange(10**6)}", "seed": _random_seed(rng)}
    if rng.random() < 0.8:
        puppet["frame_rate"] = rng.choice((10, 25, 30, 50, 60, rng.randint(10, 60)))
    if rng.random() < 0.4:
        puppet["noise_spread"] = rng.choice((0, 1, 0.5, _decimal(rng, 0, 1)))
    puppet["dof"] = {f"DOF_{j}": _random_dof(rng) for j in range(dofs)}
    declared = rng.sample(_CHANNELS, rng.randint(0, 3))
    puppet["live"] = {name: _random_live(rng) for name in declared}
    puppet["function"] = _random_functions(rng) if level == "full" else {}
    puppet["action"] = {}
    room = _MAPPINGS_LIMIT
    for i in range(actions):
        longest = min(dofs, room - (actions - 1 - i))
        action = puppet["action"][f"ACTION_{i}"] = _random_action(rng, level, puppet, longest)
        room -= len(action["map"])
    names = list(puppet["action"])
    puppet["behaviour"] = {
        f"BEHAVIOUR_{i}": {name: random_target(rng) for name in rng.sample(names, rng.randint(1, min(6, actions)))}
        for i in range(rng.randint(0, 4))
    }
    if level == "full":
        puppet["mood"] = {f"MOOD_{i}": _random_mood(rng, gains) for i in range(rng.randint(0, 3))}
    return {key: value for key, value in puppet.items() if value != {}}


def random_score(rng, puppet, seconds, level="core", gains=True):
    """Return a random score for `puppet`, as `tomllib` would give it, with cues in 0..seconds.

    Cues of the `"full"` level have band gains if `gains` says so.
    """
    frame_rate = puppet.get("frame_rate", 30)
    cues = []
    at_s = 0.0
    for _ in range(1 + round(seconds * rng.choice((0.3, 1, 3)))):
        if rng.random() < 0.7:
            at_s = _random_time(rng, seconds, frame_rate)
        cues.append({"at": at_s} | _random_cue(rng, puppet, level, gains))
    if rng.random() < 0.8:
        cues.sort(key=lambda cue: cue["at"])
    return {"cue": cues}


def add_random_dynamics(rng, puppet):
    """Give the DOFs of a puppet limits and characters, or none; where they rest is within their limits."""
    for dof in puppet["dof"].values():
        relative = dof.get("kind") == "relative"
        if rng.random() < 0.6:
            dof["limits"] = _random_limits(rng, relative, 0 if relative else dof.get("rest", 0.5))
        if rng.random() < 0.5:
            dof["character"] = _random_character(rng)


def add_random_gains(rng, puppet, score, seconds, reach):
    """Give moods of a puppet and cues of its score band gains within -reach..reach, and DOFs `signal` keys.

    The first gains come within the first second, and are not all 1. On most DOFs blinks give way to other functions.
    """
    blinking = {name for name in puppet["dof"] if rng.random() < 0.1}
    for mapping in [mapping for action in puppet["action"].values() for mapping in action["map"]]:
        if mapping[0] not in blinking and mapping[-1].startswith(_TRIGGERED):
            mapping[-1] = _random_function(rng, "core", {})
    for name, dof in puppet["dof"].items():
        if rng.random() < (0.7 if dof.get("kind") == "relative" else 0.2):
            dof["signal"] = name not in blinking and (dof.get("kind") == "relative" or rng.random() < 0.5)
    for mood in puppet.get("mood", {}).values():
        if rng.random() < 0.7:
            mood["gains"] = _random_gains(rng, reach)
    frame_rate = puppet.get("frame_rate", 30)
    times_s = [rng.choice((0, _random_time(rng, 1, frame_rate)))]
    times_s += [_random_time(rng, seconds, frame_rate) for _ in range(rng.choice((0, 0, 1, 3, 8)))]
    for n, at_s in enumerate(times_s):
        score["cue"].append({"at": at_s, "gains": _random_gains(rng, reach, flat=n > 0)})
    rng.shuffle(score["cue"])


def random_robot(rng, puppet):
    """Return a robot for most DOFs of a puppet: servos and bridges at pins, each with a calibration, limits and a rate.

    Nothing in it depends on how quickly the MCU computes: no DOF is let go while it plays.
    """
    robot = {
        "name": "random",
        "rate": rng.choice((50, 333, 100, _decimal(rng, 50, 333))),
        "attach_interval": rng.choice((0, 0.02, 0.05)),
    }
    pairs = []
    for pins in _CHANNEL_PAIRS:
        known = [rng.choice([pin for pin in channel if pin in _OUTPUT_PINS]) for channel in zip(*pins, strict=True)]
        pairs.append(known)
    rng.shuffle(pairs)
    wheels = [name for name, dof in puppet["dof"].items() if dof.get("kind") == "relative"]
    bridged = [name for name in wheels[:3] if rng.random() < 0.3]
    outputs = {name: _random_bridge(rng, pairs.pop()) for name in bridged}
    # Outputs of one slice have one rate.
    rates_hz = [rng.choice((None, None, 50, 100, _decimal(rng, 50, 333))) for _ in pairs]
    free = [(pin, rate_hz) for pair, rate_hz in zip(pairs, rates_hz, strict=True) for pin in pair]
    rng.shuffle(free)
    for name in puppet["dof"]:
        if name not in outputs and free and rng.random() < 0.9:
            outputs[name] = _random_servo(rng, *free.pop())
    for name, output in outputs.items():
        dof = puppet["dof"][name]
        relative = dof.get("kind") == "relative"
        if rng.random() < 0.4:
            output |= _random_limits(rng, relative, 0 if relative else dof.get("rest", 0.5), table=True)
        if relative and rng.random() < 0.5:
            output["dead_band"], output["top_speed"] = _decimal(rng, 0, 0.5), _decimal(rng, 0.6, 1)
    return robot | {"output": {name: outputs[name] for name in puppet["dof"] if name in outputs}}


def random_target(rng):
    """Return a weight target, 0..4: often 0 or 1, at times faint or large."""
    return rng.choice((0, 0, 1, 1.0, _decimal(rng, 0, 1), _decimal(rng, 0, 4), 4, _logarithmic(rng, 0.0005, 0.1)))


def to_toml(document):
    """Return the TOML text of a puppet or score; `tomllib.loads` gives an equal dict back."""
    lines = [f"{key} = {_toml_value(value)}" for key, value in document.items() if not _is_tables(value)]
    for key, value in document.items():
        if isinstance(value, dict):
            for name, table in value.items():
                lines += ["", f"[{key}.{_toml_key(name)}]"]
                lines += [f"{_toml_key(inner)} = {_toml_value(item)}" for inner, item in table.items()]
        elif _is_tables(value):
            for table in value:
                lines += ["", f"[[{key}]]"]
                lines += [f"{inner} = {_toml_value(item)}" for inner, item in table.items()]
    return "\n".join(lines) + "\n"


def _is_tables(value):
    return isinstance(value, dict) or (isinstance(value, list) and all(isinstance(item, dict) for item in value))


def _toml_key(key):
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)


def _toml_value(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml_key(key)} = {_toml_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    return json.dumps(value)


def _decimal(rng, low, high):
    return round(rng.uniform(low, high), rng.choice((1, 2, 4, 6)))


def _logarithmic(rng, low, high):
    return min(max(round(low * (high / low) ** rng.random(), 6), low), high)


def _random_seed(rng):
    return rng.choice((0, 1, 1999, 2**31, 2**32 - 1, *(rng.getrandbits(32) for _ in range(5))))


def _random_tau(rng):
    rise_s, fall_s = (rng.choice((0.03, 10, *(_logarithmic(rng, 0.03, 10) for _ in range(4)))) for _ in range(2))
    return rng.choice((rise_s, [rise_s, fall_s]))


def _random_dof(rng):
    if rng.random() < 0.25:
        return {"kind": "relative"}
    dof = {"kind": "absolute"} if rng.random() < 0.5 else {}
    if rng.random() < 0.5:
        dof["rest"] = rng.choice((0, 1, _decimal(rng, 0, 1)))
    return dof


def _random_limits(rng, relative, rest, table=False):
    """Return limits as a list or a table; `rest` lies within."""
    least = -1 if relative else 0
    bounds = [round(rng.uniform(least, rest), 3), round(rng.uniform(rest, 1), 3)]
    if bounds[0] >= bounds[1]:
        bounds = [least, 1]
    if not table and rng.random() < 0.4:
        return bounds
    limits = {"range": bounds} if rng.random() < 0.7 else {}
    if rng.random() < 0.7:
        limits["accel"] = _logarithmic(rng, 4 if relative else 1, 1000)
    if not relative and rng.random() < 0.7:
        limits["speed"] = _logarithmic(rng, 0.05, 50)
    return limits if limits or table else bounds


def _random_character(rng):
    character = {"f": rng.choice((0.2, 10, _logarithmic(rng, 0.2, 10)))}
    if rng.random() < 0.8:
        character["zeta"] = rng.choice((0.1, 1, 3, _logarithmic(rng, 0.1, 3)))
    if rng.random() < 0.7:
        character["r"] = rng.choice((-4, 4, _decimal(rng, -4, 4)))
    return character


def _random_servo(rng, pin, rate_hz):
    low_us, high_us = rng.choice(((1000, 2000), (600.5, 2500), sorted(rng.uniform(600, 2500) for _ in range(2))))
    servo = {
        "pin": pin,
        "pulse_us": [round(low_us, 3), round(high_us, 3)],
        "trim_us": round(rng.uniform(-300, 300), 2),
        "invert": rng.random() < 0.4,
    }
    return servo | ({"rate": rate_hz} if rate_hz else {})


def _random_bridge(rng, pins):
    """Return a bridge at both channels of a PWM slice."""
    one, other = pins
    keys = rng.choice(({"pwm": one, "direction": other}, {"wiring": "two-pwm", "forward": one, "backward": other}))
    return {"driver": "bridge", "invert": rng.random() < 0.4} | keys


def _random_live(rng):
    channel = {}
    if rng.random() < 0.6:
        channel["rest"] = _decimal(rng, 0, 1)
    if rng.random() < 0.6:
        channel["tau"] = _random_tau(rng)
    return channel


def _random_functions(rng):
    tables = {
        f"CURVE_{i}": {"table": [_decimal(rng, 0, 1) for _ in range(rng.choice((2, 3, 7, 64, 256)))]}
        for i in range(rng.randint(0, 2))
    }
    expressions = {
        f"CUSTOM_{i}": {"expr": random_expression(rng, list(tables), _CHANNELS)} for i in range(rng.randint(0, 4))
    }
    return tables | expressions


def _random_function(rng, level, functions):
    """Return a FUNCTION text."""
    tables = [name for name, function in functions.items() if "table" in function]
    simple = ("rsin", "rcos", rng.choice(_NOISES), f"const({_decimal(rng, 0, 1)})", f"live({rng.choice(_CHANNELS)})")
    kinds = ("simple", "simple", "triggered", "function", "expression") if level == "full" else ("simple",)
    match rng.choice(kinds):
        case "triggered":
            threshold = rng.choice((0, 0.5, 0.93, _decimal(rng, 0, 1)))
            min_gap = rng.choice((0, 1.2, 2, _logarithmic(rng, 0.1, 1000)))
            name = rng.choice(_TRIGGERED)
            return rng.choice((name, f"{name}({threshold}, {min_gap})"))
        case "function" if functions:
            return rng.choice(list(functions))
        case "expression":
            return random_expression(rng, tables, _CHANNELS)
    return rng.choice(simple)


def _random_action(rng, level, puppet, longest):
    action = {}
    if rng.random() < 0.8:
        action["tempo"] = rng.choice((0.05, 8, 0.5, 1, _logarithmic(rng, 0.05, 8)))
    if rng.random() < 0.6:
        action["tau"] = _random_tau(rng)
    if level == "full":
        action["entry"] = rng.choice(("sync", "start", "start"))
        if action["entry"] == "start" and rng.random() < 0.4:
            action["cycles"] = rng.choice((1, 2, 3, rng.randint(1, 20)))
        if rng.random() < 0.5:
            action["warp"] = _logarithmic(rng, 0.05, 10)
    action["map"] = []
    for name in rng.sample(list(puppet["dof"]), rng.randint(1, longest)):
        low_limit = -1 if puppet["dof"][name].get("kind") == "relative" else 0
        low, high = (rng.choice((low_limit, 1, _decimal(rng, low_limit, 1))) for _ in range(2))
        action["map"].append([name, low, high, _random_function(rng, level, puppet["function"])])
    return action


def _random_mood(rng, gains):
    mood = {}
    if gains and rng.random() < 0.7:
        mood["gains"] = _any_gains(rng)
    if rng.random() < 0.7:
        mood["tempo"] = _logarithmic(rng, 0.25, 4)
    return mood


def _any_gains(rng):
    return rng.choice(([1] * 7, [_decimal(rng, -2, 2) for _ in range(7)], [_decimal(rng, -4, 4) for _ in range(7)]))


def _random_gains(rng, reach, flat=True):
    """Return gains: any, all at the ends of their range, one of them other than 1, or, if `flat`, all 1."""
    kinds = ["any", "any", "ends", "one"] + ["flat"] * flat
    match rng.choice(kinds):
        case "any":
            return [_decimal(rng, -reach, reach) for _ in range(7)]
        case "ends":
            return [rng.choice((-reach, reach)) for _ in range(7)]
        case "one":
            gains = [1] * 7
            gains[rng.randrange(7)] = rng.choice((-reach, 0, reach, _decimal(rng, -reach, reach)))
            return gains
    return [1] * 7


def _random_time(rng, seconds, frame_rate):
    """Return a time that is round, on a frame, just beside one, or anything."""
    frame = rng.randrange(int(seconds * frame_rate))
    drawn = rng.choice((frame / frame_rate, rng.uniform(0, seconds)))
    return rng.choice((int(drawn), round(drawn, 1), round(drawn, 2), round(drawn, 6), round(drawn + 1e-6, 6)))


def _random_cue(rng, puppet, level, gains):
    actions = list(puppet["action"])
    texts = [text for action in puppet["action"].values() for *_, text in action["map"]]
    texts += [function.get("expr", "") for function in puppet.get("function", {}).values()]
    channels = sorted({*puppet.get("live", {}), *re.findall(r"live\((\w+)\)", " ".join(texts))})
    cue = {}
    if "behaviour" in puppet and rng.random() < 0.25:
        cue["behaviour"] = rng.choice(list(puppet["behaviour"]))
    if rng.random() < 0.7:
        some = rng.sample(actions, rng.randint(1, min(5, len(actions))))
        cue["weights"] = {name: random_target(rng) for name in some}
        if rng.random() < 0.05:
            # A hand-over to one faint action: where it is a slow one, the sum of weights gets very small.
            cue["weights"] = dict.fromkeys(actions, 0) | {some[0]: _logarithmic(rng, 0.0005, 0.1)}
    if channels and rng.random() < 0.3:
        cue["live"] = {name: rng.choice((0, 1, _decimal(rng, 0, 1))) for name in rng.sample(channels, 1)}
    tempo = {}
    if rng.random() < 0.15:
        tempo["global"] = rng.choice((0.25, 1, 4, _logarithmic(rng, 0.25, 4)))
    if level == "full":
        if rng.random() < 0.2:
            tempo[rng.choice(actions)] = _logarithmic(rng, 0.05, 8)
        if "mood" in puppet and rng.random() < 0.15:
            cue["mood"] = rng.choice(list(puppet["mood"]))
        if gains and rng.random() < 0.1:
            cue["gains"] = _any_gains(rng)
    if tempo:
        cue["tempo"] = tempo
    return cue
