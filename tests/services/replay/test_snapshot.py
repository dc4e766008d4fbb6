"""Priorities and counters outlive the process; a damaged or foreign snapshot does no harm."""

import dataclasses
import logging
import struct
import threading
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Float64Array
from mrcdrl.services.replay.sampler import priorities_of
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.snapshot import Settings, Snapshot, SnapshotWriter, read_snapshot
from tests.patience import PATIENCE_S
from tests.services.replay.harness import (
    CONFIG,
    LENGTH,
    insert,
    make_chunk,
    save,
    settings,
    start,
    update,
)


def scaled_priorities(service: ReplayService) -> Float64Array:
    return service._table.sampler.scaled_priorities(service._table.keys)


def scaled(priority: float) -> float:
    exact = float(np.float32(priority))
    return float((exact + 1e-6) ** CONFIG.replay.priority_exponent)


def test_priorities_survive_a_restart(tmp_path: Path) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    rng = np.random.default_rng(0)
    update(first, dict(enumerate(rng.lognormal(0, 4, 5 * LENGTH).tolist())))
    update(first, {3: 0.0, 4: 1e-9})
    save(first, tmp_path)
    again = start(tmp_path)  # the first was never closed: a kill -9
    np.testing.assert_allclose(scaled_priorities(again), scaled_priorities(first), rtol=1e-9)
    again._table.check_invariants()
    assert again._table.sampler.largest == first._table.sampler.largest


def test_newer_transitions_keep_their_initial_priorities_and_evicted_ones_are_skipped(
    tmp_path: Path,
) -> None:
    first = start(tmp_path)
    first._limiter.samples_per_insert = 0
    insert(first, *map(make_chunk, range(10)))
    update(first, dict.fromkeys(range(10 * LENGTH), 0.5))
    save(first, tmp_path)
    insert(first, *(make_chunk(n, priority=7.0) for n in range(10, 33)))
    again = start(tmp_path)
    kept = 10 * LENGTH - again._table.first_key
    assert 0 < kept < 10 * LENGTH
    np.testing.assert_allclose(scaled_priorities(again)[:kept], scaled(0.5), rtol=1e-9)
    np.testing.assert_allclose(scaled_priorities(again)[kept:], scaled(7.0), rtol=1e-9)


def test_the_largest_priority_outlives_the_transition_that_had_it(tmp_path: Path) -> None:
    first = start(tmp_path)
    insert(first, make_chunk(0, priority=1.0))
    update(first, {0: 50.0})
    update(first, {0: 2.0})
    save(first, tmp_path)
    again = start(tmp_path)
    insert(again, make_chunk(1))
    np.testing.assert_allclose(scaled_priorities(again)[LENGTH:], scaled(50.0), rtol=1e-9)


def test_counters_continue_where_they_were(tmp_path: Path) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    first._limiter.samples = 96
    save(first, tmp_path)
    insert(first, make_chunk(5))
    again = start(tmp_path)
    assert (again._limiter.inserts, again._limiter.samples) == (96, 96)
    assert again.metrics().inserts == 96
    assert again.metrics().samples == 96
    save(again, tmp_path)
    assert start(tmp_path).metrics().samples == 96


def test_samples_forgotten_since_the_snapshot_leave_the_lead_within_the_buffer(
    tmp_path: Path,
) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    save(first, tmp_path)
    first._limiter.samples_per_insert = 0
    insert(first, *map(make_chunk, range(5, 25)))
    limiter = start(tmp_path)._limiter
    due = (limiter.inserts - limiter.min_size) * limiter.samples_per_insert
    assert 0 < due - limiter.samples <= limiter.error_buffer


def test_a_table_that_lost_its_log_fills_anew(tmp_path: Path) -> None:
    config = settings(min_size=100)
    first = start(tmp_path, config)
    first._limiter.samples_per_insert = 0
    insert(first, *map(make_chunk, range(20)))
    save(first, tmp_path)
    paths = sorted(tmp_path.glob("*.segment"))
    for path in paths[1:]:
        path.unlink()
    again = start(tmp_path, config)
    assert 0 < len(again._table) < config.replay.min_size
    assert not again._limiter.can_sample(1)
    assert again._limiter.inserts == len(again._table)


def test_the_configuration_overrides_the_snapshot_and_the_difference_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    update(first, dict.fromkeys(range(5 * LENGTH), 0.5))
    save(first, tmp_path)
    changed = settings(priority_exponent=0.9, min_size=70, samples_per_insert=0.5, capacity=400)
    with caplog.at_level(logging.INFO):
        again = start(tmp_path, changed)
    (line,) = [r.getMessage() for r in caplog.records if "overrides" in r.getMessage()]
    assert line == (
        "the configuration overrides the snapshot: replay.capacity is 400, was 500; "
        f"replay.samples_per_insert is 0.5, was {CONFIG.replay.samples_per_insert}; "
        "replay.min_size is 70, was 64; "
        f"replay.priority_exponent is 0.9, was {CONFIG.replay.priority_exponent}"
    )
    np.testing.assert_allclose(scaled_priorities(again), (0.5 + 1e-6) ** 0.9, rtol=1e-6)
    assert again._limiter.samples_per_insert == 0.5
    assert again._table.capacity == 400


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ({"priority_exponent": 0.0}, {}),
        ({"sampler": "uniform"}, {}),
        ({}, {"sampler": "uniform"}),
    ],
)
def test_a_snapshot_without_usable_priorities_leaves_the_initial_ones(
    tmp_path: Path, was: dict[str, object], now: dict[str, object]
) -> None:
    first = start(tmp_path, settings(**was))
    insert(first, *(make_chunk(n, priority=3.0) for n in range(5)))
    first._limiter.samples = 32
    save(first, tmp_path)
    again = start(tmp_path, settings(**now))
    assert np.allclose(scaled_priorities(again), scaled(3.0), rtol=1e-9)
    assert again._limiter.samples == 32


def test_without_damage_nothing_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = start(tmp_path)
    save(first, tmp_path)
    insert(first, make_chunk(0))
    with caplog.at_level(logging.INFO):
        start(tmp_path)
        save(first, tmp_path)
        start(tmp_path)
    assert not caplog.records


def foreign(data: bytes) -> bytes:
    """A snapshot of a table with other rewards."""
    of = Snapshot.from_bytes(data)
    return dataclasses.replace(of, rewards=of.rewards + 1).to_bytes()


def beyond(data: bytes) -> bytes:
    """A snapshot of transitions that the log never had."""
    return dataclasses.replace(Snapshot.from_bytes(data), first_key=10**6).to_bytes()


BAD: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda data: b"", "is not a snapshot"),
    "foreign file": (lambda data: b"\x89PNG\r\n" + data, "is not a snapshot"),
    "another version": (
        lambda data: data.replace(b"snapshot 1", b"snapshot 2"),
        "is not a snapshot",
    ),
    "header only": (lambda data: data[:27], "is torn"),
    "torn": (lambda data: data[:-1], "is torn or damaged"),
    "longer": (lambda data: data + b"\0", "is torn or damaged"),
    "another run's": (foreign, "does not match the log's transitions"),
    "of another log": (beyond, "does not match the log's transitions"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_snapshot_is_reported_and_ignored(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    spoil, said = BAD[name]
    first = start(tmp_path)
    insert(first, *(make_chunk(n, priority=3.0) for n in range(5)))
    update(first, dict.fromkeys(range(5 * LENGTH), 0.5))
    first._limiter.samples = 7
    (tmp_path / "snapshot").write_bytes(spoil(first.snapshot().to_bytes()))
    again = start(tmp_path)
    (warning,) = [r.getMessage() for r in caplog.records]
    assert said in warning
    assert "ignoring" in warning
    np.testing.assert_allclose(scaled_priorities(again), scaled(3.0), rtol=1e-9)
    assert again._limiter.inserts == 5 * LENGTH
    assert again._limiter.samples != 7


def example() -> Snapshot:
    return Snapshot(
        settings=Settings.from_config(CONFIG),
        first_key=7,
        inserts=100,
        samples=64,
        all_samples=640,
        largest=3.5,
        rng_state=np.random.default_rng(3).bit_generator.state,
        scaled_priorities=np.array([0.5, 2.0, 0.25]),
        rewards=np.array([1, -5, 200], np.float32),
    )


def test_the_bytes_read_back_to_the_same() -> None:
    again = Snapshot.from_bytes(example().to_bytes())
    for field in dataclasses.fields(Snapshot):
        ours, theirs = getattr(again, field.name), getattr(example(), field.name)
        assert np.array_equal(ours, theirs), field.name


@given(st.integers(0, len(example().to_bytes()) * 8 - 1))
def test_every_flipped_bit_is_noticed(bit: int) -> None:
    data = bytearray(example().to_bytes())
    data[bit // 8] ^= 1 << bit % 8
    with pytest.raises(CheckpointError):
        Snapshot.from_bytes(bytes(data))


@given(st.lists(st.floats(0, 1e6, width=32), min_size=1), st.floats(0.05, 1))
def test_priorities_come_back_from_scaled_priorities(errors: list[float], exponent: float) -> None:
    exact = np.array(errors, np.float32).astype(np.float64)
    made = (exact + 1e-6) ** exponent
    again = (priorities_of(made, exponent).astype(np.float64) + 1e-6) ** exponent
    np.testing.assert_allclose(again, made, rtol=1e-6)


def test_the_service_writes_one_when_it_stops_and_leaves_no_part_of_another(
    tmp_path: Path,
) -> None:
    left = tmp_path / ".snapshot.4711.part"
    left.write_bytes(b"of a process that was killed")
    service = start(tmp_path)
    service.start()
    try:
        assert service.healthy
        insert(service, *map(make_chunk, range(5)))
        update(service, {0: 9.0})
    finally:
        service.stop()
    assert not service.healthy
    written = read_snapshot(tmp_path)
    assert written is not None
    assert written.keys == range(5 * LENGTH)
    assert not left.exists()


def test_one_is_written_every_period(tmp_path: Path) -> None:
    taken = threading.Semaphore(0)

    def take() -> Snapshot:
        taken.release()
        return example()

    writer = SnapshotWriter(tmp_path, take, period_s=0.01)
    writer.start()
    try:
        for _ in range(3):
            assert taken.acquire(timeout=PATIENCE_S)
    finally:
        writer.stop()
    assert read_snapshot(tmp_path) is not None


def test_a_snapshot_that_cannot_be_written_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = SnapshotWriter(tmp_path / "missing", example, period_s=3600)
    writer._write()
    writer._write()
    (warning,) = [r.getMessage() for r in caplog.records]
    assert warning == "cannot write a snapshot of the priorities: No such file or directory"


def test_the_random_stream_continues_after_a_restart(tmp_path: Path) -> None:
    first = start(tmp_path)
    insert(first, *map(make_chunk, range(5)))
    first._table.sample(32)
    save(first, tmp_path)
    again = start(tmp_path)
    np.testing.assert_array_equal(again._table.sample(32).keys, first._table.sample(32).keys)


def test_a_snapshot_without_a_random_state_is_read() -> None:
    without = (
        dataclasses.replace(example(), rng_state={}).to_bytes().replace(b'"rng_state": {}, ', b"")
    )
    length = len(b'"rng_state": {}, ')
    begin = len(b"mrcdrl replay snapshot 1\n")
    (old,) = struct.unpack_from("<I", without, begin + 4)
    body = without[begin + 8 :]
    crc = zlib.crc32(body, zlib.crc32(struct.pack("<II", 0, old - length)))
    data = without[:begin] + struct.pack("<II", crc, old - length) + body
    assert Snapshot.from_bytes(data).rng_state == {}
