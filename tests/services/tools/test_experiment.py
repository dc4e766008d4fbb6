"""`mrcdrl experiment`: grids are read, cells named, resumed from any moment, and summed up.

A script stands in for `mrcdrl train` and `mrcdrl evaluate` here; tests/system/test_experiment.py
trains.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mrcdrl.common.config import Config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.services.monitor.records import EpisodeRecord, EvaluationRecord, record_line
from mrcdrl.services.monitor.stopping import stopped
from mrcdrl.services.tools.experiment import grid as grid_module
from mrcdrl.services.tools.experiment import main as main_module
from mrcdrl.services.tools.experiment import runner
from mrcdrl.services.tools.experiment.cell import CellFiles, State, hundreds, lock
from mrcdrl.services.tools.experiment.grid import Cell, read_grid
from mrcdrl.services.tools.experiment.main import main, time_left
from mrcdrl.services.tools.experiment.table import table

GRID = """
base = "smoke"
robots = [2, 3]
seeds = [0, 1]
[budget]
learner_steps = 100
minutes = 2
[evaluate]
episodes = 3
seed = 5
[variants.plain]
[variants.big]
learner.batch_size = 64
agent.loss = "squared"
"""

# Trains at once, notes its arguments, and obeys the files named for it.
SCRIPT = """
import json, signal, sys, time
from pathlib import Path

here = Path(__file__).parent
with (here / "calls").open("a") as calls:
    calls.write(json.dumps(sys.argv[1:]) + "\\n")
if sys.argv[1] == "evaluate":
    words = [word for word in sys.argv if word != "--values"]
    flags = dict(zip(words[3::2], words[4::2]))
    test = {"episodes": int(flags["--episodes"]), "seed": int(flags["--seed"])}
    if "--values" in sys.argv:
        test["values"] = {"overestimation": 2.0}
    print(json.dumps({**test, "success_rate": 0.5}))
    sys.exit()
words = [word for word in sys.argv if word not in ("--no-plots", "--no-web")]
flags = dict(zip(words[2::2], words[3::2]))
name = flags.get("--name") or flags["--resume"]
run = Path(flags["--run-dir"], name)
if (here / "fails").exists() and (here / "fails").read_text() in name:
    sys.exit("mrcdrl: replay-0 failed: no room")
run.mkdir(exist_ok="--resume" in flags)
if (here / "slow").exists():
    asked = []
    signal.signal(signal.SIGTERM, lambda number, _frame: asked.append(number))
    (run / "ready").touch()
    while len(asked) < int((here / "slow").read_text()):
        time.sleep(0.01)
    sys.exit()
(run / "config.toml").touch()
(run / "checkpoints" / "step_000000100").mkdir(parents=True)
(run / "evaluations.jsonl").write_bytes((here / "evaluations").read_bytes())
reason = (here / "reason").read_text() if (here / "reason").exists() else "limit reached"
summary = {"stop_reason": reason, "learner_steps": 100, "wall_s": 9.0, "machine": {}}
summary["versions"] = {}
(run / "summary.json").write_text(json.dumps(summary))
"""


def evaluated(success_rate: float, learner_step: int, time_s: float) -> str:
    test = Evaluation(
        *("e", 1, 1, learner_step, 2, 10, success_rate, 1 - success_rate, 0.0, (0.2, 0.8)),
        *(5.0, 5.0, 0.0, 9.0, 1.0, 0, 1.0),
    )
    return record_line(EvaluationRecord(time_s, 1, 1, test))


class Bench:
    """A folder with a grid and the script, and what the script was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.grid = folder / "grid.toml"
        self.out = folder / "out"
        self.write(GRID)
        (folder / "script.py").write_text(SCRIPT, "utf-8")
        lines = [evaluated(0.4, 10, 60.0), evaluated(0.9, 50, 120.0), evaluated(0.85, 90, 180.0)]
        (folder / "evaluations").write_text("".join(lines), "utf-8")

    def write(self, text: str) -> None:
        self.grid.write_text(text, "utf-8")

    def run(self, *flags: str) -> int:
        return main([str(self.grid), "--out", str(self.out), *flags])

    def cells(self) -> list[CellFiles]:
        return [CellFiles(cell, self.out) for cell in read_grid(self.grid)]

    def calls(self) -> list[list[str]]:
        """Arguments of the calls since the last look."""
        path = self.folder / "calls"
        lines = path.read_text("utf-8").splitlines() if path.exists() else []
        path.unlink(missing_ok=True)
        return [json.loads(line) for line in lines]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(runner, "COMMAND", (sys.executable, str(tmp_path / "script.py")))
    monkeypatch.setattr(runner, "_POLL_S", 0.01)
    monkeypatch.setattr(main_module.StopSignal, "listen", lambda self: self)
    return Bench(tmp_path)


# -- the grid ----------------------------------------------------------------------------


def test_a_grid_is_variants_times_robots_times_seeds(bench: Bench) -> None:
    cells = read_grid(bench.grid)
    assert len({cell.name for cell in cells}) == len(cells) == 2 * 2 * 2
    assert cells[0].name == f"plain-2robots-seed0-{cells[0].digest[:8]}"
    last = cells[-1]
    assert (last.variant, last.robots, last.seed) == ("big", 3, 1)
    assert last.settings == {"learner.batch_size": 64, "agent.loss": "squared"}
    assert last.config.learner.batch_size == 64
    assert last.config.run.learner_steps == 100
    assert last.trial.weights == ("final", "best")


def test_one_seed_is_every_seed_of_a_run_but_the_tests(bench: Bench) -> None:
    config = read_grid(bench.grid)[1].config
    assert (config.run.seed, config.learner.seed, config.replay.seed) == (1, 1, 1)
    assert config.evaluator.seed == Config().evaluator.seed


def test_a_cell_ends_at_the_budget_and_at_nothing_else(bench: Bench) -> None:
    bench.write(GRID.replace("smoke", "quick"))  # which ends at a success rate
    run = read_grid(bench.grid)[0].config.run
    assert (run.learner_steps, run.minutes) == (100, 2)
    assert (run.target_success_rate, run.patience_episodes) == (0, 0)


def test_a_name_is_that_of_what_is_learned_and_judged(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def names() -> list[str]:
        return [cell.name for cell in read_grid(bench.grid)]

    before = names()
    monkeypatch.setenv("MRCDRL_LEARNER__BATCH_SIZE", "8")
    bench.write(GRID.replace("[variants.plain]", "[variants.plain]\ntransport.timeout_s = 60"))
    assert names() == before
    bench.write(GRID.replace("[variants.plain]", '[variants.plain]\nagent.kind = "duel"'))
    assert names() == before, "a setting at its default"
    bench.write(GRID.replace("episodes = 3", "episodes = 4"))
    assert names() == before, "evaluations are made again, and nothing is trained again"
    bench.write(GRID.replace("steps = 100", "steps = 101"))
    assert not set(names()) & set(before)
    bench.write(GRID)
    monkeypatch.setattr(grid_module, "PROTOCOL", grid_module.PROTOCOL + 1)
    assert not set(names()) & set(before)


WRONG = {
    "key": (("seeds", "seds"), "unknown key 'seds'"),
    "base": (('"smoke"', '"smoky"'), "smoky"),
    "setting": (("batch_size", "bach_size"), "did you mean learner.batch_size"),
    "value": (("= 64", "= 0"), "variant 'big': learner.batch_size: must be at least 1"),
    "seeds": (("[0, 1]", "[0, 0]"), "seeds must be a list of different numbers"),
    "negative": (("[0, 1]", "[0, -1]"), "seeds must be whole numbers"),
    "settled": (("learner.batch", "run.seed = 3\nlearner.batch"), "sets run.seed"),
    "numbers": (("learner.batch", "arena.robots = [1, 2]\nlearner.batch"), "sets arena.robots"),
    "budget": (("learner_steps = 100\nminutes = 2", "minutes = 0"), "would never end"),
    "budget key": (("minutes", "hours"), "'budget.hours'"),
    "own test": (("seed = 5", "seed = 1"), "evaluate.seed 1 is evaluator.seed"),
    "weights": (("seed = 5", 'seed = 5\nweights = ["worst"]'), "'final' or 'best'"),
    "values": (("seed = 5", "seed = 5\nvalues = 1"), "values must be true or false"),
    "no final": (
        ("seed = 5", 'seed = 5\nvalues = true\nweights = ["best"]'),
        "evaluate.values needs 'final'",
    ),
    "flat": (("learner.batch_size", "batch_size"), "write SECTION.FIELD"),
    "name": (("variants.plain", 'variants."a b"'), "variant 'a b'"),
    "toml": (("[budget]", "[budget"), "is not TOML"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_grid_is_refused_before_anything_begins(case: str, bench: Bench) -> None:
    (old, new), words = WRONG[case]
    assert old in GRID
    bench.write(GRID.replace(old, new, 1))
    with pytest.raises(ConfigError) as refused:
        bench.run()
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not bench.out.exists()


# -- running -----------------------------------------------------------------------------


def test_every_cell_is_trained_and_evaluated_once(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench.run("--jobs", "2") == 0
    calls = bench.calls()
    assert sum(call[0] == "train" for call in calls) == 8
    assert sum(call[0] == "evaluate" for call in calls) == 8, "the runs left no best weights"
    lines = (bench.out / "results.jsonl").read_text("utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    assert [result["cell"] for result in results] == [f.cell.name for f in bench.cells()]
    first = results[0]
    assert first["reached"]["0.5"] == {"learner_steps": 50, "seconds": 120.0}
    assert first["reached"]["0.93"] is None
    assert (first["best"]["success_rate"], first["last"]["success_rate"]) == (0.9, 0.85)
    assert first["last"]["success_interval"] == [0.2, 0.8]
    assert first["evaluate"]["final"]["success_rate"] == 0.5
    assert first["evaluate"]["best"] is None
    assert first["command"].startswith("mrcdrl experiment ")
    assert "| plain | 2 | 2 of 2 | 50 steps, 2.0 min (2 of 2) |" in capsys.readouterr().out
    assert bench.run() == 0
    assert bench.calls() == [], "done cells are not run again"


def test_other_evaluations_are_made_without_training_again(bench: Bench) -> None:
    assert bench.run("--only", "plain-2robots-seed0-*") == 0
    bench.calls()
    bench.write(GRID.replace("episodes = 3", "episodes = 4"))
    assert bench.run("--only", "plain-2robots-seed0-*") == 0
    (call,) = bench.calls()
    assert call[0] == "evaluate"
    assert call[call.index("--episodes") + 1] == "4"


def test_values_are_compared_with_returns_for_the_final_weights_only(bench: Bench) -> None:
    only = ("--only", "plain-2robots-seed0-*")
    bench.write(GRID.replace("seed = 5", 'seed = 5\nweights = ["final"]'))
    assert bench.run(*only) == 0
    bench.calls()
    bench.write(GRID.replace("seed = 5", "seed = 5\nvalues = true"))
    (cell, *_) = bench.cells()
    (cell.run / "checkpoints" / "best.safetensors").touch()
    assert cell.state is not State.DONE, "values were not asked for before"
    assert bench.run(*only) == 0
    calls = bench.calls()
    assert [("--values" in call, Path(call[1]).name) for call in calls] == [
        (True, "step_000000100"),
        (False, "best.safetensors"),
    ]
    assert cell.state is State.DONE


def test_training_is_told_by_whole_hundreds() -> None:
    def record(number: int) -> EpisodeRecord:
        won = Outcome.SUCCESS if number % 4 == 0 else Outcome.TIMEOUT
        summary = EpisodeSummary("a", 0, number, won, 9, float(number), 1, 0.1, 5, 2.0, 2)
        return EpisodeRecord(float(number), 10 * number, summary)

    told = hundreds([record(number) for number in range(250)], 0.1)
    assert told == {
        "successes": [25, 25],
        "score": [49.5, 149.5],
        "mean_q": [20.0, 20.0],
        "learner_steps": [990, 1990],
    }
    assert hundreds([record(0)], 1.0)["successes"] == []


def test_a_failed_cell_is_named_and_tried_again_and_the_others_go_on(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    (bench.folder / "fails").write_text("big-3robots-seed1")
    assert bench.run("--jobs", "3") == 1
    states = [files.state for files in bench.cells()]
    assert states == [State.DONE] * 7 + [State.FAILED]
    shown = capsys.readouterr().out
    assert f"`{bench.cells()[-1].cell.name}`: failed, code 1: mrcdrl: replay-0 failed" in shown
    assert "| big | 3 | 1 of 2 |" in shown
    (bench.folder / "fails").unlink()
    bench.calls()
    assert bench.run() == 0
    assert [call[0] for call in bench.calls()] == ["train", "evaluate"]
    assert bench.cells()[-1].state is State.DONE


def test_a_training_that_was_stopped_is_not_done(bench: Bench) -> None:
    (bench.folder / "reason").write_text(stopped("SIGTERM"))
    only = ("--only", "plain-2robots-seed0-*")
    assert bench.run(*only) == 1
    assert bench.cells()[0].failure == "training did not come to its end: stopped (SIGTERM)"


@pytest.mark.parametrize("asked", [1, 2, 1000], ids=["ends", "asked again", "killed"])
def test_a_signal_stops_the_cells_at_work_and_they_can_be_resumed(
    asked: int, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "_ASKED_S", 0.5)
    (bench.folder / "slow").write_text(str(asked))
    files = bench.cells()[:2]
    files[0].run.parent.mkdir(parents=True)
    stop = runner.StopSignal()

    def tick(at_work: int) -> None:
        if at_work == 2 and all((f.run / "ready").exists() for f in files):
            stop.set()

    runner.run_cells(files, 2, "", stop, tick)
    assert [f.state for f in files] == [State.STOPPED] * 2
    (bench.folder / "slow").unlink()
    assert bench.run("--only", "plain-2robots-*") == 0


def killed_with_its_configuration(files: CellFiles) -> None:
    files.begin()


def killed_before_it_was_a_run(files: CellFiles) -> None:
    files.begin()
    (files.run / "logs").mkdir(parents=True)


def killed_in_training(files: CellFiles) -> None:
    files.begin()
    files.run.mkdir()
    (files.run / "config.toml").touch()
    (files.run / "metrics.jsonl").write_text('{"time_s": 90.0, "learner_steps": 40}\n')


def killed_while_evaluating(files: CellFiles) -> None:
    killed_in_training(files)
    (files.run / "checkpoints" / "step_000000100").mkdir(parents=True)
    summary = {"stop_reason": "limit", "learner_steps": 1, "wall_s": 1, "machine": {}}
    (files.run / "summary.json").write_text(json.dumps({**summary, "versions": {}}))
    files.run.with_name(f"{files.run.name}.final.part").write_text('{"episo')


KILLED: list[tuple[Callable[[CellFiles], None], list[list[str]]]] = [
    (killed_with_its_configuration, [["train", "--config"], ["evaluate"]]),
    (killed_before_it_was_a_run, [["train", "--config"], ["evaluate"]]),
    (killed_in_training, [["train", "--resume"], ["evaluate"]]),
    (killed_while_evaluating, [["evaluate"]]),
]


@pytest.mark.parametrize(("kill", "expected"), KILLED, ids=[k.__name__ for k, _ in KILLED])
def test_a_cell_goes_on_where_it_was_killed(
    kill: Callable[[CellFiles], None], expected: list[list[str]], bench: Bench
) -> None:
    files = bench.cells()[0]
    files.run.parent.mkdir(parents=True)
    kill(files)
    assert files.state is State.STOPPED
    assert bench.run("--only", files.cell.name) == 0
    calls = bench.calls()
    assert [call[: len(e)] for call, e in zip(calls, expected, strict=True)] == expected
    assert files.state is State.DONE


def test_a_resumed_training_gets_the_minutes_that_are_left(bench: Bench) -> None:
    files = bench.cells()[0]
    files.run.parent.mkdir(parents=True)
    killed_in_training(files)
    assert bench.run("--only", files.cell.name) == 0
    train = bench.calls()[0]
    assert train[-2:] == ["--minutes", "0.500"]


def test_a_cell_that_another_process_works_at_is_left_alone(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    files, other = bench.cells()[:2]
    files.run.parent.mkdir(parents=True)
    files.begin()
    released = []

    def tick(_at_work: int) -> None:
        if other.state is State.DONE and not released:
            assert files.state is State.RUNNING
            assert bench.run("--list") == 0
            log.close()
            released.append(True)

    with files.log.open("ab") as log:
        assert lock(log)
        runner.run_cells([files, other], 1, "", runner.StopSignal(), tick)
    assert released
    assert files.state is State.DONE
    assert f"running  {files.cell.name}\ndone     {other.cell.name}\n" in capsys.readouterr().out


def test_list_does_nothing(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.run("--list", "--only", "*-seed1-*") == 0
    assert not bench.out.exists()
    assert capsys.readouterr().out.splitlines() == [
        f"missing  {files.cell.name}" for files in bench.cells() if files.cell.seed == 1
    ]


def test_a_pattern_without_cells_is_refused(bench: Bench) -> None:
    with pytest.raises(ConfigError, match="no cell is named like 'small-"):
        bench.run("--only", "small-*")


# -- what is shown -----------------------------------------------------------------------


def result(cell: Cell, steps: int | None) -> dict[str, object]:
    at = None if steps is None else {"learner_steps": steps, "seconds": 60.0}
    rates = ("0.5", "0.8", "0.9", "0.93", "0.94")
    test = {"success_rate": 0.25, "episodes": 3, "seed": 5}
    return {
        "reached": dict.fromkeys(rates, at),
        "last": test,
        "best": test,
        "evaluate": {"final": test, "best": test},
    }


def test_a_cell_that_never_reached_a_rate_counts_as_later(bench: Bench) -> None:
    bench.write(GRID.replace("[0, 1]", "[0, 1, 2]").replace("[2, 3]", "[2]"))
    cells = bench.cells()
    cells[0].run.parent.mkdir(parents=True)
    for files, steps in zip(cells, (9_000, 12_345, None, 7, None, None), strict=True):
        path = files.run.with_name(f"{files.run.name}.done")
        path.write_text(json.dumps(result(files.cell, steps)))
    shown = table(cells)
    assert "12 345 steps, 1.0 min (2 of 3)" in shown
    assert "| big | 2 | 3 of 3 | – (1 of 3) |" in shown
    assert "25.0 % (25.0–25.0; 3)" in shown
    assert "Missing" not in shown


def test_time_left_is_that_of_the_pace_so_far() -> None:
    assert time_left(60.0, 0.5, 1.5) == "0:03:00"
    assert time_left(60.0, 0.0, 1.5) == "unknown time"


# -- grids to start from -----------------------------------------------------------------

GRIDS = sorted((Path(__file__).parents[3] / "experiments").glob("*.toml"))


@pytest.mark.parametrize("path", GRIDS, ids=lambda path: path.stem)
def test_the_grids_to_start_from_are_whole_and_described(path: Path) -> None:
    assert read_grid(path)
    assert f"[{path.name}]({path.name})" in path.with_name("README.md").read_text("utf-8")
