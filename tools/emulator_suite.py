"""Run MicroPython's own test suite on the emulated RP2040: the regression test of its CPU core.

    python tools/emulator_suite.py [--image FILE.uf2] [--core compiled|js] [DIRECTORY ...]

The directories are those of the source tree's `tests/` (default: those that exercise the CPU). Ends with status 1 if one
fails.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from marotte.errors import MarotteError
from marotte.image_sources import micropython_sources
from marotte.mcu.rp2040 import Rp2040Mcu
from marotte.mcu.serve import serve

DIRECTORIES = ["basics", "float", "micropython", "inlineasm/thumb"]

SPEED = 10.0
"""Tests that wait are over ten times sooner; those that compute run as fast as they can anyway."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", type=Path, help="a UF2 file (default: our own image)")
    parser.add_argument(
        "--core", choices=("compiled", "js"), default="compiled", help="the CPU core (default: %(default)s)"
    )
    parser.add_argument("directories", nargs="*", default=DIRECTORIES, help="(default: %(default)s)")
    options = parser.parse_args()
    try:
        return run_suite(options.image, options.core, options.directories)
    except MarotteError as error:
        print(f"emulator-suite: {error}", file=sys.stderr)
        return 1


def run_suite(image: Path | None, core: str, directories: list[str]) -> int:
    tests = micropython_sources().micropython / "tests"
    start_s = time.monotonic()
    with tempfile.TemporaryDirectory() as results, serve(Rp2040Mcu(image, core=core), speed=SPEED) as live:
        command = [sys.executable, "run-tests.py", "-t", live.url, "-r", results, "-d", *directories]
        subprocess.run(command, cwd=tests, check=False)
        report = live.mcu.report()
        outcomes = Counter(
            outcome for _, outcome, _ in json.loads(Path(results, "_results.json").read_text())["results"]
        )
    took_s = time.monotonic() - start_s
    print(
        f"{outcomes['pass']} passed, {outcomes['fail']} failed, {outcomes['skip']} skipped in {took_s:.0f} s; "
        f"{report['instructions'] / 1e6:.0f} million instructions, image {report['image_sha256'][:12]}"
    )
    return 1 if outcomes["fail"] or not outcomes["pass"] else 0


if __name__ == "__main__":
    sys.exit(main())
