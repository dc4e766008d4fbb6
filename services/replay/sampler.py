"""Choice of a mini-batch's transitions: all alike, or those with large errors more often.

Invariants: a transition outside the table is never sampled; the probabilities are those by which
the samples were drawn. Keys are consecutive; the table says which ones it holds.
"""

from typing import Protocol

import numpy as np

from mrcdrl.common.config import ReplayConfig
from mrcdrl.common.messages.trajectory import Float32Array, Float64Array, Int64Array
from mrcdrl.services.replay.sum_tree import SumTree

_EPSILON = 1e-6  # so that a transition without any error is sampled now and then


class Sampler(Protocol):
    """What the table asks of a sampler; a range holds consecutive keys."""

    rng: np.random.Generator
    """The random stream of the samples."""

    @property
    def nbytes(self) -> int:
        """Memory of its data about transitions."""
        ...

    @property
    def largest(self) -> float:
        """Largest priority so far, given to a transition that comes without one."""
        ...

    def raise_largest(self, priority: float) -> None:
        """Raise the largest priority so far to at least this one."""
        ...

    def scaled_priorities(self, keys: range) -> Float64Array:
        """A copy of priority ** alpha of the table's keys [len(keys)]; [0] where uniform."""
        ...

    def insert(self, keys: range, priorities: Float32Array) -> None:
        """Add keys to the table's; priorities: absolute TD errors [len(keys)], or none [0]."""
        ...

    def evict(self, keys: range) -> None:
        """Remove keys from the table's."""
        ...

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        """Set the absolute TD errors of keys in the table; return how many were used."""
        ...

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        """`size` of the table's keys, with replacement, and their probabilities, both [size]."""
        ...

    def total(self, keys: range) -> float:
        """Sum of the scaled priorities of the table's keys; their number where uniform."""
        ...

    def check_invariants(self, keys: range) -> None:
        """Raise AssertionError where the sampler's data do not match the table's keys."""
        ...


class UniformSampler:
    """Samples each transition with the same probability; ignores priorities."""

    nbytes = 0
    largest = 1.0

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def raise_largest(self, priority: float) -> None:
        pass

    def scaled_priorities(self, keys: range) -> Float64Array:
        return np.empty(0, np.float64)

    def insert(self, keys: range, priorities: Float32Array) -> None:
        pass

    def evict(self, keys: range) -> None:
        pass

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        return 0

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        sampled = keys.start + self.rng.integers(0, len(keys), size)
        return sampled, np.full(size, 1.0 / len(keys))

    def total(self, keys: range) -> float:
        return float(len(keys))

    def check_invariants(self, keys: range) -> None:
        pass


class PrioritizedSampler:
    """Proportional prioritization (Schaul et al. 2016, section 3.3), stratified.

    Transition i is sampled with probability p_i^a / sum of all p^a, where p_i is its last absolute
    TD error and a the exponent. The sum is cut into one equal stratum per sample of a batch.
    capacity: the table's, in transitions.
    """

    def __init__(self, capacity: int, exponent: float, rng: np.random.Generator) -> None:
        self._tree = SumTree(capacity)
        self._exponent = exponent
        self.rng = rng
        self._largest = 1.0

    @property
    def nbytes(self) -> int:
        return self._tree.nbytes

    @property
    def largest(self) -> float:
        return self._largest

    def raise_largest(self, priority: float) -> None:
        self._largest = max(self._largest, priority)

    def scaled_priorities(self, keys: range) -> Float64Array:
        return self._tree.get(self._leaves(_array(keys)))

    def insert(self, keys: range, priorities: Float32Array) -> None:
        unknown = np.full(len(keys), self._largest, np.float32)
        self._fill(keys, self._scale(priorities if len(priorities) else unknown))

    def evict(self, keys: range) -> None:
        self._fill(keys, np.zeros(len(keys)))

    def update(self, keys: Int64Array, priorities: Float32Array) -> int:
        self._tree.set(self._leaves(keys), self._scale(priorities))
        return len(keys)

    def sample(self, keys: range, size: int) -> tuple[Int64Array, Float64Array]:
        leaves = self._tree.sample(self.rng.random(size))
        sampled = keys.start + (leaves - keys.start) % len(self._tree)
        return sampled, self._tree.get(leaves) / self._tree.total

    def total(self, keys: range) -> float:
        return self._tree.total

    def _scale(self, priorities: Float32Array) -> Float64Array:
        """Scaled priorities; remembers the largest priority."""
        exact = priorities.astype(np.float64)
        self._largest = max(self._largest, float(exact.max(initial=0.0)))
        scaled: Float64Array = (exact + _EPSILON) ** self._exponent
        return scaled

    def _fill(self, keys: range, scaled: Float64Array) -> None:
        """Set the scaled priorities of consecutive keys, whose leaves may wrap to the first."""
        start = keys.start % len(self._tree)
        before_end = len(self._tree) - start
        self._tree.fill(start, scaled[:before_end])
        self._tree.fill(0, scaled[before_end:])

    def _leaves(self, keys: Int64Array) -> Int64Array:
        return keys % len(self._tree)

    def check_invariants(self, keys: range) -> None:
        self._tree.check_invariants()
        possible = np.flatnonzero(self._tree.get(np.arange(len(self._tree))))
        if not np.array_equal(possible, np.sort(self._leaves(_array(keys)))):
            raise AssertionError("the transitions that can be sampled are not those of the table")


def make_sampler(replay: ReplayConfig, capacity: int) -> Sampler:
    """The sampler a configuration asks for."""
    rng = np.random.default_rng(replay.seed)
    if replay.prioritized:
        return PrioritizedSampler(capacity, replay.priority_exponent, rng)
    return UniformSampler(rng)


def priorities_of(scaled: Float64Array, exponent: float) -> Float32Array:
    """Absolute TD errors [N] that gave these scaled priorities [N]; none [0] for exponent 0."""
    if exponent == 0:
        return np.empty(0, np.float32)
    errors = scaled ** (1 / exponent) - _EPSILON
    return np.maximum(errors, 0.0).astype(np.float32)


def _array(keys: range) -> Int64Array:
    return np.arange(keys.start, keys.stop)
