"""The paper's claims, what decides on each, and its verdict; docs/reproduction.md lists them.

Invariants: every claim has a verdict, also where nothing was run; a verdict follows from numbers
alone, by the rules of `statistics`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from mrcdrl.services.tools.reproduce.printed import (
    BEST_WEIGHT,
    KINDS,
    NAMES,
    TABLE1,
    TABLE2,
)
from mrcdrl.services.tools.reproduce.protocol import TESTED_ROBOTS
from mrcdrl.services.tools.reproduce.runs import (
    Result,
    Runs,
    overestimation,
    success,
    training_average,
    variance,
)
from mrcdrl.services.tools.reproduce.statistics import (
    MIN_SEEDS,
    Comparison,
    Verdict,
    compare,
    holm,
    interval,
    verdict,
    verdict_of_best,
    verdict_of_equality,
    verdict_of_level,
)

Measure = Callable[[Result], float]


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim of the paper, and what the runs say of it."""

    number: str
    text: str
    where: str  # in the paper
    paper: str  # what it prints; empty if nothing
    ours: str
    seeds: int  # of each side; the smallest number
    verdict: Verdict

    @property
    def answer(self) -> str:
        """The verdict, and whether it is for want of seeds."""
        few = self.verdict is Verdict.INCONCLUSIVE and self.seeds < MIN_SEEDS
        return f"{self.verdict}, fewer than {MIN_SEEDS} seeds" if few else str(self.verdict)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two kinds compared; the paper says that the first is better."""

    first: str
    second: str
    papers: float | None  # difference that the paper prints

    @property
    def name(self) -> str:
        return f"{NAMES[self.first]} – {NAMES[self.second]}"


def judge(runs: Runs) -> list[Claim]:
    """Give a verdict on each claim, in the order of docs/reproduction.md."""
    return [
        *_test(runs),
        _level(runs),
        *_variance(runs),
        *_training(runs),
        _similar(runs),
        *_overestimation(runs),
        _weight(runs),
        *_not_tested(),
    ]


def compare_kinds(
    runs: Runs, pairs: Sequence[Pair], robots: int, measure: Measure
) -> dict[Pair, tuple[Comparison, float]]:
    """Compare pairs of kinds; each with its p-value after Holm's correction over all of them."""
    compared = {
        pair: compare(
            [measure(result) for result in runs.kind(pair.first, robots)],
            [measure(result) for result in runs.kind(pair.second, robots)],
        )
        for pair in pairs
    }
    corrected = holm({pair.name: found.p_value for pair, found in compared.items()})
    return {pair: (found, corrected[pair.name]) for pair, found in compared.items()}


def test_pairs() -> tuple[Pair, Pair, Pair]:
    """The pairs of Table 2: the two of the main question, and the two ends."""
    averages = {kind: row.average for kind, row in TABLE2.items()}
    return (
        Pair("duel", "ddqn", averages["duel"] - averages["ddqn"]),
        Pair("ddqn", "dqn", averages["ddqn"] - averages["dqn"]),
        Pair("duel", "dqn", averages["duel"] - averages["dqn"]),
    )


HIGHER = "higher by {} points"


def told(found: Comparison, corrected: float, words: str = HIGHER) -> str:
    """A comparison in words, with a place for the difference."""
    difference, better = found.difference, found.improvement
    if math.isnan(difference.estimate):
        return "no runs"
    by = f"{difference.estimate:+.1f} ({difference.low:+.1f} to {difference.high:+.1f})"
    return (
        f"{words.format(by)}, "
        f"better with probability {better.estimate:.2f} ({better.low:.2f} to {better.high:.2f}), "
        f"p = {corrected:.3f}"
    )


def _test(runs: Runs) -> Iterator[Claim]:
    """Claims 1 to 3, of Table 2; Holm over the first two."""
    *family, ends = test_pairs()
    compared = compare_kinds(runs, family, TESTED_ROBOTS, success)
    compared |= compare_kinds(runs, [ends], TESTED_ROBOTS, success)
    for number, (pair, (found, p)) in enumerate(compared.items(), 1):
        text = f"{NAMES[pair.first]} succeeds more often than {NAMES[pair.second]} in the test"
        yield _claim(str(number), f"{text}, 4 robots", "Table 2", pair, found, p)


def _level(runs: Runs) -> Claim:
    """Claim 4: the level that Duel reaches."""
    found = interval([success(result) for result in runs.kind("duel", TESTED_ROBOTS)])
    papers, median = TABLE2["duel"].average, runs.median("duel", TESTED_ROBOTS)
    ours = "no runs"
    if median is not None:
        ours = (
            f"{found.estimate:.1f} % ({found.low:.1f} to {found.high:.1f}); "
            f"median seed {success(median):.1f} %"
        )
    return Claim(
        "4", "Duel reaches 92.33 of 100 in the test, 4 robots, to within 3 points", "Table 2",
        f"{papers:.2f} %", ours, found.seeds, verdict_of_level(found, papers),
    )  # fmt: skip


def _variance(runs: Runs) -> Iterator[Claim]:
    """Claims 5a and 5b: fewer differences between hundreds of the test, "robustness"."""
    pairs = [
        Pair("duel", other, TABLE2[other].variance - TABLE2["duel"].variance)
        for other in ("ddqn", "dqn")
    ]
    compared = compare_kinds(runs, pairs, TESTED_ROBOTS, lambda result: -variance(result))
    for letter, (pair, (found, p)) in zip("ab", compared.items(), strict=True):
        text = f"Duel's successes per 100 vary less than {NAMES[pair.second]}'s in the test"
        yield _claim(f"5{letter}", text, "Table 2", pair, found, p, "lower by {}")


def _training(runs: Runs) -> Iterator[Claim]:
    """Claims 6 and 7: training with 2 and 3 robots, over its last 1 000 episodes."""
    for number, robots in (("6", 2), ("7", 3)):
        rows = TABLE1[robots]
        pairs = [
            Pair("duel", other, rows["duel"].average - rows[other].average)
            for other in ("ddqn", "dqn")
        ]
        compared = compare_kinds(runs, pairs, robots, training_average)
        for letter, (pair, (found, p)) in zip("ab", compared.items(), strict=True):
            text = (
                f"Duel succeeds more often than {NAMES[pair.second]} in training, {robots} robots"
            )
            yield _claim(f"{number}{letter}", text, "Table 1", pair, found, p)


def _similar(runs: Runs) -> Claim:
    """Claim 8: training with 4 robots."""
    rows = TABLE1[4]
    pairs = [Pair(a, b, rows[a].average - rows[b].average) for b, a in combinations(KINDS, 2)]
    compared = compare_kinds(runs, pairs, 4, training_average)
    seeds = min(found.difference.seeds for found, _ in compared.values())
    ours = "; ".join(
        f"{pair.name} {found.difference.estimate:+.1f} "
        f"({found.difference.low:+.1f} to {found.difference.high:+.1f})"
        for pair, (found, _) in compared.items()
        if found.difference.seeds
    )
    paper = "; ".join(f"{pair.name} {pair.papers:+.2f}" for pair in pairs)
    return Claim(
        "8", "All three kinds do similarly in training, 4 robots", "Table 1, section 5.2",
        paper, ours or "no runs", seeds, verdict_of_equality(list(compared.values())),
    )  # fmt: skip


def _overestimation(runs: Runs) -> Iterator[Claim]:
    """Claims 9a to 9c: values of first states against returns, 4 robots."""
    pairs = [Pair("duel", "ddqn", None), Pair("duel", "dqn", None), Pair("ddqn", "dqn", None)]
    compared = compare_kinds(runs, pairs, TESTED_ROBOTS, lambda result: -overestimation(result))
    for letter, (pair, (found, p)) in zip("abc", compared.items(), strict=True):
        text = f"{NAMES[pair.first]} overestimates less than {NAMES[pair.second]}, 4 robots"
        words = "lower by {} % of a success's reward"
        yield _claim(f"9{letter}", text, "Fig. 7 a–c", pair, found, p, words)


def _weight(runs: Runs) -> Claim:
    """Claim 10: p of the reward on a target."""
    values = {
        p: [training_average(result) for result in runs.of(cells)]
        for p, cells in runs.plan.weights.items()
    }
    best = values.pop(BEST_WEIGHT, [])
    compared = {p: compare(best, others) for p, others in values.items()}
    corrected = holm({str(p): found.p_value for p, found in compared.items()})
    ours = "; ".join(
        f"to {p:g}: {found.difference.estimate:+.1f} "
        f"({found.difference.low:+.1f} to {found.difference.high:+.1f})"
        for p, found in compared.items()
        if found.difference.seeds
    )
    rivals = [(found, corrected[str(p)]) for p, found in compared.items()]
    return Claim(
        "10", "p = 0.7 is the best weight of the reward on a target", "Fig. 5", "no number",
        ours or "no runs", min((found.difference.seeds for found, _ in rivals), default=0),
        verdict_of_best(rivals) if rivals else Verdict.NOT_TESTED,
    )  # fmt: skip


def _not_tested() -> Iterator[Claim]:
    """Claims 11 to 13, on which these runs cannot decide."""
    why = {
        ("Duel needs more episodes of training with 4 robots", "Section 5.2"): "budgets are equal "
        "by design, and no run is ended by its successes",
        ("Scores are stable where the stopping rule ends training", "Section 5.2"): "the rule is "
        "off: it ends a run by its own result; Fig. 6 shows scores over the whole budget",
        ("Duel gives way, and leaves targets to others", "Figs. 8 and 10"): "a matter of looking: "
        "the same figures are drawn below, from starts that nobody chose",
    }
    for number, ((text, where), reason) in enumerate(why.items(), 11):
        yield Claim(str(number), text, where, "in words", reason, 0, Verdict.NOT_TESTED)


def _claim(
    number: str,
    text: str,
    where: str,
    pair: Pair,
    found: Comparison,
    corrected: float,
    words: str = HIGHER,
) -> Claim:
    """A claim that one kind is better."""
    paper = "no number" if pair.papers is None else f"{pair.papers:+.2f}"
    decided = verdict(found, corrected, pair.papers)
    seeds = found.difference.seeds
    return Claim(number, text, where, paper, told(found, corrected, words), seeds, decided)
