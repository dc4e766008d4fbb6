"""Epsilon follows the paper's schedule; the ladder is spread over all arenas of all actors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.config import ExplorationConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.model.exploration import epsilon_exponents, epsilons

PAPER = ((0, 1.0), (800_000, 0.1))


@pytest.mark.parametrize(
    ("learner_step", "epsilon"),
    [(0, 1.0), (400_000, 0.55), (800_000, 0.1), (5_000_000, 0.1)],
)
def test_the_papers_schedule(learner_step: int, epsilon: float) -> None:
    assert value_at(PAPER, learner_step) == pytest.approx(epsilon)


def test_a_schedule_of_several_points_or_one() -> None:
    points = ((0, 1.0), (100, 0.1), (200, 0.02))
    assert value_at(points, 150) == pytest.approx(0.06)
    assert value_at(((0, 0.3),), 10**9) == 0.3


def test_a_single_arena_has_exponent_one() -> None:
    assert epsilon_exponents(1, 0, 1, 8.0).tolist() == [1.0]


def test_actors_interleave() -> None:
    assert epsilon_exponents(2, 0, 2, 4.0).tolist() == [1.0, 3.0]
    assert epsilon_exponents(2, 1, 2, 4.0).tolist() == [2.0, 4.0]


@given(st.integers(1, 12), st.integers(1, 12), st.floats(1.0, 10.0))
def test_all_arenas_together_are_evenly_spread(
    num_actors: int, num_arenas: int, power: float
) -> None:
    each = [epsilon_exponents(num_actors, r, num_arenas, power) for r in range(num_actors)]
    total = num_actors * num_arenas
    expected = np.linspace(1.0, power, total) if total > 1 else np.ones(1)
    np.testing.assert_allclose(np.sort(np.concatenate(each)), expected, rtol=1e-9)


@pytest.mark.parametrize("rank", [-1, 3])
def test_a_rank_outside_the_actors_is_refused(rank: int) -> None:
    with pytest.raises(ConfigError, match="rank"):
        epsilon_exponents(3, rank, 8, 3.0)


def test_epsilons_of_both_kinds() -> None:
    schedule = ExplorationConfig(schedule=((0, 0.5),))
    assert epsilons(schedule, 0, 0, 2, 3).tolist() == [0.5, 0.5, 0.5]
    ladder = ExplorationConfig(kind="ladder", schedule=((0, 0.5),), ladder_power=4.0)
    np.testing.assert_allclose(epsilons(ladder, 0, 1, 2, 2), [0.5**2, 0.5**4])
    assert epsilons(ladder, 0, 1, 2, 2).dtype == np.float32
    start = ExplorationConfig(kind="ladder")
    assert epsilons(start, 0, 0, 1, 4).tolist() == [1.0] * 4
