"""What a demonstrator shows, and that the network is drawn to it."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from mrcdrl.common.arena import ArenaBatch, make_codec
from mrcdrl.common.arena import test_starts as starts_of
from mrcdrl.common.arena.controllers import make_controller
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import AgentConfig, ArenaConfig, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.learner.batch import Batch, Demonstration, collate
from mrcdrl.services.learner.demonstrator import demonstrator
from mrcdrl.services.learner.loss import td_loss
from mrcdrl.services.learner.rendering import HostRenderer
from mrcdrl.services.learner.symmetries import LayoutSymmetries
from tests.services.learner.test_accelerated_step import assert_same_term
from tests.services.learner.test_batch import make_samples
from tests.services.learner.test_cuda_graphs import batches

RANDOM = ArenaConfig(num_robots=3, target_layout="random", num_obstacles=2)


def scenes(config: ArenaConfig, count: int) -> list[Scene]:
    starts = starts_of(config, count, seed=3)
    return [Scene(s.robots, s.targets, s.obstacles) for s in starts]


def test_one_robot_is_shown_what_the_controller_does() -> None:
    config = RANDOM.with_robots(1)
    codec, shown = make_codec(config), demonstrator(config)
    given = scenes(config, 50)
    found = shown(np.concatenate([codec.encode(scene) for scene in given]))
    rng = np.random.default_rng(0)
    expected = [make_controller("potential_field", config, rng)(scene)[0] for scene in given]
    assert found.tolist() == expected
    assert set(expected) == {0, 1, 2}


def test_what_it_shows_brings_robots_to_their_targets() -> None:
    """Each robot acts by its own record alone, and there is no memory."""
    config = ArenaConfig(num_robots=3, target_layout="random")
    shown, count = demonstrator(config), 40
    rngs = [np.random.default_rng(i) for i in range(count)]
    arenas = ArenaBatch(config, rngs, max_collisions=1)
    starts = starts_of(config, count, seed=1)
    records = np.stack([arenas.reset(i, start).records for i, start in enumerate(starts)])
    outcomes: dict[int, Outcome] = {}
    going = np.arange(count)
    while len(going):
        actions = shown(records.reshape(-1, records.shape[-1])).reshape(len(going), -1)
        steps = arenas.step(actions, going)
        ended = [outcome is not None for outcome in steps.outcomes]
        outcomes |= {int(i): o for i, o in zip(going, steps.outcomes, strict=True) if o is not None}
        going, records = going[~np.array(ended)], steps.records[~np.array(ended)]
    successes = sum(outcome is Outcome.SUCCESS for outcome in outcomes.values())
    assert successes >= 0.9 * count, outcomes


def test_absent_robots_and_targets_count_for_nothing() -> None:
    """A robot of two in an arena of up to three is shown what it is in one of two."""
    large = RANDOM.model_copy(update={"robots": (2, 3)})
    small = RANDOM.with_robots(2)
    for scene in scenes(small, 30):
        absent = Scene(
            np.concatenate([scene.robots, np.full((1, 3), np.nan)]),
            np.concatenate([scene.targets, np.full((1, 2), np.nan)]),
            scene.obstacles,
        )
        found = demonstrator(large)(make_codec(large).encode(absent)[:2])
        expected = demonstrator(small)(make_codec(small).encode(scene))
        assert found.tolist() == expected.tolist()


@pytest.mark.parametrize("byte", [0, 1, 127, 255])
def test_records_of_any_bytes_give_some_action(byte: int) -> None:
    size = RANDOM.record_bytes
    noise = np.random.default_rng(byte).integers(256, size=(40, size), dtype=np.uint8)
    filled = np.full((1, size), byte, np.uint8)
    assert set(demonstrator(RANDOM)(np.concatenate([noise, filled])).tolist()) <= {0, 1, 2}


def test_an_action_shown_is_mapped_as_the_images_are() -> None:
    config = RANDOM.with_robots(2)
    codec = make_codec(config)
    records = np.concatenate([codec.encode(scene) for scene in scenes(config, 20)])
    samples = dataclasses.replace(
        make_samples([1] * len(records), width=3), records=np.stack([records] * 3, axis=1)
    )
    drawn = LayoutSymmetries(config).draw(samples.records, np.random.default_rng(0))
    shown = demonstrator(config)
    batch = collate(
        samples,
        HostRenderer(codec.decode),
        2,
        symmetry_rows=drawn,
        demonstrate=shown,
        demonstration_weight=0.5,
    )
    expected = shown(records)
    mirrored = np.zeros(len(records), bool)
    for symmetry, rows in drawn:
        mirrored[rows] = symmetry.mirrors
    assert 0 < mirrored.sum() < len(records)
    assert batch.demonstration is not None
    assert (
        batch.demonstration.actions.tolist() == np.where(mirrored, 2 - expected, expected).tolist()
    )
    assert batch.demonstration.weights.tolist() == [0.5] * len(records)


def shown_in(batch: Batch, weight: float) -> Batch:
    generator = torch.Generator().manual_seed(0)
    size = len(batch.keys)
    actions = torch.randint(3, (size,), generator=generator)
    return dataclasses.replace(
        batch, demonstration=Demonstration(actions, torch.full((size,), weight))
    )


def test_the_margin_by_hand() -> None:
    """Values 1, 3, 2; the margin is 0.5."""
    q = torch.tensor([[1.0, 3.0, 2.0]] * 4)
    agent = AgentConfig(demonstration_margin=0.5)
    ones, none = torch.ones(4), torch.zeros(4)
    actions = torch.tensor([1, 2, 0, 0])
    weights = torch.tensor([1.0, 1.0, 1.0, 0.0])
    batch = Batch(
        torch.tensor(0), torch.ones(4).long(), 3 * ones, none, torch.tensor(1), ones, np.arange(4),
        demonstration=Demonstration(actions, weights),
    )  # fmt: skip

    def values(states: Tensor) -> Tensor:
        return q

    # 1 is the best by 1.0; 2 is short by 3.5 - 2; 0 by 3.5 - 1; the last has no weight
    assert float(td_loss(values, values, batch, agent).loss) == pytest.approx((1.5 + 2.5) / 4)


@pytest.mark.parametrize("threads", [1, 3])
def test_the_accelerated_step_is_drawn_as_the_plain_one(threads: int) -> None:
    agent = AgentConfig(demonstration_margin=0.3, optimizer_epsilon=1e-2)
    given = [shown_in(batch, 2.0) for batch in batches(4)]
    assert_same_term(agent, given, threads, without=(agent, batches(4)))


def test_pictures_hold_no_poses() -> None:
    with pytest.raises(ConfigError, match="demonstrator needs the poses"):
        load_config(
            "quick",
            {"agent.demonstrator": "potential_field", "arena.codec": "frames"},
            environ={},
        )
    with pytest.raises(TypeError, match="keeps no poses"):
        demonstrator(ArenaConfig(codec="frames"))
