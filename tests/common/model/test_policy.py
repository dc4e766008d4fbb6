"""Actions follow the values, explore as often as told, and weights change wholly or not."""

import numpy as np
import pytest
import torch

from mrcdrl.common.arena import IDENTITY, SYMMETRIES
from mrcdrl.common.config import load_config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import UInt8Array, Weights
from mrcdrl.common.model.policy import FrameStack, Policy, averaged_symmetries, make_policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes

VIEW_PX = 31


def make_network(seed: int) -> QNetwork:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return QNetwork("duel", view_px=VIEW_PX)


def states(count: int) -> UInt8Array:
    rng = np.random.default_rng(0)
    return rng.integers(256, size=(count, 4, VIEW_PX, VIEW_PX), dtype=np.uint8)


def test_without_exploration_the_greedy_action_is_taken() -> None:
    network = make_network(0)
    observations = states(64)
    selection = Policy(network).select_actions(observations, 0.0, np.random.default_rng(0))
    with torch.no_grad():
        expected = network(torch.from_numpy(observations)).numpy()
    np.testing.assert_array_equal(selection.actions, expected.argmax(axis=1))
    np.testing.assert_allclose(selection.q_values, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(selection.greedy_q, selection.q_values.max(axis=1))
    assert selection.actions.dtype == np.uint8
    assert selection.q_values.dtype == selection.greedy_q.dtype == np.float32


def test_exploration_is_uniform_and_as_frequent_as_epsilon() -> None:
    policy = Policy(make_network(0))
    observations = np.repeat(states(1), 3000, axis=0)
    rng = np.random.default_rng(1)
    always = policy.select_actions(observations, 1.0, rng)
    shares = np.bincount(always.actions, minlength=3) / 3000
    np.testing.assert_allclose(shares, 1 / 3, atol=0.04)
    epsilon = np.where(np.arange(3000) < 1500, 0.0, 0.6).astype(np.float32)
    mixed = policy.select_actions(observations, epsilon, rng)
    other = mixed.actions != mixed.q_values.argmax(axis=1)
    assert not other[:1500].any()
    assert other[1500:].mean() == pytest.approx(0.6 * 2 / 3, abs=0.05)


def test_with_symmetric_views_alike_states_have_alike_values() -> None:
    """The mean over a group does not change where the state is mapped by one of its members."""
    network, observations = make_network(0), states(8)
    alone, averaged = Policy(network), Policy(network, SYMMETRIES)
    turns = np.arange(3, dtype=np.uint8)
    views = [
        alone.q_values(s.apply_to_images(observations))[:, s.apply_to_actions(turns)]
        for s in SYMMETRIES
    ]
    np.testing.assert_allclose(averaged.q_values(observations), np.mean(views, 0), atol=1e-6)
    for symmetry in SYMMETRIES:
        mapped, back = symmetry.apply_to_images(observations), symmetry.apply_to_actions(turns)
        np.testing.assert_allclose(
            averaged.q_values(mapped)[:, back], averaged.q_values(observations), atol=1e-6
        )
    chosen = averaged.select_actions(observations, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(chosen.q_values, averaged.q_values(observations))
    one_view = averaged.averaging((IDENTITY,))
    np.testing.assert_array_equal(one_view.q_values(observations), alone.q_values(observations))


@pytest.mark.parametrize(("robots", "symmetries"), [(1, 8), (2, 4), (3, 2), (4, 8)])
@pytest.mark.parametrize("most", [1, 4, 8])
def test_the_views_are_those_of_the_layout(robots: int, symmetries: int, most: int) -> None:
    settings = {"arena.num_robots": str(robots), "agent.symmetric_views": str(most)}
    found = averaged_symmetries(load_config(None, settings, environ={}))
    assert len(set(found)) == min(symmetries, most)
    assert found[0] == IDENTITY
    plain = load_config(None, {"arena.num_robots": str(robots)}, environ={})
    assert averaged_symmetries(plain) == (IDENTITY,)


def test_who_explores_acts_by_one_view() -> None:
    config = load_config(None, {"agent.symmetric_views": "8"}, environ={})
    judge, actor = make_policy(config), make_policy(config, averages=False)
    actor.network.load_state_dict(judge.network.state_dict())
    shape = (3, 4, config.arena.view_px, config.arena.view_px)
    seen = np.random.default_rng(0).integers(256, size=shape, dtype=np.uint8)
    assert np.abs(judge.q_values(seen) - actor.q_values(seen)).max() > 1e-3


def test_the_same_generator_gives_the_same_actions() -> None:
    policy, observations = Policy(make_network(0)), states(32)
    first = policy.select_actions(observations, 0.5, np.random.default_rng(2))
    second = policy.select_actions(observations, 0.5, np.random.default_rng(2))
    np.testing.assert_array_equal(first.actions, second.actions)


def test_views_and_read_only_images_are_taken() -> None:
    policy, observations = Policy(make_network(0)), states(4)
    expected = policy.q_values(observations[:, :, ::-1].copy())
    mirrored = observations[:, :, ::-1]
    mirrored.flags.writeable = False
    np.testing.assert_array_equal(policy.q_values(mirrored), expected)


def test_adopted_weights_are_acted_by() -> None:
    policy, other, observations = Policy(make_network(0)), make_network(1), states(8)
    policy.adopt(Weights.of(epoch=2, version=7, learner_step=700, payload=weights_to_bytes(other)))
    assert (policy.weights_epoch, policy.weights_version, policy.learner_step) == (2, 7, 700)
    with torch.no_grad():
        expected = other(torch.from_numpy(observations)).numpy()
    np.testing.assert_array_equal(policy.q_values(observations), expected)


def test_foreign_weights_leave_the_policy_as_it_was() -> None:
    policy, observations = Policy(make_network(0)), states(8)
    before = policy.q_values(observations)
    foreign = weights_to_bytes(QNetwork("dqn", view_px=VIEW_PX))
    with pytest.raises(CheckpointError, match="kind"):
        policy.adopt(Weights.of(epoch=0, version=1, learner_step=1, payload=foreign))
    assert policy.weights_version == -1
    np.testing.assert_array_equal(policy.q_values(observations), before)


def images(*numbers: int) -> UInt8Array:
    return np.stack([np.full((2, 2), number, np.uint8) for number in numbers])


def test_frame_stack_repeats_the_first_image_and_keeps_the_newest_last() -> None:
    stack = FrameStack(num_robots=2, stack=4, view_px=2)
    stack.reset(slice(None), images(1, 11))
    assert stack.stacks[:, :, 0, 0].tolist() == [[1, 1, 1, 1], [11, 11, 11, 11]]
    stack.push(images(2, 12))
    stack.push(images(3, 13))
    assert stack.stacks[:, :, 0, 0].tolist() == [[1, 1, 2, 3], [11, 11, 12, 13]]
    stack.reset(np.array([1]), images(20))
    latest = stack.push(images(4, 21))
    assert latest[:, :, 1, 1].tolist() == [[1, 2, 3, 4], [20, 20, 20, 21]]


def test_frame_stack_of_one_is_the_image() -> None:
    stack = FrameStack(num_robots=1, stack=1, view_px=2)
    assert stack.push(images(9))[0, :, 0, 0].tolist() == [9]
