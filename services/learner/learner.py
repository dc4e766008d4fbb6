"""The learner: one batch in, one gradient step (paper sections 4 and 5.2).

Invariants: no clock, lock or transport; the target network is a copy of the online one taken at
the last multiple of target_period; a learner restored from `state()` goes on exactly as the one
that gave it; a step is the same operations in the same order whether it is done as they come or
replayed, and nothing in it waits for the device.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import save as write_safetensors
from torch import Tensor

from mrcdrl.common.config import AgentConfig, LearnerConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import CheckpointError, ConfigError, DivergedError
from mrcdrl.common.model.q_network import Operands, QNetwork, Trace, precision, resolve_device
from mrcdrl.common.model.weights_io import SENT_AS, load_weights, read_arrays, weights_to_bytes
from mrcdrl.services.learner.accelerate.cuda_graphs import CudaGraphs, Recorder, Recording
from mrcdrl.services.learner.accelerate.data_parallel import Slices
from mrcdrl.services.learner.accelerate.optimizer import (
    MOMENTS,
    Descent,
    Gradients,
    gradients,
    leaves,
)
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.loss import Update, double_dqn_target, dqn_target, td_loss


@dataclass(frozen=True, slots=True)
class LearnerState:
    """All that a learner needs to go on, ready to be written."""

    learner_step: int
    model: bytes  # weights
    target: bytes  # weights
    optimizer: bytes  # safetensors: float32 by "<parameter>:<moment>"
    rng_state: dict[str, Any]  # of the symmetries' generator, as JSON takes it


@dataclass(frozen=True, slots=True)
class _Part:
    """What some rows of a batch bring."""

    loss: Tensor  # float32 [], their share in the batch's
    greedy_q: Tensor  # float32 [rows]
    td_errors: Tensor  # float32 [rows]
    gradients: Gradients


class Learner:
    """Online and target network, optimiser and their step."""

    def __init__(
        self,
        agent: AgentConfig,
        learner: LearnerConfig,
        *,
        stack: int,
        view_px: int,
        threads: int = 1,
        recorder: Recorder | None = None,
    ) -> None:
        """threads: that share a batch on a CPU, each one of torch's. recorder: of steps, instead
        of the device's own.

        Raises ConfigError for a device that is none, or one that cannot do what learner.step says.
        """
        self.agent = agent
        self.device = resolve_device(learner.device, "learner.device")
        self.learner_step = 0
        self.rng = np.random.default_rng(learner.seed)  # for whoever draws symmetries
        self._sent_as = SENT_AS[learner.publish_precision]
        self._slices = Slices(threads if self.device.type == "cpu" else 1)
        self._recorder = recorder or _device_recorder(learner.step, self.device)
        self.updates_per_launch = learner.updates_per_launch if self._recorder else 1
        self._recordings: dict[int, Recording] = {}
        dtype = precision(learner.precision, self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(learner.seed)
            online = QNetwork(agent.kind, stack=stack, view_px=view_px, compute_dtype=dtype)
            target = QNetwork(agent.kind, stack=stack, view_px=view_px, compute_dtype=dtype)
        self.online = online.to(self.device)
        self.target = target.to(self.device).requires_grad_(requires_grad=False)
        self._target_operands = self.target.operands()
        self._copy_to_target()
        self._learning_rate = torch.zeros((), device=self.device)  # where a recorded step reads it
        self._descent = Descent(self.online, agent, self._learning_rate, self._slices)

    def __repr__(self) -> str:
        step = "eager" if self._recorder is None else f"graph of up to {self.updates_per_launch}"
        return (
            f"Learner(kind={self.agent.kind!r}, device={str(self.device)!r}, step={step!r}, "
            f"dtype={self.online.compute_dtype}, learner_step={self.learner_step})"
        )

    def step(self, batch: Batch) -> Update:
        """Learn from one batch; the td_errors are of the parameters before the step."""
        return self.steps([batch])[0]

    def steps(self, batches: Sequence[Batch]) -> list[Update]:
        """Learn from these batches of one size, one after the other; `updates_per_launch` of them
        in one launch where no copy to the target network lies between.
        """
        updates: list[Update] = []
        while len(updates) < len(batches):
            following = batches[len(updates) :][: self.updates_per_launch]
            period = self.agent.target_period
            if not self.updates_per_launch == len(following) <= period - self.learner_step % period:
                following = following[:1]
            updates += self._launch(following)
            self.learner_step += len(following)
            if self.learner_step % period == 0:
                self._copy_to_target()
        return updates

    def _launch(self, batches: Sequence[Batch]) -> list[Update]:
        rates = [self._rate_at(self.learner_step + i) for i in range(len(batches))]
        if self._recorder is None:
            self._learning_rate.fill_(rates[0])
            return [self._update(batches[0])]
        num = len(batches)
        if num not in self._recordings:
            self._recordings[num] = Recording(
                self._recorder, self._update, self._learning_rate, batches[0], num
            )
        return self._recordings[num](batches, rates)

    def _update(self, batch: Batch) -> Update:
        """One step on the device; nothing of it waits for the device or counts in Python."""
        with torch.no_grad():
            operands = self.online.operands()
            reward = batch.reward * self.agent.reward_scale
        size = len(batch.keys)
        scaled = replace(batch, reward=reward)
        parts = self._slices.map(
            lambda rows: self._differentiate(scaled.map(lambda x: x[rows]), operands, size), size
        )
        gradient_norm = self._descent.step([part.gradients for part in parts])
        return Update(
            loss=torch.stack([part.loss for part in parts]).sum(),
            mean_q=torch.cat([part.greedy_q for part in parts]).mean(),
            gradient_norm=gradient_norm,
            td_errors=torch.cat([part.td_errors for part in parts]),
        )

    def _differentiate(self, rows: Batch, operands: Operands, size: int) -> _Part:
        """Loss of these rows of a batch of that size, and its gradient."""
        target = self._target(rows, operands)
        own, trace = leaves(operands, self.online), Trace()
        q = self.online.evaluate(self.online.prepare(rows.observation), own, trace)
        mean, td_errors = td_loss(q, rows.action, target, rows.importance_weights, self.agent.loss)
        loss = mean * (len(q) / size)
        greedy_q = q.detach().max(dim=1).values
        return _Part(loss.detach(), greedy_q, td_errors, gradients(loss, own, trace))

    def payload(self) -> bytes:
        """The online parameters for publication; raises DivergedError if one is not finite."""
        return self._to_bytes(self.online, self._sent_as)

    def state(self) -> LearnerState:
        """A copy of everything; raises DivergedError if a number of it is not finite."""
        moments = {
            name: moment.detach().cpu().contiguous()
            for name, moment in self._descent.moments().items()
        }
        if not all(bool(torch.isfinite(moment).all()) for moment in moments.values()):
            raise self._diverged("the optimiser has moments that are not finite")
        return LearnerState(
            learner_step=self.learner_step,
            model=self._to_bytes(self.online, torch.float32),
            target=self._to_bytes(self.target, torch.float32),
            optimizer=write_safetensors(moments),
            rng_state=dict(self.rng.bit_generator.state),
        )

    def _to_bytes(self, network: QNetwork, dtype: torch.dtype) -> bytes:
        try:
            return weights_to_bytes(network, dtype)
        except CheckpointError as error:
            raise self._diverged(str(error)) from error

    def _diverged(self, what: str) -> DivergedError:
        return DivergedError(
            f"learning diverged by step {self.learner_step}: {what}. Nothing of it was published; "
            "go on from the last checkpoint with a lower agent.learning_rate or with "
            "agent.max_gradient_norm: mrcdrl train --resume"
        )

    def restore(self, state: LearnerState) -> None:
        """Go on from a state; raises CheckpointError if it is damaged or of another agent."""
        moments = self._read_moments(state.optimizer)
        rng = np.random.default_rng()
        try:
            rng.bit_generator.state = state.rng_state
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"the checkpoint's rng_state is damaged: {error}") from error
        load_weights(self.target, state.target)
        load_weights(self.online, state.model)
        self._refresh_target_operands()
        self._recordings.clear()
        self._descent.restore(moments)
        self.learner_step = state.learner_step
        self.rng.bit_generator.state = rng.bit_generator.state

    def _read_moments(self, payload: bytes) -> dict[str, Tensor]:
        """The optimiser's tensors, each on its device; {} before the first step."""
        arrays = read_arrays(payload)
        shapes = {
            f"{name}:{moment}": torch.Size() if moment == "step" else parameter.shape
            for name, parameter in self.online.named_parameters()
            for moment in MOMENTS[self.agent.optimizer]
        }
        if arrays and {name: array.shape for name, array in arrays.items()} != shapes:
            raise CheckpointError(
                f"the checkpoint's optimiser is not {self.agent.optimizer} of a "
                f"{self.agent.kind} network like this"
            )
        return {name: array.to(self.device, copy=True) for name, array in arrays.items()}

    def _rate_at(self, learner_step: int) -> float:
        return self.agent.learning_rate * value_at(self.agent.learning_rate_schedule, learner_step)

    def _target(self, rows: Batch, operands: Operands) -> Tensor:
        """y of Eq. (2), or of Eq. (4) for `dqn`, float32 [B]; operands: of the online network."""
        with torch.no_grad():
            next_states = self.target.prepare(rows.next_observation)
            target_next_q = self.target.evaluate(next_states, self._target_operands)
            if self.agent.kind == "dqn":
                return dqn_target(rows.reward, rows.discount, target_next_q)
            online_next_q = self.online.evaluate(next_states, operands)
            return double_dqn_target(rows.reward, rows.discount, online_next_q, target_next_q)

    def _copy_to_target(self) -> None:
        self.target.load_state_dict(self.online.state_dict())
        self._refresh_target_operands()

    def _refresh_target_operands(self) -> None:
        """In place: a recorded step reads them where they are."""
        operands = self.target.operands()
        torch._foreach_copy_(list(self._target_operands.values()), list(operands.values()))


def _device_recorder(
    setting: Literal["auto", "eager", "graph"], device: torch.device
) -> Recorder | None:
    """Of CUDA graphs where the device and the setting have them; None: steps are eager."""
    if device.type == "cuda":
        return None if setting == "eager" else CudaGraphs()
    if setting == "graph":
        raise ConfigError(
            f"learner.step 'graph': only a CUDA device replays graphs, not {device}; use auto"
        )
    return None
