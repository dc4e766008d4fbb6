"""Averaged parameters: what is averaged, published and kept, and exact over a restart."""

from pathlib import Path

import pytest
import torch

from mrcdrl.common.config import AgentConfig
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.model.weights_io import network_from_bytes, weights_to_bytes
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.learner.checkpoint import Checkpoint
from mrcdrl.services.learner.learner import Learner
from tests.services.learner.test_learner import FLOAT32, make_learner, random_batch

AVERAGED = FLOAT32.model_copy(update={"average_decay": 0.9})


def averaged(learner: Learner) -> torch.Tensor:
    return learner.tested.conv1.bias.detach().clone()


def test_the_average_follows_the_parameters_as_its_decay_says() -> None:
    """0.9 from the 80th step on; before it (1 + n) / (10 + n)."""
    learner = make_learner(learner=AVERAGED)
    expected = learner.online.conv1.bias.detach().clone()
    for step in range(1, 4):
        learner.step(random_batch(seed=step))
        keep = (1 + step) / (10 + step)
        expected = keep * expected + (1 - keep) * learner.online.conv1.bias.detach()
        torch.testing.assert_close(averaged(learner), expected)
    learner.learner_step = 1000
    learner.step(random_batch())
    expected = 0.9 * expected + 0.1 * learner.online.conv1.bias.detach()
    torch.testing.assert_close(averaged(learner), expected)


def test_the_average_is_published_and_learning_is_as_without() -> None:
    learner, plain = make_learner(learner=AVERAGED), make_learner()
    for step in range(3):
        learner.step(random_batch(seed=step))
        plain.step(random_batch(seed=step))
    assert plain.state().average == b""
    assert learner.state().model == plain.state().model
    assert learner.payload() == weights_to_bytes(learner.tested) != plain.payload()


def test_actors_may_act_by_the_newest_parameters() -> None:
    learner = make_learner(learner=AVERAGED.model_copy(update={"average_for": "evaluation"}))
    learner.step(random_batch())
    assert learner.payload() == weights_to_bytes(learner.online)
    assert learner.average_payload() == weights_to_bytes(learner.tested) != learner.payload()
    assert make_learner(learner=AVERAGED).average_payload() == b""
    alone = FLOAT32.model_copy(update={"average_for": "evaluation"})
    assert make_learner(learner=alone).average_payload() == b""


def test_it_continues_to_the_bit_from_a_checkpoint(tmp_path: Path) -> None:
    whole = make_learner(learner=AVERAGED)
    for step in range(3):
        whole.step(random_batch(seed=step))
    checkpoint.save(tmp_path, Checkpoint(whole.state(), 1, 1, "", 0.0), keep=1)
    found = checkpoint.load_latest(tmp_path)
    assert found is not None
    assert (found.path / "average.safetensors").is_file()
    resumed = make_learner(learner=AVERAGED)
    resumed.restore(found.checkpoint.state)
    for learner in (whole, resumed):
        learner.step(random_batch(seed=9))
    assert resumed.state() == whole.state()


def test_an_average_begins_with_the_parameters_of_a_checkpoint_without_one() -> None:
    plain, learner = make_learner(), make_learner(learner=AVERAGED)
    plain.step(random_batch())
    learner.restore(plain.state())
    assert torch.equal(averaged(learner), plain.online.conv1.bias)


def test_initial_weights_replace_all_random_ones() -> None:
    source, learner = make_learner(), make_learner(learner=AVERAGED.model_copy(update={"seed": 1}))
    source.step(random_batch())
    learner.start_from(source.payload())
    for network in (learner.online, learner.target, learner.tested):
        assert torch.equal(network.conv1.bias, source.online.conv1.bias)
    update = learner.step(random_batch())
    assert torch.isfinite(update.loss), "and steps go on from there"


def test_initial_weights_may_be_of_a_kind_with_the_same_parameters() -> None:
    ddqn, dqn = (make_learner(AgentConfig(kind=kind)) for kind in ("ddqn", "dqn"))  # type: ignore[arg-type]
    dqn.start_from(ddqn.payload())
    assert torch.equal(dqn.online.hidden.weight, ddqn.online.hidden.weight)
    assert network_from_bytes(dqn.payload()).kind == "dqn"
    before = dqn.payload()
    with pytest.raises(CheckpointError, match="parameter"):
        dqn.start_from(make_learner(AgentConfig(kind="duel")).payload())
    assert dqn.payload() == before
