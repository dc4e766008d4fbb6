"""Statistics over seeds, with rliable and SciPy as oracles."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from rliable import library, metrics
from scipy import stats

from mrcdrl.services.tools.reproduce.statistics import (
    Comparison,
    Interval,
    Verdict,
    compare,
    holm,
    interquartile_mean,
    interval,
    permutation_test,
    probability_of_improvement,
    verdict,
    verdict_of_best,
    verdict_of_equality,
    verdict_of_level,
)

GOOD = (94.2, 96.1, 91.7, 97.0, 95.5)
POOR = (90.3, 88.9, 95.5, 84.0, 91.7)


def column(values: Sequence[float]) -> np.ndarray:
    """Scores as rliable takes them: runs x tasks."""
    return np.array(values)[:, None]


@pytest.mark.parametrize("n", range(1, 12))
def test_the_interquartile_mean_is_rliables(n: int) -> None:
    values = np.random.default_rng(n).normal(90, 5, n)
    assert interquartile_mean(values) == pytest.approx(metrics.aggregate_iqm(column(values)))


@pytest.mark.filterwarnings("ignore:random_state is deprecated:FutureWarning")
def test_an_interval_is_rliables_up_to_the_draw_of_resamples() -> None:
    _, intervals = library.get_interval_estimates(
        {"good": column(GOOD)},
        lambda scores: np.array([metrics.aggregate_iqm(scores)]),
        reps=10_000,
        random_state=np.random.RandomState(1),
    )
    found = interval(GOOD)
    assert found.seeds == 5
    assert (found.low, found.high) == pytest.approx(tuple(intervals["good"][:, 0]), abs=0.3)
    assert found == interval(GOOD)


def test_the_probability_of_improvement_is_rliables_and_counts_ties_half() -> None:
    expected = metrics.probability_of_improvement(column(GOOD), column(POOR))
    found = probability_of_improvement(np.array(GOOD), np.array(POOR))
    assert found == pytest.approx(expected)
    assert found == (4 + 5 + 3.5 + 5 + 4.5) / 25
    assert probability_of_improvement(np.array(GOOD), np.array(GOOD)) == 0.5


def test_all_permutations_are_scipys() -> None:
    expected = stats.permutation_test(
        (GOOD, POOR), lambda a, b: np.mean(a) - np.mean(b), n_resamples=np.inf
    )
    assert permutation_test(np.array(GOOD), np.array(POOR)) == pytest.approx(expected.pvalue)
    apart = permutation_test(np.arange(5.0) + 10, np.arange(5.0))
    assert apart == 2 / math.comb(10, 5)


def test_a_sample_of_permutations_comes_near_all() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.normal(0.8, 1, 12), rng.normal(0, 1, 12)
    expected = stats.ttest_ind(first, second).pvalue
    assert permutation_test(first, second) == pytest.approx(expected, abs=0.02)


def test_holm_corrects_in_order_and_leaves_out_what_was_not_tested() -> None:
    corrected = holm({"a": 0.04, "b": 0.01, "c": 0.03, "d": math.nan})
    assert corrected["b"] == pytest.approx(0.03)
    assert corrected["c"] == pytest.approx(0.06)
    assert corrected["a"] == pytest.approx(0.06)  # never below one that ranks before
    assert math.isnan(corrected["d"])
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0}


def comparison(low: float, estimate: float, high: float) -> Comparison:
    return Comparison(Interval(estimate, low, high, 5), Interval(0.5, 0.0, 1.0, 5), 0.5)


@pytest.mark.parametrize(
    ("low", "estimate", "high", "p", "expected"),
    [
        (2.0, 6.0, 9.0, 0.01, Verdict.REPRODUCED),  # 6.19 is among them
        (4.0, 5.0, 6.0, 0.01, Verdict.DIRECTION),
        (8.0, 9.0, 12.0, 0.01, Verdict.DIRECTION),
        (-9.0, -6.0, -2.0, 0.01, Verdict.CONTRADICTED),
        (-2.9, 0.0, 2.9, 0.9, Verdict.EQUAL),
        (0.5, 1.5, 2.5, 0.01, Verdict.EQUAL),
        (-4.0, 3.0, 12.0, 0.2, Verdict.INCONCLUSIVE),
        (2.0, 6.0, 9.0, 0.06, Verdict.INCONCLUSIVE),
        (math.nan, math.nan, math.nan, math.nan, Verdict.NOT_TESTED),
    ],
)
def test_a_verdict_follows_the_interval_and_the_test(
    low: float, estimate: float, high: float, p: float, expected: Verdict
) -> None:
    assert verdict(comparison(low, estimate, high), p, 6.19) is expected


def test_without_a_number_of_the_papers_better_is_reproduced() -> None:
    assert verdict(comparison(4.0, 5.0, 6.0), 0.01, None) is Verdict.REPRODUCED


def test_few_seeds_are_inconclusive() -> None:
    few = Comparison(Interval(6.0, 2.0, 9.0, 4), Interval(1.0, 1.0, 1.0, 4), 0.03)
    assert verdict(few, 0.03, 6.19) is Verdict.INCONCLUSIVE
    assert verdict_of_equality([(few, 0.03)]) is Verdict.INCONCLUSIVE
    assert verdict_of_best([(few, 0.03)]) is Verdict.INCONCLUSIVE
    assert verdict_of_level(few.difference, 0.0) is Verdict.INCONCLUSIVE


BETTER = (comparison(5.0, 8.0, 12.0), 0.01)
WORSE = (comparison(-12.0, -8.0, -5.0), 0.01)
EVEN = (comparison(-2.0, 0.5, 2.0), 0.01)
WIDE = (comparison(-5.0, 3.0, 12.0), 0.4)
NONE = (comparison(math.nan, math.nan, math.nan), math.nan)


@pytest.mark.parametrize(
    ("judged", "equality", "best"),
    [
        ([EVEN, EVEN], Verdict.REPRODUCED, Verdict.EQUAL),
        ([EVEN, BETTER], Verdict.CONTRADICTED, Verdict.DIRECTION),
        ([BETTER, BETTER], Verdict.CONTRADICTED, Verdict.REPRODUCED),
        ([BETTER, WORSE], Verdict.CONTRADICTED, Verdict.CONTRADICTED),
        ([BETTER, WIDE], Verdict.CONTRADICTED, Verdict.INCONCLUSIVE),
        ([EVEN, WIDE], Verdict.INCONCLUSIVE, Verdict.INCONCLUSIVE),
        ([EVEN, NONE], Verdict.NOT_TESTED, Verdict.NOT_TESTED),
    ],
)
def test_verdicts_on_several_comparisons(
    judged: list[tuple[Comparison, float]], equality: Verdict, best: Verdict
) -> None:
    assert verdict_of_equality(judged) is equality
    assert verdict_of_best(judged) is best


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (89.4, 97.0, Verdict.REPRODUCED),
        (80.0, 95.0, Verdict.INCONCLUSIVE),
        (80.0, 89.0, Verdict.CONTRADICTED),
        (math.nan, math.nan, Verdict.NOT_TESTED),
    ],
)
def test_a_level_is_reached_within_three_points(low: float, high: float, expected: Verdict) -> None:
    assert verdict_of_level(Interval((low + high) / 2, low, high, 5), 92.33) is expected


def test_two_kinds_are_compared_seed_by_seed() -> None:
    found = compare(GOOD, POOR)
    assert found.difference.estimate == pytest.approx(
        interquartile_mean(np.array(GOOD)) - interquartile_mean(np.array(POOR))
    )
    assert found.difference.low < found.difference.estimate < found.difference.high
    assert 0.5 < found.improvement.low <= found.improvement.estimate <= found.improvement.high <= 1
    assert found.p_value == permutation_test(np.array(GOOD), np.array(POOR))


def test_nothing_is_said_of_a_kind_without_runs() -> None:
    found = compare(GOOD, ())
    assert verdict(found, found.p_value, 6.19) is Verdict.NOT_TESTED
    assert found.difference.seeds == 0
