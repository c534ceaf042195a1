"""What the tests of safety share: small robots from text, sessions that play on, and when the last pulse ended."""

import tempfile
from pathlib import Path

import marotte
from marotte.pulses import pulses
from marotte.tables import Tables, build_tables, keeps
from shared import formats

KILL_US = 20_000
"""A kill from the host takes all pulses away within this and a motor tick."""

PUMP_US = 1_000
KILL_PIN = 22
SHORTEST_US, LONGEST_US = 500, 2500
"""The ends of a servo's pulses, unless its output says otherwise."""


def puppet_text(names, entries=None, frame_rate=50, more=""):
    """Return a puppet file with these DOFs and one action, LOOK, that leads each through its whole range once a second."""
    entries = entries or [f'["{name}", 0, 1, "rsin"]' for name in names]
    dofs = "".join(f"[dof.{name}]\n" for name in names)
    return f"frame_rate = {frame_rate}\n{more}\n{dofs}[action.LOOK]\ntempo = 1.0\ntau = 0.03\nmap = [{', '.join(entries)}]\n"


def tables_of(puppet: str, robot: str) -> Tables:
    """Return the tables of two files, given as text."""
    with tempfile.TemporaryDirectory(prefix="marotte-test-") as folder:
        paths = [Path(folder) / name for name in ("puppet.toml", "robot.toml")]
        for path, text in zip(paths, (puppet, robot), strict=True):
            path.write_text(text, "utf-8")
        loaded = marotte.load_puppet(paths[0])
        return build_tables(loaded, marotte.load_robot(paths[1], loaded))


def exchange_parts(tables, playing):
    """Return the messages that exchange the tables of a puppet that plays, the commit apart."""
    *parts, commit = tables.messages()
    return [*parts, *keeps(playing.puppet, tables.puppet)], commit


def post(session, parts):
    """Hand commands to the link, which sends them as its window allows; what is refused is of no interest."""
    for name, fields, items in parts:
        session.link.post(name, fields, items, on_refused=lambda *_: None)


def play(session, for_us, step_us=20_000):
    """Let time pass, the host talking."""
    end_us = session.carrier.now_us() + for_us
    while (left_us := end_us - session.carrier.now_us()) > 0:
        session.pump(min(step_us, left_us))


def begin(session, tables, taps=0, weights_every=0):
    """Upload a puppet and play its first action with all its weight."""
    session.upload(tables)
    session.telemetry(taps, 1, weights_every)
    session.weight_targets(0, {0: formats.WEIGHT_MAX})
    session.start()
    session.flush()


def drive(session, for_us=100_000):
    """Arm, and play on once all outputs are attached."""
    session.arm()
    session.wait_attached()
    play(session, for_us)


def widths_us(mcu, pin, after_us=0):
    """Return the pulses of a pin that begin after an instant, `(t_us, width_us)`."""
    found = pulses(mcu.edges(pin))
    return [(pulse.start_ns / 1000, pulse.width_ns / 1000) for pulse in found if pulse.start_ns > after_us * 1000]


def last_fall_us(mcu, pins, none_us):
    """Return when the last pulse of any pin ended, `none_us` if there was none since edges were cleared; all have to be low."""
    edges = [edges for edges in map(mcu.edges, pins) if edges]
    assert all(seen[-1][1] == 0 for seen in edges)
    return max((seen[-1][0] / 1000 for seen in edges), default=none_us)
