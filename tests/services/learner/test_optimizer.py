"""However many threads share it, a step follows the gradient that plain autograd finds."""

from typing import Literal

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from mrcdrl.common.config import AgentConfig, LearnerConfig
from mrcdrl.common.model.fast_forward import Trace, fast_forward, operands, prepare
from mrcdrl.common.model.q_network import Kind, QNetwork
from mrcdrl.services.learner.accelerate.data_parallel import DataParallel
from mrcdrl.services.learner.accelerate.optimizer import SharedOptimizer, gradients, leaves
from mrcdrl.services.learner.learner import Learner
from tests.services.learner.test_learner import VIEW_PX, random_batch

pytestmark = pytest.mark.usefixtures("one_thread")
SIZE = 9  # of a batch, which no number of threads below divides


def states() -> Tensor:
    return random_batch(SIZE).observation


def loss_of(q: Tensor) -> Tensor:
    return functional.huber_loss(q, torch.full_like(q, 0.3), reduction="sum")


def reference(kind: Kind) -> dict[str, Tensor]:
    """Gradients by autograd of the whole batch, by torch's operations alone."""
    network = make_network(kind)
    loss_of(network(states())).backward()  # type: ignore[no-untyped-call]
    return {name: p.grad for name, p in network.named_parameters() if p.grad is not None}


def make_network(kind: Kind) -> QNetwork:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return QNetwork(kind, view_px=VIEW_PX)


def descend(network: QNetwork, optimizer: SharedOptimizer, threads: DataParallel) -> Tensor:
    """One step on the states, shared; the norm of its gradient."""
    with torch.no_grad():
        parameters = operands(network)

    def part(rows: slice) -> object:
        own, trace = leaves(parameters, network), Trace()
        q = fast_forward(network, prepare(network, states()[rows]), own, trace)
        return gradients(loss_of(q), own, trace)

    return optimizer.step(threads.map(part, SIZE))  # type: ignore[arg-type]


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("kind", ["duel", "ddqn"])
@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_the_gradient_is_that_of_the_whole_batch(kind: Kind, threads: int, limit: float) -> None:
    expected = reference(kind)
    length = float(torch.nn.utils.get_total_norm(expected.values()))
    assert length > 1.0, "or nothing would be limited"
    network, shared = make_network(kind), DataParallel(threads)
    agent = AgentConfig(kind=kind, max_gradient_norm=limit)
    norm = descend(network, SharedOptimizer(network, agent, torch.tensor(0.0), shared), shared)
    assert float(norm) == pytest.approx(length, rel=1e-4)
    scale = min(1.0, limit / length) if limit else 1.0
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None
        due = expected[name] * scale
        limits = {"atol": 1e-4 * float(due.abs().max()) + 1e-7, "rtol": 1e-3}
        torch.testing.assert_close(parameter.grad, due, **limits, msg=name)


@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_checkpoint_is_the_same_however_many_threads_there_were(
    threads: int, optimizer: Literal["adam", "rmsprop"]
) -> None:
    """All parameters are updated once a step, and taken up by a learner with one thread."""
    agent = AgentConfig(optimizer=optimizer)

    def learner(threads: int) -> Learner:
        return Learner(agent, LearnerConfig(), stack=4, view_px=VIEW_PX, threads=threads)

    shared, alone = learner(threads), learner(1)
    before = [p.detach().clone() for p in shared.online.parameters()]
    for step in range(3):
        shared.step(random_batch(seed=step))
    assert all((a != b).any() for a, b in zip(shared.online.parameters(), before, strict=True))
    state = shared.state()
    alone.restore(state)
    again = alone.state()
    assert again.optimizer == state.optimizer
    assert again.model == state.model
