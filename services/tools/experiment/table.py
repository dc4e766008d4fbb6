"""The results of a grid as a Markdown table: a row for each variant and number of robots.

Invariants: what is missing is named, never guessed; a cell that never reached a rate counts as
later than all that did.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from mrcdrl.services.tools.experiment.cell import RATES, CellFiles
from mrcdrl.services.tools.experiment.grid import Cell

Results = Sequence[dict[str, Any]]


def table(cells: Sequence[CellFiles]) -> str:
    """Medians over the seeds, with the number of cells that each stands for."""
    trial = cells[0].cell.trial
    starts = [f"{name} weights, {trial.episodes} starts" for name in trial.weights]
    costs = [f"to {100 * rate:.0f} %" for rate in RATES]
    head = ["variant", "robots", "done", *costs, "last", "best", *starts]
    lines = [_row(head), "|---" * len(head) + "|\n"]
    for (variant, robots), group in itertools.groupby(cells, _group):
        members = list(group)
        results = [r for r in (files.result() for files in members) if r is not None]
        lines.append(_row(_figures(variant, robots, len(members), results, trial.weights)))
    missing = [f"- `{files.cell.name}`: {_why(files)}" for files in cells if not files.result()]
    if missing:
        lines += ["\nMissing:\n\n", *(f"{line}\n" for line in missing)]
    return "".join(lines)


def _group(files: CellFiles) -> tuple[str, int]:
    cell: Cell = files.cell
    return cell.variant, cell.robots


def _figures(
    variant: str, robots: int, num: int, results: Results, weights: Sequence[str]
) -> Iterator[str]:
    yield from (variant, str(robots), f"{len(results)} of {num}")
    for rate in RATES:
        yield _cost([result["reached"][f"{rate:g}"] for result in results])
    for name in ("last", "best"):
        yield _success([result[name] for result in results])
    for name in weights:
        yield _success([result["evaluate"][name] for result in results])


def _cost(reached: Sequence[dict[str, float] | None]) -> str:
    """Median learner steps and minutes, such as "9 756 steps, 6.4 min (3 of 3)"."""
    if not reached:
        return "(0)"
    counted = f"({sum(r is not None for r in reached)} of {len(reached)})"
    steps = median(math.inf if r is None else r["learner_steps"] for r in reached)
    minutes = median(math.inf if r is None else r["seconds"] / 60 for r in reached)
    if math.isinf(steps):
        return f"– {counted}"
    return f"{steps:_.0f} steps, {minutes:.1f} min {counted}".replace("_", " ")


def _success(tests: Sequence[dict[str, Any] | None]) -> str:
    """Median success, with the least and the greatest, such as "97.0 % (94.0–98.0; 3)"."""
    rates = [100 * test["success_rate"] for test in tests if test is not None]
    if not rates:
        return "(0)"
    return f"{median(rates):.1f} % ({min(rates):.1f}–{max(rates):.1f}; {len(rates)})"


def _why(files: CellFiles) -> str:
    """Its state, and why it failed."""
    return f"{files.state}, {files.failure}" if files.failure else str(files.state)


def _row(cells: Iterator[str] | Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |\n"
