"""The sum tree against a plain list of numbers."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from mrcdrl.services.replay.sum_tree import SumTree

# From values lost to rounding beside the others to values that swallow them.
VALUES = st.one_of(st.just(0.0), st.floats(1e-12, 1e12), st.floats(0.0, 1.0, width=16))
BELOW_ONE = st.floats(0.0, 1.0, exclude_max=True)


ROOTS = st.sampled_from([1, 2, 8, 4096])


def tree_of(values: list[float], num_roots: int = 2) -> SumTree:
    tree = SumTree(len(values), num_roots)
    tree.set(np.arange(len(values)), np.array(values))
    return tree


class TreeAgainstList(RuleBasedStateMachine):
    """Values by index determine sums and samples."""

    @initialize(size=st.integers(1, 70), num_roots=ROOTS)
    def make(self, size: int, num_roots: int) -> None:
        self.tree = SumTree(size, num_roots)
        self.model = [0.0] * size

    @rule(data=st.data())
    def set(self, data: st.DataObject) -> None:
        indices = data.draw(st.lists(st.integers(0, len(self.model) - 1), max_size=20))
        values = data.draw(st.lists(VALUES, min_size=len(indices), max_size=len(indices)))
        self.tree.set(np.array(indices, np.int64), np.array(values, np.float64))
        for index, value in zip(indices, values, strict=True):
            self.model[index] = value

    @rule(data=st.data())
    def fill(self, data: st.DataObject) -> None:
        start = data.draw(st.integers(0, len(self.model) - 1))
        values = data.draw(st.lists(VALUES, max_size=len(self.model) - start))
        self.tree.fill(start, np.array(values, np.float64))
        self.model[start : start + len(values)] = values

    @rule(uniforms=st.lists(BELOW_ONE, min_size=1, max_size=12))
    def sample(self, uniforms: list[float]) -> None:
        if not any(self.model):
            with pytest.raises(ValueError, match="all values are 0"):
                self.tree.sample(np.array(uniforms))
            return
        sampled = self.tree.sample(np.array(uniforms)).tolist()
        bounds = np.concatenate([[0.0], np.cumsum(self.model)])
        near = 1e-9 * bounds[-1]
        for row, (index, uniform) in enumerate(zip(sampled, uniforms, strict=True)):
            assert self.model[index] > 0
            target = (row + uniform) / len(uniforms) * bounds[-1]
            assert bounds[index] - near <= target <= bounds[index + 1] + near

    @invariant()
    def holds_the_values_and_their_sum(self) -> None:
        self.tree.check_invariants()
        assert self.tree.get(np.arange(len(self.model))).tolist() == self.model
        assert self.tree.total == pytest.approx(math.fsum(self.model), rel=1e-12)


TestTreeAgainstList = TreeAgainstList.TestCase
TestTreeAgainstList.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)


def test_samples_by_hand() -> None:
    """Values 1, 0, 3, 4 fill 0-1, 1-1, 1-4, 4-8."""
    tree = tree_of([1.0, 0.0, 3.0, 4.0])
    assert tree.total == 8.0
    assert tree.sample(np.zeros(8)).tolist() == [0, 2, 2, 2, 3, 3, 3, 3]
    assert tree.sample(np.full(8, 0.99)).tolist() == [0, 2, 2, 2, 3, 3, 3, 3]
    assert tree.sample(np.array([0.24, 0.0])).tolist() == [0, 3]
    assert tree.sample(np.array([0.26, 0.99])).tolist() == [2, 3]


@given(st.lists(VALUES, min_size=1, max_size=70).filter(any), st.integers(1, 9), ROOTS)
@example([1.0, 2.0**-53, 2.0**-53], 1, 1)
@example([1.0, 2.0**-53, 2.0**-53], 1, 4096)
@example([3.0, 0.0, 0.1, 0.0], 3, 1)
@example([1e12, 0.0, 1e-12, 0.0], 3, 2)
@example([1e12, 0.0, 1e-12, 0.0], 3, 4096)
@example([5e-324], 2, 1)
def test_the_greatest_uniform_samples_no_zero(
    values: list[float], count: int, num_roots: int
) -> None:
    tree = tree_of(values, num_roots)
    sampled = tree.sample(np.full(count, np.nextafter(1.0, 0.0)))
    assert (tree.get(sampled) > 0).all()


def test_sums_do_not_drift() -> None:
    """After 2 000 rounds of large values, the total is that of a new tree."""
    tree, rng = SumTree(100), np.random.default_rng(0)
    for _ in range(2000):
        indices = rng.integers(0, 100, 64)
        tree.set(indices, rng.random(64) * 1e9)
        tree.set(indices, rng.random(64))
    assert tree.total == tree_of(tree.get(np.arange(100)).tolist()).total


@pytest.mark.parametrize(
    ("indices", "values", "reason"),
    [
        ([4], [1.0], "outside 0 ... 3"),
        ([-1], [1.0], "outside 0 ... 3"),
        ([0], [-1.0], "negative or not finite"),
        ([0, 1], [1.0, math.nan], "negative or not finite"),
        ([0], [math.inf], "negative or not finite"),
    ],
)
def test_an_impossible_value_or_index_is_refused_and_changes_nothing(
    indices: list[int], values: list[float], reason: str
) -> None:
    tree = tree_of([1.0, 2.0, 3.0, 4.0])
    with pytest.raises(ValueError, match=reason):
        tree.set(np.array(indices), np.array(values))
    assert tree.get(np.arange(4)).tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("start", "values", "reason"),
    [
        (3, [1.0, 1.0], "outside 0 ... 3"),
        (-1, [1.0], "outside 0 ... 3"),
        (0, [1.0, math.inf], "negative or not finite"),
        (2, [-1.0], "negative or not finite"),
    ],
)
def test_an_impossible_fill_is_refused_and_changes_nothing(
    start: int, values: list[float], reason: str
) -> None:
    tree = tree_of([1.0, 2.0, 3.0, 4.0])
    with pytest.raises(ValueError, match=reason):
        tree.fill(start, np.array(values))
    assert tree.get(np.arange(4)).tolist() == [1.0, 2.0, 3.0, 4.0]
    tree.check_invariants()


def test_a_tree_has_a_leaf() -> None:
    with pytest.raises(ValueError, match="at least one leaf"):
        SumTree(0)
