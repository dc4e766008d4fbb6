"""The update on one screen: the loss of a TD error (paper section 4, Eqs. (2) to (4)).

Two targets that are not the paper's are options: Munchausen DQN and advantage learning.

`td_loss` is a pure function of two action-value functions and a batch. Every learner step computes
it: `PlainStep` with the networks themselves, `accelerate/` with faster ways to evaluate and
differentiate the same functions.

Shapes: B = transitions, A = actions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from mrcdrl.common.config import AgentConfig
from mrcdrl.services.learner.batch import Batch

S = TypeVar("S")  # states, in the form that the action-value functions take


@dataclass(frozen=True, slots=True)
class TDLoss:
    """The loss of a batch, and what is known of it besides."""

    loss: Tensor  # float32 [], with gradient
    td_errors: Tensor  # float32 [B], y - Q(s, a), rewards scaled
    greedy_q: Tensor  # float32 [B], max_a Q(s, a)


def td_loss(
    online: Callable[[S], Tensor],
    target: Callable[[S], Tensor],
    batch: Batch[S],
    agent: AgentConfig,
) -> TDLoss:
    """Loss and TD errors of a batch; online, target: states to values float32 [B, A].

    A discount of 0 leaves the bootstrap out, whatever the values of the next state are. Only the
    values of the actions taken have a gradient, and those that a demonstration compares.
    """
    with torch.no_grad():
        next_q = target(batch.next_observation)
        if agent.munchausen_alpha and agent.munchausen_temperature:
            next_value = _soft_maximum(next_q, agent.munchausen_temperature)
        else:
            # dqn, Eq. (4): the target network picks the action whose value it gives. ddqn and
            # duel, Eq. (2): the online network picks it.
            chooses = next_q if agent.kind == "dqn" else online(batch.next_observation)
            next_value = next_q.gather(1, chooses.argmax(dim=1, keepdim=True)).squeeze(1)
        y = agent.reward_scale * batch.reward + batch.discount * next_value
        if agent.munchausen_alpha:
            y = y + _log_policy_term(target(batch.observation), batch.action, agent)
    q = online(batch.observation)
    taken = _values_of(batch.action, q)
    if agent.loss == "squared":  # Eq. (3)
        losses = functional.mse_loss(taken, y, reduction="none")
    else:  # half the square up to an error of 1, then linear
        losses = functional.huber_loss(taken, y, reduction="none")
    loss = torch.mean(batch.importance_weights * losses)
    if batch.demonstration is not None:
        shown = batch.demonstration
        short = _short_of_margin(shown.actions, q, agent.demonstration_margin)
        loss = loss + torch.mean(shown.weights * short)
    q = q.detach()
    return TDLoss(loss, td_errors=y - taken.detach(), greedy_q=q.max(dim=1).values)


def _short_of_margin(action: Tensor, q: Tensor, margin: float) -> Tensor:
    """max_a (q(a) + margin if a is not the action shown) - q(action) [B], of actions [B]; >= 0.

    The large-margin loss of DQfD (Hester et al. 2018, section 4): 0 once the action shown is the
    best by the margin.
    """
    raised = (q + margin).scatter(1, action.unsqueeze(1), _values_of(action, q).unsqueeze(1))
    return raised.max(dim=1).values - _values_of(action, q)


def _log_policy_term(q: Tensor, action: Tensor, agent: AgentConfig) -> Tensor:
    """What is added to the target for actions [B] in states with target values q [B, A]; <= 0.

    Munchausen DQN (Vieillard et al. 2020): alpha tau log pi(a|s), where tau log pi counts as minus
    the clip if it is below that. With tau -> 0 it is Q(s, a) - max Q(s, .), advantage learning
    (Bellemare et al. 2016). As in the authors' code, an n-step return has the term of its first
    action alone.
    """
    log_policy = _values_of(action, q) - _soft_maximum(q, agent.munchausen_temperature)
    return agent.munchausen_alpha * log_policy.clamp(-agent.munchausen_clip, 0.0)


def _soft_maximum(q: Tensor, temperature: float) -> Tensor:
    """sum_a pi(a) (q(a) - tau log pi(a)) [B], with pi = softmax(q / tau); at 0 the maximum."""
    if not temperature:
        return q.max(dim=1).values
    return temperature * torch.logsumexp(q / temperature, dim=1)


def _values_of(action: Tensor, q: Tensor) -> Tensor:
    """The values [B] of these actions [B], of q [B, A]."""
    return q.gather(1, action.unsqueeze(1)).squeeze(1)
