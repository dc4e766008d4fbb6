"""Targets and losses against tables worked out by hand."""

import pytest
import torch

from mrcdrl.services.learner.loss import double_dqn_target, dqn_target, td_loss

# reward, discount, online Q(s', .), target Q(s', .), DQN's y, double DQN's y
TABLE = [
    (1.0, 0.5, [1.0, 3.0, 2.0], [10.0, 20.0, 40.0], 21.0, 11.0),  # picks 1, not the highest
    (-5.0, 0.99, [0.0, 0.0, 1.0], [1.0, 2.0, 3.0], -2.03, -2.03),  # both pick 2
    (200.0, 0.0, [1.0, 2.0, 3.0], [1e9, 1e9, 1e9], 200.0, 200.0),  # terminated
    (0.03, 0.99, [3.0, 1.0, 1.0], [-2.0, -1.0, -3.0], -0.96, -1.95),  # truncated: bootstraps
    (0.0, 0.970299, [2.0, 1.0, 0.0], [4.0, 9.0, 0.0], 8.732691, 3.881196),  # gamma**3
]


def columns() -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor(column) for column in zip(*TABLE, strict=True))


def test_targets_by_hand() -> None:
    reward, discount, online, target, dqn, double = columns()
    torch.testing.assert_close(dqn_target(reward, discount, target), dqn)
    torch.testing.assert_close(double_dqn_target(reward, discount, online, target), double)


def test_targets_carry_no_gradient() -> None:
    reward, discount, online, target, _, _ = columns()
    online, target = online.requires_grad_(), target.requires_grad_()
    assert not dqn_target(reward, discount, target).requires_grad
    assert not double_dqn_target(reward, discount, online, target).requires_grad


@pytest.mark.parametrize(
    ("kind", "loss", "gradient"),
    [
        ("squared", (1.0 * 0.25 + 0.5 * 9.0) / 2, [[0.0, -0.5, 0.0], [1.5, 0.0, 0.0]]),
        ("huber", (1.0 * 0.125 + 0.5 * 2.5) / 2, [[0.0, -0.25, 0.0], [0.25, 0.0, 0.0]]),
    ],
)
def test_losses_by_hand(kind: str, loss: float, gradient: list[list[float]]) -> None:
    """Errors +0.5 and -3 with weights 1 and 0.5; only the action taken has a gradient."""
    q = torch.tensor([[7.0, 1.0, 7.0], [4.0, 7.0, 7.0]], requires_grad=True)
    value, errors = td_loss(
        q,
        torch.tensor([1, 0]),
        torch.tensor([1.5, 1.0]),
        torch.tensor([1.0, 0.5]),
        "huber" if kind == "huber" else "squared",
    )
    value.backward()
    assert value.item() == pytest.approx(loss)
    assert errors.tolist() == [0.5, -3.0]
    assert not errors.requires_grad
    assert q.grad is not None
    assert q.grad.tolist() == gradient
