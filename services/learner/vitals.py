"""Signs that learning goes astray, told while it can still be mended.

Invariants: looks only, and changes nothing; one inference on a few states for each look, so that
a look a second costs next to nothing; a warning is logged once until its cause has gone.
"""

import logging
import math

import torch
from torch import Tensor

from common.config import Config
from services.learner.batch import Batch
from services.learner.learner import Learner, Update

_LOG = logging.getLogger("learner")
_STATES = 64  # of a batch that are looked at
_TOO_LARGE = 2.0  # times the largest return
_TOO_DEAD = 0.9


class Vitals:
    """Values, errors, units and target of a learner, as its last batch shows them."""

    def __init__(self, config: Config, learner: Learner) -> None:
        self._learner = learner
        self._largest_return = largest_return(config)
        self._warned: set[str] = set()

    def look(self, batch: Batch, update: Update) -> dict[str, float]:
        """Metrics by name after a step on this batch; logs what is alarming."""
        q, dead_share = self._infer(batch.observation[:_STATES])
        errors = update.td_errors.abs()
        q_min, q_p50, q_max = _quantiles(q, 0.0, 0.5, 1.0)
        error_p50, error_p90, error_p99 = _quantiles(errors, 0.5, 0.9, 0.99)
        self._warn(
            "values",
            max(-q_min, q_max) > _TOO_LARGE * self._largest_return,
            f"values of {q_min:.3g} to {q_max:.3g}, where no return exceeds "
            f"{self._largest_return:.3g}: learning diverges; lower agent.learning_rate",
        )
        self._warn(
            "units",
            dead_share > _TOO_DEAD,
            f"{dead_share:.0%} of the network's units are 0 whatever they see: little can be "
            "learned any more; lower agent.learning_rate and start anew",
        )
        return {
            "loss_finite": math.isfinite(float(update.loss)),
            "q_min": q_min,
            "q_p50": q_p50,
            "q_max": q_max,
            "td_error_p50": error_p50,
            "td_error_p90": error_p90,
            "td_error_p99": error_p99,
            "dead_share": dead_share,
            "target_drift": self._target_drift(),
        }

    def _infer(self, states: Tensor) -> tuple[Tensor, float]:
        """Values [B, A], and the share of hidden units that are 0 for all these states.

        Of a convolution the units are its channels.
        """
        network = self._learner.online
        seen: list[Tensor] = []
        with torch.no_grad():
            q = network.evaluate(network.prepare(states), network.operands(), seen)
        dead = torch.cat([x.transpose(0, 1).flatten(1).amax(1) <= 0 for x in seen])
        return q, float(dead.float().mean())

    def _target_drift(self) -> float:
        """Distance of the online parameters from the target's, relative to the latter's length."""
        online, target = self._learner.online.parameters(), self._learner.target.parameters()
        with torch.no_grad():
            pairs = [(p - t, t) for p, t in zip(online, target, strict=True)]
            far = torch.nn.utils.get_total_norm([difference for difference, _ in pairs])
            length = torch.nn.utils.get_total_norm([parameter for _, parameter in pairs])
        return float(far / length)

    def _warn(self, cause: str, alarming: bool, text: str) -> None:
        if alarming and cause not in self._warned:
            _LOG.warning("%s", text)
        (self._warned.add if alarming else self._warned.discard)(cause)


def largest_return(config: Config) -> float:
    """A bound of what any state is worth, in scaled rewards: all that an episode may bring."""
    arena, gamma = config.arena, config.agent.gamma
    steps = min(arena.max_frames, 1 / (1 - gamma))
    rewards = (
        abs(arena.success_reward)
        + arena.max_collisions * abs(arena.collision_reward)
        + steps * abs(arena.step_reward)
    )
    return config.agent.reward_scale * rewards


def _quantiles(values: Tensor, *shares: float) -> list[float]:
    found = torch.quantile(values.flatten().float(), torch.tensor(shares, device=values.device))
    return [float(value) for value in found]
