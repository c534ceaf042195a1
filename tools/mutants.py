"""Plant faults in the firmware, one at a time, and see that the test named for each fails: `python tools/mutants.py [NAME ...]`.

The faults are listed in `tools/mutants.toml`. They are planted in a copy of the tree, never in the checkout. First the
tests run as they are and must pass; then each fault must make its test fail. NAMEs choose faults by parts of their names.
Ends with status 1 if a fault survives, if its text is not found exactly once, or if a test fails without one. Where the
RP2040's image cannot be built, the faults that only it shows are left out.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIST = ROOT / "tools" / "mutants.toml"
COPIED = ("firmware", "shared", "host", "tests", "puppets", "tools", "emulator", "docs", "pyproject.toml")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "node_modules", "*.egg-info")
WORKERS = 2
PATIENCE_S = 120
"""A fault may hang its test; that is found, too."""

PATIENCE_WITHOUT_S = 600
"""For all tests without a fault."""

COMPLAINT_LENGTH = 100

PASSED, FAILED = 0, 1
"""Exit statuses of pytest; any other says that the test did not run."""


PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["hypothesis.strategies", "numpy", "pytest", "rich.live", "serial"])
"""Each test runs in a process of its own, which finds loaded what has no faults: it takes longer to load than most tests do."""


@dataclass(frozen=True)
class Mutant:
    """A fault: `old` in `file` becomes `new`, and `test`, a pytest node, fails. `image`: it needs the RP2040's."""

    name: str
    file: str
    old: str
    new: str
    test: str
    image: bool = False

    def plant(self, tree: Path) -> None:
        path = tree / self.file
        path.write_text(path.read_text("utf-8").replace(self.old, self.new), "utf-8")

    def remove(self, tree: Path) -> None:
        shutil.copyfile(ROOT / self.file, tree / self.file)

    @property
    def is_found(self) -> bool:
        """Whether the text to change is in the file exactly once."""
        return (ROOT / self.file).read_text("utf-8").count(self.old) == 1


class Tree:
    """A copy of the checkout in which tests run."""

    def __init__(self, folder: Path):
        self.path = folder
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=LEFT_OUT)
            else:
                shutil.copyfile(source, folder / name)

    def run(self, tests: list[str], patience_s: int = PATIENCE_S) -> tuple[int, str]:
        """Run tests; return pytest's exit status and what it said. A test that hangs has failed."""
        said = self.path / "said.txt"
        process = PROCESSES.Process(target=_perform, args=(self.path, said, tests))
        process.start()
        process.join(patience_s)
        if process.exitcode is None:
            os.killpg(process.pid or 0, signal.SIGKILL)
            process.join()
            return FAILED, f"nothing for {patience_s} s"
        return process.exitcode, said.read_text("utf-8", "replace")

    def judge(self, mutant: Mutant) -> tuple[bool, str, float]:
        """Return whether a mutant's test fails, what is to be said of it, and the seconds that it took."""
        begun_s = time.monotonic()
        mutant.plant(self.path)
        try:
            status, said = self.run([mutant.test])
        finally:
            mutant.remove(self.path)
        took_s = time.monotonic() - begun_s
        if status == FAILED:
            return True, f"found: {_complaint(said)}", took_s
        return False, "SURVIVED" if status == PASSED else f"NOT RUN: {said.strip()[-500:]}", took_s


def load_mutants(names: list[str]) -> list[Mutant]:
    """Return the mutants of the list, or those whose names have one of `names` in them."""
    mutants = [Mutant(**table) for table in tomllib.loads(LIST.read_text("utf-8"))["mutant"]]
    return [mutant for mutant in mutants if not names or any(name in mutant.name for name in names)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of the names of those to plant (default: all)")
    mutants = load_mutants(parser.parse_args().names)
    begun_s = time.monotonic()
    lost = [mutant for mutant in mutants if not mutant.is_found]
    for mutant in lost:
        print(f"{mutant.name}: {mutant.file} does not have this exactly once:\n{mutant.old}")
    planted = [mutant for mutant in mutants if mutant not in lost]
    if any(mutant.image for mutant in planted) and not _has_image():
        planted = [mutant for mutant in planted if not mutant.image]
    if not planted:
        print("no fault to plant")
        return 1
    with tempfile.TemporaryDirectory(prefix="marotte-mutants-") as folder:
        trees = [Tree(Path(folder) / str(number)) for number in range(WORKERS)]
        tests = sorted({mutant.test for mutant in planted})
        print(f"running {len(tests)} tests as they are", flush=True)
        with ThreadPoolExecutor(WORKERS) as pool:
            parts = [tests[number::WORKERS] for number in range(min(WORKERS, len(tests)))]
            found = list(pool.map(lambda tree, part: tree.run(part, PATIENCE_WITHOUT_S), trees, parts))
        for status, said in found:
            if status != PASSED:
                print(f"they must pass before a fault is planted:\n{said}")
                return 1
        survivors = sum(not is_killed for is_killed in _judge_all(trees, planted))
    took_s = time.monotonic() - begun_s
    print(f"{len(planted) - survivors} of {len(planted)} planted faults found, in {took_s:.0f} s")
    return 1 if survivors or lost else 0


def _has_image() -> bool:
    """Return whether there is an image of the RP2040, or one can be built; say why not."""
    from marotte.errors import MarotteError
    from marotte.images import rp2040_image

    try:
        rp2040_image()
    except (MarotteError, OSError) as error:
        print(f"without what needs the RP2040's image: {error}")
        return False
    return True


def _judge_all(trees: list[Tree], mutants: list[Mutant]):
    """Yield for each mutant whether it was killed, having printed its line; each tree takes one at a time."""
    width = max(len(mutant.name) for mutant in mutants)
    free = list(trees)

    def judge(mutant: Mutant) -> tuple[bool, str, float]:
        tree = free.pop()
        try:
            return tree.judge(mutant)
        finally:
            free.append(tree)

    with ThreadPoolExecutor(len(trees)) as pool:
        for mutant, (is_killed, verdict, took_s) in zip(mutants, pool.map(judge, mutants), strict=True):
            print(f"{mutant.name:{width}}  {took_s:4.1f} s  {mutant.test.rpartition('/')[2]}  {verdict}", flush=True)
            yield is_killed


def _perform(tree: Path, said: Path, tests: list[str]) -> None:
    """Run tests in a tree, in this process, which ends with pytest's status."""
    os.setsid()  # so that what it starts can be ended with it
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.chdir(tree)
    paths = [str(tree / name) for name in ("", "host")]
    sys.path[:0] = paths
    # Without byte code: a file that changes twice within a second would be taken for its older self.
    sys.dont_write_bytecode = True
    os.environ |= {"PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}
    import pytest

    sys.exit(pytest.main(["-x", "-p", "no:cacheprovider", "--hypothesis-seed=0", *tests]))


def _complaint(said: str) -> str:
    """Return the first line of what a failed test complains about."""
    lines = [line[2:].strip() for line in said.splitlines() if line.startswith("E  ")]
    return (lines or said.splitlines() or ["nothing"])[0][:COMPLAINT_LENGTH]


if __name__ == "__main__":
    sys.exit(main())
