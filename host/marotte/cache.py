"""Things that are built once and kept: MicroPython binaries, the RP2040 image, the emulator's boot ROM and CPU core.

Everything lives under `cache_dir()`. A built thing is a folder `NAME/KEY`, where KEY is a hash of all that went into
it, so that a changed input builds a new one and an unchanged input costs a few milliseconds:

    folder = build_cached("cpu-core", [source, "clang 14", " ".join(flags)], compile_core, about_s=5)
    wasm = folder / "core.wasm"

    def compile_core(folder: Path) -> None:
        run_logged(folder, ["clang", *flags, "-o", folder / "core.wasm", source])
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from marotte.errors import MarotteError
from marotte.progress import doing, say

KEPT_PER_NAME = 20
"""Built things of one name that are kept; the ones not used for longest go first."""

LOG_NAME = "build.log"
LOG_TAIL_LINES = 15
_KEY_DIGITS = 20
_IGNORED = {"__pycache__", ".DS_Store", ".mypy_cache", ".pytest_cache", ".ruff_cache"}


class BuildError(MarotteError):
    """A build step failed; the text holds the end of its log and where the whole log is."""


def cache_dir() -> Path:
    """Return the folder of built things: `$MAROTTE_CACHE`, else `marotte` in `$XDG_CACHE_HOME` or `~/.cache`."""
    own = os.environ.get("MAROTTE_CACHE")
    if own:
        return Path(own).expanduser().absolute()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "marotte"


def files_of(path: Path) -> list[Path]:
    """Return `path` itself, or all files below it in a fixed order, without byte code and other droppings.

    Raises MarotteError if it does not exist.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise MarotteError(f"{path}: no such file or folder (an input of something to be built)")
    found = (file for file in path.rglob("*") if file.is_file() and not _IGNORED.intersection(file.parts))
    return sorted(found, key=lambda file: file.relative_to(path).as_posix())


def hash_of(inputs: Sequence[Path | str]) -> str:
    """Return the SHA-256, in hex, of texts (`str`) and of the contents of files and folders (`Path`).

    A file counts with its name and contents, a folder with the relative names and contents of its files; where they lie
    does not count, so that two checkouts share what they build. Raises MarotteError if a path does not exist.
    """
    total = hashlib.sha256()
    for item in inputs:
        if isinstance(item, str):
            total.update(b"text\0" + hashlib.sha256(item.encode()).digest())
            continue
        total.update(b"path\0" + item.name.encode() + b"\0")
        for file in files_of(item):
            name = file.name if file == item else file.relative_to(item).as_posix()
            total.update(name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def build_cached(
    name: str, inputs: Sequence[Path | str], build: Callable[[Path], None], about_s: float | None = None
) -> Path:
    """Return the folder in which `build` has put its results, calling it only if these inputs were not built before.

    `name` is a word or two for people and for the folder ("cpu-core"). `inputs` is all that the result depends on: see
    `hash_of`. `build` gets an empty folder, fills it (`run_logged` keeps a log there), and raises if it cannot; the
    folder is then moved to its final place in one step, so nobody ever sees half a result, and nothing in it may name
    its own path. Processes that want the same name wait for each other. `about_s` is the expected time in seconds.

    Raises BuildError, or whatever `build` raises.
    """
    home = cache_dir() / name
    final = home / hash_of([name, *inputs])[:_KEY_DIGITS]
    if not _is_there(final):
        with locked(name):
            if not _is_there(final):
                _build(name, final, build, about_s)
                _forget_oldest(home)
    return final


def run_logged(
    folder: Path, command: Sequence[str | Path], cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> None:
    """Run `command` with its output appended to the log in `folder`; `env` is added to the environment.

    Raises BuildError with the end of the log if the command fails or does not exist.
    """
    words = [str(word) for word in command]
    log_path = folder / LOG_NAME
    with log_path.open("a") as log:
        log.write(f"$ {' '.join(words)}\n")
        log.flush()
        try:
            done = subprocess.run(
                words, cwd=cwd, env={**os.environ, **(env or {})}, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        except FileNotFoundError as missing:
            raise BuildError(f"the program {words[0]} is needed and is not installed") from missing
    if done.returncode:
        raise BuildError(f"{words[0]} failed with exit status {done.returncode}{_tail(log_path)}")


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Hold the lock of a name in the cache while the block runs, against other processes and threads."""
    import fcntl  # here, as Windows lacks it: hosts that only drive a real puppet build nothing

    home = cache_dir() / name
    home.mkdir(parents=True, exist_ok=True)
    with (home / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"waiting for another process that is building {name}")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _is_there(final: Path) -> bool:
    """Return whether a result exists, and note that it was used."""
    try:
        os.utime(final)
    except FileNotFoundError:
        return False
    return True


def _build(name: str, final: Path, build: Callable[[Path], None], about_s: float | None) -> None:
    failed = final.with_name(f"{final.name}.failed.log")
    work = Path(tempfile.mkdtemp(prefix=".new-", dir=final.parent))
    try:
        work.chmod(0o755)
        with doing(f"building {name}", about_s):
            build(work)
        work.rename(final)
        failed.unlink(missing_ok=True)
    except BuildError as error:
        if not (work / LOG_NAME).exists():
            raise BuildError(f"building {name}: {error}") from error
        shutil.move(work / LOG_NAME, failed)
        raise BuildError(f"building {name}: {error}\nthe whole log: {failed}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _forget_oldest(home: Path) -> None:
    results = [entry for entry in home.iterdir() if entry.is_dir() and not entry.name.startswith(".")]
    results.sort(key=lambda entry: entry.stat().st_mtime, reverse=True)
    for entry in results[KEPT_PER_NAME:]:
        shutil.rmtree(entry, ignore_errors=True)


def _tail(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines()[-LOG_TAIL_LINES:]
    return "".join(f"\n    {line}" for line in lines)
