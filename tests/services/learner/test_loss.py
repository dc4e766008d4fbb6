"""The loss against tables worked out by hand."""

from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.loss import td_loss

# reward, discount, online Q(s', .), target Q(s', .), DQN's y, double DQN's y
TABLE = [
    (1.0, 0.5, [1.0, 3.0, 2.0], [10.0, 20.0, 40.0], 21.0, 11.0),  # picks 1, not the highest
    (-5.0, 0.99, [0.0, 0.0, 1.0], [1.0, 2.0, 3.0], -2.03, -2.03),  # both pick 2
    (200.0, 0.0, [1.0, 2.0, 3.0], [1e9, 1e9, 1e9], 200.0, 200.0),  # terminated
    (0.03, 0.99, [3.0, 1.0, 1.0], [-2.0, -1.0, -3.0], -0.96, -1.95),  # truncated: bootstraps
    (0.0, 0.970299, [2.0, 1.0, 0.0], [4.0, 9.0, 0.0], 8.732691, 3.881196),  # gamma**3
]
NOW, NEXT = torch.tensor(0), torch.tensor(1)  # stand for the states


def batch_of(reward: Tensor, discount: Tensor, action: Tensor, weights: Tensor) -> Batch:
    return Batch(NOW, action, reward, discount, NEXT, weights, np.arange(len(reward)))


def columns() -> tuple[Tensor, ...]:
    return tuple(torch.tensor(column) for column in zip(*TABLE, strict=True))


@pytest.mark.parametrize("kind", ["dqn", "ddqn", "duel"])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_targets_by_hand(kind: Literal["dqn", "ddqn", "duel"], scale: float) -> None:
    """Where all values of the states are 0, TD errors are the targets."""
    reward, discount, online_next, target_next, dqn, double = columns()
    now = torch.zeros(len(reward), 3, requires_grad=True)
    online_next, target_next = online_next.requires_grad_(), target_next.requires_grad_()
    batch = batch_of(reward / scale, discount, torch.zeros(len(reward)).long(), reward * 0 + 1)
    found = td_loss(
        lambda states: now if states is NOW else online_next,
        lambda states: target_next,
        batch,
        AgentConfig(kind=kind, reward_scale=scale),
    )
    torch.testing.assert_close(found.td_errors, dqn if kind == "dqn" else double)
    assert not found.td_errors.requires_grad
    found.loss.backward()  # type: ignore[no-untyped-call]
    assert online_next.grad is target_next.grad is None, "a target has no gradient"


@pytest.mark.parametrize(
    ("kind", "loss", "gradient"),
    [
        ("squared", (1.0 * 0.25 + 0.5 * 9.0) / 2, [[0.0, -0.5, 0.0], [1.5, 0.0, 0.0]]),
        ("huber", (1.0 * 0.125 + 0.5 * 2.5) / 2, [[0.0, -0.25, 0.0], [0.25, 0.0, 0.0]]),
    ],
)
def test_losses_by_hand(
    kind: Literal["squared", "huber"], loss: float, gradient: list[list[float]]
) -> None:
    """Errors +0.5 and -3 with weights 1 and 0.5; only the action taken has a gradient."""
    q = torch.tensor([[7.0, 1.0, 7.0], [4.0, 7.0, 7.0]], requires_grad=True)
    weights, reward = torch.tensor([1.0, 0.5]), torch.tensor([1.5, 1.0])
    batch = batch_of(reward, torch.zeros(2), torch.tensor([1, 0]), weights)
    found = td_loss(lambda states: q, lambda states: q, batch, AgentConfig(loss=kind))
    found.loss.backward()  # type: ignore[no-untyped-call]
    assert found.loss.item() == pytest.approx(loss)
    assert found.td_errors.tolist() == [0.5, -3.0]
    assert found.greedy_q.tolist() == [7.0, 7.0]
    assert not found.greedy_q.requires_grad
    assert q.grad is not None
    assert q.grad.tolist() == gradient
