"""Which number of robots an actor plays next."""

from typing import Literal

import numpy as np
import pytest

from mrcdrl.common.config import ArenaConfig, CurriculumConfig
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.actor.curriculum import Curriculum

ARENA = ArenaConfig(robots=(1, 2, 4))


def automatic(floor: float = 0.0, memory_episodes: int = 20) -> Curriculum:
    config = CurriculumConfig(kind="automatic", floor=floor, memory_episodes=memory_episodes)
    return Curriculum(config, ARENA)


def play(
    curriculum: Curriculum, number: int, successes: int, failures: int, frames: int = 100
) -> None:
    for outcome in [Outcome.SUCCESS] * successes + [Outcome.TIMEOUT] * failures:
        curriculum.add(number, outcome, frames)


def test_at_first_all_numbers_make_as_many_transitions() -> None:
    for curriculum in (automatic(), Curriculum(CurriculumConfig(), ARENA)):
        np.testing.assert_allclose(curriculum.weights(0), [1 / 3] * 3)
        np.testing.assert_allclose(curriculum.chances(0), np.array([4, 2, 1]) / 7)


@pytest.mark.parametrize("kind", ["schedule", "automatic"])
def test_the_greatest_number_may_be_played_alone_at_first(
    kind: Literal["schedule", "automatic"],
) -> None:
    after = Curriculum(CurriculumConfig(kind=kind), ARENA)
    curriculum = Curriculum(CurriculumConfig(kind=kind, greatest_first_steps=10), ARENA)
    for step in (0, 9):
        np.testing.assert_array_equal(curriculum.weights(step), [0, 0, 1])
        np.testing.assert_array_equal(curriculum.chances(step), [0, 0, 1])
    np.testing.assert_array_equal(curriculum.weights(10), after.weights(10))


def test_what_is_neither_solved_nor_hopeless_is_played_most() -> None:
    curriculum = automatic()
    play(curriculum, 1, 200, 0)
    play(curriculum, 4, 0, 200)
    for _ in range(100):
        play(curriculum, 2, 1, 1)
    solved, between, hopeless = curriculum.weights(0)
    assert between > 0.8
    assert solved == pytest.approx(hopeless)
    assert 0.05 < solved < 0.1, "never given up"


def test_the_weight_is_the_variance_of_success() -> None:
    curriculum = automatic()
    rates = curriculum.success_rates
    np.testing.assert_array_equal(rates, [0.5] * 3)
    play(curriculum, 2, 6, 2)
    rates = curriculum.success_rates
    learnable = rates * (1 - rates)
    np.testing.assert_allclose(curriculum.weights(0), learnable / learnable.sum())


def test_a_floor_is_spread_evenly() -> None:
    curriculum = automatic(floor=0.6, memory_episodes=10**6)
    play(curriculum, 1, 10_000, 0)
    weights = curriculum.weights(0)
    assert weights[0] == pytest.approx(0.2, abs=1e-3)
    assert weights.sum() == pytest.approx(1)


def test_old_episodes_are_forgotten() -> None:
    curriculum = automatic()
    play(curriculum, 1, 0, 500)
    assert curriculum.success_rates[0] == pytest.approx(0.5 / 21, rel=0.01)
    play(curriculum, 1, 200, 0)
    assert curriculum.success_rates[0] == pytest.approx(20.5 / 21, rel=0.01)


def test_where_all_is_hopeless_all_is_played() -> None:
    curriculum = automatic()
    for number in (1, 2, 4):
        play(curriculum, number, 0, 10_000)
    np.testing.assert_allclose(curriculum.weights(0), [1 / 3] * 3)


def test_long_episodes_are_played_less_often() -> None:
    curriculum = Curriculum(CurriculumConfig(memory_episodes=10**6), ARENA)
    play(curriculum, 1, 300, 0, frames=50)
    play(curriculum, 2, 300, 0, frames=100)
    play(curriculum, 4, 0, 300, frames=1000)
    chances = curriculum.chances(0)
    transitions = chances * [50, 2 * 100, 4 * 1000]
    np.testing.assert_allclose(transitions / transitions.sum(), [1 / 3] * 3, rtol=0.1)


def test_a_number_not_played_yet_counts_as_long_as_the_others() -> None:
    curriculum = Curriculum(CurriculumConfig(), ARENA)
    play(curriculum, 1, 50, 0, frames=100)
    one, two, four = curriculum.chances(0)
    assert one == pytest.approx(2 * two, rel=0.2)
    assert two == pytest.approx(2 * four)


def test_a_schedule_sets_the_weights() -> None:
    config = CurriculumConfig(schedule=((0, 1, 0, 0), (100, 1, 1, 2)))
    curriculum = Curriculum(config, ARENA)
    np.testing.assert_allclose(curriculum.weights(0), [1, 0, 0])
    np.testing.assert_allclose(curriculum.chances(0), [1, 0, 0])
    np.testing.assert_allclose(curriculum.weights(50), [1 / 2.5, 0.5 / 2.5, 1 / 2.5])
    np.testing.assert_allclose(curriculum.weights(10**6), [1 / 4, 1 / 4, 1 / 2])
