"""A run whose replay is several processes, one of which is killed."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.patience import eventually
from tests.system.system_processes import (
    Command,
    end_all,
    processes_of,
    run_name,
    smoke_training,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def last_metrics(run: Path) -> dict[str, float]:
    path = run / "metrics.jsonl"
    lines = path.read_text("utf-8").splitlines() if path.exists() else []
    found: dict[str, float] = json.loads(lines[-1]) if lines else {}
    return found


def test_training_goes_on_when_a_shard_is_killed(tmp_path: Path) -> None:
    name = run_name("shards")
    run = tmp_path / name
    arguments = smoke_training(tmp_path, name)
    # Room for the restart: the launcher takes one that lived for less than 10 s for broken.
    sharded = ["--replay.shards=2", "--actors=2", "--run.evaluators=0", "--learner-steps=100000"]

    def steps_beyond(steps: float) -> bool:
        return last_metrics(run).get("learner_steps", 0) > steps

    def inserts_of(shard: int) -> float:
        return last_metrics(run).get(f"replay/replay-{shard}/inserts", 0)

    try:
        with Command([*arguments, *sharded], tmp_path) as train:
            eventually(lambda: steps_beyond(50), "learner steps")
            eventually(lambda: inserts_of(0) > 0 and inserts_of(1) > 0, "inserts into both shards")
            eventually(lambda: last_metrics(run).get("time_s", 0) > 20, "20 s of running")
            (victim,) = processes_of(name, "--shard 1")
            os.kill(victim, signal.SIGKILL)
            before = last_metrics(run)["learner_steps"]
            eventually(lambda: steps_beyond(before + 20), "steps after the kill")
            (again,) = eventually(lambda: list(processes_of(name, "--shard 1")), "another shard 1")
            assert again != victim
            held = inserts_of(1)
            eventually(lambda: inserts_of(1) > held, "inserts into the shard that is back")
            train.signal(signal.SIGINT)
            assert train.wait_without_plots() == 0, train.err
        assert processes_of(name) == {}
    finally:
        end_all(name)
    assert "Traceback" not in train.err
    assert {path.name for path in (run / "replay").iterdir()} == {"0", "1"}
