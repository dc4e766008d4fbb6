"""Several shards are one table to those who use them: real services over real sessions."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.messages.trajectory import Chunk, Priorities, Samples
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.build import build
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader, ReplayWriter, shard_of
from mrcdrl.services.replay.service import ReplayService

_DEADLINE_S = 30.0
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
    table, limiter = build(config)
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
    with Session(TransportConfig(connect=(router,), timeout_s=6.0)) as opened:
        yield opened


def fill(session: Session, config: Config, shard: int, count: int, priority: float) -> None:
    """`count` transitions whose reward is their shard's number."""
    writer = ReplayWriter(session, KEYS, 10.0, StopSignal(), shard=shard, num_shards=9)
    length, arena = 40, config.arena
    rows = arena.stack - 1 + length + config.agent.n_step
    for sequence in range(count // length):
        chunk = Chunk(
            actor="a",
            incarnation=shard,
            sequence=sequence,
            weights_version=0,
            records=np.full((rows, arena.record_bytes), sequence, np.uint8),
            actions=np.zeros(length, np.uint8),
            rewards=np.full(length, shard, np.float32),
            discounts=np.ones(length, np.float32),
            bootstrap_offsets=np.ones(length, np.uint8),
            priorities=np.full(length, priority, np.float32),
        )
        assert writer.insert([chunk]) is not None


def reader_of(
    session: Session, num_shards: int, stop: StopSignal | None = None, late_s: float = 0.2
) -> ReplayReader:
    settings = (BATCH, BATCHES, 2, 10.0, stop or StopSignal())
    return ReplayReader(session, KEYS, *settings, num_shards=num_shards, seed=3, late_s=late_s)


def draw(reader: ReplayReader, num_batches: int) -> list[Samples]:
    batches = []
    for _ in range(num_batches):
        batch = reader.sample()
        assert batch is not None
        batches.append(batch)
    return batches


def shares(batches: list[Samples]) -> dict[int, float]:
    """Of all batches, those of each shard."""
    found = [int(batch.rewards[0]) for batch in batches]
    return {shard: found.count(shard) / len(found) for shard in set(found)}


def test_batches_come_in_proportion_to_the_shards_priorities(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0), shard_up(config, router, 1):
        fill(session, config, 0, 200, priority=1.0)
        fill(session, config, 1, 200, priority=3.0)
        reader = reader_of(session, 2, late_s=_DEADLINE_S)  # a busy one is none that is away
        draw(reader, 40 * BATCHES)  # until both have told of their priorities
        batches = draw(reader, 400 * BATCHES)
    drawn = 0.95 * 0.75 + 0.05 / 2
    assert shares(batches)[1] == pytest.approx(drawn, abs=0.08)
    for batch in batches:
        assert len(set(batch.rewards.tolist())) == 1
        shard = int(batch.rewards[0])
        assert (batch.keys % 2 == shard).all()
        assert (batch.keys // 2 < 200).all()
        assert batch.table_size == 400
        assert batch.total_priority == pytest.approx(800, rel=1e-3)
        share = (1 - drawn, drawn)[shard]
        np.testing.assert_allclose(batch.probabilities, share / 200, rtol=1e-3)


def test_priorities_reach_the_shard_that_their_keys_name(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0) as first, shard_up(config, router, 1) as second:
        fill(session, config, 0, 40, priority=1.0)
        fill(session, config, 1, 40, priority=1.0)
        writer = PriorityWriter(session, KEYS, StopSignal(), num_shards=2)
        keys = np.array([2 * 5, 2 * 6, 2 * 7 + 1, 2 * 999 + 1], np.int64)
        reply = writer.update(Priorities(keys, np.full(4, 1e6, np.float32)))
        assert reply is not None
        assert (reply.updated, reply.ignored) == (3, 1)
        told = [s.metrics()["priority_updates"] for s in (first, second)]
        assert told == [2, 1]
        reader = reader_of(session, 2, late_s=_DEADLINE_S)
        draw(reader, 20 * BATCHES)
        found = {int(key) for batch in draw(reader, 40 * BATCHES) for key in batch.keys}
    assert found == {2 * 5, 2 * 6, 2 * 7 + 1}


def test_a_shard_that_is_away_is_left_out_until_it_is_back(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0):
        fill(session, config, 0, 200, priority=1.0)
        reader = reader_of(session, 2)
        with shard_up(config, router, 1):
            fill(session, config, 1, 200, priority=1.0)
            assert set(shares(draw(reader, 40 * BATCHES))) == {0, 1}
        draw(reader, 40 * BATCHES)  # what was under way
        before = time.monotonic()
        assert set(shares(draw(reader, 40 * BATCHES))) == {0}
        assert time.monotonic() - before < _DEADLINE_S
        with shard_up(config, router, 1):
            fill(session, config, 1, 200, priority=1.0)
            deadline = time.monotonic() + _DEADLINE_S
            while 1 not in shares(draw(reader, BATCHES)):
                assert time.monotonic() < deadline


def test_a_shard_that_holds_back_is_left_out(router: str, session: Session) -> None:
    config = config_of(2)
    with shard_up(config, router, 0), shard_up(config, router, 1):
        fill(session, config, 0, 200, priority=1.0)
        assert set(shares(draw(reader_of(session, 2), 40 * BATCHES))) == {0}


def test_one_that_waits_for_all_shards_stops_when_told(session: Session) -> None:
    stop = StopSignal()
    reader = reader_of(session, 3, stop)
    threading.Timer(0.3, stop.set).start()
    before = time.monotonic()
    assert reader.sample() is None
    assert time.monotonic() - before < 5.0


ACTORS = {"actor-0": 0, "actor-5": 2, "a12": 0, "7": 1, "host-a-31": 1}


@pytest.mark.parametrize("actor", ACTORS)
def test_an_actors_number_says_where_its_chunks_go(actor: str) -> None:
    assert shard_of(actor, 3) == ACTORS[actor]
    assert shard_of(actor, 1) == 0


def test_actors_without_a_number_spread(  # such as containers, named by a checksum
) -> None:
    counts = np.bincount([shard_of(f"{n:x}-x", 4) for n in range(400)], minlength=4)
    assert counts.min() > 60
