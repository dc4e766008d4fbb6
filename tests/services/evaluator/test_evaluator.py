"""The evaluator, in a thread of the test: which weights it evaluates, and what it tells."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.metrics import EvaluatorMetrics, read
from mrcdrl.common.messages.trajectory import Evaluation, Stats, Weights, WeightsNotice
from mrcdrl.common.messages.wire import decode_published, encode
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.heartbeat import FILE_VARIABLE, Pulse
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.joining import Joining
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.common.transport.shared_memory import SealedMemory
from mrcdrl.services.evaluator.evaluator import BestWeights, Evaluator
from tests.patience import eventually

SMALL = {
    "arena.view_px": "32",
    "arena.max_frames": "20",
    "learner.precision": "float32",
    "learner.average_decay": "0",  # the announcer below has no averages
    "evaluator.episodes": "1",
    "evaluator.period_s": "0",
    "evaluator.max_share": "1",
}
CONFIG = load_config("smoke", SMALL, environ={})


@pytest.fixture
def session() -> Iterator[Session]:
    with Session(TransportConfig(listen=(free_endpoint(),))) as opened:
        yield opened


def weights(epoch: int, version: int, view_px: int = 32) -> Weights:
    network = QNetwork(CONFIG.agent.kind, view_px=view_px)
    return Weights.of(epoch, version, 10 * version, weights_to_bytes(network))


class Announcer:
    """Announces weights as a learner of this host, in any order."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._publisher = session.publisher(keys.weights_notice)
        self._memories: list[SealedMemory] = []

    def put(self, weights: Weights) -> None:
        memory = SealedMemory(weights.payload)
        self._memories.append(memory)
        size = len(weights.payload)
        of = (*weights.order, weights.learner_step, weights.digest, size, memory.address)
        self._publisher.put(encode(WeightsNotice(*of)))


def test_each_frame_is_work_and_only_the_first_may_take_minutes(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "heartbeat"
    monkeypatch.setenv(FILE_VARIABLE, str(path))
    monkeypatch.setattr(StatsReporter, "publish_if_due", StatsReporter.publish)
    pulses: list[Pulse] = []

    def play(*_: object, keep_going: Callable[[int], bool], **__: object) -> None:
        for frame in range(3):
            keep_going(frame)
            pulses.append(Pulse.read(path))
        stop.set()

    monkeypatch.setattr("mrcdrl.services.evaluator.evaluator.play", play)
    joining, stop = Joining("judged", "e", tmp_path, TransportConfig(), {}), StopSignal()
    with closing(WeightsWriter(session, joining.keys)) as writer:
        writer.publish(weights(1, 1))
        thread = threading.Thread(target=Evaluator(CONFIG, joining, session, stop).run)
        thread.start()
        thread.join()
    first, second, third = pulses
    assert (first.patience_s, second.patience_s, third.patience_s) == (600, 0, 0)
    assert first.worked_s < second.worked_s < third.worked_s


def test_refused_weights_are_told_and_do_not_block_good_ones(
    session: Session, tmp_path: Path
) -> None:
    joining, stop = Joining("judged", "e", tmp_path, TransportConfig(), {}), StopSignal()
    keys = joining.keys
    statistics = session.queue_subscriber(keys.stats("evaluator", "e"))
    results = session.queue_subscriber(keys.evaluation("e"))
    publisher = Announcer(session, keys)
    thread = threading.Thread(target=Evaluator(CONFIG, joining, session, stop).run)
    thread.start()
    judged: list[tuple[int, int]] = []
    told = EvaluatorMetrics(evaluations=0, weights_version=0, weights_refused=0, busy=0)

    def refused() -> bool:
        nonlocal told
        publisher.put(weights(2, 10**6, view_px=40))
        item = statistics.take(0.1)
        if item is not None:
            told = read(EvaluatorMetrics, decode_published(Stats, *item).metrics)
        return told.weights_refused > before

    def evaluated(version: int) -> bool:
        publisher.put(weights(1, version))
        item = results.take(0.1)
        if item is not None:
            found = decode_published(Evaluation, *item)
            judged.append((found.weights_epoch, found.weights_version))
        return (1, version) in judged

    try:
        for version in (1, 2):
            before = told.weights_refused
            eventually(refused)
            eventually(lambda latest=version: evaluated(latest))
    finally:
        stop.set()
        thread.join()
    assert {epoch for epoch, _ in judged} == {1}


def test_a_full_disk_under_the_best_weights_ends_no_evaluator(
    session: Session,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    joining, stop = Joining("judged", "e", tmp_path, TransportConfig(), {}), StopSignal()
    full = CheckpointError("weights best.safetensors not written: No space left on device")
    monkeypatch.setattr(BestWeights, "offer", MagicMock(side_effect=full))
    results = session.queue_subscriber(joining.keys.evaluation("e"))
    publisher = Announcer(session, joining.keys)
    thread = threading.Thread(target=Evaluator(CONFIG, joining, session, stop).run)
    thread.start()
    try:
        for version in (1, 2):
            publisher.put(weights(1, version))
            eventually(lambda: results.take(0.1) is not None)
    finally:
        stop.set()
        thread.join()
    assert "No space left on device (1 times so far)" in caplog.text
