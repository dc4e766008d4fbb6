"""`mrcdrl reproduce`: the protocol's runs, verdicts on made-up results, the report on part of them.

tests/system/test_reproduce.py trains.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.plots import reproduction
from mrcdrl.services.plots.reproduction import Group, Training
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.grid import Cell
from mrcdrl.services.tools.reproduce import drawing, main
from mrcdrl.services.tools.reproduce.claims import judge
from mrcdrl.services.tools.reproduce.keeping import card, keep_weights
from mrcdrl.services.tools.reproduce.page import page
from mrcdrl.services.tools.reproduce.printed import KINDS
from mrcdrl.services.tools.reproduce.protocol import (
    PARTS,
    SCALES,
    SMOKE,
    Plan,
    Scale,
    plan,
)
from mrcdrl.services.tools.reproduce.report import write_report
from mrcdrl.services.tools.reproduce.runs import (
    Result,
    Runs,
    in_test,
    in_training,
    overestimation,
    success,
    training_average,
)
from mrcdrl.services.tools.reproduce.statistics import Verdict
from mrcdrl.services.tools.reproduce.tables import by_the_rule, table1, table2

ROOT = Path(__file__).parents[3]
CPU = plan(SCALES["cpu"])
SPREAD = (-1.0, 0.5, 0.0, 1.0, -0.5)  # of seeds around their kind's success


def learned(config: Config) -> dict[str, Any]:
    """What a run learns by, but for its seed."""
    values = config.model_dump(exclude={"transport", "run", "evaluator"})
    for section in ("learner", "replay"):
        del values[section]["seed"]
    return values


# -- the protocol ------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [*SCALES.values(), SMOKE], ids=lambda scale: scale.name)
def test_kinds_differ_in_their_kind_alone_and_have_equal_budgets(scale: Scale) -> None:
    planned = plan(scale)
    for robots in scale.budget:
        groups = [planned.kinds[kind, robots] for kind in KINDS]
        assert len({tuple(cell.seed for cell in group) for group in groups}) == 1
        for cells in zip(*groups, strict=True):
            each = [learned(cell.config) for cell in cells]
            assert [values["agent"].pop("kind") for values in each] == list(KINDS)
            assert each[0] == each[1] == each[2]
            for cell in cells:
                run, trial = cell.config.run, cell.trial
                assert run.learner_steps == scale.budget[robots]
                assert (run.minutes, run.target_success_rate, run.patience_episodes) == (0, 0, 0)
                assert (trial.episodes, trial.seed, trial.values) == (scale.episodes, 0, True)
                assert cell.config.arena.numbers == (robots,)


def test_the_rate_falls_over_each_budget_as_quicks_does_over_that_of_four_robots() -> None:
    quick = load_config("quick", environ={}).agent.learning_rate_schedule
    for group in plan(SCALES["cpu"]).kinds.values():
        for cell in group:
            budget = cell.config.run.learner_steps
            for share in np.linspace(0, 1, 21):
                found = value_at(cell.config.agent.learning_rate_schedule, share * budget)
                assert found == pytest.approx(value_at(quick, share * 30_000))


@pytest.mark.parametrize("scale", [*SCALES.values(), SMOKE], ids=lambda scale: scale.name)
def test_no_run_is_made_twice(scale: Scale) -> None:
    planned = plan(scale)
    every = planned.part("all")
    assert len({cell.digest for cell in every}) == len(every)
    named = {cell.name for part in PARTS for cell in planned.part(part)}
    assert named == {cell.name for cell in every}


def test_the_runs_that_are_kept_are_runs_of_the_protocol() -> None:
    """A preset that changes must not make other runs of those that were planned."""
    kept = ROOT / "benchmarks" / "results" / "reproduction"
    done = {path.stem for path in (kept / "cpu" / "cells").glob("*.done")}
    assert done
    assert done <= {cell.name for cell in CPU.part("all")}


def test_the_numbers_of_seeds_are_those_of_the_page() -> None:
    assert {kind: len(CPU.kinds[kind, 4]) for kind in KINDS} == dict.fromkeys(KINDS, 5)
    assert len(plan(SCALES["gpu"]).kinds["duel", 4]) == 10
    assert list(CPU.weights) == [0.1, 0.3, 0.5, 0.7, 0.9]
    assert CPU.weights[0.7] == CPU.kinds["dqn", 2][:3]
    for p, cells in CPU.weights.items():
        assert [cell.config.arena.proximity_weight for cell in cells] == [p] * 3
        assert {cell.config.agent.kind for cell in cells} == {"dqn"}


@pytest.mark.parametrize("scale", SCALES.values(), ids=lambda scale: scale.name)
def test_budgets_and_seeds_are_those_of_the_page(scale: Scale) -> None:
    text = (ROOT / "docs" / "reproduction.md").read_text("utf-8")
    (row,) = [line for line in text.splitlines() if line.startswith(f"| `{scale.name}` | ")]
    if scale.name != "gpu":  # "the same" as cpu
        for steps in scale.budget.values():
            assert f"{steps:_}".replace("_", " ") in row
    for seeds in scale.seeds.values():
        assert f"{min(seeds)} to {max(seeds)}" in row


def test_the_rule_changes_a_rate_for_more_than_three_points() -> None:
    assert by_the_rule({0.5: [90.0], 1.0: [92.0], 2.0: [94.9]}, 1.0) == "keep × 1"
    assert by_the_rule({0.5: [90.0], 1.0: [92.0], 2.0: [95.1]}, 1.0).startswith("change to × 2")
    assert by_the_rule({0.5: [90.0], 1.0: [92.0], 2.0: [95.1]}, 2.0) == "keep × 2"
    assert by_the_rule({1.0: [92.0], 2.0: []}, 1.0) == "not all runs are there"


def test_the_sweep_is_equal_for_all_kinds_and_on_other_seeds() -> None:
    used = {cell.seed for cells in CPU.kinds.values() for cell in cells}
    rate = CPU.kinds["dqn", 2][0].config.agent.learning_rate
    assert {kind for kind, _ in CPU.sweep} == set(KINDS)
    for (kind, factor), cells in CPU.sweep.items():
        assert {cell.config.agent.learning_rate for cell in cells} == {factor * rate}
        assert {cell.config.agent.kind for cell in cells} == {kind}
        assert {cell.seed for cell in cells}.isdisjoint(used)


def test_the_compressed_scale_is_an_eighth_of_the_papers() -> None:
    compressed, paper = (plan(SCALES[name]).kinds["duel", 4][0] for name in ("compressed", "paper"))
    short, whole = compressed.config, paper.config
    assert 8 * short.run.learner_steps == whole.run.learner_steps == 800_000
    assert whole.exploration.schedule[-1] == (800_000, 0.1)
    assert short.exploration.schedule[-1] == (100_000, 0.1)
    assert 8 * short.replay.capacity == whole.replay.capacity == 400_000
    assert 8 * short.replay.min_size == whole.replay.min_size == 50_000
    assert short.agent.target_period == whole.agent.target_period // 8
    assert (short.agent.n_step, short.agent.loss, short.agent.reward_scale) == (1, "squared", 1.0)
    assert short.replay.sampler == "uniform"
    assert short.learner.batch_size == 32


# -- verdicts ------------------------------------------------------------------------------


def made_up(
    cell: Cell, percent: float = 90.0, *, variance: float = 8.0, excess: float = 4.0
) -> Result:
    """A result whose success, in training and test, is given; excess: in rewards."""
    test = {
        "success_rate": percent / 100,
        "success_interval": [0.5, 1.0],
        "max_per_100": 97.0,
        "mean_per_100": percent,
        "variance_per_100": variance,
        "timeout_rate": 0.01,
        "episodes": 1100,
        "seed": 0,
        "outcomes": "s" * round(10 * percent) + "c" * (1000 - round(10 * percent)),
        "values": {"expected": 50.0, "realised": 50.0 - excess, "overestimation": excess},
        "navigation": {"collision_with_robot_rate": 0.04, "collision_with_wall_rate": 0.01},
    }
    hundreds = [0.0] * 10 + [percent] * 10
    return {
        "cell": cell.name,
        "seed": cell.seed,
        "robots": cell.robots,
        "learner_steps": 30_000,
        "wall_s": 1800.0,
        "machine": {"cpu": "a processor", "cores": 2},
        "versions": {"python": "3.11"},
        "training": {
            "successes": hundreds,
            "score": hundreds,
            "mean_q": hundreds,
            "learner_steps": list(range(20)),
        },
        "evaluate": {"final": test, "best": {**test, "mean_per_100": percent + 1}},
    }


def runs_with(
    successes: Mapping[str, float] | None = None,
    *,
    planned: Plan = CPU,
    seeds: int = 5,
    spread: Sequence[float] = SPREAD,
    by_weight: Mapping[float, float] | None = None,
    **more: Mapping[str, float],
) -> Runs:
    """Results by kind, with all numbers of robots, or by weight p."""
    results = {}
    for (kind, _), cells in planned.kinds.items():
        for cell in cells[:seeds]:
            if successes and kind in successes:
                off = spread[cell.seed]
                made = {name: values[kind] + off for name, values in more.items()}
                percent = successes[kind] + off
                results[cell.name] = made_up(cell, percent, **made)
    for p, average in (by_weight or {}).items():
        for cell in planned.weights[p]:
            results[cell.name] = made_up(cell, average + spread[cell.seed])
    return Runs(planned, results)


def verdicts(runs: Runs) -> dict[str, Verdict]:
    return {claim.number: claim.verdict for claim in judge(runs)}


def test_without_runs_no_claim_is_tested() -> None:
    assert set(verdicts(Runs(CPU, {})).values()) == {Verdict.NOT_TESTED}


PAPERS = {"dqn": 72.0, "ddqn": 86.1, "duel": 92.3}
CASES = {  # success of the three kinds, initials of the verdicts on claims 1 to 4
    "as in the paper": (PAPERS, "rrrr"),
    "equal": ({"dqn": 96.2, "ddqn": 96.0, "duel": 95.8}, "eeer"),
    "less apart": ({"dqn": 80.0, "ddqn": 90.5, "duel": 95.0}, "dddr"),
    "reversed": ({"dqn": 92.0, "ddqn": 86.0, "duel": 72.0}, "cccc"),
    "two only": ({"dqn": 92.0, "duel": 92.0}, "nner"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_verdict_on_the_test_is_that_of_the_numbers(case: str) -> None:
    successes, expected = CASES[case]
    found = verdicts(runs_with(successes))
    assert "".join(found[number][0] for number in "1234") == expected


def test_a_wide_interval_is_inconclusive() -> None:
    wide = (-20.0, 10.0, 0.0, 20.0, -10.0)
    found = verdicts(runs_with({"dqn": 68.0, "ddqn": 70.0, "duel": 78.0}, spread=wide))
    assert [found[n] for n in "123"] == [Verdict.INCONCLUSIVE] * 3


def test_few_seeds_are_inconclusive_whatever_they_say() -> None:
    found = verdicts(runs_with(PAPERS, seeds=4))
    tested = {n for n, v in found.items() if v is not Verdict.NOT_TESTED}
    assert tested == set(found) - {"10", "11", "12", "13"}
    assert {found[n] for n in tested} == {Verdict.INCONCLUSIVE}


def test_a_smaller_variance_and_a_smaller_overestimate_are_better() -> None:
    even = dict.fromkeys(KINDS, 90.0)
    found = verdicts(
        runs_with(
            even,
            variance={"dqn": 33.2, "ddqn": 13.2, "duel": 6.3},
            excess={"dqn": 60.0, "ddqn": 30.0, "duel": 2.0},
        )
    )
    assert [found[n] for n in ("5a", "5b")] == [Verdict.REPRODUCED] * 2
    assert [found[n] for n in ("9a", "9b", "9c")] == [Verdict.REPRODUCED] * 3
    found = verdicts(
        runs_with(
            even,
            variance={"dqn": 6.0, "ddqn": 13.0, "duel": 14.0},
            excess={"dqn": 2.0, "ddqn": 3.0, "duel": 60.0},
        )
    )
    assert (found["5a"], found["5b"]) == (Verdict.EQUAL, Verdict.CONTRADICTED)
    assert [found[n] for n in ("9a", "9b", "9c")] == [
        Verdict.CONTRADICTED,
        Verdict.CONTRADICTED,
        Verdict.EQUAL,
    ]


def test_training_is_judged_by_its_last_thousand_episodes() -> None:
    found = verdicts(runs_with({"dqn": 90.7, "ddqn": 90.2, "duel": 94.3}))
    assert [found[n] for n in ("6a", "6b", "8")] == [
        Verdict.REPRODUCED,
        Verdict.REPRODUCED,
        Verdict.CONTRADICTED,
    ]
    found = verdicts(runs_with(dict.fromkeys(KINDS, 83.0)))
    assert (found["7a"], found["8"]) == (Verdict.EQUAL, Verdict.REPRODUCED)


def test_three_seeds_of_each_weight_give_no_verdict() -> None:
    best = dict.fromkeys(CPU.weights, 40.0) | {0.7: 90.0}
    assert verdicts(runs_with(by_weight=best))["10"] is Verdict.INCONCLUSIVE
    assert verdicts(runs_with({"dqn": 90.0}))["10"] is Verdict.NOT_TESTED


# -- what runs measure ---------------------------------------------------------------------


def test_the_measures_of_a_run() -> None:
    result = made_up(CPU.kinds["duel", 4][0], 80.0, excess=10.0)
    assert success(result) == pytest.approx(80.0)
    assert overestimation(result) == pytest.approx(5.0)
    assert training_average(result) == 80.0
    all_of_it = in_training(result)
    assert all_of_it is not None
    assert (all_of_it.maximum, all_of_it.average, all_of_it.variance) == (80.0, 40.0, 1600.0)
    best = in_test(result, "best")
    assert best is not None
    assert best.average == 81.0
    short = {**result, "training": {"successes": []}, "evaluate": {"best": None}}
    assert in_training(short) is in_test(short, "best") is None
    assert training_average(short) == 0.0


def test_the_median_run_of_two_is_the_lesser() -> None:
    runs = runs_with({"duel": 90.0})
    median = runs.median("duel", 4)
    assert median is not None
    assert median["seed"] == 2
    two = runs_with({"duel": 90.0}, seeds=2).median("duel", 4)
    assert two is not None
    assert two["seed"] == 0
    assert runs.median("dqn", 4) is None


# -- tables, figures, pages ----------------------------------------------------------------


def test_every_cell_of_a_table_tells_its_number_of_seeds() -> None:
    runs = runs_with({"duel": 90.0, "ddqn": 88.0}, seeds=3)
    for table, rows in ((table1(runs), 18), (table2(runs), 6)):
        lines = [line for line in table.splitlines()[2:] if "n = " in line]
        assert len(lines) == rows
        for line in lines:
            assert line.count("n = 3") == 2
            assert line.count("– (n = 0)") == 1
    assert "| 89.83 (89.0 – 90.5; n = 3) | 94.26 |" in table1(runs)
    assert "90.00 (seed 2)" in table2(runs)


def test_figures_are_drawn_from_any_number_of_runs(tmp_path: Path) -> None:
    def run(hundreds: int) -> Training:
        rising = np.linspace(0, 90, hundreds)
        return Training(rising, 2 * rising, 3 * rising)

    files = [tmp_path / f"{number}.png" for number in range(9)]
    reproduction.weights({}, files[0])
    reproduction.weights({0.1: [run(30), run(1)], 0.7: [run(0)]}, files[1])
    reproduction.training(None, "no run", files[2])
    reproduction.training(run(40), "a run", files[3])
    reproduction.kinds({2: [Group("DQN", [run(1)])], 4: [Group("Duel", [])]}, files[4])
    reproduction.test({"Duel": [True] * 550, "DQN": [True] * 99}, files[5])
    reproduction.test({}, files[6])
    reproduction.overestimation({2: {"DQN": [], "Duel": [1.0, 2.0]}}, files[7])
    reproduction.overestimation({4: {"DQN": []}}, files[8])
    for file in files:
        with Image.open(file) as image:
            assert len(np.unique(np.asarray(image.convert("L")))) > 20


def test_fig_10_shows_where_the_kinds_differ() -> None:
    class Played:
        def __init__(self, won: bool) -> None:
            self.outcome = Outcome.SUCCESS if won else Outcome.COLLISION

    def row(text: str) -> list[Any]:
        return [Played(letter == "s") for letter in text]

    assert drawing.columns([row("ssssscss"), row("sssscsss"), row("sscsssss")]) == [0, 1, 2, 4]
    assert drawing.columns([row("sscs"), row("sscs")]) == [0, 1, 2, 3]
    assert drawing.columns([row("sc"), row("cs")]) == [0, 1]


def test_a_page_stands_alone(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"image")
    text = "# A *title* & more\n\n| a | b |\n|---|---|\n| 1 | `x<y` |\n\n![what](a.png)\n\n<b>\n"
    made = page(text, tmp_path)
    assert f'src="data:image/png;base64,{base64.b64encode(b"image").decode()}"' in made
    assert "<td><code>x&lt;y</code></td>" in made
    assert "&lt;b&gt;" in made
    assert "http" not in made.replace("https://www.w3.org", "")
    assert 'alt="what"' in made


def claims_of(report: str) -> list[str]:
    """Lines of the table of claims."""
    part = report.split("## Each claim")[1].split("\n\n")[1]
    return part.splitlines()[2:]


@pytest.mark.parametrize("seeds", [0, 2, 5])
def test_a_report_says_what_is_missing(seeds: int, tmp_path: Path) -> None:
    runs = runs_with(PAPERS, seeds=seeds)
    files = [CellFiles(cell, tmp_path) for cell in CPU.part("all")]
    claims = write_report(runs, files, tmp_path)
    report = (tmp_path / "report.md").read_text("utf-8")
    assert len(claims_of(report)) == len(claims) == 18
    missing = [files.cell.name for files in files if files.cell.name not in runs.results]
    assert f"## Missing: {len(missing)} runs" in report
    for name in missing:
        assert f"- `{name}`: missing" in report
    for each in files:
        assert f"--scale cpu --out again --only {each.cell.name}`" in report
    assert "Missing: no weights are kept yet." in report
    assert ("**reproduced**" in report) == (seeds == 5)
    made = (tmp_path / "report.html").read_text("utf-8")
    assert made.count("<table>") == report.count("\n| ---")


def test_what_differs_from_the_papers_settings_is_told(tmp_path: Path) -> None:
    runs = Runs(plan(SCALES["compressed"]), {})
    write_report(runs, [], tmp_path)
    report = (tmp_path / "report.md").read_text("utf-8")
    assert "| `replay.capacity` | `400000` | `50000` |" in report
    assert "| `arena.renderer` | `literal` | `analytic` |" in report
    assert "`agent.n_step`" not in report


def test_a_card_says_how_weights_fail() -> None:
    text = card(made_up(CPU.kinds["ddqn", 4][1], 95.0), "ddqn-4robots")
    assert "# DDQN, 4 robots" in text
    assert "seed 1" in text
    assert "95.0 % of 1100 starts" in text
    assert "4.0 % end by a robot that hits a robot, 1.0 %\nby one that hits a wall" in text


def test_weights_of_a_run_that_is_gone_are_said_to_be_missing(tmp_path: Path) -> None:
    runs = runs_with({"duel": 90.0})
    said = list(keep_weights(runs, tmp_path))
    assert len(said) == 3  # numbers of robots
    assert all("the run's folder is gone" in line for line in said)
    assert not (tmp_path / "weights").exists()


# -- the command ---------------------------------------------------------------------------


def test_list_names_the_runs_of_a_part(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    where = ["--out", str(tmp_path / "out")]
    assert main.main(["table2", "--list", *where]) == 0
    names = [line.split()[1] for line in capsys.readouterr().out.splitlines()]
    assert names == [cell.name for cell in CPU.part("table2")]
    assert main.main(["fig5", "--list", "--json", "--only", "dqn-p10-*", *where]) == 0
    states = json.loads(capsys.readouterr().out)
    assert len(states) == 3
    assert set(states.values()) == {"missing"}
    assert not (tmp_path / "out").exists()


def test_a_report_is_made_before_the_first_run_and_shows_no_older_episodes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "fig10.png").write_bytes(b"of other weights")
    assert main.main(["report", "--smoke", "--json", "--out", str(tmp_path)]) == 0
    claims = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {claim["verdict"] for claim in claims} == {Verdict.NOT_TESTED}
    assert "## Missing: 7 runs" in (tmp_path / "report.md").read_text("utf-8")
    assert (tmp_path / "results.jsonl").read_bytes() == b""
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"fig1", "fig5", "fig6", "fig7", "fig9", "overestimation"}


def test_a_part_without_runs_is_refused() -> None:
    with pytest.raises(ConfigError, match="scale compressed has no runs for fig5"):
        main.main(["fig5", "--scale", "compressed"])
    with pytest.raises(ConfigError, match="named like 'sarsa-"):
        main.main(["--only", "sarsa-*"])


def test_all_claims_are_on_the_protocols_page() -> None:
    text = (ROOT / "docs" / "reproduction.md").read_text("utf-8")
    table = text.split("## The claims")[1].split("##")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("|")][2:]
    numbers = [number.strip() for row in rows for number in row.split(",")]
    assert numbers == [claim.number for claim in judge(Runs(CPU, {}))]
