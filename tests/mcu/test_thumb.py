"""The loops in the RP2040's own instructions give what their twins in viper give, to the bit, on the chip."""

import pytest

DRAW = """
import gc
room.clear()
gc.collect()
from array import array
state = SEED
def draw(n):
    global state
    state = state * 16807 % 2147483647
    return (state >> 4) % n
def some(code, count, *choices):
    values = array(code, range(count))
    for i in range(count):
        k = draw(2 * len(choices))
        values[i] = choices[k] if k < len(choices) else draw(max(choices) + 1)
    return values
def same(a, b):
    return all(x == y for x, y in zip(a, b))
"""

RINGS = """
from firmware import bands, bands_thumb
ring = some("H", 1024, 0, 32768)
third = some("H", 1024, 0, 32768)
one = array("H", ring)
two = array("H", third)
row = bytes((1, 0, 0))
signal = bytes((1, 0, 1))
scratch = array("i", range(41))
taps = bands.tap_table()
taps.extend(bands_thumb.quartets(taps))
gc.collect()
bad = 0
"""

SMOOTH = """
for k in range(30):
    first = 498 + draw(600) + 512 * k
    frames = 1 + draw(17)
    bands.smooth(ring, third, row, 3, signal, first, frames, scratch)
    bands_thumb.smooth(ring, two, row, 3, signal, first, frames, scratch)
    bad += not same(third, two)
print(bad, same(ring, one))
"""

SPLIT = """
level = array("i", range(128))
other = array("i", range(128))
for k in range(30):
    frame = k if k < 4 else 508 + k if k < 8 else draw(1 << 20)
    bands.split(ring, third, row, 3, signal, frame, taps, level)
    bands_thumb.split(ring, third, row, 3, signal, frame, taps, other)
    bad += not same(level, other)
print(bad, same(ring, one) and same(third, two))
"""

BEND = """
knots = bytes((0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 162, 254))
for k in range(20):
    delta = some("i", 48, 32768, 65536, 98304)
    frame = draw(2000)
    end = frame + (0, 1, 254, 271)[k] if k < 4 else frame + draw(272)
    first = draw(3)
    count = 1 + draw(16)
    knot = draw(count)
    for step in range(2):
        bands.bend(ring, third, row, 3, signal, first, frame, end, knots, knot, count, delta)
        bands_thumb.bend(one, two, row, 3, signal, first, frame, end, knots, knot, count, delta)
    bad += not (same(ring, one) and same(third, two))
print(bad, min(ring) == 0 and max(ring) == 32768)
"""


@pytest.mark.images
@pytest.mark.parametrize("loop", [SMOOTH, SPLIT, BEND], ids=["smooth", "split", "bend"])
@pytest.mark.parametrize("seed", [1, 1999])
def test_loops_of_the_bands_are_the_same_in_assembler(repl, loop, seed):
    repl.exec(DRAW.replace("SEED", str(seed)))
    repl.exec(RINGS, timeout_us=20_000_000)
    assert repl.exec(loop, timeout_us=60_000_000).split() == ["0", "True"]


SCENE = """
from firmware import foresight, foresight_thumb
from firmware.functions import sine_table
sine = sine_table()
fade = foresight.fade_table(sine)
gradients = some("H", 512, 0, 65535)
start = array("H", (0, 2, 5))
lengths = array("H", (2, 3, 20))
means = some("H", 3, 16384)
samples = some("H", 25, 0, 32768)
pairs = ((0, 0), (1, 0), (2, 0), (2, 1), (3, 0), (3, 32768), (4, 0), (4, 1), (5, 0), (5, 1), (5, 2), (6, 0))
first = array("H", (0, 5, 5))
count = bytes((5, 0, 7))
dof_of = bytes((0, 1, 2, 3, 4, 6, 5, 4, 3, 2, 1, 0))
signal = bytes((1, 1, 1, 1, 1, 0, 1))
playing = bytes((2, 1, 0))
row = array("H", range(256))
faded = array("H", range(16))
gc.collect()
"""

EVALUATE = """
bad = 0
seen = 0
for k in range(40):
    chosen = [pairs[draw(12)] for m in range(12)]
    for m in (1, 3, 6):
        chosen[m] = chosen[m - 1]
    if k == 0:
        chosen = list(pairs)
    codes = bytes([pair[0] for pair in chosen])
    arguments = array("H", [pair[1] for pair in chosen])
    same_as = array("H", [(0 if m < 5 else 5) + chosen[0 if m < 5 else 5:].index(chosen[m]) for m in range(12)])
    seen += sum(1 for m in range(12) if same_as[m] != m)
    low = some("H", 12, 0, 32768)
    high = some("H", 12, 0, 32768)
    frames = 16 if k < 2 else 1 + draw(16)
    cycle = some("H", 48, 0, 4095)
    fraction = some("i", 48, 0, (1 << 24) - 1)
    weight = some("i", 48, 0, 1 << 28)
    live = some("i", 32, 0, 1 << 28, (1 << 30) - 1)
    pace = some("i", 3, 0, 1 << 21, (1 << 22) - 1)
    spacing = some("H", 16, 0, 4, 508)
    shift = bytes([16 + draw(6) for d in range(7)])
    found = []
    for run in (foresight._evaluate, foresight_thumb.evaluate):
        top = array("i", [5] * 112)
        bottom = array("i", [5] * 112)
        run(playing, 3, frames, k & 1, cycle, fraction, weight, first, count, dof_of, signal, codes, arguments, same_as, low,
            high, shift, sine, gradients, live, start, lengths, means, samples, pace, spacing, fade, faded, row, top, bottom)
        found += [top, bottom]
    bad += not (same(found[0], found[2]) and same(found[1], found[3]))
    found = None
    gc.collect()
print(bad, seen > 0)
"""


@pytest.mark.images
@pytest.mark.parametrize("seed", [1, 1999])
def test_sums_of_frames_to_come_are_the_same_in_assembler(repl, seed):
    repl.exec(DRAW.replace("SEED", str(seed)))
    repl.exec(SCENE, timeout_us=20_000_000)
    assert repl.exec(EVALUATE, timeout_us=60_000_000).split() == ["0", "True"]
