"""Where MicroPython's source tree comes from.

In this order: the folders that the user names (`MAROTTE_MICROPYTHON`, `MAROTTE_PICO_SDK`), the official release by its
SHA-256, Debian's source packages. What was fetched once is kept in the cache and no network is asked again.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import threading
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marotte.cache import BuildError, build_cached, run_logged
from marotte.errors import MarotteError
from marotte.progress import say

RECIPES = Path(__file__).resolve().parents[2] / "tools" / "image"
"""The board, the manifest and the scripts that images are built with: part of the checkout."""

RELEASE_VERSION = "1.26.1"
RELEASE_URL = (
    "https://github.com/micropython/micropython/releases/download/"
    f"v{RELEASE_VERSION}/micropython-{RELEASE_VERSION}.tar.xz"
)
RELEASE_SHA256 = "12be6514df6272c0fcb328122b534af6b12abdd52435c19f40ee1707cc43ac98"
"""As Homebrew's formula for this version has it."""

ANSWER_TIMEOUT_S = 5.0
"""How long the release's server may take to answer; machines without the Internet go on to Debian's mirror after it."""

_UNUSED_LIBRARIES = ("alif*", "arduino-lib", "asf4", "fsp", "nrfx", "nxp_driver", "stm32lib")
PICO_LIBRARIES = ("pico-sdk/pico_sdk_init.cmake", "tinyusb/src/tusb.h", "mbedtls/include/mbedtls/version.h")


@dataclass(frozen=True)
class Sources:
    """A MicroPython source tree to build from. It is only read; everything is built elsewhere."""

    micropython: Path
    """The tree's top folder, with `py/`, `ports/`, `tests/`, `lib/`."""
    pico_sdk: Path
    version: str
    """As in "1.26.1", read from the tree."""
    origin: str
    """In words: "Debian's source packages"."""
    identity: str
    """Differs whenever the sources differ; part of the key of all that is built from them."""

    def require_pico_libraries(self) -> None:
        """Raise MarotteError if a library that the RP2040 image needs is missing from the tree."""
        for name in PICO_LIBRARIES:
            folder, file = name.split("/", 1)
            path = self.pico_sdk / file if folder == "pico-sdk" else self.micropython / "lib" / name
            if not path.is_file():
                raise MarotteError(
                    f"{path} is missing: the MicroPython tree lacks its {folder} library; in a git checkout "
                    f"`make -C {self.micropython}/ports/rp2 BOARD=RPI_PICO submodules` fetches it"
                )


def micropython_sources() -> Sources:
    """Return the source tree to build from, fetching it on first use (about 100 MB on disk).

    Raises MarotteError if a named folder is not what it should be, or if no source can be reached.
    """
    own = _own_folder("MAROTTE_MICROPYTHON", "py/mpconfig.h", "a MicroPython source tree")
    own_sdk = _own_folder("MAROTTE_PICO_SDK", "pico_sdk_init.cmake", "a pico-sdk")
    if own:
        tree, origin, identity = own, f"the folder {own}", signature_of(own)
    else:
        script = RECIPES / "debian_sources.sh"
        fetched = build_cached("micropython-sources", [RELEASE_URL, RELEASE_SHA256, script], _fetch, about_s=20)
        record = (fetched / "record.txt").read_text()
        tree = fetched / "micropython"
        origin = record.splitlines()[0].removeprefix("origin: ")
        identity = hashlib.sha256(record.encode()).hexdigest()
    if own_sdk:
        identity += signature_of(own_sdk)
        origin += f" with the pico-sdk in {own_sdk}"
    return Sources(tree, own_sdk or tree / "lib" / "pico-sdk", version_of(tree), origin, identity)


def version_of(tree: Path) -> str:
    """Return the version of a MicroPython source tree, as "1.26.1"."""
    header = (tree / "py" / "mpconfig.h").read_text()
    numbers = dict(re.findall(r"#define MICROPY_VERSION_(MAJOR|MINOR|MICRO|PRERELEASE) (\d+)", header))
    try:
        version = f"{numbers['MAJOR']}.{numbers['MINOR']}.{numbers['MICRO']}"
    except KeyError as missing:
        raise MarotteError(f"{tree}/py/mpconfig.h: MICROPY_VERSION_{missing.args[0]} is not defined") from missing
    return version + ("-preview" if numbers.get("PRERELEASE", "0") != "0" else "")


def signature_of(folder: Path) -> str:
    """Return a hash of the names, sizes and times of the files in a user's own folder, without what was built in it.

    Unlike a hash of all contents it takes well under a second; any edit changes it.
    """
    total = hashlib.sha256()
    for here, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith((".git", "build", "__pycache__")))
        for name in sorted(files):
            path = Path(here, name)
            if not path.is_symlink():
                facts = path.stat()
                total.update(f"{path.relative_to(folder)} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return total.hexdigest()


def _own_folder(variable: str, evidence: str, what: str) -> Path | None:
    """Return the folder that an environment variable names, or None; raise MarotteError if it is not `what`."""
    value = os.environ.get(variable)
    if not value:
        return None
    folder = Path(value).expanduser().absolute()
    if not (folder / evidence).is_file():
        raise MarotteError(f"{variable}={value}: not the folder of {what} ({evidence} is missing in it)")
    return folder


def _fetch(folder: Path) -> None:
    """Fill `folder` from the first source that works: `micropython/` and `record.txt`."""
    ways: list[tuple[str, Callable[[Path], None]]] = [
        ("the official release", _fetch_release),
        ("Debian's source packages", _fetch_debian),
    ]
    failures = []
    for origin, fetch in ways:
        try:
            fetch(folder)
        except (MarotteError, OSError) as error:
            failures.append(f"{origin}: {error}")
            say(f"MicroPython's sources are not to be had from {origin} ({str(error).splitlines()[0]})")
            shutil.rmtree(folder / "micropython", ignore_errors=True)
        else:
            return
    raise BuildError(
        "MicroPython's sources are not to be had; if you have a source tree, set MAROTTE_MICROPYTHON to its folder\n"
        + "\n".join(failures)
    )


def _fetch_release(folder: Path) -> None:
    archive = folder / "micropython.tar.xz"
    answer = within(ANSWER_TIMEOUT_S, lambda: urllib.request.urlopen(RELEASE_URL, timeout=ANSWER_TIMEOUT_S))
    with answer, archive.open("wb") as file:
        shutil.copyfileobj(answer, file)
    found = hashlib.sha256(archive.read_bytes()).hexdigest()
    if found != RELEASE_SHA256:
        raise MarotteError(f"{RELEASE_URL} has the SHA-256 {found}, expected {RELEASE_SHA256}")
    tree = folder / "micropython"
    tree.mkdir()
    left_out = [f"--exclude=*/lib/{name}" for name in _UNUSED_LIBRARIES]
    run_logged(folder, ["tar", *left_out, "--no-same-owner", "--strip-components=1", "-xf", archive, "-C", tree])
    archive.unlink()
    Sources(tree, tree / "lib" / "pico-sdk", "", "", "").require_pico_libraries()
    (folder / "record.txt").write_text(f"origin: the official release\n{RELEASE_SHA256}  {RELEASE_URL}\n")


def _fetch_debian(folder: Path) -> None:
    run_logged(folder, ["bash", RECIPES / "debian_sources.sh", folder])


def within(limit_s: float, call: Callable[[], Any]) -> Any:
    """Return what `call` returns or raise what it raises; TimeoutError after `limit_s` seconds, name look-ups included."""
    outcome: list[tuple[bool, Any]] = []

    def work() -> None:
        try:
            outcome.append((True, call()))
        except Exception as error:
            outcome.append((False, error))

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    worker.join(limit_s)
    if not outcome:
        raise TimeoutError(f"no answer within {limit_s:g} s")
    well, value = outcome[0]
    if not well:
        raise value
    return value
