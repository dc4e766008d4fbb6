"""The service's answers to requests in memory."""

import dataclasses
import queue
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from mrcdrl.common.config import Config, ReplayConfig, RunConfig, TransportConfig
from mrcdrl.common.messages.framing import Part, join_set
from mrcdrl.common.messages.trajectory import (
    Chunk,
    InsertReply,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
)
from mrcdrl.common.messages.wire import decode, encode, encode_parts
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.sampler import PrioritizedSampler, UniformSampler
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.table import Table
from tests.services.replay.harness import PATIENCE_S, Answer, FakeRequest, make_chunk

LENGTH, BATCH = 5, 4


@dataclass
class WatchfulRequest(FakeRequest):
    """Notes how many transitions the table holds when the acknowledgement comes."""

    table: Table | None = None
    stored_when_acknowledged: int = -1

    def reply(self, payload: Part | Sequence[Part]) -> None:
        assert self.table is not None
        self.stored_when_acknowledged = len(self.table)
        super().reply(payload)


class FakeServer:
    """A queue of requests."""

    def __init__(self) -> None:
        self.refused = 0
        self._waiting: queue.Queue[FakeRequest] = queue.Queue()

    def take(self, timeout_s: float) -> FakeRequest | None:
        try:
            return self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def ask(self, payload: bytes) -> FakeRequest:
        return self.put(FakeRequest(payload))

    def put(self, request: FakeRequest) -> FakeRequest:
        self._waiting.put(request)
        return request


@dataclass
class Replay:
    """A running service, its table and its three servers."""

    service: ReplayService
    table: Table
    inserts: FakeServer
    samples: FakeServer
    priorities: FakeServer

    def insert(self, payload: bytes) -> Answer:
        return self.inserts.ask(payload).answer()

    def sample(self, batch_size: int = BATCH) -> Answer:
        return self.samples.ask(encode(SampleRequest(batch_size))).answer()

    def prioritize(self, keys: list[int], priorities: list[float]) -> Answer:
        message = Priorities(np.array(keys, np.int64), np.array(priorities, np.float32))
        return self.priorities.ask(encode(message)).answer()

    def fill(self, count: int) -> None:
        for sequence in range(count):
            kind, _ = self.insert(chunk_bytes(sequence))
            assert kind == "reply"


@contextmanager
def replay(
    *,
    min_size: int = 10,
    ratio: float = 0.0,
    buffer: float = 0.0,
    hold_s: float = PATIENCE_S,
    prioritized: bool = False,
    turn_size: int = 0,
) -> Iterator[Replay]:
    config = Config(
        replay=ReplayConfig(capacity=1000, min_size=96, hold_s=hold_s),
        run=RunConfig(turn_size=turn_size),
        transport=TransportConfig(timeout_s=2 * hold_s),
    )
    rng = np.random.default_rng(0)
    sampler = PrioritizedSampler(1000, 1.0, rng) if prioritized else UniformSampler(rng)
    table = Table(1000, 2, 1, LENGTH, 4, sampler)
    limiter = RateLimiter(ratio, min_size, buffer, LENGTH, BATCH)
    inserts, samples, priorities = FakeServer(), FakeServer(), FakeServer()
    service = ReplayService(config, table, limiter, inserts, samples, priorities)
    service.start()
    try:
        yield Replay(service, table, inserts, samples, priorities)
    finally:
        service.stop()


def chunk(sequence: int, length: int = LENGTH, **fields: Any) -> Chunk:
    records = np.full((length + 2, 4), sequence, np.uint8)
    return make_chunk(sequence, length, records=records, **fields)


def chunk_bytes(sequence: int, **other: object) -> bytes:
    return encode(chunk(sequence, **other))  # type: ignore[arg-type]


def inserted(answer: Answer) -> InsertReply:
    kind, payload = answer
    assert kind == "reply"
    assert isinstance(payload, bytes)
    return decode(InsertReply, payload)


def test_a_chunk_is_acknowledged_when_it_is_in_the_table() -> None:
    with replay() as up:
        request = WatchfulRequest(chunk_bytes(0), table=up.table)
        up.inserts.put(request)
        assert inserted(request.answer()) == InsertReply(0, False, LENGTH)
        assert request.stored_when_acknowledged == LENGTH
        assert inserted(up.insert(chunk_bytes(1))) == InsertReply(1, False, 2 * LENGTH)


def test_a_repeated_chunk_is_acknowledged_and_not_stored_again() -> None:
    with replay() as up:
        up.fill(2)
        assert inserted(up.insert(chunk_bytes(1))) == InsertReply(1, True, 2 * LENGTH)
        assert inserted(up.insert(chunk_bytes(0))) == InsertReply(0, True, 2 * LENGTH)
        assert len(up.table) == 2 * LENGTH
        metrics = up.service.metrics()
        assert (metrics.chunks, metrics.duplicates, metrics.gaps) == (2, 2, 0)


def test_a_gap_is_stored_and_counted() -> None:
    with replay() as up:
        up.fill(1)
        assert not inserted(up.insert(chunk_bytes(4))).duplicate
        assert not inserted(up.insert(chunk_bytes(0, incarnation=2))).duplicate
        metrics = up.service.metrics()
        assert (metrics.chunks, metrics.gaps, metrics.inserts) == (3, 1, 3 * LENGTH)


def set_bytes(*sequences: int) -> bytes:
    return b"".join(join_set([encode_parts(chunk(sequence)) for sequence in sequences]))


def test_chunks_that_come_together_are_acknowledged_together() -> None:
    with replay() as up:
        up.fill(1)
        assert inserted(up.insert(set_bytes(0, 1, 2))) == InsertReply(2, False, 3 * LENGTH)
        assert inserted(up.insert(set_bytes(1, 2))) == InsertReply(2, True, 3 * LENGTH)
        metrics = up.service.metrics()
        assert (metrics.chunks, metrics.duplicates, metrics.gaps) == (3, 3, 0)


def test_one_wrong_chunk_refuses_all_that_come_with_it() -> None:
    wrong = dataclasses.replace(chunk(1), records=np.zeros((LENGTH + 2, 5), np.uint8))
    with replay() as up:
        kind, reason = up.insert(b"".join(join_set([encode_parts(chunk(0)), encode_parts(wrong)])))
        assert kind == "refuse"
        assert "another arena or agent" in str(reason)
        assert len(up.table) == 0


def test_chunks_before_a_throttled_one_are_stored() -> None:
    with replay(min_size=2 * LENGTH, ratio=1.0, buffer=2.0 * LENGTH, hold_s=0.05) as up:
        kind, _ = up.insert(set_bytes(0, 1, 2, 3, 4, 5))
        assert kind == "throttle"
        assert len(up.table) == 4 * LENGTH
        assert up.sample(BATCH)[0] == up.sample(BATCH)[0] == "reply"
        assert inserted(up.insert(set_bytes(0, 1, 2, 3, 4))) == InsertReply(4, False, 5 * LENGTH)


def test_requests_that_wait_are_stored_together_and_answered_each() -> None:
    with replay() as up:
        with up.service._changed:  # as a slow sample would
            requests = [
                up.inserts.put(WatchfulRequest(payload, table=up.table))
                for payload in (*map(chunk_bytes, (0, 1)), b"\x00", *map(chunk_bytes, (1, 3)))
            ]
        answers = [request.answer() for request in requests]
        assert answers.pop(2)[0] == "refuse"
        assert list(map(inserted, answers)) == [
            InsertReply(0, False, LENGTH),
            InsertReply(1, False, 2 * LENGTH),
            InsertReply(1, True, 2 * LENGTH),
            InsertReply(3, False, 3 * LENGTH),
        ]
        stored = [request.stored_when_acknowledged for request in requests]
        assert stored[0] >= LENGTH
        assert min(stored[1], stored[3]) >= 2 * LENGTH
        assert stored[4] == 3 * LENGTH
        metrics = up.service.metrics()
        assert (metrics.chunks, metrics.duplicates, metrics.gaps) == (3, 1, 1)


REFUSED = {
    "not a message": (b"\x00\x01", "not msgpack|not a map"),
    "another message": (encode(Stats("a", "b", {})), "'stats/1' where 'chunk/1'"),
    "another arena": (
        encode(dataclasses.replace(chunk(0), records=np.zeros((LENGTH + 2, 5), np.uint8))),
        "another arena or agent",
    ),
    "longer than the limiter allows": (
        chunk_bytes(0, length=LENGTH + 1),
        "6 transitions where the run's actor.chunk_length is 5",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_chunk_that_does_not_fit_is_refused_counted_and_disturbs_nothing(name: str) -> None:
    payload, reason = REFUSED[name]
    with replay() as up:
        kind, text = up.insert(payload)
        assert kind == "refuse"
        assert isinstance(text, str)
        assert re.search(reason, text)
        assert up.service.metrics().refused == 1
        assert len(up.table) == 0
        assert not inserted(up.insert(chunk_bytes(0))).duplicate
        assert up.service.healthy


@pytest.mark.parametrize("size", [0, -1, BATCH + 1, 2**62])
def test_a_batch_of_another_size_is_refused(size: int) -> None:
    with replay(min_size=1) as up:
        up.fill(1)
        assert up.sample(size) == ("refuse", f"batch_size {size} is outside 1 ... {BATCH}")
        assert up.service.metrics().refused == 1


def test_samples_are_the_tables_transitions() -> None:
    with replay(min_size=10) as up:
        up.fill(2)
        kind, payload = up.sample()
        assert kind == "reply"
        assert isinstance(payload, bytes)
        samples = decode(Samples, payload)
        assert samples.table_size == 10
        np.testing.assert_array_equal(samples.records[:, 0, 0], samples.keys // LENGTH)
        np.testing.assert_array_equal(samples.rewards, samples.keys // LENGTH)
        assert up.service.metrics().samples == BATCH


def test_priorities_decide_what_is_sampled_and_evicted_keys_are_ignored() -> None:
    with replay(min_size=10, prioritized=True) as up:
        up.fill(2)
        kind, payload = up.prioritize([7, -1, 10, *range(10)], [9.0, 1.0, 1.0, *[0.0] * 10])
        assert kind == "reply"
        assert isinstance(payload, bytes)
        assert decode(PrioritiesReply, payload) == PrioritiesReply(updated=11, ignored=2)
        assert up.prioritize([7], [1000.0])[0] == "reply"
        samples = up.table.sample(1000)
        assert samples.keys.tolist().count(7) >= 999
        metrics = up.service.metrics()
        assert (metrics.priority_updates, metrics.priorities_ignored) == (12, 2)


def test_requests_too_large_to_take_count_as_refused() -> None:
    with replay() as up:
        up.inserts.ask(b"").answer()
        for server in (up.inserts, up.samples, up.priorities):
            server.refused = 2
        assert up.service.metrics().refused == 7


def test_a_uniform_table_ignores_priorities() -> None:
    with replay(min_size=10) as up:
        up.fill(2)
        _, payload = up.prioritize([7], [9.0])
        assert isinstance(payload, bytes)
        assert decode(PrioritiesReply, payload) == PrioritiesReply(updated=0, ignored=1)
        assert up.service.metrics().priorities_ignored == 1


def test_impossible_priorities_are_refused_and_counted() -> None:
    with replay(prioritized=True) as up:
        up.fill(2)
        assert up.prioritize([7], [-1.0]) == ("refuse", "a priority is negative or not finite")
        metrics = up.service.metrics()
        assert (metrics.refused, metrics.priority_updates) == (1, 0)
        assert up.service.healthy


def test_a_sample_waits_for_min_size() -> None:
    with replay(min_size=10) as up:
        waiting = up.samples.ask(encode(SampleRequest(BATCH)))
        up.fill(2)
        assert waiting.answer()[0] == "reply"
        assert not up.service.metrics().sample_held


def test_a_sample_that_waited_too_long_is_throttled_with_the_reason() -> None:
    with replay(min_size=10, hold_s=0.05) as up:
        up.fill(1)
        assert up.sample() == ("throttle", "the table holds 5 of the first 10 transitions")
        assert up.service.metrics().sample_held
        assert up.inserts.ask(chunk_bytes(1)).answer()[0] == "reply"
        assert up.sample()[0] == "reply"
        assert not up.service.metrics().sample_held


def test_samples_wait_for_inserts_once_the_ratio_is_reached() -> None:
    with replay(min_size=5, ratio=1.0, buffer=5.0, hold_s=0.05) as up:
        up.fill(1)
        assert up.sample()[0] == "reply"
        assert up.sample() == (
            "throttle",
            "the actors have not inserted enough for another sample yet",
        )


def test_inserts_wait_for_samples_once_the_ratio_is_reached() -> None:
    with replay(min_size=5, ratio=1.0, buffer=5.0) as up:
        up.fill(2)
        waiting = up.inserts.ask(chunk_bytes(2))
        assert up.sample()[0] == "reply"
        assert up.sample()[0] == "reply"
        assert inserted(waiting.answer()) == InsertReply(2, False, 15)


def test_an_insert_that_waited_too_long_is_throttled_and_taken_when_asked_again() -> None:
    with replay(min_size=5, ratio=1.0, buffer=5.0, hold_s=0.05) as up:
        up.fill(2)
        kind, reason = up.insert(chunk_bytes(2))
        assert (kind, reason) == (
            "throttle",
            "the learner has not sampled enough of what is there yet",
        )
        assert len(up.table) == 10
        metrics = up.service.metrics()
        assert metrics.insert_held
        assert metrics.chunks == 2
        for _ in range(2):
            assert up.sample()[0] == "reply"
        assert inserted(up.insert(chunk_bytes(2))) == InsertReply(2, False, 15)
        assert not up.service.metrics().insert_held


def test_a_request_that_waited_in_the_queue_is_answered_at_once() -> None:
    with replay(min_size=10, hold_s=3600.0) as up:
        request = FakeRequest(encode(SampleRequest(BATCH)), time.monotonic() - 3601.0)
        up.samples.put(request)
        assert request.answer()[0] == "throttle"


def test_in_lockstep_a_learner_step_gets_the_same_samples_however_often_it_asks() -> None:
    def keys(up: Replay, learner_step: int) -> list[int]:
        answer = up.samples.ask(encode(SampleRequest(BATCH, learner_step))).answer()
        return sampled_keys(answer)

    with replay(turn_size=64) as up:  # 96 + 64 transitions are due in the first turn
        waiting = up.samples.ask(encode(SampleRequest(BATCH, 0)))
        for sequence in range(160 // LENGTH):
            assert waiting.answers.empty()
            up.insert(chunk_bytes(sequence))
        first = sampled_keys(waiting.answer())
        assert keys(up, 3) != first
        assert keys(up, 0) == first
        kind, reason = up.sample()
        assert (kind, "must state its learner step" in str(reason)) == ("refuse", True)
        up.insert(chunk_bytes(160 // LENGTH))
        kind, reason = up.samples.ask(encode(SampleRequest(BATCH, 0))).answer()
        assert (kind, "165 transitions where 160 are due" in str(reason)) == ("refuse", True)


def sampled_keys(answer: Answer) -> list[int]:
    kind, payload = answer
    assert kind == "reply"
    assert isinstance(payload, bytes)
    return decode(Samples, payload).keys.tolist()


def test_stop_answers_waiting_requests_and_ends_the_threads() -> None:
    with replay(min_size=10, hold_s=3600.0) as up:
        assert up.service.healthy
        waiting = up.samples.ask(encode(SampleRequest(BATCH)))
        before = time.monotonic()
        up.service.stop()
        assert time.monotonic() - before < PATIENCE_S
        assert not up.service.healthy
        if waiting.answers.qsize():
            assert waiting.answer()[0] == "throttle"
    assert not {"insert", "sample", "priorities"} & {
        thread.name for thread in threading.enumerate()
    }


def test_metrics_name_the_table_and_the_limiter() -> None:
    with replay(min_size=10) as up:
        up.fill(2)
        metrics = up.service.metrics()
    assert metrics.size == 10
    assert metrics.capacity == 1000
    assert metrics.min_size == 10
    assert metrics.bytes == up.table.nbytes
    assert metrics.samples_per_insert == 0
