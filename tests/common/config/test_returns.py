"""No arena gives more than the bounds say, and they are those of the rewards."""

import numpy as np
import pytest

from mrcdrl.common.arena import make_arenas
from mrcdrl.common.arena.counting import counting_reward
from mrcdrl.common.config import load_config
from mrcdrl.common.config.returns import largest_n_step_return, largest_return

REWARDS = {"arena.success_reward": "100", "arena.collision_reward": "-2", "agent.gamma": "0.9"}


def test_the_largest_return_is_that_of_an_episodes_rewards() -> None:
    more = {"arena.step_reward": "-1.5", "arena.max_collisions": "3", "agent.reward_scale": "0.1"}
    config = load_config(None, REWARDS | more, environ={})
    assert largest_return(config) == pytest.approx(0.1 * (100 + 3 * 2 + 1.5 * 10))


def test_the_largest_n_step_return_is_that_of_n_frames_and_not_scaled() -> None:
    more = {"agent.n_step": "2", "agent.reward_scale": "0.1"}
    config = load_config(None, REWARDS | more, environ={})
    assert largest_n_step_return(config) == 100 + 2 * 2 + 2 * 1


def test_shaping_and_prices_widen_both_bounds() -> None:
    """By the potential of the arena's diagonal, once, and by the highest price."""
    more = {
        "agent.n_step": "2",
        "agent.reward_scale": "0.1",
        "agent.shaping_per_px": "0.5",
        "agent.collision_schedule": "[[0, 1], [9, 4], [10, 3]]",
    }
    config = load_config(None, REWARDS | more, environ={})
    potential = 0.5 * 600 * 2**0.5
    assert largest_n_step_return(config) == pytest.approx(100 + 2 * 8 + 2 * 1 + potential)
    assert largest_return(config) == pytest.approx(0.1 * (100 + 5 * 8 + 10 + potential))


def test_a_log_policy_widens_the_bound_on_values_alone() -> None:
    plain = load_config(None, REWARDS, environ={})
    more = {"agent.munchausen_alpha": "0.5", "agent.munchausen_temperature": "0.1"}
    config = load_config(None, REWARDS | more, environ={})
    added = largest_return(config) - largest_return(plain)
    assert added == pytest.approx(10 * (0.5 * 1.0 + 0.1 * np.log(3)))
    assert largest_n_step_return(config) == largest_n_step_return(plain)


@pytest.mark.parametrize("reward", ["0", "200"])
def test_no_arena_gives_more(reward: str) -> None:
    given = {"arena.success_reward": reward, "arena.collision_reward": "0", "agent.n_step": "3"}
    config = load_config(None, given, environ={})
    arenas = make_arenas(config.arena, [np.random.default_rng(seed) for seed in range(8)], range(8))
    rng, received = np.random.default_rng(0), []
    for arena in range(8):
        arenas.reset(arena)
    for _ in range(400):
        steps = arenas.step(rng.integers(3, size=(8, config.arena.num_robots)))
        received.append(steps.rewards)
        for arena, outcome in enumerate(steps.outcomes):
            if outcome is not None:
                arenas.reset(arena)
    sums = np.lib.stride_tricks.sliding_window_view(np.abs(received), 3, axis=0).sum(axis=-1)
    assert 0 < sums.max() <= largest_n_step_return(config)


def test_no_counting_arena_gives_more() -> None:
    given = {"arena.kind": "counting", "arena.codec": "frames", "arena.success_reward": "0"}
    config = load_config(None, given | {"arena.collision_reward": "0"}, environ={})
    most = max(counting_reward(episode, 23) for episode in range(8))
    assert most <= largest_n_step_return(config) == 24
