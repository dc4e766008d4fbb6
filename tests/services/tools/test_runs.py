"""`mrcdrl runs` tells each run's state from its files; `mrcdrl runs rm` removes what it may."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, load_config, nearest_preset, to_toml
from mrcdrl.common.errors import MrcdrlError, RunDirectoryError
from mrcdrl.common.runtime.files import lock_directory
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_info import State, run_info
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import failed, stopped
from mrcdrl.services.tools import runs, runs_rm


def config(**overrides: str) -> Config:
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_config("smoke", named, environ={})


def make_run(path: Path, reason: str | None) -> Path:
    """A run of 90 s that ended so; None: without a summary."""
    path.mkdir(parents=True)
    of, lasted_s = config(arena__num_robots="4"), 90.0
    (path / "config.toml").write_text(to_toml(of))
    with Recorder(path, of) as recorder:
        state = RunState(of)
        recorder.record_metrics(state, lasted_s)
        if reason is not None:
            recorder.write_summary(state, lasted_s, reason)
    return path


@pytest.fixture
def four(tmp_path: Path) -> Path:
    return make_run(tmp_path / "runs" / "four", "time limit reached (30 min)")


@pytest.fixture
def up(four: Path) -> Iterator[Path]:
    """A run that a process holds."""
    path = make_run(four.with_name("up"), stopped("Ctrl-C"))
    lock = lock_directory(path)
    yield path
    os.close(lock)


@pytest.mark.parametrize(
    ("reason", "state", "text"),
    [
        ("time limit reached (30 min)", State.ENDED, "ended (time)"),
        ("evaluation success 0.990 reached run.target_success_rate", State.ENDED, "ended (target)"),
        ("learner step limit reached (60)", State.ENDED, "ended (steps)"),
        ("the learner has finished its steps", State.ENDED, "ended (steps)"),
        ("no new maximum above 9 successes", State.ENDED, "ended (patience)"),
        (stopped("SIGTERM"), State.STOPPED, "stopped"),
        (failed("learner-0 failed: no memory"), State.FAILED, "failed"),
        ("some rule of another version", State.ENDED, "ended"),
        (None, State.KILLED, "killed"),
    ],
)
def test_the_state_of_a_run_is_how_it_ended(
    tmp_path: Path, reason: str | None, state: State, text: str
) -> None:
    found = run_info(make_run(tmp_path / "a", reason))
    assert (found.state, found.stop_reason, runs.state_text(found)) == (state, reason, text)


def test_the_summary_of_an_earlier_start_does_not_count(four: Path) -> None:
    with Recorder(four, config()) as recorder:
        recorder.record_metrics(RunState(config()), 120.0)
    assert run_info(four).state is State.KILLED


def test_a_run_that_a_process_holds_is_running(up: Path) -> None:
    assert run_info(up).state is State.RUNNING


def test_a_run_whose_replay_was_started_by_hand_is_running_too(four: Path) -> None:
    (four / "replay" / "1").mkdir(parents=True)
    lock = lock_directory(four / "replay" / "1")
    assert run_info(four).state is State.RUNNING
    with pytest.raises(RunDirectoryError, match="four is up"):
        remove(four, "four", "--yes")
    os.close(lock)
    assert remove(four, "four", "--yes") == 0


def test_a_run_that_fails_says_so_in_its_summary_and_keeps_what_it_recorded(four: Path) -> None:
    with Recorder(four, config()) as recorder:
        recorder.summarize(failed("replay-0 failed: no room"))
    found = run_info(four)
    assert (found.state, found.stop_reason) == (State.FAILED, "failed (replay-0 failed: no room)")
    assert json.loads((four / "summary.json").read_bytes())["wall_s"] == 90


def test_what_files_do_not_tell_is_unknown_and_ends_nothing(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "config.toml").write_text("[arena]\nnumber_of_robots = 2\n")
    (tmp_path / "old" / "summary.json").write_text("[1]")
    (tmp_path / "old" / "evaluations.jsonl").write_text('{"success": 1}\n')
    found = run_info(tmp_path / "old")
    assert (found.robots, found.preset, found.best_success, found.minutes) == (None,) * 4
    assert runs.main(["--run-dir", str(tmp_path)]) == 0


def test_best_success_is_that_of_the_weights_that_are_kept(four: Path) -> None:
    (four / "checkpoints").mkdir()
    (four / "checkpoints" / "best.json").write_text('{"success_rate": 0.925}')
    assert run_info(four).best_success == 0.925


def test_the_preset_is_the_nearest_whatever_the_robots_seeds_and_limits() -> None:
    assert nearest_preset(config(arena__num_robots="3", run__minutes="1", learner__seed="7")) == (
        "smoke",
        0,
    )
    assert nearest_preset(load_config("paper", {"agent.gamma": "0.5"}, {})) == ("paper", 1)


def test_the_table_and_the_json_tell_the_same(
    four: Path, up: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.utime(four / "config.toml", (1, 1))
    os.utime(four / "metrics.jsonl", (1, 1))
    folder = ["--run-dir", str(four.parent)]
    assert runs.main(folder) == 0
    header, first, second = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["name", "state", "robots"]
    assert first.split()[:6] == ["four", "ended", "(time)", "4", "duel", "smoke"]
    assert second.split()[:2] == ["up", "running"]
    assert runs.main([*folder, "--json"]) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(run["name"], run["state"]) for run in told] == [("four", "ended"), ("up", "running")]
    assert told[0]["minutes"] == 1.5
    assert told[0]["disk_bytes"] > 0


def test_a_folder_without_runs_is_said_on_stderr(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runs.main(["--run-dir", str(tmp_path), "--json"]) == 0
    assert runs.main(["--run-dir", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert told.out == ""
    assert str(tmp_path) in told.err


# -- runs rm -----------------------------------------------------------------------------


def remove(four: Path, *argv: str) -> int:
    return runs_rm.main([*argv, "--run-dir", str(four.parent)])


def test_removed_runs_are_gone_and_what_they_free_is_said(
    four: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = make_run(four.with_name("two"), None)
    kept = make_run(four.with_name("six"), None)
    assert remove(four, "four", str(other), "four", "--yes") == 0
    assert [path.exists() for path in (four, other)] == [False, False]
    assert kept.exists()
    told = capsys.readouterr()
    assert "4 robots, ended (time)" in told.err
    assert told.out.startswith("removed four, two: ")
    assert told.out.endswith("B are free again\n")


@pytest.mark.parametrize(("answer", "gone"), [("y\n", True), ("n\n", False), ("", False)])
def test_it_asks(four: Path, answer: str, gone: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stdin.readline", lambda: answer, raising=False)
    assert remove(four, "four") == (0 if gone else 1)
    assert four.exists() != gone


def test_where_nobody_can_answer_nothing_is_removed(
    four: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with pytest.raises(RunDirectoryError, match="give --yes"):
        remove(four, "four")
    assert four.exists()


def test_a_run_that_is_up_is_refused_and_the_others_stay(four: Path, up: Path) -> None:
    with pytest.raises(RunDirectoryError, match="up is up; stop it first"):
        remove(four, "four", "up", "--yes")
    assert four.exists()
    assert up.exists()


def test_only_runs_that_stand_alone_are_removed(four: Path) -> None:
    folder = four.parent
    (folder / "link").symlink_to(four)
    (folder / "data" / "checkpoints").mkdir(parents=True)
    cell = make_run(folder / "cells" / "a", None)
    cell.with_name("a.toml").touch()
    for word, why in (
        ("link", "is a link"),
        ("data", "no configuration of a run"),
        (str(cell), "belongs to an experiment"),
        ("fuor", "did you mean four"),
    ):
        with pytest.raises(MrcdrlError, match=why):
            remove(four, "four", word, "--yes")
    assert four.exists()
    assert (folder / "data").exists()
    assert cell.exists()
