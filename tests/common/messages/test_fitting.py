"""The learner takes only samples that are a mini-batch of its run."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.fitting import Fitting
from mrcdrl.common.messages.trajectory import Samples

CONFIG = load_config("smoke", {"agent.n_step": "3"}, environ={})
SIZE, WINDOW = CONFIG.learner.batch_size, CONFIG.arena.stack + 3
BYTES = CONFIG.arena.record_bytes
GOOD = Samples(
    keys=np.arange(SIZE),
    probabilities=np.full(SIZE, 0.1),
    table_size=100,
    total_priority=100.0,
    actions=np.zeros(SIZE, np.uint8),
    rewards=np.full(SIZE, CONFIG.arena.success_reward, np.float32),
    discounts=np.ones(SIZE, np.float32),
    bootstrap_offsets=np.full(SIZE, 3, np.uint8),
    weights_versions=np.zeros(SIZE, np.int64),
    records=np.zeros((SIZE, WINDOW, BYTES), np.uint8),
)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, ""),
        ({"records": np.zeros((SIZE, WINDOW, BYTES + 4), np.uint8)}, "another run"),
        ({"records": np.zeros((SIZE, WINDOW + 1, BYTES), np.uint8)}, "another run"),
        ({"records": np.zeros((1, WINDOW, BYTES), np.uint8)}, "another run"),
        ({"bootstrap_offsets": np.full(SIZE, 4, np.uint8)}, "exceeds agent.n_step"),
        ({"actions": np.full(SIZE, 3, np.uint8)}, "action 3 where the arena of this run has 3"),
        ({"rewards": np.full(SIZE, -1e37, np.float32)}, "a return of 1e\\+37"),
    ],
)
def test_samples_of_another_run_are_refused(change: dict[str, Any], reason: str) -> None:
    samples = dataclasses.replace(GOOD, **change)
    if not reason:
        Fitting(CONFIG).check(samples)
        return
    with pytest.raises(WireError, match=reason):
        Fitting(CONFIG).check(samples)
