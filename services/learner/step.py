"""A gradient step on a batch: what the learner asks for, and the plain way to make one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.loss import td_loss

RMSPROP_DECAY = 0.9  # the ancestor's library


@dataclass(frozen=True, slots=True)
class Update:
    """The result of one step; tensors stay on the device until someone reads them."""

    loss: Tensor  # float32 []
    mean_q: Tensor  # float32 [], mean over the batch of max_a Q(s, a)
    gradient_norm: Tensor  # float32 [], before clipping
    td_errors: Tensor  # float32 [B], y - Q(s, a) before the step, rewards scaled

    def numbers(self) -> Tensor:
        """All of it in one tensor, float32 [3 + B]."""
        return torch.cat(
            [torch.stack([self.loss, self.mean_q, self.gradient_norm]), self.td_errors]
        )

    @classmethod
    def from_numbers(cls, numbers: Tensor) -> Self:
        """The inverse of `numbers`."""
        loss, mean_q, gradient_norm = numbers[:3].unbind()
        return cls(loss, mean_q, gradient_norm, numbers[3:])


class GradientStep(Protocol):
    """Changes a network's parameters by the gradient of `td_loss`, batch after batch."""

    updates_per_launch: int
    """Batches that one call takes at most."""

    def __call__(self, batches: Sequence[Batch], learning_rates: Sequence[float]) -> list[Update]:
        """Learn from these batches of one size, one after the other, each at its rate."""
        ...

    def ahead(self, batch: Batch) -> Batch:
        """The batch with all that its step needs and the online network does not change.

        Another thread may call it beside a step, for a later one.
        """
        ...

    def target_changed(self) -> None:
        """The target network has new parameters."""
        ...

    def moments(self) -> dict[str, Tensor]:
        """The optimizer's state by "<parameter>:<moment>"; {} before the first step."""
        ...

    def restore(self, moments: dict[str, Tensor]) -> None:
        """Go on with what `moments` gave, and with parameters that may have changed."""
        ...


class PlainStep:
    """The step as the paper has it: loss, gradient, clipping, optimizer. The oracle of the others.

    It changes the parameters of `online`, and none of `target`.
    """

    updates_per_launch = 1

    def __init__(self, online: QNetwork, target: QNetwork, agent: AgentConfig) -> None:
        self._online, self._target, self._agent = online, target, agent
        rate = torch.zeros((), device=next(online.parameters()).device)
        self._optimizer = make_optimizer(list(online.parameters()), agent, rate)
        self._learning_rate = rate

    def __call__(self, batches: Sequence[Batch], learning_rates: Sequence[float]) -> list[Update]:
        return [self._update(*each) for each in zip(batches, learning_rates, strict=True)]

    def _update(self, batch: Batch, learning_rate: float) -> Update:
        found = td_loss(self._online, self._target, batch, self._agent)
        self._optimizer.zero_grad()
        found.loss.backward()  # type: ignore[no-untyped-call]
        limit = self._agent.max_gradient_norm or torch.inf
        norm = torch.nn.utils.clip_grad_norm_(self._online.parameters(), limit)
        self._learning_rate.fill_(learning_rate)
        self._optimizer.step()
        return Update(found.loss.detach(), found.greedy_q.mean(), norm, found.td_errors)

    def ahead(self, batch: Batch) -> Batch:
        """Nothing is computed ahead."""
        return batch

    def target_changed(self) -> None:
        """Nothing of the target is kept."""

    def moments(self) -> dict[str, Tensor]:
        return moments_of(self._online, [self._optimizer])

    def restore(self, moments: dict[str, Tensor]) -> None:
        restore_moments(self._online, [self._optimizer], moments)


MOMENTS = {"adam": ("step", "exp_avg", "exp_avg_sq"), "rmsprop": ("step", "square_avg")}


def make_optimizer(
    parameters: list[Tensor], agent: AgentConfig, learning_rate: Tensor
) -> torch.optim.Optimizer:
    """The configured optimizer; learning_rate: float32 [], read at each step."""
    capturable, epsilon = learning_rate.device.type == "cuda", agent.optimizer_epsilon
    if agent.optimizer == "adam":
        return torch.optim.Adam(
            parameters, lr=learning_rate, eps=epsilon, fused=True, capturable=capturable
        )
    return torch.optim.RMSprop(
        parameters, lr=learning_rate, eps=epsilon, alpha=RMSPROP_DECAY, capturable=capturable
    )


def moments_of(network: QNetwork, optimizers: Sequence[torch.optim.Optimizer]) -> dict[str, Tensor]:
    """The state of optimizers that share a network's parameters, by "<parameter>:<moment>"."""
    return {
        f"{name}:{moment}": value
        for name, parameter in network.named_parameters()
        for optimizer in optimizers
        for moment, value in optimizer.state.get(parameter, {}).items()
    }


def restore_moments(
    network: QNetwork, optimizers: Sequence[torch.optim.Optimizer], moments: dict[str, Tensor]
) -> None:
    """Give optimizers the state that `moments_of` returned."""
    names = {name.rpartition(":")[2] for name in moments}
    name_of = {parameter: name for name, parameter in network.named_parameters()}
    for optimizer in optimizers:
        optimizer.state.clear()
        for group in optimizer.param_groups if moments else ():
            for parameter in group["params"]:
                optimizer.state[parameter] = {
                    moment: moments[f"{name_of[parameter]}:{moment}"] for moment in names
                }
