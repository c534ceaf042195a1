"""Another puppet while one plays: what keeps its name goes on without a jump, and mistakes change nothing."""

import os
import signal
import subprocess
import sys
from fractions import Fraction

import pytest

import marotte
from marotte.emulated import without_feedback
from marotte.files import LOOK_US, Files, Watch, load
from marotte.link import LinkRefused, VirtualCarrier
from marotte.mcu.unix import UnixMcu
from marotte.pulses import pulses
from marotte.puppet_file import load_puppet
from marotte.run import perform
from marotte.tables import keeps
from marotte.tomlfile import FileMistakes
from shared import formats
from tests.host.test_run import Watch as WatchingView

PUPPET = """
frame_rate = 30
seed = 7
[dof.A]
[dof.B]
rest = 0.2
[dof.W]
kind = "relative"
[live.X]
[action.ONE]
tempo = 0.7
map = [["A", 0, 1, "noise1"], ["W", -1, 1, "0.5*rsin(2*t) + 0.5*live(X)"]]
[action.TWO]
entry = "start"
map = [["B", 0, 1, "rsin"], ["A", 0.5, 1, "table(SAW)"]]
[function.SAW]
table = [0, 1, 0.5]
"""
# The same things in another order, with something new between them.
TURNED = """
frame_rate = 30
seed = 7
[dof.NEW]
[dof.W]
kind = "relative"
[dof.B]
rest = 0.2
[dof.A]
[live.NEW]
[live.X]
[function.SAW]
table = [0, 1, 0.5]
[action.NEW]
map = [["NEW", 0, 1, "live(NEW)"]]
[action.TWO]
entry = "start"
map = [["A", 0.5, 1, "table(SAW)"], ["B", 0, 1, "rsin"]]
[action.ONE]
tempo = 0.7
map = [["W", -1, 1, "0.5*rsin(2*t) + 0.5*live(X)"], ["A", 0, 1, "noise1"]]
"""
FRAMES = 90


def puppet_of(tmp_path, text):
    (tmp_path / "p.toml").write_text(text)
    return load_puppet(tmp_path / "p.toml")


def played(puppet, at_frame=None, other=None):
    """Return the base of FRAMES frames by DOF, the tables exchanged for those of `other` after some frame."""
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet))
        session.telemetry(formats.TAP_BASE, 1, 0)
        session.weight_targets(0, {puppet.action_index("ONE"): 1 << 28, puppet.action_index("TWO"): 1 << 27})
        session.live_targets(10, {puppet.live_index("X"): 1 << 28})
        session.weight_targets(70, {puppet.action_index("TWO"): 0})  # waits in the queue while the tables are exchanged
        session.tempo(5, puppet.action_index("ONE"), 3 << 15)
        session.start()
        seen = {}
        playing = puppet
        while len(seen) < FRAMES:
            session.pump(10_000)
            while session.taps:
                frame, _, values_q15 = session.taps.popleft()
                dofs = playing.dofs if len(values_q15) == len(playing.dofs) else puppet.dofs
                seen[frame] = dict(zip(dofs, values_q15, strict=True))
            if other and at_frame in seen and playing is puppet:
                session.exchange(marotte.build_tables(other), puppet)
                playing = other
        assert session.status()["late_frames"] == 0
    return [seen[frame] for frame in range(FRAMES)]


@pytest.mark.parametrize("text", [PUPPET, TURNED])
@pytest.mark.parametrize("at_frame", [3, 40])
def test_exchange_for_the_same_by_name_changes_nothing(tmp_path, text, at_frame):
    puppet = puppet_of(tmp_path, PUPPET)
    undisturbed = played(puppet)
    exchanged = played(puppet, at_frame, puppet_of(tmp_path, text))
    assert "NEW" not in text or "NEW" in exchanged[-1]
    for before, after in zip(undisturbed, exchanged, strict=True):
        assert before == {name: after[name] for name in before}


def test_exchange_for_what_differs_acts_and_does_not_jump(tmp_path):
    puppet = puppet_of(tmp_path, PUPPET)
    undisturbed = played(puppet)
    exchanged = played(puppet, 40, puppet_of(tmp_path, PUPPET.replace('"rsin"]', '"rcos"]')))
    different = [frame for frame in range(FRAMES) if exchanged[frame]["B"] != undisturbed[frame]["B"]]
    assert 40 < different[0] <= 44
    assert all(exchanged[frame]["A"] == undisturbed[frame]["A"] for frame in range(FRAMES))


@pytest.mark.parametrize(
    ("old", "new", "name"), [("frame_rate = 30", "frame_rate = 40", "commit"), ("seed = 7", "seed = 8", None)]
)
def test_exchange_is_refused_whole_or_done(tmp_path, old, new, name):
    puppet = puppet_of(tmp_path, PUPPET)
    other = puppet_of(tmp_path, PUPPET.replace(old, new))
    undisturbed = played(puppet)
    if name is None:
        assert played(puppet, 40, other)[60] != undisturbed[60]
        return
    with UnixMcu() as mcu:
        session = marotte.Session(VirtualCarrier(mcu))
        session.open()
        session.upload(marotte.build_tables(puppet))
        session.telemetry(formats.TAP_BASE, 1, 0)
        session.start()
        session.pump(300_000)
        with pytest.raises(LinkRefused, match=name):
            session.exchange(marotte.build_tables(other), puppet)
        before = session.status()["frame"]
        session.pump(300_000)
        assert session.status()["frame"] == before + 9


def test_keeps_go_by_name_and_kind(tmp_path):
    puppet = puppet_of(tmp_path, PUPPET)
    other = puppet_of(tmp_path, TURNED.replace("[dof.A]", '[dof.A]\nkind = "relative"').replace('"A", 0.5', '"A", 0'))
    new = formats.NEW
    assert [(fields, [item["old"] for item in items]) for _, fields, items in keeps(puppet, other)] == [
        ({"kind": formats.KEEP_ACTIONS, "first": 0}, [new, 1, 0]),
        ({"kind": formats.KEEP_DOFS, "first": 0}, [new, 2, 1, new]),
        ({"kind": formats.KEEP_LIVES, "first": 0}, [new, 0]),
    ]


SCORE = """
[[cue]]
at = 0.0
weights = { ONE = 1.0 }
[[cue]]
at = 2.0
live = { X = 0.9 }
"""


@pytest.fixture
def paths(tmp_path):
    (tmp_path / "p.toml").write_text(PUPPET)
    (tmp_path / "s.toml").write_text(SCORE)
    return tmp_path / "p.toml", tmp_path / "s.toml"


def rewrite(path, text):
    """Write a file so that its change shows even when the clock has not moved."""
    stat = path.stat()
    path.write_text(text)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1_000_000))


def performed(paths, edits, seconds=4):
    """Perform with a watch; `edits` are (frame, path, text). Return the performance, the view and what it has noted."""
    files = load(*paths)
    edits = list(edits)
    notes = []

    def edit(scene):
        if edits and scene.frame >= edits[0][0]:
            rewrite(*edits.pop(0)[1:])

    view = WatchingView(files.puppet, edit)
    view.note = notes.append
    with UnixMcu() as mcu:
        carrier = VirtualCarrier(mcu)
        performance = perform(files.puppet, files.score, carrier, view, seconds=Fraction(seconds), watch=Watch(*paths))
    return performance, view, notes[1:]


def test_watch_plays_on_with_what_has_changed(paths):
    text = SCORE.replace("ONE = 1.0", "TWO = 1.0, NEW = 0.5")
    performance, view, notes = performed(paths, [(30, paths[0], TURNED), (45, paths[1], text)])
    assert [note.startswith("p exchanged in ") for note in notes] == [True, True]
    assert view.last.weights["TWO"] == pytest.approx(1, abs=0.02)
    assert view.last.weights.get("ONE", 0) == pytest.approx(0, abs=0.02)
    assert set(view.last.values) == {"NEW", "W", "B", "A"}
    assert performance.frames >= 120


def test_watch_tells_mistakes_and_plays_on(paths):
    broken = PUPPET.replace("tempo = 0.7", "tempo = 70")
    _, view, notes = performed(paths, [(30, paths[0], broken), (60, paths[0], "[dof"), (90, paths[0], TURNED)])
    assert "p.toml:11 action.ONE.tempo: found 70, expected a number in 0.05..8" in notes[0]
    assert notes[0].endswith("p plays on as it was")
    assert "not valid TOML" in notes[1]
    assert notes[2].startswith("p exchanged in ")
    assert view.last.weights["ONE"] == pytest.approx(1, abs=0.02)


def test_watch_begins_anew_with_another_frame_rate(paths):
    performance, view, notes = performed(paths, [(60, paths[0], PUPPET.replace("= 30", "= 50"))])
    assert notes == ["p exchanged with a new frame rate: its motion begins anew at 50 frames a second"]
    assert min(later for earlier, later in zip(view.frames, view.frames[1:], strict=False) if later < earlier) < 5
    assert performance.frames >= 200
    assert performance.status["late_targets"] == 0


def test_watch_does_not_begin_gestures_again_and_takes_tempos_back(paths):
    puppet = PUPPET.replace('entry = "start"', 'entry = "start"\ncycles = 1')
    paths[0].write_text(puppet)
    paths[1].write_text(SCORE.replace("ONE = 1.0 }", "ONE = 1.0, TWO = 1.0 }\ntempo = { ONE = 3, global = 2 }"))
    _, view, notes = performed(paths, [(75, paths[1], SCORE)])
    assert len(notes) == 1
    assert view.last.weights.get("TWO", 0) < 0.05


STALLS = "[output.B]\npin = 2\nfeedback = { pin = 26, at = [0, 1], gain = 0, integral = 0 }\n"


@pytest.mark.parametrize(
    ("path", "text", "pins"),
    [
        ("p.toml", PUPPET.replace("tempo = 0.7", "tempo = 0.8"), set()),
        ("p.toml", PUPPET.replace("[dof.A]", "[dof.NEW]\n[dof.A]"), set()),
        ("r.toml", STALLS + "trim_us = 5\nspeed = 2\n", set()),
        ("r.toml", "link_timeout = 1\n" + STALLS + "[output.A]\npin = 4\n", {2, 4}),
        ("r.toml", STALLS.replace("pin = 2\n", "pin = 6\n"), {6}),
    ],
)
def test_watch_arms_again_for_new_outputs_alone(paths, tmp_path, path, text, pins):
    robot = tmp_path / "r.toml"
    robot.write_text(STALLS)
    files = load(*paths, robot)
    edits = [(tmp_path / path, text)]
    with UnixMcu() as mcu:

        def act(scene):
            if scene.frame >= 20:
                mcu.set_adc(26, 0.9)  # far from its rest: it counts as stalled
            if scene.stalled and edits:
                mcu.clear_edges()
                rewrite(*edits.pop())

        mcu.set_adc(26, 0.2)
        view = WatchingView(files.puppet, act)
        watch = Watch(*paths, robot)
        options = {"robot": files.robot, "arm": True, "seconds": Fraction(4), "watch": watch}
        perform(files.puppet, files.score, VirtualCarrier(mcu), view, **options)
        assert view.notes[1] == "B has stalled: it is without pulses until it is armed again"
        assert sum(note.startswith("p exchanged in ") for note in view.notes) == 1
        assert {pin for pin in (2, 4, 6) if pulses(mcu.edges(pin))} == pins


def test_watch_looks_at_intervals_and_waits_for_a_file_at_rest(paths):
    watch = Watch(*paths)
    assert watch.changed(0) is None
    rewrite(paths[0], TURNED)
    assert watch.changed(LOOK_US - 1) is None
    assert watch.changed(LOOK_US) is None  # changed, but perhaps still being written
    assert isinstance(watch.changed(2 * LOOK_US), Files)
    assert watch.changed(3 * LOOK_US) is None


def test_watch_waits_for_a_file_that_is_gone_for_a_moment(paths):
    watch = Watch(*paths)
    text = paths[0].read_text()
    paths[0].unlink()
    assert [watch.changed(look * LOOK_US) for look in range(3)] == [None] * 3
    paths[0].write_text(text + "\n[dof.C]\n")
    assert watch.changed(3 * LOOK_US) is None
    assert "C" in watch.changed(4 * LOOK_US).puppet.dofs


def test_watch_adapts_the_robot_that_it_loads(paths, tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text("[output.A]\npin = 2\nfeedback = { pin = 26, at = [0, 1] }\n")
    watch = Watch(*paths, robot)
    watch.adapt = without_feedback
    rewrite(robot, robot.read_text() + "rate = 60\n")
    assert watch.changed(0) is None
    output = watch.changed(LOOK_US).robot.outputs["A"]
    assert (output.feedback, output.rate_hz) == (None, 60)


def test_watch_tells_a_mistake_once(paths):
    watch = Watch(*paths)
    rewrite(paths[1], "[[cue]]\nat = -1\n")
    watch.changed(0)
    with pytest.raises(FileMistakes, match="found -1"):
        watch.changed(LOOK_US)
    assert watch.changed(2 * LOOK_US) is None


def test_run_command_watches_its_files(paths):
    command = [sys.executable, "-u", "-m", "marotte", "run", str(paths[0]), "--score", str(paths[1]), "--mcu", "unix"]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*command, "--watch", "--no-view"], **options) as process:
        assert process.stdout.readline().startswith("p uploaded in ")
        rewrite(paths[0], PUPPET.replace("tempo = 0.7", "tempo = 9"))
        lines = iter(process.stdout.readline, "")
        assert any("found 9, expected a number in 0.05..8" in line for line in lines)
        rewrite(paths[0], TURNED)
        assert any(line.startswith("p exchanged in ") for line in lines)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (130, "")
    assert ", 0 late" in out
