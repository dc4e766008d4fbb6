"""`mrcdrl experiment` trains a grid, killed in its middle and called again."""

import json
import os
import signal
import tomllib
from pathlib import Path

import pytest

from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    Command,
    end_all,
    processes_of,
    run_name,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(4 * PATIENCE_S)]

GRID = """
base = "smoke"
seeds = [0, 1]

[budget]
learner_steps = 40

[evaluate]
episodes = 2
weights = ["final"]

[variants.plain]
arena.view_px = 32
arena.max_frames = 30
learner.precision = "float32"
learner.checkpoint_period_s = 0.5

[variants.large]
arena.view_px = 32
arena.max_frames = 30
learner.precision = "float32"
learner.checkpoint_period_s = 0.5
learner.batch_size = 64
"""


def test_a_killed_grid_goes_on_and_runs_nothing_twice(tmp_path: Path) -> None:
    grid, out = tmp_path / "grid.toml", tmp_path / run_name("grid")
    grid.write_text(GRID, "utf-8")
    command = ["experiment", grid, "--out", out, "--jobs", "2"]

    def done() -> dict[str, bytes]:
        return {path.stem: path.read_bytes() for path in out.glob("cells/*.done")}

    def learning() -> list[Path]:
        """Run directories of cells that are not done and have checkpoints."""
        found = {path.parents[1] for path in out.glob("cells/*/checkpoints/step_*")}
        return [path for path in found if path.name not in done()]

    try:
        with Command(command, tmp_path) as first:
            eventually(lambda: done() and learning(), "a cell is done, another one learns")
            first.signal(signal.SIGKILL)
            first.wait()
            for pid in processes_of(str(out)):
                os.kill(pid, signal.SIGKILL)
        eventually(lambda: not processes_of(str(out)), "all have ended")
        before, interrupted = done(), learning()
        with Command(command, tmp_path) as second:
            assert second.wait(3 * PATIENCE_S) == 0, second.err
    finally:
        end_all(str(out))
    assert {name: done()[name] for name in before} == before, "a done cell was run again"
    logs = [path.with_name(f"{path.name}.log").read_text("utf-8") for path in interrupted]
    assert all("resuming run" in log or "evaluat" in log for log in logs), logs
    lines = (out / "results.jsonl").read_text("utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    named = [(result["variant"], result["seed"]) for result in results]
    assert named == [("plain", 0), ("plain", 1), ("large", 0), ("large", 1)]
    for result in results:
        assert result["learner_steps"] >= 40
        assert result["evaluate"]["final"]["episodes"] == 2
        assert result["machine"]["cores"] == os.cpu_count()
        config = tomllib.loads((out / "cells" / result["cell"] / "config.toml").read_text("utf-8"))
        seeds = {config[section]["seed"] for section in ("run", "learner", "replay")}
        assert seeds == {result["seed"]}
    assert "| large | 2 | 2 of 2 |" in second.out
