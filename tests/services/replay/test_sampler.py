"""Prioritized samples follow the priorities, and importance weights undo that."""

import numpy as np
import pytest

from mrcdrl.common.messages.trajectory import Float32Array, Float64Array, Int64Array, Samples
from mrcdrl.services.learner.batch import importance_weights
from mrcdrl.services.replay.sampler import PrioritizedSampler

SIZE, FIRST_KEY, EXPONENT = 200, 1_000_003, 0.6
KEYS = range(FIRST_KEY, FIRST_KEY + SIZE)


def make_sampler(
    priorities: Float32Array, *, seed: int = 0, exponent: float = EXPONENT
) -> PrioritizedSampler:
    """A sampler of the transitions KEYS, with some capacity to spare."""
    sampler = PrioritizedSampler(SIZE + 57, exponent, np.random.default_rng(seed))
    sampler.insert(KEYS, priorities)
    return sampler


def skewed_priorities() -> Float32Array:
    """A few large errors, many small ones."""
    return np.random.default_rng(1).lognormal(0, 1.5, SIZE).astype(np.float32)


def probabilities_of(priorities: Float32Array, exponent: float = EXPONENT) -> Float64Array:
    powers = (priorities.astype(np.float64) + 1e-6) ** exponent
    normalized: Float64Array = powers / powers.sum()
    return normalized


def sample(
    sampler: PrioritizedSampler, batch_size: int, num_batches: int
) -> tuple[Int64Array, Float64Array]:
    batches = [sampler.sample(KEYS, batch_size) for _ in range(num_batches)]
    return np.concatenate([b[0] for b in batches]), np.concatenate([b[1] for b in batches])


def chi_square(keys: Int64Array, expected: Float64Array) -> float:
    counts = np.bincount(keys - FIRST_KEY, minlength=SIZE)
    return float(((counts - expected) ** 2 / expected).sum())


@pytest.mark.parametrize(("batch_size", "num_batches"), [(1, 20_000), (32, 3_000), (512, 200)])
def test_samples_follow_the_priorities(batch_size: int, num_batches: int) -> None:
    priorities = skewed_priorities()
    keys, probabilities = sample(make_sampler(priorities), batch_size, num_batches)
    expected = probabilities_of(priorities)
    np.testing.assert_allclose(probabilities, expected[keys - FIRST_KEY], rtol=1e-9)
    limit = 266.4  # 99.9 % of chi-square with 199 degrees of freedom, which strata only reduce
    assert chi_square(keys, expected * batch_size * num_batches) < limit
    uniform = np.full(SIZE, batch_size * num_batches / SIZE)
    assert chi_square(keys, uniform) > 10 * limit


def test_samples_follow_updated_priorities() -> None:
    sampler = make_sampler(np.ones(SIZE, np.float32))
    priorities = skewed_priorities()
    assert sampler.update(np.array(KEYS), priorities) == SIZE
    keys, _ = sample(sampler, 32, 3_000)
    assert chi_square(keys, probabilities_of(priorities) * 96_000) < 266.4


def test_each_stratum_gives_one_sample() -> None:
    """Strata of a quarter of the sum: of four samples, one is from the first half of the keys."""
    sampler = make_sampler(np.repeat(np.array([1, 3], np.float32), SIZE // 2), exponent=1.0)
    for _ in range(200):
        keys, _ = sampler.sample(KEYS, 4)
        assert (keys - FIRST_KEY < SIZE // 2).sum() == 1


def test_exponent_0_samples_uniformly() -> None:
    keys, probabilities = sample(make_sampler(skewed_priorities(), exponent=0.0), 1, 20_000)
    np.testing.assert_allclose(probabilities, 1 / SIZE)
    assert chi_square(keys, np.full(SIZE, 20_000 / SIZE)) < 266.4


def samples_of(keys: Int64Array, probabilities: Float64Array) -> Samples:
    count = len(keys)
    return Samples(
        keys=keys,
        probabilities=probabilities,
        table_size=SIZE,
        total_priority=float(SIZE),
        records=np.zeros((count, 1, 1), np.uint8),
        actions=np.zeros(count, np.uint8),
        rewards=np.zeros(count, np.float32),
        discounts=np.zeros(count, np.float32),
        bootstrap_offsets=np.ones(count, np.uint8),
        weights_versions=np.zeros(count, np.int64),
    )


def test_importance_weights_undo_the_priorities() -> None:
    """The weighted mean of samples of a number that grows with the priority is the table's mean."""
    priorities = skewed_priorities()
    numbers = np.sqrt(priorities.astype(np.float64))
    samples = samples_of(*sample(make_sampler(priorities), 64, 2_000))
    sampled = numbers[samples.keys - FIRST_KEY]
    weights = importance_weights(samples, 1.0)
    assert np.average(sampled, weights=weights) == pytest.approx(numbers.mean(), rel=0.01)
    assert sampled.mean() > 1.3 * numbers.mean()
    half = importance_weights(samples, 0.4)
    assert numbers.mean() * 1.05 < np.average(sampled, weights=half) < sampled.mean() / 1.05


def test_a_transition_without_priority_gets_the_largest_so_far() -> None:
    sampler = PrioritizedSampler(8, 1.0, np.random.default_rng(0))
    none = np.empty(0, np.float32)
    sampler.insert(range(2), none)
    sampler.update(np.array([1]), np.array([3.0], np.float32))
    sampler.update(np.array([1]), np.array([2.0], np.float32))
    sampler.insert(range(2, 3), none)
    sampler.insert(range(3, 4), np.array([5.0], np.float32))
    sampler.insert(range(4, 5), none)
    keys, probabilities = sampler.sample(range(5), 512)
    found = dict(zip(keys.tolist(), probabilities.tolist(), strict=True))
    expected = np.array([1, 2, 3, 5, 5]) / 16
    np.testing.assert_allclose([found[key] for key in range(5)], expected, rtol=1e-5)


def test_zero_errors_are_sampled_now_and_then_and_evicted_keys_never() -> None:
    sampler = make_sampler(np.zeros(SIZE, np.float32))
    sampler.evict(KEYS[:150])
    keys, _ = sampler.sample(KEYS[150:], 4_000)
    assert set(keys.tolist()) == set(KEYS[150:])
    sampler.check_invariants(KEYS[150:])
    with pytest.raises(AssertionError, match="not those of the table"):
        sampler.check_invariants(KEYS[149:])
