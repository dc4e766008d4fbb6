"""The stopping rule, as tables of runs."""

import pytest

from mrcdrl.common.config import RunConfig
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.monitor.weakest import Weakest

NOTHING = (0.0, 0)  # published
WON, LOST = Outcome.SUCCESS, Outcome.COLLISION


def episode(outcome: Outcome) -> EpisodeSummary:
    return EpisodeSummary("actor-0", 0, 0, outcome, 100, 150.0, 1, 0.1, 5, 2.0, 2)


def evaluation(
    rate: float, epoch: int = 1, version: int = 1, num_robots: int = 2, worker: str = "0"
) -> Evaluation:
    return Evaluation(
        worker,
        epoch,
        version,
        100,
        num_robots,
        100,
        rate,
        1 - rate,
        0.0,
        (0.0, 1.0),
        1.0,
        1.0,
        1.0,
        1.0,
        1.0,
        1,
        1.0,
    )


def stopped_after(run: RunConfig, outcomes: list[Outcome]) -> int | None:
    """Episodes after which the rule first gives a reason."""
    rule = StoppingRule(run)
    for count, outcome in enumerate(outcomes, 1):
        rule.observe_episode(episode(outcome))
        if rule.reason(0, 0.0, NOTHING) is not None:
            return count
    return None


@pytest.mark.parametrize(
    ("patience", "floor", "outcomes", "expected"),
    [
        (300, 0.5, [WON] * 60 + [LOST] * 1_000, 100 + 300),
        (300, 0.5, [WON] * 40 + [LOST] * 1_000, None),  # a certain size is not satisfied
        (300, 0.0, [LOST] * 1_000, 100 + 300),
        (0, 0.5, [WON] * 60 + [LOST] * 5_000, None),
        (300, 0.5, [WON] * 60 + [LOST] * 200 + [WON] * 100 + [LOST] * 1_000, 360 + 300),
        (300, 0.5, [WON] * 99, None),
        (50, 0.5, [WON] * 149, None),
        (50, 0.5, [WON] * 150, 150),
    ],
)
def test_patience(
    patience: int, floor: float, outcomes: list[Outcome], expected: int | None
) -> None:
    run = RunConfig(patience_episodes=patience, patience_floor=floor)
    assert stopped_after(run, outcomes) == expected


@pytest.mark.parametrize(
    ("run", "steps", "minutes", "rates", "expected"),
    [
        (RunConfig(minutes=10), 0, 9.9, [], None),
        (RunConfig(minutes=10), 0, 10.0, [], "time limit reached (10 min)"),
        (RunConfig(learner_steps=500), 499, 0.0, [], None),
        (RunConfig(learner_steps=500), 500, 0.0, [], "learner step limit reached (500)"),
        (RunConfig(target_success_rate=0.9), 0, 0.0, [0.5, 0.89], None),
        (RunConfig(target_success_rate=0.9), 0, 0.0, [0.92, 0.5], "success 0.920 reached"),
        (RunConfig(), 10**9, 1e9, [1.0], None),
    ],
)
def test_other_rules(
    run: RunConfig, steps: int, minutes: float, rates: list[float], expected: str | None
) -> None:
    rule = StoppingRule(run)
    for rate in rates:
        rule.observe_evaluation(evaluation(rate))
    reason = rule.reason(steps, minutes, (1.0, 1))
    assert (reason is None) == (expected is None)
    assert expected is None or expected in str(reason)


def test_an_evaluation_of_weights_never_published_ends_no_run() -> None:
    """However early it comes: an evaluator may also be quicker than the learner's statistics."""
    rule = StoppingRule(RunConfig(target_success_rate=0.9))
    rule.observe_evaluation(evaluation(1.0, 10**18 + 1, 10**9))
    rule.observe_evaluation(evaluation(1.0, 10**18 + 2**20, 0))
    epoch = float(10**18 + 1)
    assert rule.reason(0, 0.0, NOTHING) is None
    assert rule.reason(0, 0.0, (epoch, 10**8)) is None
    rule.observe_evaluation(evaluation(0.95, 10**18 + 1, 7))
    assert rule.reason(0, 0.0, (epoch, 6)) is None
    assert "success 0.950 reached" in str(rule.reason(0, 0.0, (epoch, 7)))


def test_evaluations_of_epochs_that_never_were_do_not_hide_a_real_one() -> None:
    rule = StoppingRule(RunConfig(target_success_rate=0.9))
    rule.observe_evaluation(evaluation(0.95, epoch=7, version=3))
    for epoch in range(7):
        rule.observe_evaluation(evaluation(1.0, epoch=epoch, version=0))
    assert "success 0.950 reached" in str(rule.reason(0, 0.0, (7.0, 3)))


def test_a_target_reached_before_a_resume_ends_the_run_no_more() -> None:
    rule = StoppingRule(RunConfig(target_success_rate=0.9))
    rule.observe_evaluation(evaluation(0.95))
    assert rule.reason(0, 0.0, (1.0, 1)) is not None
    rule.go_on()
    assert rule.reason(0, 0.0, (1.0, 1)) is None
    rule.observe_evaluation(evaluation(0.97, version=2))
    assert rule.reason(0, 0.0, (1.0, 2)) is None


def test_a_target_not_reached_before_a_resume_ends_the_run() -> None:
    rule = StoppingRule(RunConfig(target_success_rate=0.9))
    rule.observe_evaluation(evaluation(0.8))
    rule.go_on()
    rule.observe_evaluation(evaluation(0.95))
    assert rule.reason(0, 0.0, (1.0, 1)) is not None


def test_patience_that_was_over_counts_from_the_resume() -> None:
    rule = StoppingRule(RunConfig(patience_episodes=50))
    for outcome in [WON] * 60 + [LOST] * 200:
        rule.observe_episode(episode(outcome))
    assert rule.reason(0, 0.0, NOTHING) is not None
    rule.go_on()
    for _ in range(50):
        assert rule.reason(0, 0.0, NOTHING) is None
        rule.observe_episode(episode(LOST))
    assert "in 50 episodes" in str(rule.reason(0, 0.0, NOTHING))


def test_patience_that_was_not_over_goes_on_counting_after_a_resume() -> None:
    rule = StoppingRule(RunConfig(patience_episodes=50))
    for outcome in [WON] * 100 + [LOST] * 30:
        rule.observe_episode(episode(outcome))
    rule.go_on()
    for _ in range(20):
        rule.observe_episode(episode(LOST))
    assert rule.reason(0, 0.0, NOTHING) is not None


def test_every_number_of_robots_has_to_reach_the_target() -> None:
    rule = StoppingRule(RunConfig(target_success_rate=0.9), (1, 2, 4))
    published = (1.0, 9)
    for version, rates in enumerate([(0.99, 0.95, 0.5), (0.8, 0.9, 0.9), (0.9, 0.9, 0.9)], 1):
        assert rule.reason(0, 0.0, published) is None
        for number, rate in zip((1, 2, 4), rates, strict=True):
            assert rule.reason(0, 0.0, published) is None, "not before all are tested"
            rule.observe_evaluation(evaluation(rate, version=version, num_robots=number))
    assert rule.reason(0, 0.0, published) is not None


def test_the_weakest_is_that_of_one_version_and_one_evaluator() -> None:
    weakest = Weakest((1, 4))
    assert weakest.add(evaluation(0.9, version=1, num_robots=1, worker="a")) is None
    assert weakest.add(evaluation(0.8, version=1, num_robots=4, worker="b")) is None
    assert weakest.add(evaluation(0.7, version=2, num_robots=4, worker="a")) is None
    found = weakest.add(evaluation(0.8, version=2, num_robots=1, worker="a"))
    assert found is not None
    assert (found.success_rate, found.num_robots) == (0.7, 4)
    found = weakest.add(evaluation(0.6, version=1, num_robots=1, worker="b"))
    assert found is not None
    assert (found.success_rate, found.num_robots) == (0.6, 1)
    for number in range(1000):
        weakest.add(evaluation(0.5, worker=f"w{number}"))
    assert len(weakest._pending) <= 64
