"""What an observation record holds makes no difference to what is learned, to the last bit."""

from itertools import count

import numpy as np
import pytest

from mrcdrl.common.arena import make_codec
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import Chunk, Weights
from mrcdrl.common.model.policy import make_policy
from mrcdrl.services.actor.actor import make_collector
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import make_collate
from mrcdrl.services.replay.table import Table

pytestmark = pytest.mark.usefixtures("one_thread")
NUM_STEPS = 5


def config_of(codec: str, sampler: str) -> Config:
    return load_config(
        "smoke",
        {
            "arena.codec": codec,
            "arena.num_robots": "3",
            "arena.max_frames": "40",
            "agent.n_step": "3",
            "replay.sampler": sampler,
            "learner.precision": "float32",
            "learner.device": "cpu",
            "learner.symmetries": "true",
            "actor.chunk_length": "16",
        },
        environ={},
    )


def collect(config: Config, learner: Learner, num_transitions: int) -> list[Chunk]:
    policy = make_policy(config)
    policy.adopt(Weights.of(0, 1, 0, learner.payload()))
    collector = make_collector(config, "actor-0", policy)
    epsilons = np.full(config.actor.num_arenas, 0.5, np.float32)
    chunks: list[Chunk] = []
    for _ in count():
        chunks += collector.step(epsilons)[0]
        if sum(map(len, chunks)) >= num_transitions:
            return chunks
    raise AssertionError


def learned(codec: str, sampler: str) -> bytes:
    """The parameters after some steps on what was collected."""
    config = config_of(codec, sampler)
    learner = Learner(config.agent, config.learner, stack=4, view_px=config.arena.view_px)
    table = Table.from_config(config)
    for chunk in collect(config, learner, 400):
        table.insert(chunk)
    collate = make_collate(config, learner)
    for _ in range(NUM_STEPS):
        samples = table.sample(config.learner.batch_size)
        update = learner.step(collate(samples))
        table.update_priorities(samples.keys, update.td_errors.abs().numpy())
    return learner.payload()


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
def test_poses_and_pixels_teach_the_same(sampler: str) -> None:
    assert make_codec(config_of("scene", sampler).arena).record_bytes < 100
    assert learned("scene", sampler) == learned("frames", sampler)
