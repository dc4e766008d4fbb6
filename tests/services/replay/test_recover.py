"""A replay service that is started again holds what the one before it acknowledged."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.build import build, open_log
from mrcdrl.services.replay.service import ReplayService

CONFIG = load_config(
    "smoke",
    {
        "replay.capacity": "500",
        "replay.min_size": "64",
        "replay.segment_bytes": "4000",
        "arena.num_robots": "2",
    },
    environ={},
)


class NoServer:
    """Nobody asks."""

    refused = 0

    def take(self, timeout_s: float) -> None:
        return None


class Answered:
    """A request that keeps its answer."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        self.arrived_s = 0.0
        self.answers: list[str] = []

    def room(self, size: int) -> None:
        return None

    def reply(self, payload: Part | Sequence[Part]) -> None:
        self.answers.append("reply")

    def refuse(self, reason: str) -> None:
        self.answers.append(f"refused: {reason}")

    def throttle(self, reason: str) -> None:
        self.answers.append(f"held: {reason}")


def chunk(sequence: int, length: int = 16, *, actor: str = "a", n_step: int = 3) -> Chunk:
    rows = CONFIG.arena.stack - 1 + length + n_step
    return Chunk(
        actor=actor,
        incarnation=1,
        sequence=sequence,
        weights_version=sequence,
        records=np.full((rows, CONFIG.arena.record_bytes), sequence % 256, np.uint8),
        actions=np.zeros(length, np.uint8),
        rewards=np.full(length, sequence, np.float32),
        discounts=np.full(length, 0.9, np.float32),
        bootstrap_offsets=np.full(length, n_step, np.uint8),
        priorities=np.empty(0, np.float32),
    )


def start(directory: Path, config: Config = CONFIG) -> ReplayService:
    table, limiter = build(config)
    log = open_log(config, directory)
    service = ReplayService(config, table, limiter, *[NoServer()] * 3, log)
    service.recover()
    return service


def insert(service: ReplayService, *chunks: Chunk) -> list[str]:
    requests = [Answered(encode(c)) for c in chunks]
    for request in requests:
        service._insert(request)
        service._commit()
    return [answer for request in requests for answer in request.answers]


def rewards(service: ReplayService) -> set[float]:
    return set(service._table.sample(4000).rewards.tolist())


def test_acknowledged_chunks_are_there_again(tmp_path: Path) -> None:
    first = start(tmp_path)
    assert insert(first, *map(chunk, range(5))) == ["reply"] * 5
    again = start(tmp_path)  # the first was never closed: a kill -9
    assert again.metrics()["size"] == 80
    assert rewards(again) == {0, 1, 2, 3, 4}
    assert again.metrics()["inserts"] == 80


def test_a_repeated_chunk_is_known_after_a_restart(tmp_path: Path) -> None:
    insert(start(tmp_path), chunk(0), chunk(1))
    again = start(tmp_path)
    assert insert(again, chunk(1), chunk(2)) == ["reply", "reply"]
    assert again.metrics()["size"] == 48
    assert again.metrics()["duplicates"] == 1


def test_evicted_chunks_leave_the_log_and_keys_go_on(tmp_path: Path) -> None:
    first = start(tmp_path)
    first._limiter.samples_per_insert = 0
    insert(first, *map(chunk, range(100)))
    files = len(list(tmp_path.iterdir()))
    assert files < 40
    again = start(tmp_path)
    size = again.metrics()["size"]
    assert 400 <= size <= 500
    assert min(rewards(again)) >= 60
    assert again.metrics()["inserts"] >= 1600


def test_a_recovered_table_fills_to_its_minimum_before_it_is_sampled(tmp_path: Path) -> None:
    insert(start(tmp_path), chunk(0))
    again = start(tmp_path)
    assert not again._limiter.can_sample(32)
    assert insert(again, *(chunk(n) for n in range(1, 5))) == ["reply"] * 4
    assert again._limiter.can_sample(32)


def test_chunks_of_another_agent_are_left_out_and_new_ones_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    insert(start(tmp_path), *map(chunk, range(6)))
    agent = CONFIG.agent.model_copy(update={"n_step": 2})
    again = start(tmp_path, CONFIG.model_copy(update={"agent": agent}))
    assert "6 chunks of the log are left out" in caplog.text
    assert not again._limiter.can_sample(32)
    assert insert(again, *(chunk(n, actor="b", n_step=2) for n in range(5))) == ["reply"] * 5
    assert again._limiter.can_sample(32)


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


FULL = "held: replay's log cannot be written: No space left on device"


def test_a_full_disk_holds_inserts_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    insert(service, chunk(0))
    monkeypatch.setattr(service._log, "append", full)
    assert insert(service, chunk(1)) == [FULL]
    monkeypatch.undo()
    assert insert(service, chunk(1)) == ["reply"]
    assert start(tmp_path).metrics()["size"] == 32


def test_what_is_held_together_is_taken_when_it_comes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    insert(service, chunk(0))
    requests = [Answered(encode(chunk(n))) for n in (1, 2, 1)]  # the last by an impatient actor
    monkeypatch.setattr(service._log, "append", full)
    for request in requests:
        service._insert(request)
    service._commit()
    assert [request.answers for request in requests] == [[FULL]] * 3
    assert service.metrics()["size"] == 16
    monkeypatch.undo()
    assert insert(service, chunk(1), chunk(2)) == ["reply"] * 2
    assert service.metrics()["gaps"] == 0
    assert rewards(service) == rewards(start(tmp_path)) == {0, 1, 2}


def test_a_stream_that_was_held_from_its_first_chunk_on_is_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    monkeypatch.setattr(service._log, "append", full)
    assert insert(service, chunk(0)) == [FULL]
    monkeypatch.undo()
    assert insert(service, chunk(0)) == ["reply"]
    assert service.metrics()["duplicates"] == 0
    assert service.metrics()["size"] == 16
