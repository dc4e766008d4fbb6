"""No transition is torn, doubled, misaligned or lost between arenas and learner.

Counting arenas in real actor processes, a real replay process, and this test as the learner: it
publishes weights, samples until it has seen every transition of the table, and compares each
with the pure functions that made it. Meanwhile replay is away for two seconds, so that actors
send chunks again, and an actor is killed and started again.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mrcdrl.common.arena import (
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
    make_codec,
)
from mrcdrl.common.config import Config, TransportConfig, load_config, to_toml
from mrcdrl.common.messages.trajectory import Outcome, Samples, Stats, Weights
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.model.policy import make_policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import QueueSubscriber, Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.actor import arena_identity
from mrcdrl.services.learner.batch import collate
from mrcdrl.services.learner.rendering import HostRenderer
from mrcdrl.services.replay.client import ReplayReader
from tests.system.system_processes import PATIENCE_S, Command, end_all, run_name

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

ACTORS = ("actor-0", "actor-1")
ARENAS, ROBOTS, BATCH = 2, 2, 256
SAMPLING_S = 700.0
# Actors may run 3 000 transitions ahead, then each batch of 256 lets a chunk of 16 in: they are
# held throughout, and at the end 96 000 samples are left to see every transition by.
CONFIG = load_config(
    "smoke",
    {
        "arena.kind": "counting",
        "arena.codec": "frames",
        "arena.view_px": "32",
        "exploration.schedule": "[[0, 0.0]]",
        "replay.min_size": "500",
        "replay.samples_per_insert": "16",
        "replay.tolerance": "6",
        "replay.hold_s": "0.3",
        "actor.num_arenas": str(ARENAS),
        "actor.chunk_length": "16",
        "learner.batch_size": str(BATCH),
        "learner.precision": "float32",
    },
    environ={},
)

Transition = tuple[int, int, int, int]  # identity, robot, episode, step before it
Stream = list[tuple[int, int]]  # (episode, step) of one robot, in the order of insertion


class Witness:
    """Samples as the learner does, checks every transition, and remembers it by its key."""

    def __init__(self, config: Config, reader: ReplayReader, weights: Weights) -> None:
        self._reader = reader
        self._decode = make_codec(config.arena).decode
        self._config = config
        self._policy = make_policy(config, averages=False)  # as actors do
        self._policy.adopt(weights)
        self.seen: dict[int, Transition] = {}
        self.versions: set[int] = set()
        self.decided = 0  # transitions whose greedy action is beyond doubt

    def sample(self, num_batches: int) -> None:
        for _ in range(num_batches):
            samples = self._reader.sample()
            assert samples is not None, "no batch in time"
            self._check(samples)

    def _check(self, samples: Samples) -> None:
        stack = self._config.arena.stack
        batch = collate(samples, HostRenderer(self._decode), stack)
        now = decode_counters(batch.observation.numpy())  # [B, stack]
        later = decode_counters(batch.next_observation.numpy())
        rows = zip(
            *(samples.keys.tolist(), now.identity[:, -1].tolist(), now.robot[:, -1].tolist()),
            *(now.episode[:, -1].tolist(), now.step[:, -1].tolist()),
            strict=True,
        )
        back = np.arange(stack)[::-1]
        for row, (key, *named) in enumerate(rows):
            transition: Transition = (named[0], named[1], named[2], named[3])
            known = self.seen.setdefault(key, transition)
            assert known == transition, f"key {key} was {known}, is {transition}"
            identity, _, episode, step = transition
            frames = counting_frames(identity, episode)
            k = int(samples.bootstrap_offsets[row])
            assert k == min(self._config.agent.n_step, frames - step)
            for images, last in ((now, step), (later, step + k)):
                for name, value in zip(("identity", "robot", "episode"), transition, strict=False):
                    assert (getattr(images, name)[row] == value).all()
                assert (images.step[row] == np.maximum(last - back, 0)).all()
            self._check_return(transition, k, float(batch.reward[row]), float(batch.discount[row]))
        self.versions |= set(samples.weights_versions.tolist())
        self._check_actions(batch.observation.numpy(), samples.actions)

    def _check_return(self, made: Transition, k: int, reward: float, discount: float) -> None:
        identity, _, episode, step = made
        gamma = self._config.agent.gamma
        due = sum(gamma**i * counting_reward(episode, step + 1 + i) for i in range(k))
        ends = step + k == counting_frames(identity, episode)
        terminated = ends and counting_outcome(identity, episode) is Outcome.SUCCESS
        assert reward == pytest.approx(due, rel=1e-6)
        assert discount == pytest.approx(0.0 if terminated else gamma**k, rel=1e-6)

    def _check_actions(self, observations: np.ndarray, actions: np.ndarray) -> None:
        """Epsilon is 0: each action is the network's own for that very state."""
        values = self._policy.q_values(observations)
        best, second = np.sort(values, axis=1)[:, :-3:-1].T
        clear = best - second > 1e-4
        assert (values.argmax(axis=1)[clear] == actions[clear]).all()
        self.decided += int(clear.sum())


class Listener:
    """The latest statistics of every service."""

    def __init__(self, subscriber: QueueSubscriber) -> None:
        self._subscriber = subscriber
        self.latest: dict[str, dict[str, float]] = {}

    def follow(self, seconds: float) -> None:
        """Take in what comes in that time."""
        until_s = time.monotonic() + seconds
        while (left := until_s - time.monotonic()) > 0:
            item = self._subscriber.take(left)
            if item is not None:
                stats = decode(Stats, item[1])
                self.latest[stats.id] = stats.metrics

    def wait(
        self,
        worker: str,
        metric: str,
        at_least: float,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> float:
        """The metric once it is as large; held actors need sampling meanwhile."""
        deadline = time.monotonic() + PATIENCE_S
        while self.latest.get(worker, {}).get(metric, -1.0) < at_least:
            assert time.monotonic() < deadline, f"{worker} {metric} {at_least}: {self.latest}"
            meanwhile()
            self.follow(0.2)
        return self.latest[worker][metric]


@pytest.fixture
def watched() -> Iterator[StopSignal]:
    """A signal that ends sampling when it takes too long."""
    stop = StopSignal()
    timer = threading.Timer(SAMPLING_S, stop.set)
    timer.start()
    yield stop
    stop.set()
    timer.cancel()
    timer.join()


def first_weights() -> Weights:
    network = QNetwork("duel", stack=CONFIG.arena.stack, view_px=CONFIG.arena.view_px)
    return Weights.of(1, 1, 0, weights_to_bytes(network))


def streams_of(seen: dict[int, Transition]) -> dict[tuple[int, int], Stream]:
    """Transitions of each robot in the table, in the order of insertion."""
    streams: dict[tuple[int, int], Stream] = {}
    for key in sorted(seen):
        identity, robot, episode, step = seen[key]
        streams.setdefault((identity, robot), []).append((episode, step))
    return streams


def incarnations(identity: int, stream: Stream) -> list[int]:
    """Transitions of each start of an arena; fails where one does not follow on the one before."""
    assert stream[0] == (0, 0)
    lengths = [1]
    for (episode, step), following in pairwise(stream):
        last = step + 1 == counting_frames(identity, episode)
        due = (episode + 1, 0) if last else (episode, step + 1)
        if following == due:
            lengths[-1] += 1
        else:
            assert following == (0, 0), f"{due} is due after {(episode, step)}, not {following}"
            lengths.append(1)
    return lengths


def test_every_transition_arrives_once_whole_and_in_order(
    tmp_path: Path, watched: StopSignal
) -> None:
    name, endpoint = run_name("counting"), free_endpoint()
    config_path = tmp_path / "counting.toml"
    config_path.write_text(to_toml(CONFIG), "utf-8")
    keys, weights = Keys(name), first_weights()
    serving = ["replay", "--run", name, "--config", config_path, "--listen", endpoint]
    joining = ["--run", name, "--connect", endpoint, "--transport.timeout_s", "1.0"]
    try:
        with (
            Command([*serving, "--run-dir", tmp_path], tmp_path) as replay,
            Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as session,
        ):
            listener = Listener(session.queue_subscriber(keys.every_stats))
            writer = WeightsWriter(session, keys)
            writer.publish(weights)
            reader = ReplayReader(session, keys, BATCH, 1, 2, 10.0, watched)
            witness = Witness(CONFIG, reader, weights)
            renamed = Weights.of(1, 2, 0, weights.payload)  # so that actions stay comparable
            try:
                acknowledged = disturb(
                    tmp_path, joining, replay, listener, witness, lambda: writer.publish(renamed)
                )
                total = settle(listener)
                while len(witness.seen) < total:
                    witness.sample(8)
            finally:
                writer.close()
            listener.follow(1.5)
            counts = listener.latest["replay-0"]
            assert replay.end() == 0, replay.err
    finally:
        end_all(name)
    assert sorted(witness.seen) == list(range(total))
    assert (counts["inserts"], counts["gaps"], counts["refused"]) == (total, 0, 0)
    assert witness.versions == {1, 2}
    assert witness.decided > 100
    compare(streams_of(witness.seen), acknowledged)


def disturb(
    folder: Path,
    joining: list[str],
    replay: Command,
    listener: Listener,
    witness: Witness,
    publish_again: Callable[[], None],
) -> dict[str, list[float]]:
    """Collect while replay pauses and an actor dies; what each actor's starts had acknowledged."""

    def start(worker: str) -> Command:
        settings = {
            "MRCDRL_REPLAY__HOLD_S": "0.3"
        }  # the run's: else so short a deadline is refused
        return Command(["actor", *joining, "--id", worker], folder, **settings)

    def all_live() -> None:
        for actor in actors.values():
            assert actor.process.poll() is None, actor.err

    actors = {worker: start(worker) for worker in ACTORS}
    try:
        for worker in ACTORS:
            listener.wait(worker, "inserts_acknowledged", 1, all_live)
        witness.sample(30)
        replay.signal(signal.SIGSTOP)
        listener.follow(2.0)
        replay.signal(signal.SIGCONT)
        witness.sample(30)
        publish_again()
        listener.wait("actor-0", "weights_version", 2, lambda: witness.sample(4))
        witness.sample(30)
        killed, dead = listener.latest.pop("actor-0"), actors["actor-0"]
        dead.signal(signal.SIGKILL)
        assert dead.wait() == -signal.SIGKILL
        listener.follow(0.5)
        listener.latest.pop("actor-0", None)
        actors["actor-0"] = start("actor-0")
        listener.wait("actor-0", "inserts_acknowledged", 30, lambda: witness.sample(4))
        for actor in actors.values():
            assert actor.end() == 0, actor.err
        return {
            "actor-0": [killed["inserts_acknowledged"], metric_of(listener, "actor-0")],
            "actor-1": [metric_of(listener, "actor-1")],
        }
    finally:
        for actor in actors.values():
            actor.end()


def metric_of(listener: Listener, worker: str) -> float:
    return listener.latest[worker]["inserts_acknowledged"]


def settle(listener: Listener) -> int:
    """Transitions of the table, once that number rises no more."""
    before, now = -1.0, -2.0
    deadline = time.monotonic() + PATIENCE_S
    while before != now:
        assert time.monotonic() < deadline, f"inserts still rise: {now}"
        before = now
        listener.latest.clear()
        now = listener.wait("replay-0", "inserts", 0)
    return int(now)


def compare(streams: dict[tuple[int, int], Stream], acknowledged: dict[str, list[float]]) -> None:
    """Every stream is without gap or double, and holds at least what was acknowledged."""
    whose = {arena_identity(w, arena): w for w in ACTORS for arena in range(ARENAS)}
    assert len(whose) == len(ACTORS) * ARENAS
    assert {identity for identity, _ in streams} == set(whose)
    stored = {worker: [0] * len(starts) for worker, starts in acknowledged.items()}
    for (identity, _), stream in streams.items():
        lengths = incarnations(identity, stream)
        worker = whose[identity]
        assert len(lengths) <= len(stored[worker])
        for start, length in enumerate(lengths):
            stored[worker][start] += length
    for worker, starts in acknowledged.items():
        for told, kept in zip(starts, stored[worker], strict=True):
            assert 0 < told <= kept, f"{worker}: {told} acknowledged, {kept} stored"
