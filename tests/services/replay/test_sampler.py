"""Prioritized draws follow the priorities, and importance weights undo that."""

import numpy as np
import pytest

from mrcdrl.common.messages.trajectory import Float32Array, Float64Array, Int64Array, Samples
from mrcdrl.services.learner.batch import importance_weights
from mrcdrl.services.replay.sampler import PrioritizedSampler

HELD, FIRST_KEY, EXPONENT = 200, 1_000_003, 0.6
KEYS = range(FIRST_KEY, FIRST_KEY + HELD)


def make_sampler(
    priorities: Float32Array, *, seed: int = 0, exponent: float = EXPONENT
) -> PrioritizedSampler:
    """With the transitions KEYS; capacity leaves some room."""
    sampler = PrioritizedSampler(HELD + 57, exponent, np.random.default_rng(seed))
    sampler.insert(KEYS, priorities)
    return sampler


def skewed_priorities() -> Float32Array:
    """A few large errors, many small ones."""
    return np.random.default_rng(1).lognormal(0, 1.5, HELD).astype(np.float32)


def shares(priorities: Float32Array, exponent: float = EXPONENT) -> Float64Array:
    powers = (priorities.astype(np.float64) + 1e-6) ** exponent
    normalized: Float64Array = powers / powers.sum()
    return normalized


def draw(
    sampler: PrioritizedSampler, batch_size: int, num_batches: int
) -> tuple[Int64Array, Float64Array]:
    batches = [sampler.sample(KEYS, batch_size) for _ in range(num_batches)]
    return np.concatenate([b[0] for b in batches]), np.concatenate([b[1] for b in batches])


def chi_square(keys: Int64Array, expected: Float64Array) -> float:
    counts = np.bincount(keys - FIRST_KEY, minlength=HELD)
    return float(((counts - expected) ** 2 / expected).sum())


@pytest.mark.parametrize(("batch_size", "num_batches"), [(1, 20_000), (32, 3_000), (512, 200)])
def test_draws_follow_the_priorities(batch_size: int, num_batches: int) -> None:
    priorities = skewed_priorities()
    keys, probabilities = draw(make_sampler(priorities), batch_size, num_batches)
    expected = shares(priorities)
    np.testing.assert_allclose(probabilities, expected[keys - FIRST_KEY], rtol=1e-9)
    limit = 266.4  # 99.9 % of chi-square with 199 degrees of freedom; strata only lessen it
    assert chi_square(keys, expected * batch_size * num_batches) < limit
    uniform = np.full(HELD, batch_size * num_batches / HELD)
    assert chi_square(keys, uniform) > 10 * limit


def test_draws_follow_updated_priorities() -> None:
    sampler = make_sampler(np.ones(HELD, np.float32))
    priorities = skewed_priorities()
    assert sampler.update(np.array(KEYS), priorities) == HELD
    keys, _ = draw(sampler, 32, 3_000)
    assert chi_square(keys, shares(priorities) * 96_000) < 266.4


def test_a_stratum_gives_one_draw_each() -> None:
    """Two halves of the sum: every batch of two has one draw of each."""
    sampler = make_sampler(np.repeat(np.array([1, 3], np.float32), HELD // 2), exponent=1.0)
    for _ in range(200):
        keys, _ = sampler.sample(KEYS, 4)
        assert (keys - FIRST_KEY < HELD // 2).sum() == 1


def test_exponent_0_draws_uniformly() -> None:
    keys, probabilities = draw(make_sampler(skewed_priorities(), exponent=0.0), 1, 20_000)
    np.testing.assert_allclose(probabilities, 1 / HELD)
    assert chi_square(keys, np.full(HELD, 20_000 / HELD)) < 266.4


def samples_of(keys: Int64Array, probabilities: Float64Array) -> Samples:
    count = len(keys)
    return Samples(
        keys=keys,
        probabilities=probabilities,
        table_size=HELD,
        total_priority=float(HELD),
        records=np.zeros((count, 1, 1), np.uint8),
        actions=np.zeros(count, np.uint8),
        rewards=np.zeros(count, np.float32),
        discounts=np.zeros(count, np.float32),
        bootstrap_offsets=np.ones(count, np.uint8),
        weights_versions=np.zeros(count, np.int64),
    )


def test_importance_weights_undo_the_priorities() -> None:
    """Of a number that grows with the priority: weighed mean of the draws, mean of the table."""
    priorities = skewed_priorities()
    numbers = np.sqrt(priorities.astype(np.float64))
    samples = samples_of(*draw(make_sampler(priorities), 64, 2_000))
    drawn = numbers[samples.keys - FIRST_KEY]
    weights = importance_weights(samples, 1.0)
    assert np.average(drawn, weights=weights) == pytest.approx(numbers.mean(), rel=0.01)
    assert drawn.mean() > 1.3 * numbers.mean()
    half = importance_weights(samples, 0.4)
    assert numbers.mean() * 1.05 < np.average(drawn, weights=half) < drawn.mean() / 1.05


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


def test_what_has_no_error_is_drawn_now_and_then_and_what_is_evicted_never() -> None:
    sampler = make_sampler(np.zeros(HELD, np.float32))
    sampler.evict(KEYS[:150])
    keys, _ = sampler.sample(KEYS[150:], 4_000)
    assert set(keys.tolist()) == set(KEYS[150:])
    sampler.check_invariants(KEYS[150:])
    with pytest.raises(AssertionError, match="not those of the table"):
        sampler.check_invariants(KEYS[149:])
