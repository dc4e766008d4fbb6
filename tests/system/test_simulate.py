"""`mrcdrl simulate` as a process: with its own replay, and on a run that is up."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import Command, processes_of, run_name

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

ACTORS = 6


def figures(command: Command) -> dict[str, Any]:
    assert command.wait() == 0, command.err
    (line,) = command.out.splitlines()
    found: dict[str, Any] = json.loads(line)
    return found


def test_shards_of_its_own_behind_a_router(tmp_path: Path) -> None:
    arguments = ["simulate", "--actors", ACTORS, "--minutes", 0.05, "--rate", "max"]
    settings = ["--replay.shards=2", "--replay.sampler=prioritized", "--replay.min_size=256"]
    with Command([*map(str, arguments), *settings], tmp_path, TMPDIR=str(tmp_path)) as command:
        told = figures(command)
    assert told["actors"] == ACTORS
    assert told["due_transitions_per_s"] is None
    assert told["refused"] == told["unanswered"] == 0
    assert told["transitions_per_s"] > 0
    assert told["lost"] == 0
    assert 0 < told["acknowledged"] <= told["made"]
    assert told["joined_s"] > 0
    assert "actors and learner that have joined: 0 of 7" in command.err
    assert told["insert_ms"]["p50"] <= told["insert_ms"]["p99"] <= told["insert_ms"]["max"]
    assert {"router", "replay-0", "replay-1", "actors-0", "learner"} <= set(told["processes"])
    assert told["first_limit"]
    assert list(tmp_path.glob("simulate-*/")) == []
    assert processes_of(str(tmp_path)) == {}


def test_a_run_that_is_up_gets_what_is_acknowledged_and_no_weights(tmp_path: Path) -> None:
    run, endpoint = run_name("simulate"), free_endpoint()
    replay = ["replay", "--run", run, "--run-dir", tmp_path, "--listen", endpoint]
    replay += ["--replay.samples_per_insert", "0", "--replay.fsync", "off"]
    load = ["simulate", "--actors", str(ACTORS), "--minutes", "60", "--processes", "2"]
    load += ["--rate", "2000", "--run", run, "--connect", endpoint]
    with (
        Command([*replay, "--config", "quick"], tmp_path),
        Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as session,
    ):
        stats = session.queue_subscriber(Keys(run).every_stats)
        there = session.presence(Keys(run).everyone("actor"))
        weights = session.latest_subscriber(Keys(run).weights_notice)
        said: dict[str, Stats] = {}

        def inserts() -> float:
            for _, payload in stats.drain():
                told = decode(Stats, payload)
                said[told.id] = told
            return said["replay-0"].metrics["inserts"] if "replay-0" in said else 0.0

        with Command(load, tmp_path) as command:
            eventually(lambda: inserts() > 5000, "replay stores what is simulated")
            eventually(lambda: len(there.alive()) == ACTORS, "all are among the living")
            eventually(lambda: len(said) == 1 + ACTORS, "all tell of themselves")
            command.signal(signal.SIGINT)
            told = figures(command)
        eventually(lambda: not there.alive(), "none is left")
        acknowledged = told["transitions_per_s"] * told["seconds"]
        metrics = said["replay-0"].metrics
        assert acknowledged > 0
        assert metrics["duplicates"] == metrics["gaps"] == metrics["refused"] == 0
        assert weights.take() is None
        assert set(told["processes"]) == {"actors-0", "actors-1", "simulate"}
        assert told["weights_published"] == 0


def test_a_replay_that_ends_is_one_line(tmp_path: Path) -> None:
    run, endpoint = run_name("simulate"), free_endpoint()
    replay = ["replay", "--run", run, "--run-dir", tmp_path, "--listen", endpoint]
    load = ["simulate", "--actors", "3", "--run", run, "--connect", endpoint, "--processes", "1"]
    with (
        Command([*replay, "--transport.max_peers", "2", "--config", "quick"], tmp_path) as service,
        Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S),
    ):
        with Command(load, tmp_path) as command:
            assert command.wait() == 1
        *_, line = command.err.splitlines()
        assert line.startswith("mrcdrl: actors-0: ")
        assert "all places (its transport.max_peers) are taken" in line
        assert "Traceback" not in command.err
        service.signal(signal.SIGTERM)
