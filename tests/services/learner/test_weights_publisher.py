"""Versions of weights rise over restarts, whatever the wall clock does meanwhile."""

import errno
import os
import time
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.services.learner.checkpoint import load_latest
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from tests.services.learner.test_learner import make_learner, random_batch

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


def test_a_new_run_starts_from_its_initial_weights_and_a_resumed_one_does_not(
    tmp_path: Path,
) -> None:
    source, writer = make_learner(), MagicMock()
    source.step(random_batch())
    path = tmp_path / "weights.safetensors"
    path.write_bytes(source.payload())
    settings = {"learner.initial_weights": str(path)}
    config, learner = load_config("smoke", settings, environ={}), make_learner()
    publisher = WeightsPublisher(config, learner, writer, tmp_path / "checkpoints")
    assert learner.payload() == source.payload()
    learner.step(random_batch(seed=1))
    publisher.save()
    path.unlink()
    resumed = make_learner()
    WeightsPublisher(config, resumed, writer, tmp_path / "checkpoints")
    assert resumed.payload() == learner.payload() != source.payload()


def test_a_checkpoint_that_cannot_be_written_is_tried_again_while_learning_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    config = load_config("smoke", {"learner.checkpoint_period_s": "1e-9"}, environ={})
    publisher = WeightsPublisher(config, make_learner(), MagicMock(), tmp_path)
    saved = sorted(tmp_path.iterdir())
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", MagicMock(side_effect=OSError(errno.ENOSPC, "No space left")))
        for _ in range(5):
            publisher.maybe_save()
            publisher.publish()
        assert sorted(tmp_path.iterdir()) == saved
    assert [r.getMessage().partition("not written: ")[2] for r in caplog.records] == [
        f"No space left ({count} times so far); learning goes on" for count in (1, 2, 4)
    ]
    before = publisher.version
    publisher.maybe_save()
    loaded = load_latest(tmp_path)
    assert loaded is not None
    assert loaded.checkpoint.weights_version > before + 1000


@pytest.mark.parametrize("content", [None, b"text"])
def test_initial_weights_that_cannot_be_had_are_refused_by_name(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "weights.safetensors"
    if content is not None:
        path.write_bytes(content)
    config = load_config("smoke", {"learner.initial_weights": str(path)}, environ={})
    with pytest.raises(CheckpointError, match=r"weights\.safetensors") as error:
        WeightsPublisher(config, make_learner(), MagicMock(), tmp_path / "checkpoints")
    assert "\n" not in str(error.value)
