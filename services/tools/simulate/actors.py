"""Actors without arenas and inference: their messages are real, the contents are made up.

Each simulated actor has the network side of a real one: a session, its name's claim, a liveliness
token, a lease, a `Sender` with its thread, a subscription to the weights, statistics once a second,
a summary of each episode. Invariants: a full spool stops an actor's clock, as it stops arenas; a
process of simulated actors ends when its parent does.
"""

import contextlib
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from multiprocessing.connection import Connection
from time import monotonic, sleep, time_ns
from typing import Protocol

import numpy as np

from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.metrics import ActorMetrics, read
from mrcdrl.common.messages.trajectory import (
    NO_SLOT,
    NUM_ACTIONS,
    Chunk,
    EpisodeSummary,
    Float64Array,
    InsertReply,
    Outcome,
    UInt8Array,
    Weights,
)
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.chunker import Chunker, ChunkerConfig
from mrcdrl.services.actor.lease import LeaseClient
from mrcdrl.services.actor.sender import Sender
from mrcdrl.services.replay.client import ReplayWriter, shard_of

EPISODE_FRAMES = 186  # mean of benchmarks/results/quick-2robots
_EPISODES = 8  # different ones, then they repeat
_TICK_S = 0.01
_TURNS = 10  # ticks in which each actor once looks for weights, and reports if that is due
_TALLY_S = 1.0
_DRAIN_S = 5.0  # to have acknowledged what was made before the end
BEGIN, STOP = "begin", "stop"
_NOT_SIMULATED = read(ActorMetrics, {})  # 0 for every metric


@dataclass(frozen=True, slots=True)
class Plan:
    """What a process simulates."""

    config: Config
    run: str
    transport: TransportConfig
    workers: tuple[str, ...]  # names of the actors, or of the one learner
    rate: float  # robot steps per second of an actor, publications per second of a learner

    @property
    def keys(self) -> Keys:
        return Keys(self.run)


@dataclass(frozen=True, slots=True)
class Tally:
    """A process's counts since it began, and its latencies since the last tally.

    Before it begins, its count `joined`; with `last`, what had become of all that it made.
    """

    seconds: float = 0.0  # since it began
    counts: Counter[str] = field(default_factory=Counter)
    insert_s: Float64Array = field(default_factory=lambda: np.empty(0))
    weights_s: Float64Array = field(default_factory=lambda: np.empty(0))
    last: bool = False


Joined = Callable[[int], None]  # takes how many of a process's have joined so far


class Simulated(Protocol):
    """What a process simulates: its actors, or the learner."""

    def begin(self, now_s: float) -> None: ...
    def work(self, now_s: float) -> None: ...
    def tally(self, seconds: float) -> Tally: ...
    def drained(self) -> bool:
        """Whether all that was made is acknowledged; after a call nothing more is made."""


def follow(connection: Connection, simulated: Simulated) -> None:
    """Work from the parent's first message to its second, sending a tally once a second.

    Raises EOFError when the parent ends.
    """
    connection.recv()
    began_s = sent_s = monotonic()
    simulated.begin(began_s)
    while not connection.poll(_TICK_S):
        simulated.work(monotonic())
        if monotonic() - sent_s >= _TALLY_S:
            sent_s = monotonic()
            connection.send(simulated.tally(sent_s - began_s))
    connection.recv()
    ended_s = monotonic()
    connection.send(simulated.tally(ended_s - began_s))
    while not simulated.drained() and monotonic() < ended_s + _DRAIN_S:
        sleep(_TICK_S)
    connection.send(replace(simulated.tally(ended_s - began_s), last=True))


def tell_joined(connection: Connection) -> Joined:
    """Tells the parent how many have joined."""
    return lambda number: connection.send(Tally(counts=Counter(joined=number)))


@contextmanager
def answering(connection: Connection) -> Iterator[None]:
    """Ignore Ctrl-C, which is for the parent; send the parent an error as one line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    except (EOFError, BrokenPipeError):
        return
    except MrcdrlError as error:
        with contextlib.suppress(BrokenPipeError):  # the parent has ended for another reason
            connection.send(str(error))


def act(plan: Plan, connection: Connection) -> None:
    """Run a process's simulated actors until the parent sends STOP."""
    with answering(connection), ExitStack() as owned:
        actors = SimulatedActors(plan, tell_joined(connection))
        owned.callback(actors.close)
        follow(connection, actors)


class TimedWriter(ReplayWriter):
    """Records how long each acknowledgement took, counted from the first request."""

    def __init__(self, session: Session, plan: Plan, worker: str, stop: StopSignal) -> None:
        warn_s, num_shards = plan.config.actor.warn_s, plan.config.replay.shards
        shard = shard_of(worker, num_shards)
        super().__init__(session, plan.keys, warn_s, stop, shard=shard, num_shards=num_shards)
        self.insert_s: deque[float] = deque()
        self.requests = 0

    def insert(self, chunks: Sequence[Chunk]) -> InsertReply | None:
        asked_s = monotonic()
        reply = super().insert(chunks)
        if reply is not None:
            self.requests += 1
            self.insert_s.append(monotonic() - asked_s)
        return reply


class SimulatedActor:
    """One actor, as replay, router and learner see it."""

    def __init__(
        self,
        plan: Plan,
        worker: str,
        chunks: Sequence[Chunk],
        session: Session,
        writer: TimedWriter,
        stop: StopSignal,
    ) -> None:
        """Join as a real actor does; raises TransportError or NameTakenError."""
        config, keys = plan.config, plan.keys
        session.client(keys.config, "replay").ask(b"").result()
        claim_name(session, keys, "actor", worker, stop)
        self._worker, self._rate, self._chunks = worker, plan.rate, chunks
        self._incarnation, self._sequence = time_ns(), 0
        self._num_robots = config.arena.num_robots
        self._episode_steps = EPISODE_FRAMES * self._num_robots
        self._episodes = 0
        self._due_s = 0.0
        self.waited_s = 0.0
        self.made = 0  # transitions spooled so far
        self.counts: Counter[str] = Counter()
        self.weights_s: list[float] = []
        session.announce(keys.live("actor", worker))
        self._lease = LeaseClient(session, keys, worker, config.exploration.lease_s)
        self._weights = WeightsReader(session, keys)
        self._summaries = session.publisher(keys.episodes(worker))
        self._reporter = StatsReporter(
            session.publisher(keys.stats("actor", worker)), "actor", worker
        )
        self.writer = writer
        self.sender = Sender(writer, config.actor.spool_chunks)

    def begin(self, now_s: float, phase: float) -> None:
        """Start the clock. phase: time to the first chunk, as a fraction of a chunk's time."""
        self._due_s = now_s + phase * len(self._chunks[0]) / self._rate

    def spool(self, now_s: float) -> None:
        """Spool the chunks that are due."""
        while self._due_s <= now_s and self._spool(now_s):
            pass

    def look(self) -> None:
        """Take new weights, renew the lease and publish statistics, where these are due."""
        weights = self._weights.latest()
        if weights is not None:
            self.counts.update(weights=1)
            self.counts["weights_bytes"] = self._weights.fetched_bytes
            self.weights_s.append(monotonic() - published_s(weights))
        self._lease.follow()
        self._reporter.publish_if_due(self._metrics)

    def _spool(self, now_s: float) -> bool:
        chunk = replace(
            self._chunks[self._sequence % len(self._chunks)],
            actor=self._worker,
            incarnation=self._incarnation,
            sequence=self._sequence,
        )
        if not self.sender.put(chunk, timeout_s=0.0):
            self.waited_s += now_s - self._due_s
            self._due_s = now_s
            return False
        self._sequence += 1
        self.made += len(chunk)
        self._due_s += len(chunk) / self._rate
        if self.made >= (self._episodes + 1) * self._episode_steps:
            self._episodes += 1
            self._summaries.put(encode(self._summary()))
        return True

    def _summary(self) -> EpisodeSummary:
        return EpisodeSummary(
            actor=self._worker,
            arena=0,
            episode=self._episodes,
            outcome=Outcome.TIMEOUT,
            frames=EPISODE_FRAMES,
            score=0.0,
            collisions=0,
            epsilon=1.0,
            weights_version=0,
            mean_q=0.0,
            num_robots=self._num_robots,
        )

    def _metrics(self) -> ActorMetrics:
        return replace(
            _NOT_SIMULATED,
            robot_steps=self.made,
            episodes=self._episodes,
            chunks=self.sender.chunks,
            inserts_acknowledged=self.sender.transitions,
            spool_chunks=self.sender.spooled,
            slot=NO_SLOT,
        )


class SimulatedActors:
    """All simulated actors of one process: one thread for all, and one for each sender."""

    def __init__(self, plan: Plan, joined: Joined = lambda _number: None) -> None:
        """Join the run, one after another; raises MrcdrlError if one cannot."""
        self._stop, self._sessions = StopSignal(), ExitStack()
        self._actors: list[SimulatedActor] = []
        self._turn = 0
        chunks = episode_chunks(plan.config)
        try:
            for worker in plan.workers:
                session = self._sessions.enter_context(Session(plan.transport))
                writer = TimedWriter(session, plan, worker, self._stop)
                actor = SimulatedActor(plan, worker, chunks, session, writer, self._stop)
                self._actors.append(actor)
                joined(len(self._actors))
        except BaseException:
            self.close()
            raise

    def begin(self, now_s: float) -> None:
        for index, actor in enumerate(self._actors):
            actor.begin(now_s, index / len(self._actors))

    def work(self, now_s: float) -> None:
        for actor in self._actors:
            actor.spool(now_s)
        self._turn = (self._turn + 1) % _TURNS
        for actor in self._actors[self._turn :: _TURNS]:
            actor.look()

    def drained(self) -> bool:
        return all(actor.made == actor.sender.transitions for actor in self._actors)

    def tally(self, seconds: float) -> Tally:
        counts: Counter[str] = Counter()
        insert_s: list[float] = []
        weights_s: list[float] = []
        for actor in self._actors:
            writer, sender = actor.writer, actor.sender
            counts.update(actor.counts)
            counts.update(
                made=actor.made,
                transitions=sender.transitions,
                chunks=sender.chunks,
                requests=writer.requests,
                throttled=writer.throttled,
                unanswered=writer.unanswered,
                waited_ms=round(1000 * actor.waited_s),
            )
            insert_s += [writer.insert_s.popleft() for _ in range(len(writer.insert_s))]
            weights_s += actor.weights_s
            actor.weights_s.clear()
        return Tally(seconds, counts, np.array(insert_s), np.array(weights_s))

    def close(self) -> None:
        """End all actors; spooled chunks are dropped."""
        self._stop.set()
        with ThreadPoolExecutor(max(1, len(self._actors))) as pool:
            list(pool.map(lambda actor: actor.sender.close(), self._actors))
        self._sessions.close()


def published_s(weights: Weights) -> float:
    """When a simulated learner published these weights, on this machine's monotonic clock.

    It says so, in nanoseconds, in the place of its step.
    """
    return 1e-9 * weights.learner_step


def episode_chunks(config: Config) -> list[Chunk]:
    """Chunks of a few episodes of one robot: random steps, but real shapes and lengths."""
    rng, numbers = np.random.default_rng(0), count()
    chunker = Chunker(ChunkerConfig.from_config(config, "simulated", incarnation=0))
    chunks: list[Chunk] = []
    for _ in range(_EPISODES):
        chunker.start(_record(config, rng))
        for frame in range(1, EPISODE_FRAMES + 1):
            last = frame == EPISODE_FRAMES
            chunks += chunker.add(
                int(rng.integers(NUM_ACTIONS)),
                config.arena.step_reward,
                _record(config, rng),
                taken_q=float(rng.normal()),
                greedy_q=float(rng.normal()),
                weights_version=0,
                last=last,
                discount=0.0 if last else 1.0,
                sequence=numbers,
            )
    return chunks


def _record(config: Config, rng: np.random.Generator) -> UInt8Array:
    """A record of random poses, or an image of one intensity with noise on a tenth of it."""
    length = config.arena.record_bytes
    if config.arena.codec == "scene":
        poses = rng.uniform(0, config.arena.size_px, length // 4).astype("<f4")
        return poses.view(np.uint8)
    image = np.full(length, 128, np.uint8)
    start, size = rng.integers(length - length // 10), length // 10
    image[start : start + size] = rng.integers(0, 256, size)
    return image
