"""The whole firmware with every integer checked, 32 bits in kernels and small ones in what runs per frame: the motion stays."""

import numpy
import pytest

from tests.corners import corners
from tests.corners_full import full_corners
from tests.corners_signal import signal_corners
from tests.motion.checked_mcu import CheckedMcu
from tests.motion.playing import TAPS, Case, play, random_case, tap

NAMED = ("everything at once", "cues of one frame", "one of each function", "a tempo with every frame")
CORNERS = [Case(*corner) for corner in (*corners(), *full_corners()) if corner.name in NAMED]
GAINS_CORNERS = [Case(*corner) for corner in signal_corners(4) if corner.name in ("moods", "wheels turning round")]
RANDOM_CASES = [random_case(seed, 4) for seed in range(300, 303)]
CASES = [(case, 4) for case in (*CORNERS, *GAINS_CORNERS, *RANDOM_CASES)]


@pytest.mark.parametrize(("case", "seconds"), CASES, ids=[case.name for case, _ in CASES])
def test_checked_firmware_moves_as_on_micropython(case, seconds):
    expected = play(case, seconds, "unix")
    with CheckedMcu() as mcu:  # its timer wraps on the way
        found = play(case, seconds, mcu)
    for name in TAPS:
        assert numpy.array_equal(tap(found, name), tap(expected, name)), name
    assert found.status["late_frames"] == 0
