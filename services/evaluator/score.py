"""Scores evaluated episodes as in the paper's Table 2, with a confidence interval.

Invariant: the success, collision and time-out rates sum to 1. Pure.
"""

import math
from collections.abc import Sequence

import numpy as np

from mrcdrl.common.messages.trajectory import Evaluation, Outcome, Weights
from mrcdrl.services.evaluator.trial import EPISODES_PER_BLOCK, EpisodeResult

Z95 = 1.959964  # quantile of the normal distribution for a two-sided 95 % interval


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927); (0, 1) without observations."""
    if count == 0:
        return (0.0, 1.0)
    rate, z2 = successes / count, Z95**2
    centre = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = Z95 / (1 + z2 / count) * math.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2))
    # At rates of 0 and 1 one bound is the rate itself; rounding could miss it.
    return (min(rate, max(0.0, centre - half)), max(rate, min(1.0, centre + half)))


def successes_per_100(results: Sequence[EpisodeResult]) -> list[float]:
    """Successes in each full block of 100; fewer than 100 episodes are scaled to 100."""
    won = np.array([r.outcome is Outcome.SUCCESS for r in results])
    size = EPISODES_PER_BLOCK
    blocks = [won[i : i + size] for i in range(0, len(won), size)]
    full = [b for b in blocks if len(b) == size] or blocks[:1]
    return [float(b.mean() * size) for b in full]


def evaluation(
    results: Sequence[EpisodeResult],
    *,
    worker: str,
    weights: Weights,
    num_robots: int,
    seed: int,
    wall_s: float,
) -> Evaluation:
    """Summarize these episodes for publication."""
    count = len(results)
    outcomes = [r.outcome for r in results]
    successes = outcomes.count(Outcome.SUCCESS)
    blocks = np.array(successes_per_100(results))
    frames = [r.frames for r in results if r.outcome is Outcome.SUCCESS]
    return Evaluation(
        worker=worker,
        weights_epoch=weights.epoch,
        weights_version=weights.version,
        learner_step=weights.learner_step,
        num_robots=num_robots,
        episodes=count,
        success_rate=successes / count,
        collision_rate=outcomes.count(Outcome.COLLISION) / count,
        timeout_rate=outcomes.count(Outcome.TIMEOUT) / count,
        success_interval=wilson_interval(successes, count),
        max_per_100=float(blocks.max()),
        mean_per_100=float(blocks.mean()),
        variance_per_100=float(blocks.var()),
        mean_frames=float(np.mean(frames)) if frames else 0.0,
        mean_score=float(np.mean([r.score for r in results])),
        seed=seed,
        wall_s=wall_s,
    )
