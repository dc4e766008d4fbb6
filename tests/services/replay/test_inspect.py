"""`mrcdrl replay inspect` shows what a service would read back, and changes nothing."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrcdrl import cli
from mrcdrl.common.config import Config, to_toml
from mrcdrl.common.errors import ConfigError, MrcdrlError, RunDirectoryError
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.inspect.main import main
from mrcdrl.services.replay.log import SegmentLog
from tests.services.replay.harness import (
    CONFIG,
    LENGTH,
    TAIL,
    insert,
    make_chunk,
    save,
    settings,
    start,
    update,
)


def chunk(sequence: int, *, terminated: bool = False, **fields: Any) -> Chunk:
    records = np.full((LENGTH + TAIL, CONFIG.arena.record_bytes), sequence, np.uint8)
    discounts = np.full(LENGTH, 0.0 if terminated else 0.9, np.float32)
    fields = {"priority": 1.0, "records": records, "discounts": discounts, **fields}
    return make_chunk(sequence, **fields)


CHUNKS = (
    *(chunk(n, weights_version=n) for n in range(4)),
    *(chunk(n, actor="b", incarnation=2, weights_version=5) for n in (0, 2, 5)),
    chunk(0, actor="b", incarnation=3, weights_version=6, terminated=True),
)


def make_run(
    folder: Path, chunks: Sequence[Chunk] = CHUNKS, config: Config | None = CONFIG
) -> Path:
    """A run directory with a log and a snapshot, left by a killed service."""
    directory = folder / "four" / "replay" / "0"
    service = start(directory)
    service._limiter.samples_per_insert = 0
    insert(service, *chunks)
    update(service, {0: 9.0, 5: 0.25})
    save(service, directory)
    if config is not None:
        (folder / "four" / "config.toml").write_text(to_toml(config), "utf-8")
    return folder / "four"


def inspect(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    assert main([*map(str, arguments), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_the_log_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = inspect(capsys, make_run(tmp_path))
    assert (found["chunks"], found["transitions"]) == (8, 8 * LENGTH)
    assert (found["first_key"], found["last_key"]) == (0, 8 * LENGTH - 1)
    assert found["files"]["segments"] > 1
    assert found["files"]["bytes"] == sum(
        path.stat().st_size for path in tmp_path.rglob("*.segment")
    )
    assert 0 <= found["files"]["newest_s"] <= found["files"]["oldest_s"] < 600
    damage = ("torn_bytes", "corrupt_records", "left_out_chunks", "duplicate_chunks")
    assert [found["files"][name] for name in damage] == [0, 0, 0, 0]
    assert found["terminations"] == LENGTH
    assert sum(found["actions"]) == 8 * LENGTH
    assert found["rewards"]["max"] == 5
    assert sum(found["rewards"]["counts"]) == 8 * LENGTH
    assert found["weights"]["oldest"] == 0
    assert found["weights"]["newest"] == 6
    assert found["weights"]["staleness"]["max"] == 6


def test_each_actor_has_its_incarnations_and_gaps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = inspect(capsys, make_run(tmp_path))["actors"]
    assert first == {
        "actor": "a",
        "chunks": 4,
        "transitions": 4 * LENGTH,
        "incarnations": 1,
        "gaps": 0,
        "first_version": 0,
        "last_version": 3,
    }
    assert (second["incarnations"], second["gaps"], second["last_version"]) == (2, 3, 6)


def test_the_table_is_the_one_a_service_would_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path, [chunk(n) for n in range(60)])
    service = start(run / "replay" / "0")
    found = inspect(capsys, run)
    assert found["table"]["size"] == len(service._table) < found["transitions"]
    assert found["table"]["first_key"] == service._table.first_key
    assert found["table"]["inserts"] == 60 * LENGTH == service.metrics().inserts
    assert found["table"]["samples"] == service.metrics().samples


def test_priorities_come_from_the_snapshot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path)
    priorities = inspect(capsys, run)["priorities"]
    assert priorities["source"] == "snapshot"
    spread = priorities["spread"]
    assert (spread["min"], spread["median"], spread["max"]) == pytest.approx((0.25, 1.0, 9.0))
    assert sum(spread["counts"]) == 8 * LENGTH
    (run / "replay" / "0" / "snapshot").unlink()
    priorities = inspect(capsys, run)["priorities"]
    assert priorities["source"] == "actors"
    assert priorities["spread"]["max"] == pytest.approx(1.0)


@pytest.mark.parametrize("config", [None, settings(sampler="uniform")])
def test_without_a_prioritized_table_priorities_are_the_actors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], config: Config | None
) -> None:
    found = inspect(capsys, make_run(tmp_path, config=config))
    assert (found["table"] is None) == (config is None)
    assert found["priorities"]["source"] == "actors"
    assert found["priorities"]["spread"]["max"] == 1.0


def test_chunks_without_priorities_have_none_to_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = inspect(capsys, make_run(tmp_path, [chunk(0, priority=None)], config=None))
    assert found["priorities"] == {"source": None, "spread": None}


def files_of(folder: Path) -> dict[Path, tuple[bytes, int]]:
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def test_damage_is_reported_and_nothing_is_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path)
    directory = run / "replay" / "0"
    log = SegmentLog(directory, segment_bytes=10**6, fsync=False)
    for _ in log.recover(lambda: 0):
        pass
    stranger = chunk(9)
    log.append([encode(stranger)[:-1]], 10**6, 1)
    log.append([encode(CHUNKS[3])], 10**6, 1)
    log.append([encode(CHUNKS[0]).replace(b"chunk/1", b"chunk/7")], 10**6, 1)
    log.close()
    segments = sorted(directory.glob("*.segment"))
    with segments[-1].open("ab") as file:
        file.write(b"\x40\0\0\0torn")
    data = bytearray(segments[0].read_bytes())
    data[200] ^= 4
    segments[0].write_bytes(data)
    before = files_of(run)
    found = inspect(capsys, run)
    assert found["files"]["torn_bytes"] == 8
    assert found["files"]["corrupt_records"] == 1
    assert found["files"]["left_out_chunks"] == 2
    assert found["files"]["duplicate_chunks"] == 1
    assert found["chunks"] == 7
    assert main([str(run)]) == 0
    assert "damage" in capsys.readouterr().out
    assert files_of(run) == before


def test_chunks_of_another_arena_are_left_out_as_a_service_would(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path)
    found = inspect(capsys, run, "--arena.num_robots", "3")
    assert (found["chunks"], found["files"]["left_out_chunks"]) == (0, 8)
    assert found["first_key"] is None
    found = inspect(capsys, run, "--agent.n_step", "2")
    assert found["files"]["left_out_chunks"] == 8


def test_a_reader_is_shown_a_table_with_bars(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path)
    assert main(["four", "--run-dir", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    for part in (
        "128 transitions in 8 chunks",
        "128 of 500 transitions after a start",
        "versions 0 to 6",
        "priorities of the table, from the snapshot: min 0.25, median 1",
        "rewards (n-step returns)",
        "staleness",
        "█",
    ):
        assert part in shown, shown


def test_an_empty_log_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path, [])
    assert main([str(run)]) == 0
    assert "0 transitions in 0 chunks" in capsys.readouterr().out
    with pytest.raises(RunDirectoryError, match="no transitions to export"):
        main([str(run), "--export", str(tmp_path / "none.npz")])


def test_exported_arrays_are_the_tables_transitions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = make_run(tmp_path), tmp_path / "four.npz"
    assert main([str(run), "--export", str(out)]) == 0
    assert capsys.readouterr().out.endswith(f"{out}: 128 transitions\n")
    found = np.load(out, allow_pickle=False)
    samples = start(run / "replay" / "0")._table.sample(2000)
    rows = np.searchsorted(found["keys"], samples.keys)
    assert (found["keys"][rows] == samples.keys).all()
    window = int(found["window"])
    assert window == TAIL + 1
    spans = found["start_rows"][rows][:, None] + np.arange(window)
    np.testing.assert_array_equal(found["records"][spans], samples.records)
    for name in ("actions", "rewards", "discounts", "bootstrap_offsets", "weights_versions"):
        np.testing.assert_array_equal(found[name][rows], getattr(samples, name))
    assert found["actor_names"][found["actors"]].tolist() == ["a"] * 64 + ["b"] * 64
    assert found["sequences"][::LENGTH].tolist() == [0, 1, 2, 3, 0, 2, 5, 0]
    assert found["incarnations"][-1] == 3
    assert (found["priorities"] == 1).all()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nobody"], r"no run 'nobody' in .*; `mrcdrl runs` lists all"),
        (["bare"], r"bare has no replay log: .*replay/0 is missing$"),
        (["four", "--shard", "3"], r"replay/3 is missing; its shards are 0"),
        (["four", "--export", "/proc/x.npz"], r"/proc/x.npz cannot be written: No such file"),
    ],
)
def test_what_is_missing_is_one_clear_error(
    tmp_path: Path, arguments: list[str], reason: str
) -> None:
    make_run(tmp_path)
    (tmp_path / "bare" / "checkpoints").mkdir(parents=True)
    with pytest.raises(MrcdrlError, match=reason):
        main([*arguments, "--run-dir", str(tmp_path)])


def test_a_wrong_setting_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        main([str(make_run(tmp_path)), "--replay.capacity", "none"])


def test_it_is_a_command_of_two_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["mrcdrl", "replay", "inspect", str(make_run(tmp_path))])
    assert cli.main() == 0
    assert "128 transitions" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["mrcdrl", "replay", "inspect", "nobody"])
    monkeypatch.setenv("MRCDRL_RUN_DIR", str(tmp_path))
    assert cli.main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mrcdrl: no run 'nobody' in ")
