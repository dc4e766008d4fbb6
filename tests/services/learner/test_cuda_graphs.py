"""A captured step gives the numbers of an eager one, to the bit; here with the CPU's tensors.

A stand-in for CUDA graphs replays the very function that would be captured, on the same tensors
that stay where they are: all but the capture itself is what runs on a GPU.
"""

import dataclasses
import logging
import threading
from pathlib import Path
from typing import Literal
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from mrcdrl.common.config import AgentConfig, LearnerConfig, load_config
from mrcdrl.common.errors import ConfigError, DivergedError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.learner.accelerate.cuda_graphs import Capturer, Work
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.prefetch import Prefetcher
from mrcdrl.services.learner.step import Update
from mrcdrl.services.learner.training_loop import run
from mrcdrl.services.learner.weights_publisher import WeightsPublisher
from tests.patience import PATIENCE_S
from tests.services.learner.test_learner import FLOAT32, VIEW_PX, random_batch

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 14


class Replay:
    """Stands for CUDA graphs: captured work is done at each call, and not before."""

    def __init__(self) -> None:
        self.warm_ups = self.replays = self.launches = 0

    def warm_up(self, work: Work) -> None:
        self.warm_ups += 1
        work()

    def capture(self, work: Work) -> Work:
        def replay() -> None:
            self.replays += 1
            work()

        return replay

    def launched(self) -> None:
        self.launches += 1


class NoGraphs(Replay):
    """A device that captures nothing."""

    def capture(self, work: Work) -> Work:
        raise RuntimeError("operation not permitted when stream is capturing\nmore of it")


def make_learner(
    agent: AgentConfig, capturer: Capturer | None = None, settings: LearnerConfig = FLOAT32
) -> Learner:
    return Learner(agent, settings, stack=4, view_px=VIEW_PX, capturer=capturer)


def batches(num: int = STEPS) -> list[Batch]:
    """With importance weights as prioritized replay's, images turned and strided as drawn."""
    found = []
    for seed in range(num):
        batch, rng = random_batch(seed=seed), np.random.default_rng(seed)
        weights = torch.from_numpy(rng.uniform(0.1, 1.0, 8).astype(np.float32))
        images = torch.cat([batch.observation, batch.next_observation], dim=1).flip(-1)
        found.append(
            dataclasses.replace(
                batch,
                importance_weights=weights,
                observation=images[:, :4],
                next_observation=images[:, 1:5],
            )
        )
    return found


def assert_same(one: Update, other: Update) -> None:
    for name in ("loss", "mean_q", "gradient_norm", "td_errors"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.parametrize(
    ("kind", "optimizer", "munchausen_alpha"),
    [
        ("duel", "adam", 0.0),
        ("ddqn", "adam", 0.0),
        ("dqn", "adam", 0.0),
        ("duel", "rmsprop", 0.0),
        ("duel", "adam", 0.9),
    ],
)
@pytest.mark.parametrize("launch", [1, 3])
def test_a_captured_step_is_the_eager_one_bit_for_bit(
    kind: Literal["duel", "ddqn", "dqn"],
    optimizer: Literal["adam", "rmsprop"],
    munchausen_alpha: float,
    launch: int,
) -> None:
    """Over copies to the target network and a learning rate that falls."""
    agent = AgentConfig(
        kind=kind,
        optimizer=optimizer,
        optimizer_epsilon=1e-5,
        munchausen_alpha=munchausen_alpha,
        target_period=4,
        learning_rate_schedule=((0, 1.0), (6, 1.0), (8, 0.01)),
    )
    replay, given = Replay(), batches()
    settings = FLOAT32.model_copy(update={"updates_per_launch": launch})
    eager, captured = make_learner(agent), make_learner(agent, replay, settings)
    expected = [eager.step(batch) for batch in given]
    found = [
        update
        for at in range(0, STEPS, launch)
        for update in captured.steps(given[at : at + launch])
    ]
    assert len(found) == STEPS == captured.learner_step
    for one, other in zip(expected, found, strict=True):
        assert_same(one, other)
    assert captured.state() == eager.state()
    assert replay.replays > 0
    assert replay.launches == replay.warm_ups + replay.replays


def test_several_updates_are_one_launch_unless_the_target_is_copied_between() -> None:
    replay = Replay()
    settings = FLOAT32.model_copy(update={"updates_per_launch": 3})
    learner = make_learner(AgentConfig(target_period=8), replay, settings)
    launches = []
    for at in (0, 3, 6, 9):
        learner.steps(batches()[at : at + 3])
        launches.append(replay.launches)
    assert launches == [1, 2, 5, 6]  # 8 lies within the third
    learner.steps(batches()[:2])
    assert replay.launches == 8


class Ready:
    """Batches that a prefetcher has ready, as many as are asked for."""

    ready = refused = 0
    decode_s = heard_s = 0.0

    def __init__(self) -> None:
        self.asked: list[int] = []

    def next(self, _timeout_s: float, most: int) -> list[Batch]:
        self.asked.append(most)
        return batches(most)


@pytest.mark.parametrize(("interval_s", "at"), [("0", [0, 4, 8, 9]), ("3600", [0, 9])])
def test_no_launch_passes_over_a_publication_or_the_end(
    tmp_path: Path, interval_s: str, at: list[int]
) -> None:
    settings = {
        "arena.view_px": str(VIEW_PX),
        "learner.device": "cpu",
        "learner.precision": "float32",
        "learner.updates_per_launch": "3",
        "learner.publish_period": "4",
        "learner.publish_interval_s": interval_s,
        "run.learner_steps": "9",
    }
    config = load_config(None, settings, environ={})
    learner = make_learner(config.agent, Replay(), config.learner)
    published: list[Weights] = []
    writer, ready, priorities = MagicMock(), Ready(), MagicMock(dropped=0)
    writer.publish.side_effect = published.append
    publisher = WeightsPublisher(config, learner, writer, tmp_path)
    run(config, learner, ready, priorities, publisher, MagicMock(), StopSignal())  # type: ignore[arg-type]
    assert [weights.learner_step for weights in published] == at
    assert ready.asked == [3, 1, 3, 1, 1]
    assert priorities.put.call_count == 9


def test_batches_that_wait_are_given_together() -> None:
    stop, samples = StopSignal(), iter(range(5))
    reader = MagicMock()
    reader.sample.side_effect = lambda: next(samples, None)
    prefetcher = Prefetcher(reader, lambda sampled: sampled, depth=5, stop=stop)  # type: ignore[arg-type, return-value]
    prefetcher.close()  # once all five wait
    assert [prefetcher.next(0.0, most) for most in (2, 1, 4, 4)] == [[0, 1], [2], [3, 4], []]


def test_a_part_of_the_step_is_computed_ahead_while_a_batch_waits() -> None:
    stop, samples = StopSignal(), iter(range(1, 4))
    reader = MagicMock()
    reader.sample.side_effect = lambda: next(samples, None)
    prefetcher = Prefetcher(reader, lambda sampled: sampled, 5, stop, lambda batch: -batch)  # type: ignore[arg-type, return-value, operator]
    prefetcher.close()
    assert prefetcher.next(0.0, 3) == [1, -2, -3]


def test_a_learner_that_waits_gets_its_batch_at_once() -> None:
    """Each is sampled only when the one before has been taken."""
    stop, samples, taken = StopSignal(), iter(range(1, 4)), threading.Semaphore()
    reader = MagicMock()
    reader.sample.side_effect = lambda: taken.acquire(timeout=PATIENCE_S) and next(samples, None)
    prefetcher = Prefetcher(reader, lambda sampled: sampled, 5, stop, lambda batch: -batch)  # type: ignore[arg-type, return-value, operator]
    found = []
    for _ in range(3):
        found += prefetcher.next(PATIENCE_S)
        taken.release()
    prefetcher.close()
    assert found == [1, 2, 3]


def test_what_an_update_told_stays_after_the_next() -> None:
    learner, given = make_learner(AgentConfig(), Replay()), batches(6)
    first = learner.step(given[0])
    kept = first.td_errors.clone()
    for batch in given[1:]:
        learner.step(batch)
    assert torch.equal(first.td_errors, kept)


def test_a_device_that_cannot_capture_stays_eager_and_says_so_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    given = batches(8)
    eager, captured = make_learner(AgentConfig()), make_learner(AgentConfig(), NoGraphs())
    with caplog.at_level(logging.INFO, "learner"):
        for batch in given:
            assert_same(eager.step(batch), captured.step(batch))
    assert caplog.messages == [
        "steps stay eager: capturing a graph failed: "
        "operation not permitted when stream is capturing"
    ]


def test_a_captured_learner_that_is_restored_goes_on_from_there() -> None:
    """What was captured before would step parameters that no longer exist."""
    given = batches(10)
    whole, other = make_learner(AgentConfig()), make_learner(AgentConfig(), Replay())
    for batch in given[:5]:
        whole.step(batch)
        other.step(dataclasses.replace(batch, reward=batch.reward + 1))
    other.restore(whole.state())
    for batch in given[5:]:
        assert_same(whole.step(batch), other.step(batch))
    assert whole.state() == other.state()


def test_captured_steps_that_diverge_are_not_published() -> None:
    learner, given = make_learner(AgentConfig(), Replay()), batches(5)
    for batch in given:
        learner.step(batch)
    learner.step(dataclasses.replace(given[0], reward=torch.full((8,), torch.nan)))
    with pytest.raises(DivergedError):
        learner.payload()


def test_a_graph_on_a_device_without_graphs_is_refused() -> None:
    settings = LearnerConfig(step="graph", device="cpu")
    with pytest.raises(ConfigError, match=r"learner\.step 'graph': only a CUDA device"):
        make_learner(AgentConfig(), settings=settings)


@pytest.mark.parametrize("setting", ["auto", "eager"])
def test_steps_on_a_cpu_are_eager(setting: Literal["auto", "eager"]) -> None:
    learner = make_learner(AgentConfig(), settings=LearnerConfig(step=setting, device="cpu"))
    assert learner.updates_per_launch == 1
    assert "step='eager'" in repr(learner)
