"""What goes astray is told, once; what diverged reaches nobody and leaves the last good state."""

import dataclasses
import logging
import math
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.config.returns import largest_return
from mrcdrl.common.errors import DivergedError
from mrcdrl.common.messages.metrics import numbers
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.diagnostics import Diagnostics
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.training_loop import run
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from tests.services.learner.test_learner import random_batch

pytestmark = pytest.mark.usefixtures("one_thread")


def config_of(**changes: str) -> Config:
    small = {"arena.view_px": "31", "learner.device": "cpu", "learner.precision": "float32"}
    given = {name.replace("__", "."): value for name, value in changes.items()}
    return load_config(None, small | given, environ={})


def learner_of(config: Config) -> Learner:
    return Learner(config.agent, config.learner, stack=4, view_px=31)


def nan_batch() -> Batch:
    return dataclasses.replace(random_batch(), reward=torch.full((8,), torch.nan))


def test_the_figures_are_those_of_the_batch_and_the_network() -> None:
    config = config_of()
    learner, batch = learner_of(config), random_batch(80)
    update = learner.step(batch)
    found = Diagnostics(config, learner).look(batch, update)
    with torch.no_grad():
        q = learner.online(batch.observation[:64])
    assert found.q_min == pytest.approx(float(q.min()))
    assert found.q_p50 == pytest.approx(float(q.quantile(0.5)))
    assert found.q_max == pytest.approx(float(q.max()))
    assert found.td_error_p90 == pytest.approx(float(update.td_errors.abs().quantile(0.9)))
    assert found.loss_finite == 1
    assert 0.0 < found.target_drift < 0.1


def test_histograms_are_of_the_looks_since_the_last_ones() -> None:
    """Errors of a tenth of the largest return fall into one known bin, far values outside."""
    config = config_of()
    learner, batch = learner_of(config), random_batch()
    diagnostics, update = Diagnostics(config, learner), learner.step(batch)
    bound = largest_return(config)
    errors = torch.tensor([0.0, 0.2, -0.2, 2.0, -2.0, 2.0, math.nan, 2.0]) * bound
    told = dataclasses.replace(update, td_errors=errors)
    first = diagnostics.look(batch, told)
    assert first.td_error_bin == pytest.approx((1 / 7, *[0.0] * 6, 2 / 7, 0.0, 4 / 7))
    assert first.q_bin[4:6] != (0.0, 0.0)
    with torch.no_grad():
        learner.online.value.bias.fill_(-1.5 * bound)
    between = [diagnostics.look(batch, update) for _ in range(14)]
    assert not any(found.q_bin or found.td_error_bin for found in between)
    then = diagnostics.look(batch, update)
    assert then.q_bin == (1.0, *[0.0] * 9)
    assert sum(then.td_error_bin) == pytest.approx(1.0)


def test_dead_units_are_counted_and_told_once(caplog: pytest.LogCaptureFixture) -> None:
    config = config_of()
    learner, batch = learner_of(config), random_batch()
    diagnostics, update = Diagnostics(config, learner), learner.step(batch)
    before = diagnostics.look(batch, update).dead_share
    units = 32 + 64 + 64 + 512 + 512
    with torch.no_grad():
        learner.online.value_hidden.bias.fill_(-1e6)
        learner.online.conv3.bias.fill_(-1e6)
        learner.online.advantage_hidden.bias.fill_(-1e6)
    with caplog.at_level(logging.WARNING, "learner"):
        after = [diagnostics.look(batch, update).dead_share for _ in range(2)]
    assert before < 0.5
    assert after[0] == after[1] >= (64 + 512 + 512) / units
    assert len(caplog.messages) == 1
    assert "units are 0 whatever they see" in caplog.text


def test_values_no_episode_can_bring_are_told_until_they_are_gone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = config_of()
    learner, batch = learner_of(config), random_batch()
    diagnostics, update = Diagnostics(config, learner), learner.step(batch)
    bound = largest_return(config)
    assert bound > 0
    with caplog.at_level(logging.WARNING, "learner"):
        for value in (0.0, 3 * bound, 4 * bound, 0.0, 3 * bound):
            with torch.no_grad():
                learner.online.value.bias.fill_(value)
            diagnostics.look(batch, update)
    assert len(caplog.messages) == 2
    assert f"no return exceeds {bound:.3g}" in caplog.text


class Prefetched:
    """Batches in place of a prefetcher's."""

    ready = refused = 0
    decode_s = 0.0

    def __init__(self, batches: list[Batch]) -> None:
        self._batches = batches

    def next(self, _timeout_s: float, _most: int) -> list[Batch]:
        return [self._batches.pop(0)]


def test_what_diverged_reaches_nobody_and_the_last_good_checkpoint_stays(tmp_path: Path) -> None:
    config = config_of(
        learner__publish_period="2",
        learner__publish_interval_s="0",
        learner__checkpoint_period_s="1e-9",
    )
    learner = learner_of(config)
    published: list[Weights] = []
    writer, reporter = MagicMock(), MagicMock()
    writer.publish.side_effect = published.append
    publisher = WeightsPublisher(config, learner, writer, tmp_path)
    told: list[dict[str, float]] = []
    reporter.publish.side_effect = lambda metrics: told.append(numbers(metrics()))
    batches = [random_batch(seed=step) for step in range(3)] + [nan_batch()]
    with pytest.raises(DivergedError, match="by step 4"):
        run(
            config,
            learner,
            Prefetched(batches),  # type: ignore[arg-type]
            None,
            publisher,
            reporter,
            StopSignal(),
        )
    assert [weights.learner_step for weights in published] == [0, 2]
    assert math.isnan(told[-1]["loss"])
    assert told[-1]["loss_finite"] == 0
    found = checkpoint.load_latest(tmp_path)
    assert found is not None
    assert (found.checkpoint.state.learner_step, found.skipped) == (3, ())
    again = learner_of(config)
    before = published[-1]
    WeightsPublisher(config, again, writer, tmp_path).publish()
    assert again.learner_step == 3
    assert published[-1].order > before.order
