"""What one step tells."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor


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
