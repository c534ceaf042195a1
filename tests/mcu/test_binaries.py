"""The real MicroPython binaries: widths, what is built in, and where the image lies in flash."""

import struct
import subprocess

import pytest

from marotte.images import rp2040_image, unix_binary

UF2_MAGICS = (0x0A324655, 0x9E5D5157, 0x0AB16F30)
UF2_FAMILY_RP2040 = 0xE48BFF56
FLASH_START = 0x10000000
FILE_SYSTEM_START = FLASH_START + (2048 - 1408) * 1024
"""Where a stock Pico's file system begins: 1408 KiB at the end of 2 MiB."""


def answer_of(bits, program):
    done = subprocess.run([unix_binary(bits), "-c", program], capture_output=True, text=True, timeout=20)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("bits", [64, 32])
def test_unix_binary_has_what_the_firmware_needs(bits):
    modules = "array, binascii, gc, json, micropython, os, select, struct, sys, time"
    assert answer_of(bits, f"import {modules}; print(sys.stdin.buffer.readinto and micropython.heap_lock and 1)") == "1"
    assert answer_of(bits, "import sys; print(sys.maxsize)") == str(2 ** (bits - 1) - 1)
    with pytest.raises(AssertionError, match="no module named '_thread'"):
        answer_of(bits, "import _thread")


def test_unix_32_computes_as_the_rp2040_does():
    program = """
import array, micropython
@micropython.viper
def wrap(x: int) -> int:
    return (x << 20) * 5
@micropython.viper
def load(a: ptr32) -> int:
    return int(a[0])
print(wrap(2049), load(array.array("i", [-7])), 16777216.0 + 1)
"""
    wrapped = (2049 << 20) * 5 % 2**32
    assert answer_of(32, program) == f"{wrapped - 2**32 * (wrapped >> 31)} -7 16777216.0"


def test_rp2040_image_is_a_uf2_that_leaves_the_file_system_alone():
    image = rp2040_image()
    contents = image.path.read_bytes()
    assert len(contents) % 512 == 0
    blocks = [contents[start : start + 512] for start in range(0, len(contents), 512)]
    ends = []
    for number, block in enumerate(blocks):
        magic0, magic1, _flags, address, size, index, count, family = struct.unpack_from("<8I", block)
        assert (magic0, magic1, struct.unpack_from("<I", block, 508)[0]) == UF2_MAGICS
        assert (index, count, family) == (number, len(blocks), UF2_FAMILY_RP2040)
        ends.append(address + size)
    assert struct.unpack_from("<I", blocks[0], 12)[0] == FLASH_START
    assert max(ends) <= FILE_SYSTEM_START


def test_rp2040_image_is_not_built_again_when_nothing_changed():
    first = rp2040_image()
    assert rp2040_image() == first
    assert first.elf is not None and first.elf.is_file()
