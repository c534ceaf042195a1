"""Masks, the convex sum and HOLD against their definitions, in 32 bits from the faintest weight to 64 actions at weight 4."""

from fractions import Fraction
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import formats
from tests.checked import load_checked
from tests.kernels.values import halves, integers, values_q15, weights_q28, words

MODULE = load_checked("firmware/compositor.py")
ONE = formats.VALUE_ONE
ROUNDING = Fraction(1, 2) + Fraction(1, 2) + Fraction(1, 256)
"""Units: half for every action's value, half for the quotient, and what weights lose where heavy ones leave no room."""


class Mapping(NamedTuple):
    """One mapping of an action, with the value that its function has in this frame."""

    dof: int
    low_q15: int = 0
    high_q15: int = ONE
    value_q15: int = ONE


class Layout:
    """The tables of a list of actions, each a list of mappings, as kernels take them."""

    def __init__(self, actions):
        flat = [mapping for mappings in actions for mapping in mappings]
        starts = [sum(map(len, actions[:i])) for i in range(len(actions))]
        self.first_mapping = halves(starts)
        self.mappings = bytes(map(len, actions))
        self.mapped_dof = bytes(mapping.dof for mapping in flat)
        self.low_q15, self.high_q15, self.value_q15 = (
            halves(mapping[column] for mapping in flat) for column in (1, 2, 3)
        )


def blend(actions, weights, hold_weights, holds, before=0, playing=None):
    """Return the base of every DOF: `weights` of the actions, weight and value of every DOF's HOLD."""
    layout = Layout(actions)
    dofs = len(holds)
    playing = bytes(range(len(actions)) if playing is None else playing)
    base = halves([before] * dofs)
    scratch = words([-1] * dofs), bytearray(dofs), words([-1] * dofs), words([-1] * dofs)
    MODULE.blend(
        playing,
        len(playing),
        words(weights),
        layout.first_mapping,
        layout.mappings,
        layout.mapped_dof,
        layout.low_q15,
        layout.high_q15,
        layout.value_q15,
        dofs,
        words(hold_weights),
        halves(holds),
        base,
        *scratch,
    )
    return list(base)


def convex_sum(actions, weights, hold_weight, hold, dof):
    """Return a DOF's value by the definition, a fraction in units of Q15, or None where all weights are 0."""
    total, weight_sum = hold_weight * Fraction(hold), hold_weight
    for mappings, weight in zip(actions, weights, strict=True):
        for mapping in mappings:
            if mapping.dof == dof:
                low, high = mapping.low_q15, mapping.high_q15
                total += weight * (low + (high - low) * Fraction(mapping.value_q15, ONE))
                weight_sum += weight
    return total / weight_sum if weight_sum else None


def assert_blend_is_the_convex_sum(actions, weights, hold_weights, holds):
    found = blend(actions, weights, hold_weights, holds, before=12345)
    for dof, (hold_weight, hold) in enumerate(zip(hold_weights, holds, strict=True)):
        expected = convex_sum(actions, weights, hold_weight, hold, dof)
        if expected is None:
            assert found[dof] == 12345
        else:
            assert abs(found[dof] - expected) <= ROUNDING and 0 <= found[dof] <= ONE


@st.composite
def scenes(draw):
    """Actions, their weights, and the weights and values of HOLD, for some DOFs; weights of all magnitudes."""
    dofs = draw(st.integers(1, 4))
    values = st.sampled_from([0, ONE]) | values_q15
    mappings = st.builds(Mapping, st.integers(0, dofs - 1), values, values, values)
    actions = draw(st.lists(st.lists(mappings, max_size=dofs, unique_by=lambda mapping: mapping.dof), max_size=8))
    magnitudes = st.integers(0, 30).flatmap(lambda bits: st.integers(0, 1 << bits)) | weights_q28
    weights = draw(st.lists(magnitudes, min_size=len(actions), max_size=len(actions)))
    holds = draw(st.lists(st.tuples(integers(0, formats.WEIGHT_ONE), values), min_size=dofs, max_size=dofs))
    return actions, weights, [weight for weight, _ in holds], [value for _, value in holds]


@given(scenes())
def test_blend_is_the_convex_sum(scene):
    assert_blend_is_the_convex_sum(*scene)


@pytest.mark.parametrize(
    "weight", [1, 2, 255, 4095, 1 << 20, (1 << 27) - 1, 1 << 27, formats.WEIGHT_MAX - 1, formats.WEIGHT_MAX]
)
@pytest.mark.parametrize("count", [1, 2, 63, 64])
@pytest.mark.parametrize("hold_weight", [0, 1, formats.WEIGHT_ONE])
def test_blend_of_many_equal_weights_is_the_convex_sum(weight, count, hold_weight):
    for low, high, value in ((0, ONE, ONE), (ONE, 0, 1), (ONE, ONE, 0), (1, ONE - 1, 20_001), (0, 0, ONE)):
        actions = [[Mapping(0, low, high, value)]] * count
        assert_blend_is_the_convex_sum(actions, [weight] * count, [hold_weight], [ONE])


@pytest.mark.parametrize("strong", [1 << 20, formats.WEIGHT_ONE, formats.WEIGHT_MAX])
@pytest.mark.parametrize("faint", [1, 1000, 1 << 10])
def test_blend_of_strong_and_faint_weights_is_the_convex_sum(strong, faint):
    actions = [[Mapping(0, 0, ONE, ONE)], *[[Mapping(0, 0, ONE, 0)]] * 63]
    assert_blend_is_the_convex_sum(actions, [strong] + [faint] * 63, [0], [0])
    assert_blend_is_the_convex_sum(actions, [faint] + [strong] * 63, [faint], [ONE])


def test_blend_of_the_largest_puppet_is_the_convex_sum():
    actions = [[Mapping((i + j) % 16, ONE, j * 1000, i * 500) for j in range(8)] for i in range(64)]
    assert_blend_is_the_convex_sum(actions, [formats.WEIGHT_MAX] * 64, [formats.WEIGHT_ONE] * 16, [ONE] * 16)


def test_blend_leaves_out_actions_that_do_not_play_and_dofs_that_are_not_mapped():
    actions = [[Mapping(0)], [Mapping(0, 0, 0)], [Mapping(1)]]
    heavy = formats.WEIGHT_MAX
    assert blend(actions, [heavy] * 3, [0, 0, 1], [7, 7, 7], before=9, playing=[0]) == [ONE, 9, 7]


HOLD_ONE = formats.WEIGHT_ONE


@given(scenes(), st.data())
def test_hold_is_wanted_where_no_target_is_above_zero(scene, data):
    actions, targets, hold_weights, holds = scene
    dofs = len(holds)
    relative = data.draw(st.lists(st.booleans(), min_size=dofs, max_size=dofs))
    were = data.draw(st.lists(st.sampled_from([0, HOLD_ONE]), min_size=dofs, max_size=dofs))
    base = data.draw(st.lists(values_q15, min_size=dofs, max_size=dofs))
    found_targets, found_holds = hold_targets(actions, targets, relative, base, were, hold_weights, holds)
    for dof in range(dofs):
        is_mapped = any(
            target and any(mapping.dof == dof for mapping in mappings)
            for mappings, target in zip(actions, targets, strict=True)
        )
        assert found_targets[dof] == (0 if is_mapped else HOLD_ONE)
        takes_over = not is_mapped and were[dof] == 0 and not relative[dof] and hold_weights[dof] < HOLD_ONE // 256
        assert found_holds[dof] == (base[dof] if takes_over else holds[dof])


@pytest.mark.parametrize(
    ("relative", "was", "hold_weight", "expected"),
    [
        (0, 0, 0, 111),
        (0, 0, HOLD_ONE // 256 - 1, 111),
        (0, 0, HOLD_ONE // 256, 222),
        (0, HOLD_ONE, 0, 222),
        (1, 0, 0, 222),
    ],
)
def test_hold_takes_the_base_only_where_it_comes_back_faint(relative, was, hold_weight, expected):
    assert hold_targets([], [], [relative], [111], [was], [hold_weight], [222]) == ([HOLD_ONE], [expected])


def hold_targets(actions, targets, relative, base, were, hold_weights, holds):
    """Return the targets and the values of HOLD after one frame."""
    layout = Layout(actions)
    found_targets, found_holds = words(were), halves(holds)
    MODULE.hold_targets(
        len(actions),
        words(targets),
        layout.first_mapping,
        layout.mappings,
        layout.mapped_dof,
        len(holds),
        bytes(relative),
        halves(base),
        found_targets,
        words(hold_weights),
        found_holds,
        bytearray(len(holds)),
    )
    return list(found_targets), list(found_holds)
