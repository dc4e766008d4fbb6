"""The accelerated step is held to the plain one, and gives the same bits every time."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import pytest
import torch
from torch import Tensor

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.model.q_network import Kind, QNetwork
from mrcdrl.services.learner.accelerate.step import AcceleratedStep
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.step import GradientStep, PlainStep
from tests.services.learner.test_cuda_graphs import assert_same, batches, make_learner
from tests.services.learner.test_learner import FLOAT32, VIEW_PX, random_batch

pytestmark = pytest.mark.usefixtures("one_thread")
RATE = 1e-3


def networks(kind: Kind) -> tuple[QNetwork, QNetwork]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        pair = QNetwork(kind, view_px=VIEW_PX), QNetwork(kind, view_px=VIEW_PX)
    return pair[0], pair[1].requires_grad_(requires_grad=False)


def moved(step: GradientStep, online: QNetwork, given: Sequence[Batch]) -> list[dict[str, Tensor]]:
    """What each of a few updates tells, and how far all of them moved the parameters."""
    before = {name: p.detach().clone() for name, p in online.named_parameters()}
    told = [dataclasses.asdict(step([batch], [RATE])[0]) for batch in given]
    parameters = online.named_parameters()
    return [*told, {name: p.detach() - before[name] for name, p in parameters}]


def assert_near(found: list[dict[str, Tensor]], expected: list[dict[str, Tensor]]) -> None:
    """Within 1e-4 of the largest number of each kind: sums are added in another order."""
    for one, other in zip(expected, found, strict=True):
        for name, due in one.items():
            bound = 1e-4 * float(due.abs().max()) + 1e-7
            torch.testing.assert_close(other[name], due, atol=bound, rtol=0.0, msg=name)


def assert_same_term(
    agent: AgentConfig,
    given: Sequence[Batch],
    threads: int,
    without: tuple[AgentConfig, Sequence[Batch]],
) -> None:
    """A term of the loss counts in the accelerated step as in the plain one, and does count."""
    online, target = networks("duel")
    expected = moved(PlainStep(online, target, agent), online, given)
    online, target = networks("duel")
    found = moved(AcceleratedStep(online, target, agent, num_threads=threads), online, given)
    assert_near(found, expected)
    other, batches_without = without
    online, target = networks("duel")
    lacking = moved(PlainStep(online, target, other), online, batches_without)
    with pytest.raises(AssertionError):  # else the term is lost on both sides
        assert_near(lacking, expected)


@pytest.mark.parametrize("kind", ["duel", "ddqn", "dqn"])
@pytest.mark.parametrize("loss", ["squared", "huber"])
@pytest.mark.parametrize("optimizer", ["adam", "rmsprop"])
@pytest.mark.parametrize("threads", [1, 3])
def test_it_does_what_the_plain_step_does(
    kind: Kind,
    loss: Literal["squared", "huber"],
    optimizer: Literal["adam", "rmsprop"],
    threads: int,
) -> None:
    """With this epsilon a rounded zero stays small when an optimizer divides by its size."""
    agent = AgentConfig(kind=kind, loss=loss, optimizer=optimizer, optimizer_epsilon=1e-2)
    online, target = networks(kind)
    expected = moved(PlainStep(online, target, agent), online, batches(4))
    online, target = networks(kind)
    step = AcceleratedStep(online, target, agent, num_threads=threads)
    assert_near(moved(step, online, batches(4)), expected)


@pytest.mark.parametrize("temperature", [0.0, 0.03])
@pytest.mark.parametrize("nonzero", [1.0, 0.05])
@pytest.mark.parametrize("threads", [1, 3])
def test_munchausen_does_what_it_does_in_the_plain_step(
    temperature: float, nonzero: float, threads: int
) -> None:
    """Also on images that are mostly black, which take the sparse first layer."""
    agent = AgentConfig(
        munchausen_alpha=0.9, munchausen_temperature=temperature, optimizer_epsilon=1e-2
    )
    given = [darkened(batch, nonzero) for batch in batches(4)]
    assert_same_term(agent, given, threads, without=(AgentConfig(), given))


@pytest.mark.parametrize("nonzero", [1.0, 0.05])
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("kind", ["duel", "dqn"])
def test_what_is_computed_ahead_changes_no_number(kind: Kind, nonzero: float, threads: int) -> None:
    """Also where the target network changes between: what is known of the old one is left."""
    agent = AgentConfig(kind=kind, target_period=2, optimizer_epsilon=1e-2)
    given = [darkened(batch, nonzero) for batch in batches(5)]

    def learner() -> Learner:
        return Learner(agent, FLOAT32, stack=4, view_px=VIEW_PX, threads=threads)

    plain, fast, beside = learner(), learner(), make_learner(agent)
    ahead = [beside.ahead(batch) for batch in given[:4]]
    assert all(batch.ahead for batch in ahead)
    ahead.append(given[4])
    for batch, known in zip(given, ahead, strict=True):
        expected, found = plain.step(batch), fast.step(known)
        torch.testing.assert_close(found.td_errors, expected.td_errors, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.loss, expected.loss, rtol=1e-4, atol=1e-6)


def test_nothing_is_computed_ahead_where_all_threads_share_a_batch() -> None:
    learner = Learner(AgentConfig(), FLOAT32, stack=4, view_px=VIEW_PX, threads=2)
    assert learner.ahead(random_batch()).ahead is None


def test_values_known_ahead_are_taken() -> None:
    learner, batch = make_learner(AgentConfig(kind="dqn")), random_batch()
    known = learner.ahead(batch)
    assert known.ahead is not None
    other = dataclasses.replace(known.ahead, next_q=known.ahead.next_q + 1.0)
    moved_by = (
        learner.step(dataclasses.replace(batch, ahead=other)).td_errors
        - make_learner(AgentConfig(kind="dqn")).step(batch).td_errors
    )
    torch.testing.assert_close(moved_by, batch.discount, rtol=1e-3, atol=1e-4)


def darkened(batch: Batch, nonzero: float) -> Batch:
    """The batch with some of its images' pixels left, the others black."""
    generator = torch.Generator().manual_seed(0)

    def left(images: Tensor) -> Tensor:
        return images * (torch.rand(images.shape, generator=generator) < nonzero)

    return dataclasses.replace(
        batch,
        observation=left(batch.observation),
        next_observation=left(batch.next_observation),
    )


def test_both_keep_the_same_moments() -> None:
    agent, batch = AgentConfig(), random_batch()
    online, target = networks("duel")
    plain, fast = (step(online, target, agent) for step in (PlainStep, AcceleratedStep))
    assert plain.moments() == fast.moments() == {}
    plain([batch], [RATE])
    moments = {name: x.clone() for name, x in plain.moments().items()}
    fast.restore(plain.moments())
    assert fast.moments().keys() == moments.keys()
    assert all(torch.equal(x, moments[name]) for name, x in fast.moments().items())


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_that_share_a_batch_learn_what_one_does(threads: int) -> None:
    """Up to the order of a sum; and alike each time."""
    agent, given = AgentConfig(target_period=3), batches(5)

    def shared() -> Learner:
        return Learner(agent, FLOAT32, stack=4, view_px=VIEW_PX, threads=threads)

    one, some, again = make_learner(agent), shared(), shared()
    for batch in given:
        alone, update = one.step(batch), some.step(batch)
        assert_same(update, again.step(batch))
        torch.testing.assert_close(alone.loss, update.loss)
        torch.testing.assert_close(alone.td_errors, update.td_errors, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(alone.gradient_norm, update.gradient_norm, rtol=1e-3, atol=1e-3)
    assert some.state() == again.state()


def test_an_error_in_a_thread_that_shares_a_batch_is_raised() -> None:
    learner = Learner(AgentConfig(), FLOAT32, stack=4, view_px=VIEW_PX, threads=2)
    batch = random_batch()
    action = batch.action.clone()
    action[-1] = 7  # of the second half
    with pytest.raises(RuntimeError, match="index"):
        learner.step(dataclasses.replace(batch, action=action))


def test_more_threads_than_transitions_do_no_harm() -> None:
    learner = Learner(AgentConfig(), FLOAT32, stack=4, view_px=VIEW_PX, threads=4)
    assert learner.step(random_batch(size=2)).td_errors.shape == (2,)
