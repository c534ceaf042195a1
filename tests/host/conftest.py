"""Emulated MCUs for the tests of the host."""

import pytest


@pytest.fixture(scope="session")
def rp2040_image_path():
    """Our own image, built on first use."""
    from marotte.images import rp2040_image

    return rp2040_image().path
