"""Worlds that nobody here wrote go round the ring: actor, replay, learner, evaluator, film."""

import json
from pathlib import Path

import av
import pytest
import torch

from tests.system.system_processes import Command, end_all, printed, run_name

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
@pytest.mark.parametrize(("world", "agents", "actions"), [("pong", 2, 3), ("grid", 1, 7)])
def test_a_foreign_world_is_learned_judged_and_filmed(
    world: str, agents: int, actions: int, tmp_path: Path
) -> None:
    name, here = run_name("foreign"), {"PYTHONPATH": str(ROOT)}
    train = ["train", name, "--run-dir", str(tmp_path), "--config", "smoke", "--no-web"]
    train += ["--env", f"benchmarks.foreign_worlds:{world}", "--run.learner_steps", "40"]
    train += ["--evaluator.episodes", "2", "--arena.max_frames", "30", "--replay.min_size", "100"]
    try:
        with Command(train, tmp_path, **here) as command:
            assert command.wait(600) == 0, command.err
    finally:
        end_all(name)
    run = tmp_path / name
    summary = json.loads((run / "summary.json").read_text("utf-8"))
    assert summary["learner_steps"] >= 40, summary
    judged = (run / "evaluations.jsonl").read_text("utf-8").splitlines()
    assert judged
    settings = (run / "config.toml").read_text("utf-8")
    assert f"num_robots = {agents}" in settings
    assert f"num_actions = {actions}" in settings
    with av.open(str(run / "evaluation.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) > 4
    told = printed(tmp_path, "evaluate", run, "--episodes", "2", "--json", **here)
    assert json.loads(told)["num_robots"] == agents
    exported = tmp_path / "policy.ts"
    assert "largest difference" in printed(tmp_path, "export", run, "--out", exported, **here)
    network = torch.jit.load(str(exported))
    assert network(torch.zeros((1, 4, 60, 60), dtype=torch.uint8)).shape == (1, actions)
    resume = ["train", "--resume", run, "--run.learner_steps", "60", "--json", "--no-web"]
    try:
        again = json.loads(printed(tmp_path, *resume, timeout_s=600, **here))
    finally:
        end_all(name)
    assert again["learner_steps"] >= 60, again
