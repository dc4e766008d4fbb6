"""A run that is broken off and taken up again ends with the very numbers of one that was not.

Actor, table and learner take turns in one process and one thread. What was broken off is rebuilt
from what a run leaves: the checkpoint, replay's log and snapshot, the published weights; of the
actor, which goes on, only its policy's weights are new.
"""

import pickle
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.model.policy import make_policy
from mrcdrl.services.actor.actor import make_collector
from mrcdrl.services.actor.collector import Collector
from mrcdrl.services.learner.learner import Learner, LearnerState
from mrcdrl.services.learner.prefetch import make_collate
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from mrcdrl.services.replay.service import ReplayService
from tests.services.replay.harness import insert, save, start

BROKEN_OFF, STEPS = 12, 25  # learner steps
PUBLISH_PERIOD = 5


@pytest.fixture(autouse=True)
def deterministic(one_thread: None) -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def config_of(sampler: str) -> Config:
    return load_config(
        "smoke",
        {
            "arena.view_px": "32",
            "arena.max_frames": "30",
            "agent.target_period": "7",
            "replay.sampler": sampler,
            "replay.min_size": "64",
            "replay.capacity": "300",
            "replay.samples_per_insert": "0",
            "learner.precision": "float32",
            "learner.device": "cpu",
            "learner.symmetries": "true",
        },
        environ={},
    )


class Run:
    """Actor, replay and learner of a run, in turns."""

    def __init__(self, config: Config, folder: Path, collector: Collector | None = None) -> None:
        self._config = config
        self._folder = folder
        self.learner = Learner.from_config(config)
        writer = MagicMock()
        writer.publish.side_effect = lambda acting, *_: self._collector._policy.adopt(acting)
        checkpoints = folder / "checkpoints"
        self._publisher = WeightsPublisher(config, self.learner, writer, checkpoints)
        self._collate = make_collate(config, self.learner)
        self._replay: ReplayService = start(folder / "replay", config)
        self._collector = collector or make_collector(config, "actor-0", make_policy(config))
        if collector is None:
            self._publisher.publish()

    def go_on(self, until: int) -> None:
        """To so many learner steps."""
        table = self._replay._table
        epsilons = np.full(self._config.actor.num_arenas, 0.3, np.float32)
        while self.learner.learner_step < until:
            chunks, _ = self._collector.step(epsilons)
            insert(self._replay, *chunks)
            if len(table) < self._config.replay.min_size:
                continue
            batch = self._collate(table.sample(self._config.learner.batch_size))
            update = self.learner.step(batch)
            table.update_priorities(batch.keys, update.td_errors.abs().numpy())
            if self.learner.learner_step % PUBLISH_PERIOD == 0:
                self._publisher.publish()

    def break_off(self) -> bytes:
        """Leave what a run leaves; the actor, which goes on."""
        self._publisher.save()
        save(self._replay, self._folder / "replay")
        assert self._replay._log is not None
        self._replay._log.close()
        return pickle.dumps(self._collector)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
def test_a_run_taken_up_again_goes_on_bit_for_bit(tmp_path: Path, sampler: str) -> None:
    config = config_of(sampler)

    def whole() -> LearnerState:
        run = Run(config, tmp_path / "whole")
        run.go_on(STEPS)
        return run.learner.state()

    broken_off = Run(config, tmp_path / "broken")
    broken_off.go_on(BROKEN_OFF)
    before = broken_off.learner.state()
    actor = broken_off.break_off()
    del broken_off
    torch.manual_seed(123)  # whatever a new process draws from: it makes no difference
    resumed = Run(config, tmp_path / "broken", pickle.loads(actor))  # noqa: S301  made here
    assert resumed.learner.state() == before
    resumed.go_on(STEPS)
    assert resumed.learner.state() == whole()
    assert resumed.learner.state() != before
