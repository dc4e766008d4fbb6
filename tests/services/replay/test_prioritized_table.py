"""What a learner gets from a prioritized table, after evictions, updates and a restart.

test_sampler.py tests the sampler alone.
"""

from pathlib import Path

import numpy as np
import pytest

from mrcdrl.common.messages.trajectory import Float64Array, Samples
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.services.learner.batch import importance_weights
from mrcdrl.services.replay.service import ReplayService
from tests.services.replay.harness import CONFIG, LENGTH, insert, make_chunk, save, start

BATCH, BATCHES = 64, 1500
EXPONENT = CONFIG.replay.priority_exponent
LIMIT = 649  # 99.999 % of chi-square with up to 500 degrees of freedom


@pytest.fixture(scope="module", params=["as it was", "restarted"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> ReplayService:
    """A full table that has replaced its oldest transitions, with priorities by key."""
    folder: Path = tmp_path_factory.mktemp("log")
    made = start(folder)
    made._limiter.samples_per_insert = 0
    insert(made, *(make_chunk(n, priority=1.0) for n in range(50)))
    table = made._table
    keys = np.array(table.keys)
    assert table.update_priorities(keys, priorities(made).astype(np.float32)) == len(keys)
    save(made, folder)
    return made if request.param == "as it was" else start(folder)


def priorities(service: ReplayService) -> Float64Array:
    """Priorities of the table's transitions: a few large ones, many small ones."""
    rng = np.random.default_rng(1)
    of_all: Float64Array = rng.lognormal(0, 1.5, 50 * LENGTH)
    return of_all[service._table.first_key :]


def sample(service: ReplayService) -> list[Samples]:
    """Mini-batches as they come off the wire."""
    return [
        decode(Samples, encode(service._table.sample(BATCH)))  # as the learner reads them
        for _ in range(BATCHES)
    ]


def test_frequencies_follow_the_priorities(service: ReplayService) -> None:
    first = service._table.first_key
    assert first > 0
    batches = sample(service)
    probabilities = (priorities(service) + 1e-6) ** EXPONENT
    probabilities /= probabilities.sum()
    counts = np.zeros(len(probabilities))
    for batch in batches:
        np.add.at(counts, batch.keys - first, 1)
        expected = probabilities[batch.keys - first]
        np.testing.assert_allclose(batch.probabilities, expected, rtol=1e-5)
        assert batch.table_size == len(probabilities)
    expected = probabilities * BATCH * BATCHES
    assert ((counts - expected) ** 2 / expected).sum() < LIMIT
    uniform = BATCH * BATCHES / len(probabilities)
    assert ((counts - uniform) ** 2 / uniform).sum() > 20 * LIMIT


def test_importance_weights_give_the_uniform_mean_back(service: ReplayService) -> None:
    """Means of a number that grows with the priority, and of rewards, with beta = 1."""
    first = service._table.first_key
    table_of = {
        "priority": np.sqrt(priorities(service)),
        "reward": service._table.rewards(service._table.keys).astype(np.float64),
    }
    sums, weight = dict.fromkeys(table_of, 0.0), 0.0
    plain = dict.fromkeys(table_of, 0.0)
    for batch in sample(service):
        exact = 1 / (batch.table_size * batch.probabilities)
        weights = importance_weights(batch, 1.0)
        np.testing.assert_allclose(weights / weights.max(), exact / exact.max(), rtol=1e-5)
        weight += exact.sum()
        for name, column in table_of.items():
            sampled = column[batch.keys - first]
            sums[name] += float((exact * sampled).sum())
            plain[name] += float(sampled.mean()) / BATCHES
    for name, column in table_of.items():
        assert sums[name] / weight == pytest.approx(column.mean(), rel=0.01), name
    assert plain["priority"] > 1.3 * table_of["priority"].mean()
    assert weight == pytest.approx(BATCH * BATCHES, rel=0.01)
