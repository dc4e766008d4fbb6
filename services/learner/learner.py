"""The learner: online and target network, and the steps that change them (paper section 5.2).

Invariants: no clock, lock or transport; the target network is a copy of the online one taken at
the last multiple of target_period; a learner restored from `state()` continues exactly like the
one that gave it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from safetensors.torch import save as write_safetensors
from torch import Tensor

from mrcdrl.common.config import AgentConfig, Config, LearnerConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import CheckpointError, DivergedError
from mrcdrl.common.messages.trajectory import NUM_ACTIONS
from mrcdrl.common.model.q_network import QNetwork, precision, resolve_device
from mrcdrl.common.model.weights_io import SENT_AS, load_weights, read_arrays, weights_to_bytes
from mrcdrl.services.learner.accelerate.cuda_graphs import Capturer, capturer_for
from mrcdrl.services.learner.accelerate.step import AcceleratedStep
from mrcdrl.services.learner.accelerate.thread_tuner import ThreadTuner
from mrcdrl.services.learner.average import ParameterAverage
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.step import MOMENTS, GradientStep, Update


@dataclass(frozen=True, slots=True)
class LearnerState:
    """All that a learner needs to continue, ready to be written."""

    learner_step: int
    model: bytes  # weights
    target: bytes  # weights
    optimizer: bytes  # safetensors: float32 by "<parameter>:<moment>"
    rng_state: dict[str, Any]  # of the symmetries' generator, as JSON takes it
    average: bytes = b""  # weights; empty without an average


class Learner:
    """Two networks, the gradient step between them, and their state."""

    def __init__(
        self,
        agent: AgentConfig,
        learner: LearnerConfig,
        *,
        stack: int,
        view_px: int,
        num_actions: int = NUM_ACTIONS,
        threads: int = 1,
        tuner: ThreadTuner | None = None,
        capturer: Capturer | None = None,
    ) -> None:
        """threads: share a batch on a CPU, each one of torch's. tuner: chooses how many of them do.
        capturer: of steps, instead of the device's own.

        Raises ConfigError for an unknown device, or one that cannot do what learner.step says.
        """
        self.agent = agent
        self.device = resolve_device(learner.device, "learner.device")
        self.learner_step = 0
        self.rng = np.random.default_rng(learner.seed)  # draws symmetries
        self._sent_as = SENT_AS[learner.publish_precision]
        dtype = precision(learner.precision, self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(learner.seed)
            online, target = (
                QNetwork(
                    agent.kind,
                    stack=stack,
                    view_px=view_px,
                    num_actions=num_actions,
                    compute_dtype=dtype,
                )
                for _ in range(2)
            )
        self.online = online.to(self.device)
        self.target = target.to(self.device).requires_grad_(requires_grad=False)
        self.target.load_state_dict(self.online.state_dict())
        decay = learner.average_decay
        self._average_apart = learner.average_apart
        self._average = ParameterAverage(self.online, decay) if decay else None
        on_cpu = self.device.type == "cpu"
        self._step: GradientStep = AcceleratedStep(
            self.online,
            self.target,
            agent,
            num_threads=threads if on_cpu else 1,
            tuner=tuner if on_cpu else None,
            capturer=capturer or capturer_for(learner.step, self.device),
            updates_per_launch=learner.updates_per_launch,
        )

    @classmethod
    def from_config(
        cls, config: Config, threads: int = 1, tuner: ThreadTuner | None = None
    ) -> Self:
        """The learner of a run; threads and tuner as in the constructor."""
        return cls(
            config.agent,
            config.learner,
            stack=config.arena.stack,
            view_px=config.arena.view_px,
            num_actions=config.arena.action_count,
            threads=threads,
            tuner=tuner,
        )

    def __repr__(self) -> str:
        return (
            f"Learner(kind={self.agent.kind!r}, device={str(self.device)!r}, "
            f"step={str(self._step)!r}, "
            f"dtype={self.online.compute_dtype}, learner_step={self.learner_step})"
        )

    @property
    def updates_per_launch(self) -> int:
        """Batches that `steps` learns from in one launch."""
        return self._step.updates_per_launch

    def step(self, batch: Batch) -> Update:
        """Learn from one batch."""
        return self.steps([batch])[0]

    def steps(self, batches: Sequence[Batch]) -> list[Update]:
        """Learn from these batches of one size, one after the other.

        `updates_per_launch` of them share a launch where no copy to the target network lies
        between.
        """
        updates: list[Update] = []
        most, period = self.updates_per_launch, self.agent.target_period
        while len(updates) < len(batches):
            following = batches[len(updates) :][:most]
            if not most == len(following) <= period - self.learner_step % period:
                following = following[:1]
            rates = [self._rate_at(self.learner_step + i) for i in range(len(following))]
            updates += self._step(following, rates)
            self.learner_step += len(following)
            if self._average is not None:
                self._average.update(self.online, self.learner_step, len(following))
            if self.learner_step % period == 0:
                self.target.load_state_dict(self.online.state_dict())
                self._step.target_changed()
        return updates

    def ahead(self, batch: Batch) -> Batch:
        """The batch with a part of its step's work done, by a thread beside that of the steps."""
        return self._step.ahead(batch)

    def payload(self) -> bytes:
        """The parameters that actors act by: the newest, or their average.

        Raises DivergedError if one is not finite.
        """
        return self._to_bytes(self.online if self._average_apart else self.tested, self._sent_as)

    def average_payload(self) -> bytes:
        """The average where actors act by other parameters, else empty; raises DivergedError."""
        return self._to_bytes(self.tested, self._sent_as) if self._average_apart else b""

    @property
    def tested(self) -> QNetwork:
        """The network whose parameters are tested and kept: the average, if there is one."""
        return self.online if self._average is None else self._average.network

    def start_from(self, payload: bytes) -> None:
        """Begin with these weights in place of random ones, of a network of any kind that fits.

        Raises CheckpointError if they do not fit.
        """
        load_weights(self.online, payload, any_kind=True)
        self.target.load_state_dict(self.online.state_dict())
        self._step.target_changed()
        if self._average is not None:
            self._average.reset(self.online)

    def state(self) -> LearnerState:
        """A copy of everything; raises DivergedError if a number of it is not finite."""
        moments = {
            name: moment.detach().cpu().contiguous()
            for name, moment in self._step.moments().items()
        }
        if not all(bool(torch.isfinite(moment).all()) for moment in moments.values()):
            raise self._diverged("the optimizer has moments that are not finite")
        return LearnerState(
            learner_step=self.learner_step,
            model=self._to_bytes(self.online, torch.float32),
            target=self._to_bytes(self.target, torch.float32),
            optimizer=write_safetensors(moments),
            rng_state=dict(self.rng.bit_generator.state),
            average=b"" if self._average is None else self._to_bytes(self.tested, torch.float32),
        )

    def restore(self, state: LearnerState) -> None:
        """Continue from a state; raises CheckpointError if it is damaged or of another agent."""
        moments = self._read_moments(state.optimizer)
        rng = np.random.default_rng()
        try:
            rng.bit_generator.state = state.rng_state
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"the checkpoint's rng_state is damaged: {error}") from error
        load_weights(self.target, state.target)
        load_weights(self.online, state.model)
        if self._average is not None:
            load_weights(self._average.network, state.average or state.model)
        self._step.restore(moments)
        self.learner_step = state.learner_step
        self.rng.bit_generator.state = rng.bit_generator.state

    def _to_bytes(self, network: QNetwork, dtype: torch.dtype) -> bytes:
        try:
            return weights_to_bytes(network, dtype)
        except CheckpointError as error:
            raise self._diverged(str(error)) from error

    def _diverged(self, what: str) -> DivergedError:
        return DivergedError(
            f"learning diverged by step {self.learner_step}: {what}. Nothing of it was published; "
            "continue from the last checkpoint with a lower agent.learning_rate or with "
            "agent.max_gradient_norm: mrcdrl train --resume"
        )

    def _read_moments(self, payload: bytes) -> dict[str, Tensor]:
        """The optimizer's tensors, each on its device; {} before the first step."""
        arrays = read_arrays(payload)
        shapes = {
            f"{name}:{moment}": torch.Size() if moment == "step" else parameter.shape
            for name, parameter in self.online.named_parameters()
            for moment in MOMENTS[self.agent.optimizer]
        }
        if arrays and {name: array.shape for name, array in arrays.items()} != shapes:
            raise CheckpointError(
                f"the checkpoint's optimizer is not {self.agent.optimizer} of a "
                f"{self.agent.kind} network like this"
            )
        return {name: array.to(self.device, copy=True) for name, array in arrays.items()}

    def _rate_at(self, learner_step: int) -> float:
        return self.agent.learning_rate * value_at(self.agent.learning_rate_schedule, learner_step)
