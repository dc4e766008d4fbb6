"""The learner: one batch in, one gradient step (paper sections 4 and 5.2).

Invariants: no clock, lock or transport; the target network is a copy of the online one taken at
the last multiple of target_period; a learner restored from `state()` goes on exactly as the one
that gave it; nothing in `step` waits for the device.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from safetensors.torch import save as write_safetensors
from torch import Tensor

from common.config import AgentConfig, LearnerConfig
from common.errors import CheckpointError, ConfigError, DivergedError
from common.network import (
    SENT_AS,
    Operands,
    QNetwork,
    load_weights,
    precision,
    read_arrays,
    weights_to_bytes,
)
from common.schedule import value_at
from services.learner.batch import Batch
from services.learner.targets import double_dqn_target, dqn_target, td_loss

RMSPROP_DECAY = 0.9  # of the ancestor's library


@dataclass(frozen=True, slots=True)
class Update:
    """What one step tells; tensors stay on the device until someone reads them."""

    loss: Tensor  # float32 []
    td_errors: Tensor  # float32 [B], target - Q(s, a), rewards scaled
    mean_q: Tensor  # float32 [], mean over the batch of max_a Q(s, a)
    gradient_norm: Tensor  # float32 [], before clipping


@dataclass(frozen=True, slots=True)
class LearnerState:
    """All that a learner needs to go on, ready to be written."""

    learner_step: int
    model: bytes  # weights
    target: bytes  # weights
    optimizer: bytes  # safetensors: float32 by "<parameter>:<moment>"
    rng_state: dict[str, Any]  # of the symmetries' generator, as JSON takes it


def resolve_device(setting: str) -> torch.device:
    """`auto`: cuda if there is one, else cpu. Raises ConfigError for a device that is none."""
    if setting == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(setting)
    except RuntimeError as error:
        raise ConfigError(f"learner.device {setting!r} is no device; use auto or cpu") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"learner.device {setting!r}: no CUDA device here; use auto or cpu")
    return device


class Learner:
    """Online and target network, optimiser and their step."""

    def __init__(
        self, agent: AgentConfig, learner: LearnerConfig, *, stack: int, view_px: int
    ) -> None:
        self.agent = agent
        self.device = resolve_device(learner.device)
        self.learner_step = 0
        self.rng = np.random.default_rng(learner.seed)  # for whoever draws symmetries
        self._sent_as = SENT_AS[learner.publish_precision]
        dtype = precision(learner.precision, self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(learner.seed)
            online = QNetwork(agent.kind, stack=stack, view_px=view_px, compute_dtype=dtype)
            target = QNetwork(agent.kind, stack=stack, view_px=view_px, compute_dtype=dtype)
        self.online = online.to(self.device)
        self.target = target.to(self.device).requires_grad_(requires_grad=False)
        self._copy_to_target()
        self._optimizer = self._make_optimizer()

    def __repr__(self) -> str:
        return (
            f"Learner(kind={self.agent.kind!r}, device={str(self.device)!r}, "
            f"dtype={self.online.compute_dtype}, learner_step={self.learner_step})"
        )

    def step(self, batch: Batch) -> Update:
        """Learn from one batch; the td_errors are of the parameters before the step."""
        operands = self.online.operands()
        target = self._target(batch, operands)
        q = self.online.evaluate(self.online.prepare(batch.observation), operands)
        loss, td_errors = td_loss(
            q, batch.action, target, batch.importance_weights, self.agent.loss
        )
        self._set_learning_rate()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        gradient_norm = self._clip_gradient()
        self._optimizer.step()
        self.learner_step += 1
        if self.learner_step % self.agent.target_period == 0:
            self._copy_to_target()
        mean_q = q.detach().max(dim=1).values.mean()
        return Update(loss.detach(), td_errors, mean_q, gradient_norm)

    def payload(self) -> bytes:
        """The online parameters for publication; raises DivergedError if one is not finite."""
        return self._to_bytes(self.online, self._sent_as)

    def state(self) -> LearnerState:
        """A copy of everything; raises DivergedError if a number of it is not finite."""
        moments = {
            f"{name}:{moment}": value.detach().cpu().contiguous()
            for name, parameter in self.online.named_parameters()
            for moment, value in self._optimizer.state[parameter].items()
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
        self._target_operands = self.target.operands()
        self._optimizer = self._make_optimizer()
        for name, parameter in self.online.named_parameters():
            if moments:
                self._optimizer.state[parameter] = {
                    moment: moments[f"{name}:{moment}"] for moment in self._moments
                }
        self.learner_step = state.learner_step
        self.rng.bit_generator.state = rng.bit_generator.state

    def _read_moments(self, payload: bytes) -> dict[str, Tensor]:
        """The optimiser's tensors, each on its device; {} before the first step."""
        arrays = read_arrays(payload)
        shapes = {
            f"{name}:{moment}": torch.Size() if moment == "step" else parameter.shape
            for name, parameter in self.online.named_parameters()
            for moment in self._moments
        }
        if arrays and {name: array.shape for name, array in arrays.items()} != shapes:
            raise CheckpointError(
                f"the checkpoint's optimiser is not {self.agent.optimizer} of a "
                f"{self.agent.kind} network like this"
            )
        host = torch.device("cpu")  # where RMSprop, which is not fused, counts its steps
        return {
            name: array.to(
                host if name.endswith(":step") and not self._adam else self.device, copy=True
            )
            for name, array in arrays.items()
        }

    @property
    def _moments(self) -> tuple[str, ...]:
        return ("step", "exp_avg", "exp_avg_sq") if self._adam else ("step", "square_avg")

    def _set_learning_rate(self) -> None:
        factor = value_at(self.agent.learning_rate_schedule, self.learner_step)
        self._optimizer.param_groups[0]["lr"] = self.agent.learning_rate * factor

    @property
    def _adam(self) -> bool:
        return self.agent.optimizer == "adam"

    def _target(self, batch: Batch, operands: Operands) -> Tensor:
        """y of Eq. (2), or of Eq. (4) for `dqn`, float32 [B]; operands: of the online network."""
        reward = batch.reward * self.agent.reward_scale
        with torch.no_grad():
            next_states = self.target.prepare(batch.next_observation)
            target_next_q = self.target.evaluate(next_states, self._target_operands)
            if self.agent.kind == "dqn":
                return dqn_target(reward, batch.discount, target_next_q)
            online_next_q = self.online.evaluate(next_states, operands)
            return double_dqn_target(reward, batch.discount, online_next_q, target_next_q)

    def _copy_to_target(self) -> None:
        self.target.load_state_dict(self.online.state_dict())
        self._target_operands = self.target.operands()

    def _clip_gradient(self) -> Tensor:
        limit = self.agent.max_gradient_norm
        parameters = list(self.online.parameters())
        if limit > 0:
            return torch.nn.utils.clip_grad_norm_(parameters, limit)
        return torch.nn.utils.get_total_norm(p.grad for p in parameters if p.grad is not None)

    def _make_optimizer(self) -> torch.optim.Optimizer:
        parameters = list(self.online.parameters())
        rate, epsilon = self.agent.learning_rate, self.agent.optimizer_epsilon
        if self._adam:
            return torch.optim.Adam(parameters, lr=rate, eps=epsilon, fused=True)
        return torch.optim.RMSprop(parameters, lr=rate, eps=epsilon, alpha=RMSPROP_DECAY)
