"""Several shards act as one table for their users: real services over real sessions."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.messages.trajectory import Priorities, Samples
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader, ReplayWriter, shard_of
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.table import Table
from tests.patience import PATIENCE_S
from tests.services.replay.harness import make_chunk

KEYS = Keys("shards")
BATCH, BATCHES = 8, 4


def config_of(num_shards: int) -> Config:
    return Config.model_validate(
        {
            "replay": {
                "capacity": 400 * num_shards,
                "min_size": 32 * num_shards,
                "shards": num_shards,
                "samples_per_insert": 0,
                "sampler": "prioritized",
                "priority_exponent": 1.0,
                "fsync": "off",
            },
            "learner": {"batch_size": BATCH, "batches_per_request": BATCHES},
            "transport": {"timeout_s": 6.0},
        }
    )


@contextmanager
def shard_up(config: Config, endpoint: str, shard: int) -> Iterator[ReplayService]:
    table, limiter = Table.from_config(config), RateLimiter.from_config(config)
    with Session(config.transport.model_copy(update={"connect": (endpoint,)})) as session:
        keys = (KEYS.insert(shard), KEYS.sample(shard), KEYS.priorities(shard))
        service = ReplayService(config, table, limiter, *map(session.server, keys))
        service.start()
        try:
            yield service
        finally:
            service.stop()


@pytest.fixture
def router() -> Iterator[str]:
    endpoint = free_endpoint()
    with Session(TransportConfig(listen=(endpoint,))):
        yield endpoint


@pytest.fixture
def session(router: str) -> Iterator[Session]:
    with Session(TransportConfig(connect=(router,), timeout_s=PATIENCE_S)) as opened:
        yield opened


def fill(session: Session, config: Config, shard: int, count: int, priority: float) -> None:
    """Insert `count` transitions whose reward is their shard's number."""
    writer = ReplayWriter(session, KEYS, PATIENCE_S, StopSignal(), shard=shard, num_shards=9)
    length, tail = 40, config.arena.stack - 1 + config.agent.n_step
    for sequence in range(count // length):
        chunk = make_chunk(
            sequence,
            length,
            tail=tail,
            record_bytes=config.arena.record_bytes,
            priority=priority,
            incarnation=shard,
            rewards=np.full(length, shard, np.float32),
        )
        assert writer.insert([chunk]) is not None


def reader_of(
    session: Session, num_shards: int, stop: StopSignal | None = None, late_s: float = 0.2
) -> ReplayReader:
    settings = (BATCH, BATCHES, 2, 10.0, stop or StopSignal())
    return ReplayReader(session, KEYS, *settings, num_shards=num_shards, late_s=late_s)


def sample(reader: ReplayReader, num_batches: int) -> list[Samples]:
    batches = []
    for _ in range(num_batches):
        batch = reader.sample()
        assert batch is not None
        batches.append(batch)
    return batches


def frequencies(batches: list[Samples]) -> dict[int, float]:
    """The part of the batches that came from each shard."""
    found = [int(batch.rewards[0]) for batch in batches]
    return {shard: found.count(shard) / len(found) for shard in set(found)}


def test_batches_come_in_proportion_to_the_shards_priorities(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0), shard_up(config, router, 1):
        fill(session, config, 0, 200, priority=1.0)
        fill(session, config, 1, 200, priority=3.0)
        reader = reader_of(session, 2, late_s=PATIENCE_S)  # a busy shard is not an unreachable one
        sample(reader, 40 * BATCHES)  # until both totals are known
        batches = sample(reader, 400 * BATCHES)
    probability = 0.95 * 0.75 + 0.05 / 2
    assert frequencies(batches)[1] == pytest.approx(probability, abs=0.01)  # chance would miss that
    for batch in batches:
        assert len(set(batch.rewards.tolist())) == 1
        shard = int(batch.rewards[0])
        assert (batch.keys % 2 == shard).all()
        assert (batch.keys // 2 < 200).all()
        assert batch.table_size == 400
        assert batch.total_priority == pytest.approx(800, rel=1e-3)
        expected = (1 - probability, probability)[shard] / 200
        np.testing.assert_allclose(batch.probabilities, expected, rtol=1e-3)


def test_priorities_reach_the_shard_that_their_keys_name(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0) as first, shard_up(config, router, 1) as second:
        fill(session, config, 0, 40, priority=0.0)
        fill(session, config, 1, 40, priority=0.0)
        writer = PriorityWriter(session, KEYS, StopSignal(), num_shards=2)
        keys = np.array([2 * 5, 2 * 6, 2 * 7 + 1, 2 * 999 + 1], np.int64)
        reply = writer.update(Priorities(keys, np.full(4, 1e6, np.float32)))
        assert reply is not None
        assert (reply.updated, reply.ignored) == (3, 1)
        updates = [s.metrics().priority_updates for s in (first, second)]
        assert updates == [2, 1]
        reader = reader_of(session, 2, late_s=PATIENCE_S)
        sample(reader, 20 * BATCHES)
        found = {int(key) for batch in sample(reader, 40 * BATCHES) for key in batch.keys}
    assert found == {2 * 5, 2 * 6, 2 * 7 + 1}


def test_an_unreachable_shard_is_left_out_until_it_is_back(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0):
        fill(session, config, 0, 200, priority=1.0)
        reader = reader_of(session, 2)
        with shard_up(config, router, 1):
            fill(session, config, 1, 200, priority=1.0)
            assert set(frequencies(sample(reader, 40 * BATCHES))) == {0, 1}
        sample(reader, 40 * BATCHES)  # answers in flight
        before = time.monotonic()
        assert set(frequencies(sample(reader, 40 * BATCHES))) == {0}
        assert time.monotonic() - before < PATIENCE_S
        with shard_up(config, router, 1):
            fill(session, config, 1, 200, priority=1.0)
            deadline = time.monotonic() + PATIENCE_S
            while 1 not in frequencies(sample(reader, BATCHES)):
                assert time.monotonic() < deadline


def test_a_throttled_shard_is_left_out(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0), shard_up(config, router, 1):
        fill(session, config, 0, 200, priority=1.0)
        assert set(frequencies(sample(reader_of(session, 2), 40 * BATCHES))) == {0}


def test_a_reader_waiting_for_all_shards_stops_when_told(session: Session) -> None:
    stop = StopSignal()
    reader = reader_of(session, 3, stop)
    threading.Timer(0.3, stop.set).start()
    before = time.monotonic()
    assert reader.sample() is None
    assert time.monotonic() - before < PATIENCE_S


ACTORS = {"actor-0": 0, "actor-5": 2, "a12": 0, "7": 1, "host-a-31": 1}


@pytest.mark.parametrize("actor", ACTORS)
def test_an_actors_number_chooses_its_shard(actor: str) -> None:
    assert shard_of(actor, 3) == ACTORS[actor]
    assert shard_of(actor, 1) == 0


def test_actors_without_a_number_spread_over_shards() -> None:
    counts = np.bincount([shard_of(f"{n:x}-x", 4) for n in range(400)], minlength=4)
    assert counts.min() > 60
