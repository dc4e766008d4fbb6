"""New parameters from the gradients of a batch's slices, shared by the learner's threads.

Nearly all parameters are weights of fully connected layers, and what a step does to them is bound
by memory. So no slice of a batch computes their gradient: it is one product over the whole batch,
and each thread makes some of its rows. Then each thread updates some of the parameters.

Invariants: pure; gradients are written in place, where a captured step finds them again.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.model.fast_forward import Operands, Trace, hidden_weights, scale_gradients
from mrcdrl.common.model.q_network import HIDDEN_UNITS, QNetwork
from mrcdrl.services.learner.accelerate.data_parallel import DataParallel
from mrcdrl.services.learner.step import make_optimizer, moments_of, restore_moments

_NEAR_ZERO = 1e-6  # added to a norm before it divides


@dataclass(frozen=True, slots=True)
class Gradients:
    """What some rows of a batch bring to the gradient of its loss."""

    of_operands: Operands  # all but the weights of fully connected hidden layers
    products: dict[str, tuple[Tensor, Tensor]]  # for those: inputs, and gradients of the sums


def leaves(operands: Operands, network: QNetwork) -> Operands:
    """The operands to evaluate by, where `gradients` is to follow."""
    hidden = hidden_weights(network)
    return {name: x.detach().requires_grad_(name not in hidden) for name, x in operands.items()}


def gradients(loss: Tensor, operands: Operands, trace: Trace) -> Gradients:
    """The gradients of a loss [] of values evaluated by `leaves`, with this trace."""
    wanted = {name: x for name, x in operands.items() if x.requires_grad}
    sums = [sums for _, sums in trace.products.values()]
    found = torch.autograd.grad(loss, [*wanted.values(), *sums])
    of_sums = found[len(wanted) :]
    return Gradients(
        of_operands=dict(zip(wanted, found, strict=False)),
        products={
            name: (inputs.detach(), gradient)
            for (name, (inputs, _)), gradient in zip(trace.products.items(), of_sums, strict=True)
        },
    )


class SharedOptimizer:
    """The gradients of a network's parameters, and the optimizers that follow them."""

    def __init__(
        self, network: QNetwork, agent: AgentConfig, learning_rate: Tensor, threads: DataParallel
    ) -> None:
        """learning_rate: float32 [], read at each step."""
        self._network = network
        self._hidden_weights = hidden_weights(network)
        self._limit = agent.max_gradient_norm
        self._threads = threads
        self._gradients: dict[str, Tensor] = {}
        for name, parameter in network.named_parameters():
            parameter.grad = torch.zeros_like(parameter)
            self._gradients[name] = parameter.grad
        self._optimizers = [
            make_optimizer(some, agent, learning_rate)
            for some in _even_parts(list(network.parameters()), threads.num_threads)
        ]

    def step(self, parts: Sequence[Gradients]) -> Tensor:
        """Change the parameters by the gradients of all parts of a batch.

        Returns the norm of the gradient before it is clipped, float32 [].
        """
        self._add_up(parts)
        products = {
            name: [_joined(x) for x in zip(*(part.products[name] for part in parts), strict=True)]
            for name in self._hidden_weights
        }

        def multiply(units: slice) -> list[Tensor]:
            """Make the rows of these units; their norms."""
            rows = [(self._gradients[name][units], *x) for name, x in products.items()]
            for gradient, inputs, of_sums in rows:
                _product(of_sums[:, units].T, inputs, gradient)
            return [torch.linalg.vector_norm(gradient) for gradient, _, _ in rows]

        norms = [norm for some in self._threads.map(multiply, HIDDEN_UNITS) for norm in some]
        others = [x for name, x in self._gradients.items() if name not in products]
        norms += torch._foreach_norm(others)
        norm: Tensor = torch.linalg.vector_norm(torch.stack(norms))
        if self._limit > 0:
            scale = (self._limit / (norm + _NEAR_ZERO)).clamp(max=1.0)
            torch._foreach_mul_(list(self._gradients.values()), scale)
        self._threads.map(self._step_some, len(self._optimizers))
        return norm

    def _add_up(self, parts: Sequence[Gradients]) -> None:
        """Sum the gradients of all parameters but the hidden weights."""
        first, *others = (part.of_operands for part in parts)
        into = [self._gradients[name] for name in first]
        torch._foreach_copy_(into, list(first.values()))
        for other in others:
            torch._foreach_add_(into, list(other.values()))
        scale_gradients(self._gradients)

    def _step_some(self, which: slice) -> None:
        for optimizer in self._optimizers[which]:
            optimizer.step()

    def moments(self) -> dict[str, Tensor]:
        """The optimizers' state by "<parameter>:<moment>"; {} before the first step."""
        return moments_of(self._network, self._optimizers)

    def restore(self, moments: dict[str, Tensor]) -> None:
        """Go on with what `moments` gave."""
        restore_moments(self._network, self._optimizers, moments)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _product(left: Tensor, right: Tensor, out: Tensor) -> None:
    if left.dtype == out.dtype:
        torch.mm(left, right, out=out)
    else:
        out.copy_(left @ right)


def _even_parts(parameters: Iterable[Tensor], num: int) -> list[list[Tensor]]:
    """Up to num lists of about equal size."""
    parts: list[list[Tensor]] = [[] for _ in range(num)]
    for parameter in sorted(parameters, key=Tensor.numel, reverse=True):
        min(parts, key=lambda part: sum(map(Tensor.numel, part))).append(parameter)
    return [part for part in parts if part]
