"""The results of a plan's runs, and what they measure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, pvariance
from typing import Any

from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.experiment.grid import FINAL, Cell
from mrcdrl.services.tools.reproduce.printed import SUCCESS_REWARD, Row
from mrcdrl.services.tools.reproduce.protocol import Plan

Result = Mapping[str, Any]  # a line of results.jsonl
LAST_HUNDREDS = 10  # of training, for Table 1


@dataclass(frozen=True, slots=True)
class Runs:
    """A plan and the results that are there, by the name of their cell."""

    plan: Plan
    results: Mapping[str, Result]

    def of(self, cells: Sequence[Cell]) -> list[Result]:
        """Results of these cells, in the order of their seeds; those missing are left out."""
        found = [self.results.get(cell.name) for cell in cells]
        return [result for result in found if result is not None]

    def kind(self, kind: str, robots: int) -> list[Result]:
        """Results of a kind with a number of robots."""
        return self.of(self.plan.kinds.get((kind, robots), ()))

    def median(self, kind: str, robots: int) -> Result | None:
        """The run whose final weights have the median success, of two the lesser; None of none."""
        ranked = sorted(self.kind(kind, robots), key=success)
        return ranked[(len(ranked) - 1) // 2] if ranked else None


def read_runs(plan: Plan, files: Sequence[CellFiles]) -> Runs:
    """Read the results of all cells that are done."""
    found = {each.cell.name: each.result() for each in files}
    return Runs(plan, {name: result for name, result in found.items() if result is not None})


def success(result: Result) -> float:
    """Success of the final weights in the test, per cent."""
    return 100 * float(result["evaluate"][FINAL]["success_rate"])


def variance(result: Result) -> float:
    """Variance of the final weights' successes per 100 starts."""
    return float(result["evaluate"][FINAL]["variance_per_100"])


def in_test(result: Result, weights: str) -> Row | None:
    """Successes per 100 starts of the test; None without such weights."""
    test = result["evaluate"].get(weights)
    if test is None:
        return None
    return Row(test["max_per_100"], test["mean_per_100"], test["variance_per_100"])


def in_training(result: Result, last: int = 0) -> Row | None:
    """Successes per 100 training episodes, of the last hundreds or of all; None of none."""
    hundreds = result["training"]["successes"][-last:]
    if not hundreds:
        return None
    return Row(max(hundreds), fmean(hundreds), pvariance(hundreds))


def training_average(result: Result) -> float:
    """Successes per 100 episodes over the last 1 000 of training; 0 if there were none."""
    row = in_training(result, LAST_HUNDREDS)
    return 0.0 if row is None else row.average


def overestimation(result: Result) -> float:
    """Value of the first state minus the discounted return, in per cent of a success's reward."""
    return 100 * float(result["evaluate"][FINAL]["values"]["overestimation"]) / SUCCESS_REWARD
