"""Statistics over seeds, and the verdict on a claim.

The unit is the seed: a value is one training's result. Estimates follow Agarwal et al. 2021, "Deep
reinforcement learning at the edge of the statistical precipice".

Invariants: the same values give the same numbers, since resampling is seeded.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
CONFIDENCE = 0.95
LEVEL = 0.05  # of the tests, after Holm's correction
EQUAL = 3.0  # points of success within which two kinds count as equal
MIN_SEEDS = 5  # with three of each kind no difference is significant, and intervals are too narrow
_MAX_PERMUTATIONS = 100_000  # above, a random sample of them

Values = NDArray[np.float64]
Estimate = Callable[[Values], Values]  # float64 [..., n] -> [...]


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate and its 95 % bootstrap interval; all NaN without values."""

    estimate: float
    low: float
    high: float
    seeds: int  # values behind it; for two samples, the smaller number

    def within(self, bound: float) -> bool:
        """Whether all of it lies between -bound and bound."""
        return -bound <= self.low and self.high <= bound


class Verdict(StrEnum):
    """What the runs say of a claim that one kind is better than another."""

    REPRODUCED = "reproduced"  # better, by an amount that may be the paper's
    DIRECTION = "direction only"  # better, by an amount that is not the paper's
    EQUAL = "equal within ±3"
    CONTRADICTED = "contradicted"  # worse
    INCONCLUSIVE = "inconclusive"
    NOT_TESTED = "not tested"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two kinds, seed by seed."""

    difference: Interval  # of interquartile means, points
    improvement: Interval  # probability that a run of the first beats one of the second
    p_value: float  # two-sided permutation test; NaN if it was not tested


Judged = Sequence[tuple[Comparison, float]]  # each with its p-value after Holm's correction


def interquartile_mean(values: Values) -> Values:
    """Mean of the middle half; float64 [..., n] -> [...].

    As many values are cut at each end as there are whole ones in a quarter: none of 3, 1 of 5.
    """
    cut = values.shape[-1] // 4
    middle = np.sort(values, axis=-1)[..., cut : values.shape[-1] - cut]
    return np.asarray(middle.mean(axis=-1))


def probability_of_improvement(first: Values, second: Values) -> Values:
    """Probability that a value of the first exceeds one of the second; a tie counts half.

    float64 [..., n] and [..., m] -> [...]
    """
    difference = first[..., :, None] - second[..., None, :]
    return np.asarray(np.mean((np.sign(difference) + 1) / 2, axis=(-2, -1)))


def interval(values: Sequence[float], estimate: Estimate = interquartile_mean) -> Interval:
    """An estimate over seeds, with its percentile bootstrap interval."""
    if not values:
        return Interval(math.nan, math.nan, math.nan, 0)
    sample = np.asarray(values, np.float64)
    return _interval(estimate(sample), estimate(_resampled(sample, 0)), len(values))


def compare(first: Sequence[float], second: Sequence[float]) -> Comparison:
    """Success of two kinds over their seeds, in per cent."""
    if not first or not second:
        nothing = interval(())
        return Comparison(nothing, nothing, math.nan)
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    resampled_a, resampled_b = _resampled(a, 0), _resampled(b, 1)
    seeds = min(len(a), len(b))
    return Comparison(
        _interval(
            interquartile_mean(a) - interquartile_mean(b),
            interquartile_mean(resampled_a) - interquartile_mean(resampled_b),
            seeds,
        ),
        _interval(
            probability_of_improvement(a, b),
            probability_of_improvement(resampled_a, resampled_b),
            seeds,
        ),
        permutation_test(a, b),
    )


def permutation_test(first: Values, second: Values) -> float:
    """Two-sided p-value of a difference of means, float64 [n] and [m].

    The share of the ways to deal out all values whose difference is at least the one seen. All ways
    are tried, or a seeded sample of them where there are more than 100 000.
    """
    pooled = np.concatenate([first, second])
    seen = abs(first.mean() - second.mean())
    ways = math.comb(len(pooled), len(first))
    if ways <= _MAX_PERMUTATIONS:
        chosen = np.array(list(itertools.combinations(range(len(pooled)), len(first))))
        added = 0  # the deal that was seen is among them
    else:
        rng = np.random.default_rng(0)
        shuffled = rng.permuted(np.tile(np.arange(len(pooled)), (_MAX_PERMUTATIONS, 1)), axis=1)
        chosen, added = shuffled[:, : len(first)], 1
    sums = pooled[chosen].sum(axis=1)
    differences = np.abs(sums / len(first) - (pooled.sum() - sums) / len(second))
    as_large = np.count_nonzero(differences >= seen - 1e-9)
    return float((as_large + added) / (len(chosen) + added))


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Holm's correction of a family of p-values by name; NaN, not tested, stays out of it."""
    tested = sorted((p, name) for name, p in p_values.items() if not math.isnan(p))
    corrected, largest = dict(p_values), 0.0
    for rank, (p, name) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * p))
        corrected[name] = largest
    return corrected


def verdict(comparison: Comparison, corrected_p: float, papers_difference: float | None) -> Verdict:
    """What a comparison says of the paper's claim that the first kind is better.

    corrected_p: after Holm's correction. papers_difference: points, as printed in the paper; None
    if it prints no number. A difference that surely lies within ±3 points counts as equal,
    significant or not. An interval too wide for any answer, or too few seeds, are inconclusive.
    """
    difference = comparison.difference
    if early := _too_early(difference):
        return early
    if difference.within(EQUAL):
        return Verdict.EQUAL
    if corrected_p >= LEVEL:
        return Verdict.INCONCLUSIVE
    if difference.estimate < 0:
        return Verdict.CONTRADICTED
    papers = papers_difference is None or difference.low <= papers_difference <= difference.high
    return Verdict.REPRODUCED if papers else Verdict.DIRECTION


def verdict_of_equality(pairs: Judged) -> Verdict:
    """What comparisons say of the claim that none differs."""
    if early := _earliest(pairs):
        return early
    apart = [(c, p) for c, p in pairs if not c.difference.within(EQUAL)]
    if not apart:
        return Verdict.REPRODUCED
    differs = any(p < LEVEL for _, p in apart)
    return Verdict.CONTRADICTED if differs else Verdict.INCONCLUSIVE


def verdict_of_best(rivals: Judged) -> Verdict:
    """What comparisons with all rivals say of the claim that the first kind is the best.

    Better than some, and equal to the others, is its direction only.
    """
    if early := _earliest(rivals):
        return early
    apart = [(c, p) for c, p in rivals if not c.difference.within(EQUAL)]
    if not apart:
        return Verdict.EQUAL
    if any(p < LEVEL and c.difference.estimate < 0 for c, p in apart):
        return Verdict.CONTRADICTED
    if any(p >= LEVEL for _, p in apart):
        return Verdict.INCONCLUSIVE
    return Verdict.REPRODUCED if len(apart) == len(rivals) else Verdict.DIRECTION


def verdict_of_level(found: Interval, papers: float) -> Verdict:
    """What an interval says of the claim that a value is at least the paper's, ±3 points."""
    if early := _too_early(found):
        return early
    if found.low >= papers - EQUAL:
        return Verdict.REPRODUCED
    return Verdict.CONTRADICTED if found.high < papers - EQUAL else Verdict.INCONCLUSIVE


def _too_early(found: Interval) -> Verdict | None:
    """The verdict where there are too few seeds for one; else None."""
    if math.isnan(found.estimate):
        return Verdict.NOT_TESTED
    return Verdict.INCONCLUSIVE if found.seeds < MIN_SEEDS else None


def _earliest(judged: Judged) -> Verdict | None:
    """Not tested if one is not; else inconclusive if one has too few seeds; else None."""
    early = {_too_early(comparison.difference) for comparison, _ in judged}
    for found in (Verdict.NOT_TESTED, Verdict.INCONCLUSIVE):
        if found in early:
            return found
    return None


def _resampled(sample: Values, stream: int) -> Values:
    """Samples with replacement, float64 [RESAMPLES, n]; different streams are independent."""
    rng = np.random.default_rng([0, stream])
    return sample[rng.integers(len(sample), size=(RESAMPLES, len(sample)))]


def _interval(estimate: Values, resampled: Values, seeds: int) -> Interval:
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(resampled, [tail, 100 - tail])
    return Interval(float(estimate), float(low), float(high), seeds)
