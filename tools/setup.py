"""Make the virtual environment `.venv` from the lock files: `python3 tools/setup.py`. Needs nothing but Python 3.11.

Does nothing if `.venv` is what the lock files say already (a stamp holds their hash), so every target of the Makefile may
call it. Node comes along as a PyPI wheel where the machine has no Node 20 or newer. On Debian the package that `venv` needs is
installed if that is allowed; if not, one line says which command to give.
"""

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
STAMP = VENV / "marotte-setup"
LOCK = ROOT / "requirements.lock"
NODE_LOCK = ROOT / "requirements-node.lock"
PYTHON_MIN = (3, 11)
NODE_MIN = 20


def say(text):
    """Print one line of progress on standard error."""
    print("setup: " + text, file=sys.stderr, flush=True)


def fail(text):
    """End the program with one line that says what to do."""
    say(text)
    sys.exit(1)


def node_version():
    """Return the major version of the machine's Node, 0 if there is none."""
    node = shutil.which("node")
    if not node:
        return 0
    answer = subprocess.run([node, "--version"], capture_output=True, text=True)
    found = re.match(r"v(\d+)\.", answer.stdout)
    return int(found.group(1)) if found else 0


def stamp_text(locks):
    """Return what the stamp holds when the environment is complete: the Python, and a hash of all that went into it."""
    import tomllib  # here, so that an older Python gets as far as being told that it is too old

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    total = hashlib.sha256(repr((str(ROOT), project["project"], project["tool"]["setuptools"])).encode())
    for lock in locks:
        total.update(lock.read_bytes() + b"\0")
    return f"{sys.version}\n{total.hexdigest()}\n"


def have_venv():
    """Make sure that `venv` can make environments with pip; Debian ships that half separately."""
    if importlib.util.find_spec("ensurepip") and importlib.util.find_spec("venv"):
        return
    package = "python{}.{}-venv".format(*sys.version_info[:2])
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    command = [*prefix, "apt-get", "install", "-y", "-q", package]
    if shutil.which("apt-get") and (not prefix or shutil.which("sudo")):
        say(f"installing {package}, which makes virtual environments")
        quiet = {"stdout": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
        subprocess.run([*prefix, "apt-get", "update", "-q"], **quiet)
        if subprocess.run(command, **quiet).returncode == 0:
            return
    fail(f"Python's venv module is incomplete; please run: sudo apt-get install {package}")


def run(*command):
    """Run a command; end the program if it fails, its own output having said why."""
    words = [str(word) for word in command]
    if subprocess.run(words, cwd=ROOT).returncode:
        fail("this command failed: " + " ".join(words))


def main():
    """Bring `.venv` up to date."""
    if sys.version_info < PYTHON_MIN:
        fail("Python {}.{} or newer is needed, this is {}.{}".format(*PYTHON_MIN, *sys.version_info[:2]))
    locks = [LOCK]
    if node_version() < NODE_MIN:
        locks.append(NODE_LOCK)
    wanted = stamp_text(locks)
    found = STAMP.read_text() if STAMP.exists() else ""
    if found == wanted:
        return
    have_venv()
    say("making the virtual environment .venv" if not VENV.exists() else "bringing .venv up to date")
    STAMP.unlink(missing_ok=True)
    keep = [] if found.startswith(sys.version) else ["--clear"]
    run(sys.executable, "-m", "venv", *keep, VENV)
    pip = [PYTHON, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    for lock in locks:
        say(f"installing the packages of {lock.name}")
        run(*pip, "--require-hashes", "-r", lock)
    run(*pip, "--no-deps", "--no-build-isolation", "--editable", ".")
    STAMP.write_text(wanted)
    say("ready")


if __name__ == "__main__":
    main()
