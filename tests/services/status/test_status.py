"""`mrcdrl status`: what it shows of a run, and how it locks the run directory."""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, TransportConfig, to_toml
from mrcdrl.common.errors import ConfigError, RunDirectoryError, UnreachableError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.heartbeat import Heartbeat, Pulse
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.recall import recall
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.screen import plain_line
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.status import status
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.status.main import join, last_seen, listen, parser


def test_status_without_processes() -> None:
    said = status(RunState(Config()), 0.0)
    assert said["limited_by"] == "waiting for replay to start"
    assert said["services"] == []
    json.dumps(said, allow_nan=False)


def test_status_of_a_silent_service() -> None:
    state = RunState(Config())
    state.observe_presence("replay", "replay-0", True)
    metrics = {"robot_steps": 10.0, "loss": float("nan"), "slot": 3.0}
    state.observe_stats(Stats("actor", "a", metrics, {"zenoh": "1.10.2", "clock_ns": "1"}), 2.0)
    actor, replay = status(state, 9.0)["services"]
    assert actor == {
        "role": "actor",
        "id": "a",
        "alive": True,
        "silent_s": 7.0,
        "slot": 3,
        "compiling": False,
        "versions": {"zenoh": "1.10.2"},
    }
    assert (replay["alive"], replay["silent_s"], replay["slot"]) == (True, None, None)
    json.dumps(status(state, 9.0), allow_nan=False)


def test_statistics_are_received_and_count_as_work(tmp_path: Path) -> None:
    keys, path = Keys("heard"), tmp_path / "heartbeat"
    heartbeat, stop = Heartbeat(path), StopSignal()
    with Session(TransportConfig(listen=(free_endpoint(),))) as session:
        state = RunState(Config())
        follower = Follower(session, keys, state, None, StoppingRule(Config().run))
        born_s = follower.lived_s
        session.announce(keys.live("actor", "a"))
        publisher = session.publisher(keys.stats("actor", "a"))

        def show() -> None:
            publisher.put(encode(Stats("actor", "a", {"robot_steps": 5.0}, {})))
            if state.robot_steps:
                stop.set()

        listen(follower, heartbeat, stop, show, until_s=60.0)
    assert state.robot_steps == 5
    assert follower.lived_s > born_s
    heartbeat.beat()
    assert Pulse.read(path).problem(Pulse.read(path).beat_s, 30.0) is None


def test_a_run_that_is_recorded_is_locked(tmp_path: Path) -> None:
    with RunDirectory.join(tmp_path / "run", Config()) as run:
        assert (run.path / RUN_CONFIG).is_file()
        with pytest.raises(RunDirectoryError, match="in use"):
            RunDirectory.join(tmp_path / "run", Config())
    RunDirectory.join(tmp_path / "run", Config()).close()


def recorded(run_dir: Path, seconds: int) -> None:
    """Record as the launcher does: an actor at 254 robot steps a second, and 90 episodes."""
    state = RunState(Config())
    with Recorder(run_dir, Config()) as recorder:
        for second in range(seconds + 1):
            counted = {"env_steps": 127.0 * second, "robot_steps": 254.0 * second}
            state.observe_stats(Stats("actor", "a", counted), second)
            recorder.record_metrics(state, second)


def test_the_time_and_counters_of_a_run_that_is_recorded_here_are_its_own(tmp_path: Path) -> None:
    recorded(tmp_path, 70)
    state = RunState(Config())
    now = recall(tmp_path, state, StoppingRule(Config().run))
    assert now == 70
    assert state.resumed_at_s is None  # who started it, and when, is not known here
    for second in (1, 2):
        counted = {"env_steps": 127.0 * (70 + second), "robot_steps": 254.0 * (70 + second)}
        state.observe_stats(Stats("actor", "a", counted), now + second)
    told = status(state, now + 3)
    assert (told["time_since"], told["time_s"]) == ("the run began", 73)
    assert told["robot_steps"] == 254 * 72
    assert told["robot_steps_per_s"] == 254
    (tmp_path / "endpoint").write_text("tcp/127.0.0.1:1")
    recall(tmp_path, state, StoppingRule(Config().run))
    assert state.resumed_at_s == pytest.approx(70, abs=60)


@pytest.mark.parametrize("records", ["none", "old"])
def test_where_nothing_is_recorded_status_says_since_when_it_counts(
    records: str, tmp_path: Path
) -> None:
    if records == "old":
        recorded(tmp_path, 70)
        os.utime(tmp_path / "metrics.jsonl", (0, 0))
    state = RunState(Config())
    assert recall(tmp_path, state, StoppingRule(Config().run)) == 0
    assert status(state, 3.0)["time_since"] == "since status started"
    line = plain_line(state, 3.0)
    assert line.startswith("0:00:03 since status started  ")
    assert "left" not in line


def test_a_run_was_last_seen_when_it_last_recorded(tmp_path: Path) -> None:
    assert last_seen(tmp_path / "run") == (
        f"{tmp_path}/run has no records of it; give --connect if it runs elsewhere"
    )
    recorded(tmp_path / "run", 70)
    at_s = time.mktime((2026, 11, 29, 1, 20, 5, 0, 0, -1))
    os.utime(tmp_path / "run" / "metrics.jsonl", (at_s, at_s))
    assert last_seen(tmp_path / "run") == "last seen 2026-11-29 01:20:05, 0:01:10 after it began"


def test_who_names_no_run_means_the_latest_but_records_none(tmp_path: Path) -> None:
    recorded(tmp_path / "four", 70)
    (tmp_path / "four" / "config.toml").touch()
    asked = ["--run-dir", str(tmp_path)]
    with ExitStack() as owned:
        with pytest.raises(UnreachableError, match="run four is not up"):
            join(parser().parse_args(asked), StopSignal(), owned)
        with pytest.raises(ConfigError, match="give a run"):
            join(parser().parse_args([*asked, "--record"]), StopSignal(), owned)


def test_who_watches_a_run_that_is_not_up_is_told_at_once_and_waits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mrcdrl.services.status.main._WAIT_S", 600.0)  # cores may be short
    endpoint = free_endpoint()
    asked = ["--run", "late", "--run-dir", str(tmp_path), "--connect", endpoint, "--watch"]
    with ExitStack() as owned, ThreadPoolExecutor(1) as other:
        joined = other.submit(join, parser().parse_args(asked), StopSignal(), owned)
        said = ""
        while "waiting" not in said and not joined.done():
            said += capsys.readouterr().err
            time.sleep(0.01)
        with Session(TransportConfig(listen=(endpoint,))) as replay:
            server = replay.server(Keys("late").config)
            while not joined.done():
                request = server.take(0.05)
                if request is not None:
                    request.reply(to_toml(Config()).encode())
            _, _, config = joined.result()
            owned.close()
    assert said.startswith(f"mrcdrl: run late is not up: nobody answers at {endpoint}")
    assert said.endswith("; waiting up to 600 s for it\n")
    assert config.agent == Config().agent


@pytest.mark.parametrize("how", ["looks once", "watches, and is told to stop"])
def test_who_does_not_wait_for_a_run_is_told_why_it_is_not_up(
    how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked, stop = ["--run", "gone", "--run-dir", str(tmp_path)], StopSignal()
    asked += ["--connect", free_endpoint()]
    if how != "looks once":
        asked.append("--watch")
        stop.set()
    with ExitStack() as owned, pytest.raises(UnreachableError, match="run gone is not up: nobody"):
        join(parser().parse_args(asked), stop, owned)
    assert capsys.readouterr().err == ""
