"""Plant faults in the firmware, one at a time, and see that the test named for each fails: `python tools/mutants.py [NAME ...]`.

The faults are listed in `tools/mutants.toml`. They are planted in a copy of the tree, never in the checkout. First the
tests run as they are and must pass; then each fault must make its test fail. NAMEs choose faults by parts of their names.
Ends with status 1 if a fault survives, if its text is not found exactly once, or if a test fails without one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
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

COMPLAINT_LENGTH = 100

PASSED, FAILED = 0, 1
"""Exit statuses of pytest; any other says that the test did not run."""


@dataclass(frozen=True)
class Mutant:
    """A fault: `old` in `file` becomes `new`, and `test`, a pytest node, fails."""

    name: str
    file: str
    old: str
    new: str
    test: str

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

    def run(self, tests: list[str]) -> tuple[int, str]:
        """Run tests; return pytest's exit status and what it said. A test that hangs has failed."""
        command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--hypothesis-seed=0", *tests]
        paths = os.pathsep.join(str(self.path / name) for name in ("", "host"))
        # Without byte code: a file that changes twice within a second would be taken for its older self.
        environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.path, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
            )
        except subprocess.TimeoutExpired:
            return FAILED, f"nothing for {PATIENCE_S} s"
        return done.returncode, done.stdout + done.stderr

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
    if not planted:
        print("no fault to plant")
        return 1
    with tempfile.TemporaryDirectory(prefix="marotte-mutants-") as folder:
        trees = [Tree(Path(folder) / str(number)) for number in range(WORKERS)]
        tests = sorted({mutant.test for mutant in planted})
        print(f"running {len(tests)} tests as they are", flush=True)
        status, said = trees[0].run(tests)
        if status != PASSED:
            print(f"they must pass before a fault is planted:\n{said}")
            return 1
        survivors = sum(not is_killed for is_killed in _judge_all(trees, planted))
    took_s = time.monotonic() - begun_s
    print(f"{len(planted) - survivors} of {len(mutants)} planted faults found, in {took_s:.0f} s")
    return 1 if survivors or lost else 0


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


def _complaint(said: str) -> str:
    """Return the first line of what a failed test complains about."""
    lines = [line[2:].strip() for line in said.splitlines() if line.startswith("E  ")]
    return (lines or said.splitlines() or ["nothing"])[0][:COMPLAINT_LENGTH]


if __name__ == "__main__":
    sys.exit(main())
