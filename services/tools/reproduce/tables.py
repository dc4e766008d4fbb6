"""The report's tables as Markdown: ours beside the paper's, with the number of seeds in each cell.

Invariants: what is missing is a dash with n = 0, never a guess.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

from mrcdrl.services.tools.experiment.grid import BEST, FINAL
from mrcdrl.services.tools.reproduce.claims import Claim, compare_kinds, test_pairs, told
from mrcdrl.services.tools.reproduce.printed import KINDS, NAMES, TABLE1, TABLE2, Row
from mrcdrl.services.tools.reproduce.protocol import RATES, TESTED_ROBOTS
from mrcdrl.services.tools.reproduce.runs import (
    LAST_HUNDREDS,
    Result,
    Runs,
    in_test,
    in_training,
    success,
)
from mrcdrl.services.tools.reproduce.statistics import EQUAL, interval

_ROWS = ("maximum", "average", "variance")
_COLUMNS = [f"{NAMES[kind]}{whose}" for kind in KINDS for whose in ("", ", paper")]


def claims_table(claims: Sequence[Claim]) -> str:
    """Every claim with its verdict."""
    head = ("", "claim", "where", "paper", "ours", "n", "verdict")
    rows = (
        (c.number, c.text, c.where, c.paper, c.ours, str(c.seeds), f"**{c.answer}**")
        for c in claims
    )
    return markdown(head, rows)


def table2(runs: Runs) -> str:
    """The test: final weights, and the best by another test."""
    rows = [
        _row(f"final weights, {name}", TABLE2, name, runs, TESTED_ROBOTS, _final) for name in _ROWS
    ]
    rows += [
        _row(f"best weights, {name}", TABLE2, name, runs, TESTED_ROBOTS, _best) for name in _ROWS
    ]
    median = [runs.median(kind, TESTED_ROBOTS) for kind in KINDS]
    cells = [
        cell
        for kind, run in zip(KINDS, median, strict=True)
        for cell in (
            "–" if run is None else f"{success(run):.2f} (seed {run['seed']})",
            f"{TABLE2[kind].average:.2f}",
        )
    ]
    rows.append(["final weights of the median seed, average", *cells])
    return markdown(("successes per 100 starts", *_COLUMNS), rows)


def table1(runs: Runs) -> str:
    """Training, from the first episode and over the last 1 000."""
    rows = []
    for robots, printed in TABLE1.items():
        spans = (("last 1 000 episodes", _at_the_end), ("from the first episode", _from_the_first))
        for span, measure in spans:
            for name in _ROWS:
                title = f"{robots} robots, {span}, {name}"
                rows.append(_row(title, printed, name, runs, robots, measure))
    return markdown(("successes per 100 episodes", *_COLUMNS), rows)


def comparisons(runs: Runs) -> str:
    """The pairs of Table 2, in the test with 4 robots."""
    *family, ends = test_pairs()
    compared = compare_kinds(runs, family, TESTED_ROBOTS, success)
    compared |= compare_kinds(runs, [ends], TESTED_ROBOTS, success)
    rows = (
        (pair.name, f"{pair.papers:+.2f}", told(found, p), str(found.difference.seeds))
        for pair, (found, p) in compared.items()
    )
    return markdown(("difference of success", "paper", "ours", "n"), rows)


def values_table(runs: Runs) -> str:
    """Values of first states, discounted returns, and their difference, in rewards."""
    numbers = sorted({robots for _, robots in runs.plan.kinds})
    rows = []
    for robots in numbers:
        for kind in KINDS:
            found = [r["evaluate"][FINAL]["values"] for r in runs.kind(kind, robots)]
            cells = [
                _summary([values[name] for values in found])
                for name in ("expected", "realised", "overestimation")
            ]
            rows.append([f"{robots} robots, {NAMES[kind]}", *cells])
    return markdown(("", "Q(s₀)", "discounted return", "overestimation"), rows)


def weights_table(runs: Runs) -> str:
    """Each p of Fig. 5, at the end of training and in the test."""
    rows = []
    for p, cells in runs.plan.weights.items():
        results = runs.of(cells)
        last = [row.average for row in map(_at_the_end, results) if row is not None]
        rows.append([f"{p:g}", _summary(last), _summary([success(r) for r in results])])
    return markdown(("p", "training, last 1 000 episodes", "test"), rows)


def sweep_table(runs: Runs) -> str:
    """Success by kind and factor of the learning rate, and what the protocol's rule says."""
    factors = sorted({factor for _, factor in runs.plan.sweep})
    rows = []
    for kind in KINDS:
        found = {f: [success(r) for r in runs.of(runs.plan.sweep[kind, f])] for f in factors}
        cells = [_summary(values) for values in found.values()]
        rows.append([NAMES[kind], *cells, by_the_rule(found, RATES[kind])])
    head = ("test, per cent", *(f"rate × {factor:g}" for factor in factors), "by the rule")
    return markdown(head, rows)


def by_the_rule(found: Mapping[float, Sequence[float]], used: float) -> str:
    """Whether the factor that is used stays, given successes in per cent by factor."""
    if not all(found.values()):
        return "not all runs are there"
    estimates = {factor: interval(values).estimate for factor, values in found.items()}
    best = max(estimates, key=lambda factor: estimates[factor])
    if estimates[best] - estimates[used] > EQUAL:
        return f"change to × {best:g}, and train again"
    return f"keep × {used:g}"


def markdown(head: Sequence[str], rows: Iterator[Sequence[str]] | Sequence[Sequence[str]]) -> str:
    """A table; cells hold no line breaks."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _row(
    title: str,
    printed: dict[str, Row],
    name: str,
    runs: Runs,
    robots: int,
    measure: Callable[[Result], Row | None],
) -> list[str]:
    cells = [title]
    for kind in KINDS:
        found = [row for row in map(measure, runs.kind(kind, robots)) if row is not None]
        cells += [_summary([getattr(row, name) for row in found])]
        cells += [f"{getattr(printed[kind], name):g}"]
    return cells


def _summary(values: Sequence[float]) -> str:
    """Interquartile mean over seeds with its interval, such as "94.2 (92.0–95.1; n = 5)"."""
    found = interval(values)
    if math.isnan(found.estimate):
        return "– (n = 0)"
    return f"{found.estimate:.2f} ({found.low:.1f} – {found.high:.1f}; n = {found.seeds})"


def _final(result: Result) -> Row | None:
    return in_test(result, FINAL)


def _best(result: Result) -> Row | None:
    return in_test(result, BEST)


def _at_the_end(result: Result) -> Row | None:
    return in_training(result, LAST_HUNDREDS)


def _from_the_first(result: Result) -> Row | None:
    return in_training(result)
