"""The loss against tables worked out by hand."""

from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.messages.trajectory import Float64Array
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.loss import td_loss

# reward, discount, online Q(s', .), target Q(s', .), DQN's y, double DQN's y
TABLE = [
    (1.0, 0.5, [1.0, 3.0, 2.0], [10.0, 20.0, 40.0], 21.0, 11.0),  # picks 1, not the highest
    (-5.0, 0.99, [0.0, 0.0, 1.0], [1.0, 2.0, 3.0], -2.03, -2.03),  # both pick 2
    (200.0, 0.0, [1.0, 2.0, 3.0], [1e9, 1e9, 1e9], 200.0, 200.0),  # terminated
    (0.03, 0.99, [3.0, 1.0, 1.0], [-2.0, -1.0, -3.0], -0.96, -1.95),  # truncated: bootstraps
    (0.0, 0.970299, [2.0, 1.0, 0.0], [4.0, 9.0, 0.0], 8.732691, 3.881196),  # gamma**3
]
NOW, NEXT = torch.tensor(0), torch.tensor(1)  # stand for the states


def batch_of(reward: Tensor, discount: Tensor, action: Tensor, weights: Tensor) -> Batch:
    return Batch(NOW, action, reward, discount, NEXT, weights, np.arange(len(reward)))


def columns() -> tuple[Tensor, ...]:
    return tuple(torch.tensor(column) for column in zip(*TABLE, strict=True))


@pytest.mark.parametrize("kind", ["dqn", "ddqn", "duel"])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_targets_by_hand(kind: Literal["dqn", "ddqn", "duel"], scale: float) -> None:
    """Where all values of the states are 0, TD errors are the targets."""
    reward, discount, online_next, target_next, dqn, double = columns()
    now = torch.zeros(len(reward), 3, requires_grad=True)
    online_next, target_next = online_next.requires_grad_(), target_next.requires_grad_()
    batch = batch_of(reward / scale, discount, torch.zeros(len(reward)).long(), reward * 0 + 1)
    found = td_loss(
        lambda states: now if states is NOW else online_next,
        lambda states: target_next,
        batch,
        AgentConfig(kind=kind, reward_scale=scale),
    )
    torch.testing.assert_close(found.td_errors, dqn if kind == "dqn" else double)
    assert not found.td_errors.requires_grad
    found.loss.backward()  # type: ignore[no-untyped-call]
    assert online_next.grad is target_next.grad is None, "a target has no gradient"


@pytest.mark.parametrize(
    ("kind", "loss", "gradient"),
    [
        ("squared", (1.0 * 0.25 + 0.5 * 9.0) / 2, [[0.0, -0.5, 0.0], [1.5, 0.0, 0.0]]),
        ("huber", (1.0 * 0.125 + 0.5 * 2.5) / 2, [[0.0, -0.25, 0.0], [0.25, 0.0, 0.0]]),
    ],
)
def test_losses_by_hand(
    kind: Literal["squared", "huber"], loss: float, gradient: list[list[float]]
) -> None:
    """Errors +0.5 and -3 with weights 1 and 0.5; only the action taken has a gradient."""
    q = torch.tensor([[7.0, 1.0, 7.0], [4.0, 7.0, 7.0]], requires_grad=True)
    weights, reward = torch.tensor([1.0, 0.5]), torch.tensor([1.5, 1.0])
    batch = batch_of(reward, torch.zeros(2), torch.tensor([1, 0]), weights)
    found = td_loss(lambda states: q, lambda states: q, batch, AgentConfig(loss=kind))
    found.loss.backward()  # type: ignore[no-untyped-call]
    assert found.loss.item() == pytest.approx(loss)
    assert found.td_errors.tolist() == [0.5, -3.0]
    assert found.greedy_q.tolist() == [7.0, 7.0]
    assert not found.greedy_q.requires_grad
    assert q.grad is not None
    assert q.grad.tolist() == gradient


def literal_target(
    reward: float, discount: float, action: int, own_q: list[float], next_q: list[float]
) -> float:
    """y of Munchausen DQN as its paper prints it, alpha 0.9, tau 0.5, clipped at -1."""

    def policy(q: list[float]) -> Float64Array:
        powers = np.exp(np.array(q) / 0.5)
        return np.asarray(powers / powers.sum(), np.float64)

    soft = policy(next_q) @ (np.array(next_q) - 0.5 * np.log(policy(next_q)))
    term = max(0.5 * np.log(policy(own_q)[action]), -1.0)
    return float(reward + 0.9 * term + discount * soft)


OWN_Q = [[0.5, 0.2, -0.1], [0.0, 4.0, 3.9], [1.0, 1.0, 1.0]]  # by the target network
NEXT_Q = [[1.0, 1.2, 0.7], [-3.0, -2.5, 2.0], [9.0, 8.0, 7.0]]
ACTIONS, REWARDS, DISCOUNTS = [1, 0, 2], [0.3, -5.0, 20.0], [0.99, 0.970299, 0.0]


def munchausen_errors(agent: AgentConfig) -> list[float]:
    """TD errors where all values of the online network are 0, except that it prefers action 2."""
    now, following = torch.zeros(3, 3), torch.tensor([[0.0, 0.0, 1.0]] * 3)
    own_q, next_q = torch.tensor(OWN_Q), torch.tensor(NEXT_Q)
    reward, discount = torch.tensor(REWARDS), torch.tensor(DISCOUNTS)
    batch = batch_of(reward, discount, torch.tensor(ACTIONS), torch.ones(3))
    found = td_loss(
        lambda states: now if states is NOW else following,
        lambda states: own_q if states is NOW else next_q,
        batch,
        agent,
    )
    errors: list[float] = found.td_errors.tolist()
    return errors


@pytest.mark.parametrize("kind", ["dqn", "ddqn", "duel"])
def test_munchausen_targets_are_those_of_its_paper(kind: Literal["dqn", "ddqn", "duel"]) -> None:
    """One clipped, one not; a termination keeps the term. The online network has no say."""
    agent = AgentConfig(kind=kind, munchausen_alpha=0.9, munchausen_temperature=0.5)
    rows = zip(REWARDS, DISCOUNTS, ACTIONS, OWN_Q, NEXT_Q, strict=True)
    expected = [literal_target(*row) for row in rows]
    assert munchausen_errors(agent) == pytest.approx(expected, rel=1e-6)
    looser = munchausen_errors(agent.model_copy(update={"munchausen_clip": 9.0}))
    assert looser[1] < expected[1] - 1
    assert looser[::2] == pytest.approx(expected[::2], rel=1e-6)


@pytest.mark.parametrize(("kind", "bootstraps"), [("dqn", [1.2, 2.0]), ("ddqn", [0.7, 2.0])])
def test_advantage_learning_targets_by_hand(
    kind: Literal["dqn", "ddqn"], bootstraps: list[float]
) -> None:
    """Q(s, a) - max Q(s, .) is -0.3, -4 and 0; the bootstrap is as without it."""
    agent = AgentConfig(
        kind=kind, munchausen_alpha=0.5, munchausen_temperature=0, munchausen_clip=3
    )
    assert munchausen_errors(agent) == pytest.approx(
        [
            0.3 - 0.5 * 0.3 + 0.99 * bootstraps[0],
            -5.0 - 0.5 * 3.0 + 0.970299 * bootstraps[1],
            20.0,
        ],
        rel=1e-6,
    )


@pytest.mark.parametrize("temperature", [0.0, 0.03])
def test_sharp_policies_are_finite_and_add_nothing_to_the_best_action(temperature: float) -> None:
    """Values of 200 over a temperature of 0.03 overflow a plain softmax."""
    agent = AgentConfig(munchausen_alpha=0.9, munchausen_temperature=temperature)
    q = torch.tensor([[200.0, 0.0, 150.0]])
    batch = batch_of(torch.ones(1), torch.zeros(1), torch.zeros(1).long(), torch.ones(1))
    found = td_loss(lambda states: 0 * q, lambda states: q, batch, agent)
    assert found.td_errors.tolist() == pytest.approx([1.0], abs=1e-4)


def converged(agent: AgentConfig) -> Float64Array:
    """Values [2, 2] that the target repeats, in a decision process of two states and actions.

    Action a in state s pays REWARD[s][a] and leads to state a.
    """
    states, actions = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])
    reward = torch.tensor([0.0, 0.1, 0.3, 0.0])
    batch = Batch(states, actions, reward, torch.full((4,), 0.5), actions, reward, np.arange(4))
    q = torch.zeros(2, 2)
    for _ in range(400):
        values = q.__getitem__
        q = q + td_loss(values, values, batch, agent).td_errors.reshape(2, 2)
    return q.double().numpy()


def test_advantage_learning_widens_the_gap_and_keeps_the_best_actions() -> None:
    """Gaps are those of Q* over 1 - alpha, and the best values stay (Bellemare et al. 2016)."""
    plain = converged(AgentConfig(kind="dqn"))
    agent = AgentConfig(kind="dqn", munchausen_alpha=0.75, munchausen_temperature=0)
    found = converged(agent)
    best = plain.max(axis=1, keepdims=True)
    np.testing.assert_allclose(best - found, 4 * (best - plain), atol=1e-5)
    assert (best - found).max() > 0.1


def test_without_alpha_the_other_settings_change_nothing() -> None:
    others = AgentConfig(munchausen_temperature=5.0, munchausen_clip=7.0)
    assert munchausen_errors(others) == munchausen_errors(AgentConfig())
