"""Rates, blocks of a hundred and the interval, by hand and against published values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.messages.trajectory import Evaluation, Outcome, Weights
from mrcdrl.services.evaluator.navigation import Journey
from mrcdrl.services.evaluator.score import evaluation, successes_per_100, wilson_interval
from mrcdrl.services.evaluator.trial import EpisodeResult

JOURNEY = Journey(np.ones(2), np.ones(2), np.ones(2), np.zeros(2, np.bool_), np.zeros(2, np.bool_))
SUCCESS, COLLISION, TIMEOUT = Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT


def episode(outcome: Outcome, frames: int = 10, score: float = 1.0) -> EpisodeResult:
    return EpisodeResult(
        outcome=outcome,
        frames=frames,
        score=score,
        targets=np.zeros((2, 2)),
        obstacles=np.empty((0, 3)),
        robots=np.empty((0, 2, 3)),
        explored=np.empty((0, 2), np.bool_),
        journey=JOURNEY,
    )


def summarized(results: list[EpisodeResult]) -> Evaluation:
    return evaluation(
        results,
        worker="evaluator-0",
        weights=Weights.of(1, 7, 700, b""),
        num_robots=2,
        seed=5,
        wall_s=2.5,
    )


@given(st.lists(st.sampled_from(Outcome), min_size=1, max_size=350))
def test_rates_sum_to_1_and_the_interval_holds_the_rate(outcomes: list[Outcome]) -> None:
    result = summarized([episode(outcome) for outcome in outcomes])
    assert result.success_rate + result.collision_rate + result.timeout_rate == pytest.approx(1)
    assert result.success_rate == outcomes.count(SUCCESS) / len(outcomes)
    low, high = result.success_interval
    assert 0 <= low <= result.success_rate + 1e-12
    assert result.success_rate - 1e-12 <= high <= 1
    assert 0 <= result.mean_per_100 <= result.max_per_100 <= 100


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [
        # R: prop.test(…, correct = FALSE); 81 of 263 and 1 of 29 are Newcombe's (1998, table I)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (20, 20, 0.8389, 1.0),
        (50, 100, 0.4038, 0.5962),
    ],
)
def test_the_interval_against_published_values(
    successes: int, count: int, low: float, high: float
) -> None:
    assert wilson_interval(successes, count) == pytest.approx((low, high), abs=5e-5)


def test_without_an_episode_the_interval_says_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_blocks_of_a_hundred() -> None:
    won, lost = episode(SUCCESS), episode(COLLISION)
    blocks = [won] * 90 + [lost] * 10 + [won] * 70 + [lost] * 30 + [won] * 50
    assert successes_per_100(blocks) == [90.0, 70.0]
    result = summarized(blocks)
    assert (result.max_per_100, result.mean_per_100, result.variance_per_100) == (90, 80, 100)
    assert result.success_rate == 210 / 250


def test_fewer_than_a_hundred_are_scaled_to_one() -> None:
    assert successes_per_100([episode(SUCCESS)] * 3 + [episode(TIMEOUT)]) == [75.0]
    assert summarized([episode(TIMEOUT)] * 7).variance_per_100 == 0


def test_frames_are_those_to_success_and_the_score_is_that_of_all() -> None:
    result = summarized(
        [episode(SUCCESS, 100, 5.0), episode(SUCCESS, 50, 1.0), episode(TIMEOUT, 999)]
    )
    assert result.mean_frames == 75
    assert result.mean_score == pytest.approx(7 / 3)
    assert summarized([episode(COLLISION)]).mean_frames == 0


def test_the_evaluation_names_its_weights_and_seed() -> None:
    result = summarized([episode(SUCCESS)])
    assert (result.worker, result.weights_epoch, result.weights_version) == ("evaluator-0", 1, 7)
    assert (result.learner_step, result.num_robots, result.episodes) == (700, 2, 1)
    assert (result.seed, result.wall_s) == (5, 2.5)
