"""Targets and loss of the TD error (paper section 4, Eqs. (2) to (4)): pure functions.

Invariants: a target carries no gradient; a discount of 0 leaves the reward alone, whatever the
values of the next state are.

Shapes: B = transitions, A = actions.
"""

from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor
from torch.nn import functional

LossKind = Literal["squared", "huber"]


def dqn_target(reward: Tensor, discount: Tensor, target_next_q: Tensor) -> Tensor:
    """y = r + discount max_a Q(s', a; theta-), float32 [B] (Eq. (4)).

    reward, discount: float32 [B]. target_next_q: float32 [B, A], of the target network.
    """
    best = target_next_q.max(dim=1).values
    return (reward + discount * best).detach()


def double_dqn_target(
    reward: Tensor, discount: Tensor, online_next_q: Tensor, target_next_q: Tensor
) -> Tensor:
    """y = r + discount Q(s', argmax_a Q(s', a; theta); theta-), float32 [B] (Eq. (2)).

    The online network picks the action, the target network says its value; both float32 [B, A].
    """
    picked = online_next_q.argmax(dim=1, keepdim=True)
    value = target_next_q.gather(1, picked).squeeze(1)
    return (reward + discount * value).detach()


def td_loss(
    q: Tensor, action: Tensor, target: Tensor, importance_weights: Tensor, kind: LossKind
) -> tuple[Tensor, Tensor]:
    """Loss float32 [] and TD errors y - Q(s, a), float32 [B], without gradient.

    q: float32 [B, A]; action: int64 [B]; target, importance_weights: float32 [B]. `squared` is
    Eq. (3), the mean of the squares; `huber` is half the square up to an error of 1, then linear.
    """
    taken = q.gather(1, action.unsqueeze(1)).squeeze(1)
    if kind == "squared":
        losses = functional.mse_loss(taken, target, reduction="none")
    else:
        losses = functional.huber_loss(taken, target, reduction="none")
    return torch.mean(importance_weights * losses), target - taken.detach()


@dataclass(frozen=True, slots=True)
class Update:
    """What one step tells; tensors stay on the device until someone reads them."""

    loss: Tensor  # float32 []
    mean_q: Tensor  # float32 [], mean over the batch of max_a Q(s, a)
    gradient_norm: Tensor  # float32 [], before clipping
    td_errors: Tensor  # float32 [B], target - Q(s, a), rewards scaled

    def numbers(self) -> Tensor:
        """All of it in one tensor, float32 [3 + B]."""
        return torch.cat(
            [torch.stack([self.loss, self.mean_q, self.gradient_norm]), self.td_errors]
        )

    @classmethod
    def of_numbers(cls, numbers: Tensor) -> Self:
        """The update of what `numbers` gave."""
        loss, mean_q, gradient_norm = numbers[:3].unbind()
        return cls(loss, mean_q, gradient_norm, numbers[3:])
