"""Versions of weights rise over restarts, whatever the wall clock does meanwhile."""

import time
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from tests.services.learner.test_learner import make_learner

DAY_NS = 86_400 * 10**9


@pytest.mark.parametrize("jump_ns", [-DAY_NS, 0, DAY_NS])
def test_a_clock_that_jumps_between_two_starts_turns_no_version_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump_ns: int
) -> None:
    config, learner = load_config("smoke", {}, environ={}), make_learner()
    published: list[Weights] = []
    writer = MagicMock()
    writer.publish.side_effect = published.append
    WeightsPublisher(config, learner, writer, tmp_path).publish()
    now_ns = time.time_ns() + jump_ns
    monkeypatch.setattr(time, "time_ns", lambda: now_ns)
    monkeypatch.setattr(time, "time", lambda: now_ns / 1e9)
    WeightsPublisher(config, learner, writer, tmp_path).publish()
    before, after = published
    assert after.epoch == before.epoch
    assert after.order > before.order
