"""The accelerated gradient step: threads that share a batch on a CPU, captured steps on a GPU.

Invariants: the loss is `loss.td_loss`, evaluated by `fast_forward`; gradients are the plain step's
within rounding, whatever the number of threads; a captured step gives the numbers of an eager one
to the bit; nothing waits for the device.
"""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.model.fast_forward import (
    Operands,
    States,
    Trace,
    fast_forward,
    operands,
    prepare,
)
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.services.learner.accelerate.cuda_graphs import CapturedSteps, Capturer
from mrcdrl.services.learner.accelerate.data_parallel import DataParallel
from mrcdrl.services.learner.accelerate.optimizer import (
    Gradients,
    SharedOptimizer,
    gradients,
    leaves,
)
from mrcdrl.services.learner.accelerate.thread_tuner import ThreadTuner
from mrcdrl.services.learner.batch import Ahead, Batch
from mrcdrl.services.learner.loss import TDLoss, td_loss
from mrcdrl.services.learner.step import Update


@dataclass(frozen=True, slots=True)
class _Part:
    """What some rows of a batch bring."""

    found: TDLoss
    loss: Tensor  # float32 [], their part of the batch's
    gradients: Gradients


class AcceleratedStep:
    """A `GradientStep`: the same numbers as `PlainStep` within rounding, several times as fast."""

    def __init__(
        self,
        online: QNetwork,
        target: QNetwork,
        agent: AgentConfig,
        *,
        num_threads: int = 1,
        tuner: ThreadTuner | None = None,
        capturer: Capturer | None = None,
        updates_per_launch: int = 1,
    ) -> None:
        """num_threads: share a batch. tuner: chooses how many of them do; None: all of them.

        capturer: None where steps are eager.

        updates_per_launch: steps that one captured launch makes.
        """
        device = next(online.parameters()).device
        self._online, self._target, self._agent = online, target, agent
        self._threads = DataParallel(num_threads)
        self._tuner = tuner
        self._target_operands = {n: x.detach().clone() for n, x in operands(target).items()}
        self._target_version = 0
        self._target_lock = threading.Lock()  # of the two above, for `ahead`
        self._learning_rate = torch.zeros((), device=device)  # where a captured step reads it
        self._optimizer = SharedOptimizer(online, agent, self._learning_rate, self._threads)
        self._capturer = capturer
        self._captured: dict[int, CapturedSteps] = {}
        self.updates_per_launch = updates_per_launch if capturer else 1

    def __repr__(self) -> str:
        return "eager" if self._capturer is None else f"graph of up to {self.updates_per_launch}"

    def __call__(self, batches: Sequence[Batch], learning_rates: Sequence[float]) -> list[Update]:
        if self._capturer is None:
            return [self._eager(*each) for each in zip(batches, learning_rates, strict=True)]
        num = len(batches)
        if num not in self._captured:
            self._captured[num] = CapturedSteps(
                self._capturer, self._update, self._learning_rate, batches[0], num
            )
        return self._captured[num](batches, learning_rates)

    def _eager(self, batch: Batch, learning_rate: float) -> Update:
        self._learning_rate.fill_(learning_rate)
        if self._tuner is None:
            return self._update(batch)
        self._threads.active = self._tuner.count
        started = time.perf_counter()
        update = self._update(batch)
        self._tuner.took(time.perf_counter() - started)
        return update

    def _update(self, batch: Batch) -> Update:
        """One step on the device; it neither waits for the device nor counts in Python."""
        with torch.no_grad():
            own = operands(self._online)
        size = len(batch.keys)
        parts = self._threads.map(lambda rows: self._part(batch[rows], own, size), size)
        gradient_norm = self._optimizer.step([part.gradients for part in parts])
        return Update(
            loss=torch.stack([part.loss for part in parts]).sum(),
            mean_q=torch.cat([part.found.greedy_q for part in parts]).mean(),
            gradient_norm=gradient_norm,
            td_errors=torch.cat([part.found.td_errors for part in parts]),
        )

    def _part(self, rows: Batch, own: Operands, size: int) -> _Part:
        """The loss of these rows of a batch of that size, and its gradient."""
        own, trace = leaves(own, self._online), Trace()

        def online(states: States) -> Tensor:
            return fast_forward(
                self._online, states, own, trace if torch.is_grad_enabled() else None
            )

        def target(states: States) -> Tensor:
            ahead = rows.ahead
            known = None if ahead is None else ahead.values_of(states, self._target_version)
            if known is not None:
                return known
            return fast_forward(self._target, states, self._target_operands)

        prepared = self._prepared(rows)
        found = td_loss(online, target, prepared, self._agent)
        loss = found.loss * (len(rows.keys) / size)
        return _Part(found, loss.detach(), gradients(loss, own, trace))

    def _prepared(self, batch: Batch) -> Batch[States]:
        """The batch with its states as the first layer takes them."""
        if batch.ahead is not None:
            return batch.with_states(batch.ahead.observation, batch.ahead.next_observation)
        states = (batch.observation, batch.next_observation)
        return batch.with_states(*(prepare(self._online, x) for x in states))

    def ahead(self, batch: Batch) -> Batch:
        """Add what is known ahead; nothing where every core has a thread of the step."""
        if 1 < self._threads.num_threads == self._threads.active:
            return batch
        states = self._prepared(batch)
        with torch.no_grad(), self._target_lock:
            next_q = fast_forward(self._target, states.next_observation, self._target_operands)
            version = self._target_version
        known = Ahead(states.observation, states.next_observation, next_q, version)
        return replace(batch, ahead=known)

    def target_changed(self) -> None:
        """Refresh the operands in place: a captured step reads them where they are."""
        fresh = operands(self._target)
        with self._target_lock:
            torch._foreach_copy_(list(self._target_operands.values()), list(fresh.values()))
            self._target_version += 1

    def moments(self) -> dict[str, Tensor]:
        return self._optimizer.moments()

    def restore(self, moments: dict[str, Tensor]) -> None:
        self.target_changed()
        self._captured.clear()
        self._optimizer.restore(moments)
