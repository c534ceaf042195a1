"""The image that the tests of this folder run."""

import pytest


@pytest.fixture(scope="session")
def rp2040_image_path():
    """Our own image, built on first use."""
    from marotte.images import rp2040_image

    return rp2040_image().path
