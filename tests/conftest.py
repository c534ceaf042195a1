"""What all tests share: where the images cannot be built, the tests that need them are skipped, and say so."""

import os
import signal

import pytest
from hypothesis import settings

settings.register_profile("marotte", deadline=None)  # a slow machine is no fault
settings.load_profile("marotte")

NEEDS_IMAGES = {"rp2040_image_path", "unix32_path"}
"""Fixtures that only the cross compiler and the 32-bit libraries can provide."""

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    # Started in the background of a script: programs that the tests start would inherit it and be deaf to Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    """Skip what needs an image if `make test` has found that none can be built (MAROTTE_NO_IMAGES)."""
    if not os.environ.get("MAROTTE_NO_IMAGES"):
        return
    skip = pytest.mark.skip(reason="the system packages that build images are missing; `make images` says which")
    for item in items:
        if item.get_closest_marker("images") or NEEDS_IMAGES.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(skip)
