"""`mrcdrl actor`: collect transitions with the newest weights of a run.

`Actor` goes at its own pace, `LockstepActor` collects once for each turn of the learner.
"""

import time
import zlib
from collections.abc import Sequence

import numpy as np

from mrcdrl.common.arena import make_arenas, make_codec
from mrcdrl.common.config import Config
from mrcdrl.common.messages.metrics import ActorMetrics
from mrcdrl.common.messages.trajectory import Chunk, EpisodeSummary, Float32Array, Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.exploration import epsilons
from mrcdrl.common.model.policy import Policy, make_policy
from mrcdrl.common.model.q_network import resolve_device
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.broadcast import Broadcast
from mrcdrl.common.sync.joining import Joining
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session
from mrcdrl.services.actor.chunker import ChunkerConfig
from mrcdrl.services.actor.collector import Collector
from mrcdrl.services.actor.lease import ALONE, ExplorationRank, LeaseClient
from mrcdrl.services.actor.sender import Sender

_LISTEN_S = 0.2


class Actor:
    """The shell around a collector; it collects at its own pace."""

    def __init__(
        self,
        config: Config,
        joining: Joining,
        session: Session,
        sender: Sender,
        lease: LeaseClient,
        broadcast: Broadcast | None = None,
    ) -> None:
        """broadcast: is shown one of the arenas, while anybody watches."""
        keys, worker = joining.keys, joining.worker
        self._config = config
        self._worker = worker
        self._sender = sender
        self._lease = lease
        self._reader = WeightsReader(session, keys, self._adopt)
        self._episodes = session.publisher(keys.episodes(worker))
        self.reporter = StatsReporter(
            session.publisher(keys.stats("actor", worker)), "actor", worker, warms_up=True
        )
        self._policy = make_policy(
            config, resolve_device(config.actor.device, "actor.device"), averages=False
        )
        self._broadcast = broadcast
        self._collector = make_collector(config, worker, self._policy, broadcast=self._broadcast)
        self._adopted_s = time.monotonic()
        self._epsilons = self._explore(lease.rank)
        self._waited_s = 0.0
        self._started_s = time.monotonic()

    def run(self, stop: StopSignal) -> None:
        """Wait for the first weights, then collect until stopped."""
        self._reader.wait(stop, meanwhile=self._report)
        self._epsilons = self._explore(self._lease.rank)
        while not stop.is_set():
            self._advance(stop)
        self.reporter.publish(self._metrics)

    def _advance(self, stop: StopSignal) -> None:
        """Adopt newer weights, step every arena once, send the result."""
        self._adopt_newer()
        self._send(*self._collector.step(self._epsilons), stop)

    def _send(
        self, chunks: Sequence[Chunk], episodes: Sequence[EpisodeSummary], stop: StopSignal
    ) -> None:
        """Spool the chunks, publish the episode summaries, report."""
        self.reporter.warmed_up()
        began_s = time.monotonic()
        self._sender.put_all(chunks, stop, self._report_waiting)
        self._waited_s += time.monotonic() - began_s
        for episode in episodes:
            self._episodes.put(encode(episode))
        self._report()

    def _report_waiting(self) -> None:
        self._lease.follow()
        self.reporter.worked(self._sender.heard_s)
        self.reporter.publish_if_due(self._metrics)

    def _report(self) -> None:
        self._lease.follow()
        self.reporter.worked()
        self.reporter.publish_if_due(self._metrics)

    def _adopt_newer(self) -> None:
        """Adopt newer weights; update epsilon when they or the exploration rank changed."""
        newer = self._reader.latest()
        self._lease.follow()
        if newer is not None or self._lease.rank != self._rank:
            self._epsilons = self._explore(self._lease.rank)

    def _adopt(self, weights: Weights) -> None:
        """Act by these weights from now on; raises CheckpointError for another network's."""
        self._policy.adopt(weights)
        self._adopted_s = time.monotonic()

    def _explore(self, rank: ExplorationRank) -> Float32Array:
        """Epsilon of each arena at this exploration rank."""
        self._rank = rank
        return epsilons(
            self._config.exploration,
            self._policy.learner_step,
            *rank,
            self._config.actor.num_arenas,
        )

    def _metrics(self) -> ActorMetrics:
        collector, seconds = self._collector, self._collector.seconds
        now = time.monotonic()
        lived_s = max(now - self._started_s, 1e-9)
        curriculum, numbers = collector.curriculum, self._config.arena.numbers
        by_robots: list[dict[int, float] | None] = [None, None]
        if self._config.arena.mixes_numbers:
            shares = curriculum.weights(self._policy.learner_step)
            columns = (curriculum.success_rates.tolist(), shares.tolist())
            by_robots = [dict(zip(numbers, column, strict=True)) for column in columns]
        return ActorMetrics(
            env_steps=collector.env_steps,
            robot_steps=collector.robot_steps,
            episodes=collector.num_episodes,
            chunks=self._sender.chunks,
            inserts_acknowledged=self._sender.transitions,
            spool_chunks=self._sender.spooled,
            weights_version=self._policy.weights_version,
            weights_age_s=now - self._adopted_s,
            weights_refused=self._reader.refused,
            slot=self._lease.slot,
            epsilon_min=float(self._epsilons.min()),
            epsilon_max=float(self._epsilons.max()),
            inference_share=seconds.inference / lived_s,
            arena_share=seconds.arena / lived_s,
            draw_share=seconds.draw / lived_s,
            chunk_share=seconds.chunk / lived_s,
            wait_share=self._waited_s / lived_s,
            success_by_robots=by_robots[0],
            share_by_robots=by_robots[1],
        )


class LockstepActor(Actor):
    """Collects once with the weights of each turn, then waits for the next turn's."""

    def __init__(
        self,
        config: Config,
        joining: Joining,
        session: Session,
        sender: Sender,
        lease: LeaseClient,
        lockstep: Lockstep,
        broadcast: Broadcast | None = None,
    ) -> None:
        super().__init__(config, joining, session, sender, lease, broadcast)
        self._lockstep = lockstep
        self._done = -1  # the last turn collected

    def _advance(self, stop: StopSignal) -> None:
        """Collect if a new turn has begun, then listen for weights."""
        turn = self._lockstep.turn(self._policy.learner_step)
        if turn > self._done and self._policy.weights_version >= 0:
            self._collect(turn, stop)
            self._done = turn
        self._sender.check()
        self._reader.latest(_LISTEN_S)
        self._report()

    def _collect(self, turn: int, stop: StopSignal) -> None:
        """Make the turn's transitions in new episodes, as if this were the only actor."""
        collector = make_collector(
            self._config, self._worker, self._policy, turn, broadcast=self._broadcast
        )
        collector.continue_counts(self._collector)
        self._collector, self._epsilons = collector, self._explore(ALONE)
        for left in reversed(range(self._lockstep.transitions(turn) // collector.num_robots)):
            if stop.is_set():
                return
            self._send(*collector.step(self._epsilons, truncate=not left), stop)


def make_collector(
    config: Config,
    worker: str,
    policy: Policy,
    turn: int | None = None,
    broadcast: Broadcast | None = None,
) -> Collector:
    """Build the arenas, codec and chunkers of one actor; its name enters the seeds.

    turn: in lockstep, enters the seeds too, and is the incarnation, so that chunks of a turn that
    is repeated are recognised.
    """
    name_entropy = int.from_bytes(worker.encode(), "little")
    entropy = [config.run.seed, name_entropy, *([] if turn is None else [turn])]
    seeds = np.random.SeedSequence(entropy)
    *arena_seeds, policy_seed = seeds.spawn(config.actor.num_arenas + 1)
    arenas = make_arenas(
        config.arena,
        [np.random.default_rng(seed) for seed in arena_seeds],
        [arena_identity(worker, index) for index in range(config.actor.num_arenas)],
    )
    incarnation = time.time_ns() if turn is None else turn
    chunking = ChunkerConfig.from_config(config, worker, incarnation)
    codec = make_codec(config.arena)
    rng = np.random.default_rng(policy_seed)
    return Collector(config, chunking, arenas, codec, policy, rng, broadcast)


def arena_identity(worker: str, arena: int) -> int:
    """16-bit identity of one actor's arena, which the images of a counting arena carry."""
    return (zlib.crc32(worker.encode()) + arena) % 2**16
