"""Check the firmware as MicroPython sees it: `python tools/check_firmware.py`. Part of `make check`.

mypy reads `firmware/` and `shared/` with MicroPython's stubs in place of CPython's library, and MicroPython's own
compiler takes every file for the RP2040's instruction set. Exits with 1 if either finds something.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from marotte.image_sources import micropython_sources
from marotte.images import mpy_cross

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted([*ROOT.glob("firmware/**/*.py"), *ROOT.glob("shared/*.py")])
ON_THE_MCU = [file for file in FILES if file.name != "cpython.py"]  # which stands in for MicroPython, on the PC
CONFIG = ROOT / "tools" / "check_firmware.ini"


def stubs(folder):
    """Link the installed stubs into a folder of their own, as mypy does not look for single files among installed
    packages.
    """
    installed = Path(sysconfig.get_path("purelib"))
    for stub in [
        *installed.glob("*.pyi"),
        installed / "_mpy_shed",
        installed / "rp2",
        installed / "stdlib",
        installed / "stubs",
    ]:
        (folder / stub.name).symlink_to(stub)


def types_are_right():
    """Run mypy over the firmware; return whether it found nothing."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stubs(folder)
        words = [sys.executable, "-m", "mypy", "--config-file", CONFIG, "--custom-typeshed-dir", folder, *FILES]
        done = subprocess.run(words, env={**os.environ, "MYPYPATH": name}, cwd=ROOT)
    return done.returncode == 0


def compiles():
    """Run MicroPython's compiler over the firmware; return whether it took every file."""
    compiler = mpy_cross(micropython_sources())
    good = True
    for file in ON_THE_MCU:
        words = [compiler, "-march=armv6m", "-o", os.devnull, file]
        good = subprocess.run(words, cwd=ROOT).returncode == 0 and good
    print(f"mpy-cross: {len(ON_THE_MCU)} files")
    return good


if __name__ == "__main__":
    sys.exit(0 if types_are_right() & compiles() else 1)
