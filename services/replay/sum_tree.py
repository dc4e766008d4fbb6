"""Non-negative values with their sum, sampled in proportion to their size (Schaul et al. 2016).

The tree is cut into many trees side by side: numpy sums and searches a few thousand adjacent roots
faster than it walks the levels that this saves.

Invariants (`check_invariants`): a node is the sum of its two children as last computed, never
updated by a difference, so rounding errors do not accumulate; an index with value 0 is never
sampled. Pure numpy: each call works on all its indices at once, level by level.
"""

import numpy as np

from mrcdrl.common.messages.trajectory import Float64Array, Int64Array

NODE_BYTES = 8
MAX_NODES = 4  # per value


class SumTree:
    """`size` values, 0 at first, as the leaves of binary trees of float64 sums.

    num_roots: the most trees, a power of two.
    """

    def __init__(self, size: int, num_roots: int = 4096) -> None:
        if size < 1:
            raise ValueError("a sum tree needs at least one leaf")
        self._size = size
        levels = (size - 1).bit_length()
        self._first_leaf = 1 << levels
        self._first_root = min(num_roots, self._first_leaf)  # as many roots as nodes before them
        self._depth = levels - (self._first_root.bit_length() - 1)
        # Node i has the children 2i and 2i + 1; those before the first root are unused.
        self._nodes: Float64Array = np.zeros(2 * self._first_leaf, np.float64)
        self._roots = self._nodes[self._first_root : 2 * self._first_root]

    def __len__(self) -> int:
        return self._size

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self._roots.sum())

    @property
    def nbytes(self) -> int:
        return self._nodes.nbytes

    def get(self, indices: Int64Array) -> Float64Array:
        """The values at these indices, float64 [len(indices)]."""
        self._check(indices)
        return self._nodes[indices + self._first_leaf]

    def set(self, indices: Int64Array, values: Float64Array) -> None:
        """Put values, float64 [len(indices)], at indices; the last one wins if an index repeats.

        Raises ValueError for a value that is negative or not finite, or an index out of range.
        """
        self._check(indices)
        _check_values(values)
        nodes = indices + self._first_leaf
        self._nodes[nodes] = values
        for _ in range(self._depth):
            nodes >>= 1
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]

    def fill(self, start: int, values: Float64Array) -> None:
        """Put values, float64 [N], at the indices start ... start + N - 1.

        Several times faster than `set`, because their parents are adjacent on every level.
        Raises ValueError as `set` does.
        """
        if len(values) == 0:
            return
        self._check(np.array([start, start + len(values) - 1]))
        _check_values(values)
        first, last = start + self._first_leaf, start + self._first_leaf + len(values) - 1
        nodes = self._nodes
        nodes[first : last + 1] = values
        for _ in range(self._depth):
            first, last = first >> 1, last >> 1
            if first == last:
                nodes[first] = nodes[2 * first] + nodes[2 * first + 1]
            else:
                lefts, rights = (
                    nodes[2 * first : 2 * last + 1 : 2],
                    nodes[2 * first + 1 : 2 * last + 2 : 2],
                )
                nodes[first : last + 1] = lefts + rights

    def sample(self, uniforms: Float64Array) -> Int64Array:
        """One index per uniform number in 0 ... 1 (1 excluded), stratified.

        The total is cut into len(uniforms) equal strata, and each gives one index, so that index i
        is expected len(uniforms) x value / total times. Raises ValueError when all values are 0.
        """
        ends = self._roots.cumsum()
        total = ends[-1]
        if total == 0:
            raise ValueError("nothing to sample: all values are 0")
        count = len(uniforms)
        targets = _below((np.arange(count) + uniforms) / count * total, total)
        trees = ends.searchsorted(targets, side="right")
        nodes = trees + self._first_root
        starts = np.where(trees > 0, ends[trees - 1], 0.0)
        left_over = _below(targets - starts, self._nodes[nodes])
        for _ in range(self._depth):
            nodes *= 2
            lefts = self._nodes[nodes]
            right = left_over >= lefts
            nodes += right
            left_over = _below(left_over - lefts * right, self._nodes[nodes])
        return nodes - self._first_leaf

    def _check(self, indices: Int64Array) -> None:
        if len(indices) and (indices.min() < 0 or indices.max() >= self._size):
            raise ValueError(f"an index is outside 0 ... {self._size - 1}")

    def check_invariants(self) -> None:
        """Raise AssertionError where a node is not the sum of its children, or negative."""
        inner = np.arange(self._first_root, self._first_leaf)
        sums = self._nodes[2 * inner] + self._nodes[2 * inner + 1]
        if not np.array_equal(self._nodes[inner], sums):
            raise AssertionError("a node is not the sum of its children")
        if (self._nodes < 0).any() or self._nodes[self._first_leaf + self._size :].any():
            raise AssertionError("a value is negative, or lies beyond the last index")


def _check_values(values: Float64Array) -> None:
    if len(values) and not (values.min() >= 0 and values.max() < np.inf):
        raise ValueError("a value is negative or not finite")


def _below(targets: Float64Array, sums: Float64Array | np.float64) -> Float64Array:
    """Clip targets below the sums they fall into; rounding may have put them on the edge.

    A target below a sum leads to a child with a sum above 0, and so on down to a leaf above 0.
    """
    return np.minimum(targets, np.nextafter(sums, 0.0))
