"""The end of a run says what it reached, what to do next, and which files there are."""

import json
import shlex
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import stopped
from mrcdrl.services.train.ending import ending, ending_as_json
from mrcdrl.services.train.launcher import plan_run

BEST = {
    "success_rate": 0.978,
    "success_interval": [0.968, 0.985],
    "episodes": 1100,
    "learner_step": 39450,
}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of 90 s in the folder of runs, with a checkpoint and an evaluation of it."""
    monkeypatch.setenv("MRCDRL_RUN_DIR", str(tmp_path))
    config = load_config("smoke", environ={})
    with RunDirectory.create(tmp_path / "four", config), Recorder(tmp_path / "four", config) as r:
        r.record_metrics(RunState(config), 90.0)
        r.write_summary(RunState(config), 90.0, stopped("Ctrl-C"))
    (tmp_path / "four" / "checkpoints").mkdir()
    (tmp_path / "four" / "checkpoints" / "best.safetensors").touch()
    (tmp_path / "four" / "checkpoints" / "best.json").write_text(json.dumps(BEST))
    return tmp_path / "four"


def test_a_program_gets_the_summary_or_one_line(run: Path) -> None:
    line = ending_as_json(run)
    assert line.count("\n") == 1
    assert json.loads(line) == json.loads((run / "summary.json").read_bytes())
    (run / "summary.json").unlink()
    with pytest.raises(RunDirectoryError, match=r"no summary\.json to print: No such file"):
        ending_as_json(run)


def test_the_result_comes_first_then_what_to_do_and_then_the_files(run: Path) -> None:
    assert ending(run, stopped("Ctrl-C")).splitlines() == [
        "ended     stopped (Ctrl-C)",
        "success   97.8 % of 1100 episodes (95 % interval 96.8 to 98.5), by the weights of "
        "learner step 39450, the best",
        "took      1.5 minutes, 0 learner steps",
        "next      mrcdrl evaluate four",
        "          mrcdrl render four --out four.mp4",
        "          mrcdrl web four",
        "          mrcdrl train --resume four",
        f"files     {run}: summary.json, checkpoints/best.safetensors",
    ]


def test_without_weights_nothing_is_evaluated_and_no_file_is_named_that_is_missing(
    run: Path,
) -> None:
    for file in (run / "checkpoints").iterdir():
        file.unlink()
    (run / "summary.json").unlink()
    text = ending(run, stopped("Ctrl-C"))
    assert "success   no evaluation came to its end\n" in text
    assert "next      mrcdrl train --resume four\n" in text
    assert text.endswith(f"files     {run}\n")
    assert "evaluate" not in text


def test_a_run_elsewhere_is_named_by_its_path(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MRCDRL_RUN_DIR")
    assert f"mrcdrl evaluate {run}\n" in ending(run, stopped("Ctrl-C"))


@pytest.mark.parametrize(
    ("limit", "reason"),
    [
        ({}, stopped("Ctrl-C")),
        ({"minutes": 1}, "time limit reached (1 min)"),
        ({"learner_steps": 60}, "learner step limit reached (60)"),
    ],
)
def test_the_command_that_resumes_can_be_pasted(
    run: Path, limit: dict[str, float], reason: str
) -> None:
    config = load_config("smoke", {f"run.{k}": str(v) for k, v in limit.items()}, {})
    (run / "config.toml").write_text(to_toml(config))
    metrics = json.loads((run / "metrics.jsonl").read_text())
    (run / "metrics.jsonl").write_text(json.dumps({**metrics, "learner_steps": 60}) + "\n")
    (line,) = (line for line in ending(run, reason).splitlines() if "--resume" in line)
    mrcdrl, train, *argv = shlex.split(line)
    assert (mrcdrl, train) == ("mrcdrl", "train")
    plan_run([*argv, "--dry-run"])  # which refuses what does not go on
