"""`mrcdrl status`: what it shows of a run, and how it locks the run directory."""

import json
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.heartbeat import Heartbeat, Pulse
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.status.main import listen, status


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
