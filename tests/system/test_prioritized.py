"""Priorities go round: from actors and learner to replay, in a run of real processes."""

import json
from pathlib import Path

import pytest

from tests.system.system_processes import Command, end_all, processes_of, run_name, smoke_training

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def test_a_prioritized_run_ends_well_and_has_set_priorities(tmp_path: Path) -> None:
    name = run_name("prioritized")
    arguments = smoke_training(tmp_path, name)
    prioritized = ["--replay.sampler=prioritized", "--replay.importance_exponent_final=1.0"]
    brief = ["--learner-steps", "600", "--run.evaluators", "0"]
    try:
        with Command([*arguments, *prioritized, *brief], tmp_path) as train:
            assert train.wait_without_plots() == 0, train.err
        assert processes_of(name) == {}
    finally:
        end_all(name)
    assert "Traceback" not in train.err
    run = tmp_path / name
    assert json.loads((run / "summary.json").read_bytes())["learner_steps"] == 600
    told = [
        metrics
        for line in (run / "metrics.jsonl").read_text("utf-8").splitlines()
        if "replay/replay-0/priority_updates" in (metrics := json.loads(line))
    ]
    assert told[-1]["replay/replay-0/priority_updates"] > 0
    assert told[-1]["replay/replay-0/refused"] == 0
