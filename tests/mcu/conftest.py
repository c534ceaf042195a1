"""Emulated MCUs for the tests of this folder."""

import os
from pathlib import Path

import pytest

from marotte.mcu.raw_repl import RawRepl
from marotte.mcu.rp2040 import Rp2040Mcu


@pytest.fixture(scope="session")
def rp2040_image_path() -> Path:
    """The image under test: our own, or the UF2 file that MAROTTE_TEST_UF2 names."""
    named = os.environ.get("MAROTTE_TEST_UF2")
    if named:
        return Path(named)
    from marotte.images import rp2040_image

    return rp2040_image().path


@pytest.fixture
def pico(rp2040_image_path):
    """An emulated RP2040 that has just been switched on."""
    with Rp2040Mcu(rp2040_image_path, timed_flash=False) as mcu:
        yield mcu


@pytest.fixture
def repl(pico):
    """The raw REPL of `pico`, entered."""
    return RawRepl(pico)
