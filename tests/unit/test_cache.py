"""The cache of built things: keys, one build for all, failures that explain themselves."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from marotte import cache
from marotte.cache import BuildError, build_cached, hash_of, run_logged
from marotte.errors import MarotteError


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MAROTTE_CACHE", str(tmp_path / "cache"))


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_cache_dir_is_the_named_one_or_the_users(monkeypatch):
    monkeypatch.setenv("MAROTTE_CACHE", "/somewhere/else")
    assert cache.cache_dir() == Path("/somewhere/else")
    monkeypatch.delenv("MAROTTE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert cache.cache_dir() == Path("/xdg/marotte")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache.cache_dir() == Path.home() / ".cache" / "marotte"


def test_hash_of_a_folder_is_the_same_wherever_it_lies(tmp_path):
    for place in ("one", "two"):
        write(tmp_path / place / "tree" / "a.py", "a")
        write(tmp_path / place / "tree" / "deep" / "b.py", "b")
    write(tmp_path / "two" / "tree" / "__pycache__" / "a.pyc", "byte code does not count")
    assert hash_of([tmp_path / "one" / "tree"]) == hash_of([tmp_path / "two" / "tree"])


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: write(tree / "a.py", "other contents"),
        lambda tree: write(tree / "new.py", ""),
        lambda tree: (tree / "a.py").rename(tree / "c.py"),
        lambda tree: (tree / "deep" / "b.py").unlink(),
    ],
)
def test_hash_of_a_folder_changes_with_contents_and_names(tmp_path, change):
    write(tmp_path / "tree" / "a.py", "a")
    write(tmp_path / "tree" / "deep" / "b.py", "b")
    before = hash_of([tmp_path / "tree"])
    change(tmp_path / "tree")
    assert hash_of([tmp_path / "tree"]) != before


def test_hash_of_texts_keeps_them_apart():
    assert len({hash_of(["ab", "c"]), hash_of(["a", "bc"]), hash_of(["abc"]), hash_of(["c", "ab"])}) == 4


def test_hash_of_a_missing_input_names_it(tmp_path):
    with pytest.raises(MarotteError, match=r"gone\.c: no such file"):
        hash_of([tmp_path / "gone.c"])


def test_build_cached_builds_once_for_the_same_inputs(tmp_path):
    source = write(tmp_path / "source.c", "int x;")
    built = []

    def build(folder):
        built.append(folder)
        (folder / "out").write_text(source.read_text())

    first = build_cached("thing", [source, "flags"], build)
    assert build_cached("thing", [source, "flags"], build) == first
    assert len(built) == 1
    assert (first / "out").read_text() == "int x;"

    source.write_text("int y;")
    second = build_cached("thing", [source, "flags"], build)
    assert second != first
    assert (second / "out").read_text() == "int y;"
    assert (first / "out").read_text() == "int x;"


def test_build_cached_failure_shows_the_end_of_the_log_and_leaves_nothing(tmp_path):
    def build(folder):
        run_logged(folder, ["sh", "-c", "seq 1 100; echo no such header >&2; exit 7"])

    with pytest.raises(BuildError) as caught:
        build_cached("thing", [], build)
    text = str(caught.value)
    assert text.startswith("building thing: sh failed with exit status 7")
    assert "no such header" in text and "\n    100" in text and "\n    50\n" not in text
    log = Path(text.rsplit("the whole log: ", 1)[1])
    assert "\n50\n" in log.read_text()
    assert [entry for entry in log.parent.iterdir() if entry.is_dir()] == []

    assert build_cached("thing", [], lambda folder: None).is_dir()
    assert not log.exists()


def test_run_logged_names_a_program_that_is_not_installed(tmp_path):
    with pytest.raises(BuildError, match="the program no-such-compiler is needed and is not installed"):
        run_logged(tmp_path, ["no-such-compiler", "-c"])


def test_run_logged_adds_to_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("KEPT", "kept")
    run_logged(tmp_path, ["sh", "-c", "echo $KEPT $GIVEN"], env={"GIVEN": "given"})
    assert "\nkept given\n" in (tmp_path / cache.LOG_NAME).read_text()


def test_build_cached_serves_processes_that_come_at_once_with_one_build(tmp_path):
    script = write(
        tmp_path / "client.py",
        "import sys, time\n"
        "from marotte.cache import build_cached\n"
        "def build(folder):\n"
        "    with open(sys.argv[1], 'a') as log: log.write('built\\n')\n"
        "    time.sleep(0.3)\n"
        "print(build_cached('thing', ['x'], build))\n",
    )
    log = tmp_path / "log"
    command = [sys.executable, script, log]
    clients = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    answers = [client.communicate(timeout=30) for client in clients]
    assert log.read_text() == "built\n"
    assert len({out for out, _ in answers}) == 1
    assert sum("waiting for another process" in said for _, said in answers) == 3


def test_build_cached_forgets_what_was_not_used_for_longest(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "KEPT_PER_NAME", 2)
    for number, name in enumerate("abc"):
        folder = build_cached("thing", [name], lambda folder: None)
        os.utime(folder, (number, number))
    build_cached("thing", ["b"], lambda folder: None)
    build_cached("thing", ["d"], lambda folder: None)
    rebuilt = []
    for name in "dba":
        build_cached("thing", [name], rebuilt.append)
    assert len(rebuilt) == 1
