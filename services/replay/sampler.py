"""Which of the table's transitions a mini-batch is made of: any alike, or those with large errors.

Invariants: a transition that is not in the table is never drawn; probabilities are those by
which the draws were made. Keys are consecutive; the table says which are there.
"""

from typing import Protocol

import numpy as np

from mrcdrl.common.messages.trajectory import Float32Array, Float64Array, Int64Array
from mrcdrl.services.replay.sum_tree import SumTree

_EPSILON = 1e-6  # so that a transition without any error is drawn now and then


class Sampler(Protocol):
    """What the table asks of a sampler; a range is of consecutive keys."""

    rng: np.random.Generator
    """Of the draws."""

    @property
    def nbytes(self) -> int:
        """Memory of what it keeps a transition."""
        ...

    @property
    def largest(self) -> float:
        """Priority so far, which a transition gets that comes without one."""
        ...

    def raise_largest(self, priority: float) -> None:
        """Take it that a priority so large was there."""
        ...

    def shares(self, keys: range) -> Float64Array:
        """A copy of what keys of the table are drawn in proportion to [len(keys)]; or none [0]."""
        ...

    def insert(self, keys: range, priorities: Float32Array) -> None:
        """These are in the table now; priorities: absolute TD errors [len(keys)], or none [0]."""
        ...

    def evict(self, keys: range) -> None:
        """These are no longer in the table."""
        ...

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        """New absolute TD errors of keys in the table; how many of them were taken."""
        ...

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        """`size` of the table's keys, with replacement, and their probabilities, both [size]."""
        ...

    def total(self, keys: range) -> float:
        """What the probabilities are shares of, over the table's keys."""
        ...

    def check_invariants(self, keys: range) -> None:
        """Raise AssertionError where what is kept does not fit the table's keys."""
        ...


class UniformSampler:
    """Each transition as likely as any other; priorities mean nothing."""

    nbytes = 0
    largest = 1.0

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def raise_largest(self, priority: float) -> None:
        pass

    def shares(self, keys: range) -> Float64Array:
        return np.empty(0, np.float64)

    def insert(self, keys: range, priorities: Float32Array) -> None:
        pass

    def evict(self, keys: range) -> None:
        pass

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        return 0

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        drawn = keys.start + self.rng.integers(0, len(keys), size)
        return drawn, np.full(size, 1.0 / len(keys))

    def total(self, keys: range) -> float:
        return float(len(keys))

    def check_invariants(self, keys: range) -> None:
        pass


class PrioritizedSampler:
    """Proportional prioritization (Schaul et al. 2016, section 3.3), stratified.

    Transition i is drawn with p_i^a / sum of all p^a, p_i its last absolute TD error and a the
    exponent; of a batch one is drawn from each of as many equal shares of the sum. capacity:
    transitions of the table.
    """

    def __init__(self, capacity: int, exponent: float, rng: np.random.Generator) -> None:
        self._tree = SumTree(capacity)
        self._exponent = exponent
        self.rng = rng
        self._largest = 1.0  # priority so far; of a transition that comes without one

    @property
    def nbytes(self) -> int:
        return self._tree.nbytes

    @property
    def largest(self) -> float:
        return self._largest

    def raise_largest(self, priority: float) -> None:
        self._largest = max(self._largest, priority)

    def shares(self, keys: range) -> Float64Array:
        return self._tree.get(self._slots(_array(keys)))

    def insert(self, keys: range, priorities: Float32Array) -> None:
        unknown = np.full(len(keys), self._largest, np.float32)
        self._fill(keys, self._shares(priorities if len(priorities) else unknown))

    def evict(self, keys: range) -> None:
        self._fill(keys, np.zeros(len(keys)))

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        self._tree.set(self._slots(keys), self._shares(priorities))
        return len(keys)

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        slots = self._tree.sample(self.rng.random(size))
        drawn = keys.start + (slots - keys.start) % len(self._tree)
        return drawn, self._tree.get(slots) / self._tree.total

    def total(self, keys: range) -> float:
        return self._tree.total

    def _shares(self, priorities: Float32Array) -> Float64Array:
        """Of the sum, by the priorities; the largest of which is remembered."""
        exact = priorities.astype(np.float64)
        self._largest = max(self._largest, float(exact.max(initial=0.0)))
        shares: Float64Array = (exact + _EPSILON) ** self._exponent
        return shares

    def _fill(self, keys: range, shares: Float64Array) -> None:
        """Set the shares of consecutive keys, whose slots may go on at the first."""
        start = keys.start % len(self._tree)
        before_end = len(self._tree) - start
        self._tree.fill(start, shares[:before_end])
        self._tree.fill(0, shares[before_end:])

    def _slots(self, keys: Int64Array) -> Int64Array:
        return keys % len(self._tree)

    def check_invariants(self, keys: range) -> None:
        self._tree.check_invariants()
        every = np.arange(len(self._tree))
        drawable = np.flatnonzero(self._tree.get(every))
        if not np.array_equal(drawable, np.sort(self._slots(_array(keys)))):
            raise AssertionError("the transitions that can be drawn are not those of the table")


def priorities_of(shares: Float64Array, exponent: float) -> Float32Array:
    """The absolute TD errors [N] that gave these shares [N]; none [0] where all were made alike."""
    if exponent == 0:
        return np.empty(0, np.float32)
    errors = shares ** (1 / exponent) - _EPSILON
    return np.maximum(errors, 0.0).astype(np.float32)


def _array(keys: range) -> Int64Array:
    return np.arange(keys.start, keys.stop)
