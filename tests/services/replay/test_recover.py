"""A restarted replay service holds what the one before it acknowledged."""

from pathlib import Path

import pytest

from mrcdrl.services.replay.service import ReplayService
from tests.services.replay.harness import CONFIG, TAIL, insert, make_chunk, offer, start


def rewards(service: ReplayService) -> set[float]:
    return set(service._table.sample(4000).rewards.tolist())


def test_acknowledged_chunks_survive_a_restart(tmp_path: Path) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    again = start(tmp_path)  # the first was never closed: a kill -9
    assert again.metrics().size == 80
    assert rewards(again) == {0, 1, 2, 3, 4}
    assert again.metrics().inserts == 80


def test_a_repeated_chunk_is_known_after_a_restart(tmp_path: Path) -> None:
    insert(start(tmp_path), make_chunk(0), make_chunk(1))
    again = start(tmp_path)
    insert(again, make_chunk(1), make_chunk(2))
    assert again.metrics().size == 48
    assert again.metrics().duplicates == 1


def test_evicted_chunks_leave_the_log_and_keys_continue(tmp_path: Path) -> None:
    first = start(tmp_path)
    first._limiter.samples_per_insert = 0
    insert(first, *map(make_chunk, range(100)))
    files = len(list(tmp_path.iterdir()))
    assert files < 40
    again = start(tmp_path)
    size = again.metrics().size
    assert 400 <= size <= 500
    assert min(rewards(again)) >= 60
    assert again.metrics().inserts >= 1600


def test_a_recovered_table_fills_to_its_minimum_before_it_is_sampled(tmp_path: Path) -> None:
    insert(start(tmp_path), make_chunk(0))
    again = start(tmp_path)
    assert not again._limiter.can_sample(32)
    insert(again, *map(make_chunk, range(1, 5)))
    assert again._limiter.can_sample(32)


def test_chunks_of_another_agent_are_left_out_and_new_ones_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    insert(start(tmp_path), *map(make_chunk, range(6)))
    agent = CONFIG.agent.model_copy(update={"n_step": 2})
    again = start(tmp_path, CONFIG.model_copy(update={"agent": agent}))
    assert "6 chunks in the log were left out" in caplog.text
    assert not again._limiter.can_sample(32)
    insert(again, *(make_chunk(n, actor="b", tail=TAIL - 1) for n in range(5)))
    assert again._limiter.can_sample(32)


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


FULL = ("throttle", "replay's log cannot be written: No space left on device")


def test_a_full_disk_throttles_inserts_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    insert(service, make_chunk(0))
    monkeypatch.setattr(service._log, "append", full)
    assert offer(service, make_chunk(1)) == [FULL]
    monkeypatch.undo()
    insert(service, make_chunk(1))
    assert start(tmp_path).metrics().size == 32


def test_chunks_throttled_together_are_taken_when_they_come_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    insert(service, make_chunk(0))
    monkeypatch.setattr(service._log, "append", full)
    chunks = map(make_chunk, (1, 2, 1))  # the last from an impatient actor
    assert offer(service, *chunks, together=True) == [FULL] * 3
    assert service.metrics().size == 16
    monkeypatch.undo()
    insert(service, make_chunk(1), make_chunk(2))
    assert service.metrics().gaps == 0
    assert rewards(service) == rewards(start(tmp_path)) == {0, 1, 2}


def test_a_stream_throttled_from_its_first_chunk_on_is_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(tmp_path)
    monkeypatch.setattr(service._log, "append", full)
    assert offer(service, make_chunk(0)) == [FULL]
    monkeypatch.undo()
    insert(service, make_chunk(0))
    assert service.metrics().duplicates == 0
    assert service.metrics().size == 16


def test_who_joins_while_a_long_log_is_read_need_not_wait(tmp_path: Path) -> None:
    asked: list[int] = []
    insert(start(tmp_path), *map(make_chunk, range(3)))
    start(tmp_path, meanwhile=lambda: asked.append(1))
    assert len(asked) == 3
