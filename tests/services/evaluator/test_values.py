"""Values against returns: a network of known values that always drives straight, by hand."""

import numpy as np
import pytest
import torch

from mrcdrl.common.arena import STRAIGHT, Arena
from mrcdrl.common.arena import test_starts as starts_of
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import NUM_ACTIONS
from mrcdrl.common.model.policy import Policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.services.evaluator.values import start_values
from mrcdrl.services.tools import evaluate

VALUES = (1.5, 4.0, -2.0)  # left, straight, right


def config(**settings: object) -> Config:
    texts = {f"arena.{name}": str(value) for name, value in settings.items()}
    chosen = {"arena.num_robots": "2", "arena.view_px": "32", "agent.reward_scale": "0.1"}
    return load_config("quick", chosen | texts, environ={})


def straight(of: Config) -> Policy:
    """A policy whose values are the same in every state."""
    network = QNetwork("dqn", stack=of.arena.stack, view_px=of.arena.view_px)
    last = [module for module in network.modules() if isinstance(module, torch.nn.Linear)][-1]
    assert last.out_features == NUM_ACTIONS
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor(VALUES))
    return Policy(network)


def by_hand(of: Config, num: int) -> np.ndarray:
    """Discounted returns of driving straight, arena by arena."""
    returns = []
    for start in starts_of(of.arena, num, 3):
        arena = Arena(of.arena, np.random.default_rng(0))
        arena.reset(start)
        total, discount, ended = 0.0, 1.0, False
        while not ended:
            step = arena.step(np.full(of.arena.num_robots, STRAIGHT))
            total += discount * float(step.rewards.mean())
            discount *= of.agent.gamma
            ended = step.last
        returns.append(total)
    return np.array(returns)


@pytest.mark.parametrize("settings", [{}, {"max_collisions": 1}, {"max_frames": 40}], ids=str)
def test_values_and_returns_are_those_by_hand(settings: dict[str, object]) -> None:
    used = config(**settings)
    ended: list[int] = []
    found = start_values(used, straight(used), starts_of(used.arena, 70, 3), ended.append)
    returns = by_hand(used, 70)
    assert ended == [64, 70]
    assert found.episodes == 70
    assert found.expected == pytest.approx(max(VALUES) / 0.1)
    assert found.realised == pytest.approx(returns.mean())
    assert found.overestimation == pytest.approx(40 - returns.mean())
    half = 1.96 * returns.std(ddof=1) / np.sqrt(70)
    expected = (40 - returns.mean() - half, 40 - returns.mean() + half)
    assert found.interval == pytest.approx(expected, abs=1e-3)


def test_a_controller_has_no_values() -> None:
    with pytest.raises(ConfigError, match="give weights, not --controller"):
        evaluate.main(["--controller", "greedy", "--values"])


def test_the_rule_is_that_of_training() -> None:
    """With five collisions an episode goes on where with one it ends."""
    one, five = config(max_collisions=1), config(max_collisions=5)
    realised = [
        start_values(c, straight(c), starts_of(c.arena, 20, 3)).realised for c in (one, five)
    ]
    assert realised[0] != pytest.approx(realised[1])
