"""Emulated MCUs for the tests of the link."""

from functools import partial

import pytest

from marotte.mcu.rp2040 import Rp2040Mcu


@pytest.fixture
def rp2040_mcu():
    """Makes an emulated RP2040 with our own image, built on first use."""
    from marotte.images import rp2040_image

    return partial(Rp2040Mcu, rp2040_image().path, timed_flash=False)
