"""A model of what many actors demand of replay, router and network, from measured costs.

Invariants: pure; sizes are those of real encoded messages; costs were measured in the runs that
benchmarks/results/simulate/README.md names. docs/generate.py makes the tables of docs/scaling.md
from it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from statistics import fmean
from typing import Any

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.messages.metrics import ActorMetrics, numbers, read
from mrcdrl.common.messages.trajectory import (
    EpisodeSummary,
    InsertReply,
    Outcome,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
    Weights,
    WeightsNotice,
)
from mrcdrl.common.messages.wire import encode_parts
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import SENT_AS, weights_to_bytes
from mrcdrl.services.tools.simulate.actors import EPISODE_FRAMES, episode_chunks

# CPU seconds of replay's process, including Zenoh's threads, for
INSERT_S = 0.36e-3  # a request to insert
CHUNK_S = 0.06e-3  # each chunk in it
SAMPLE_S = 0.41e-3  # a request for 128 transitions
PAYLOAD_S = 1.4e-9  # a byte of records that crosses the network
STATS_S = 0.13e-3  # a statistics message, including everything else that an idle actor costs
# and of the process that relays (the router, or replay if there is none), for
RELAYED_BYTE_S = 0.58e-9  # a byte of weights, per receiver
RELAYED_NOTICE_S = 0.01e-3  # a notice, per receiver
RELAYED_QUERY_S = 0.14e-3  # a request and its answer

CORE = 0.9  # fraction of a core that one Python process can use
LINK_BYTES = 1.25e9 * 0.8  # per second: four fifths of 10 Gbit/s
ACTORS_PER_HOST = 32  # assumed: one process of a host asks for weights, for all of it


@dataclass(frozen=True, slots=True)
class Flow:
    """Messages of one kind, for all actors together."""

    name: str
    way: str
    message_bytes: float
    per_s: float

    @property
    def bytes_per_s(self) -> float:
        return self.message_bytes * self.per_s

    @property
    def processor(self) -> tuple[str, float] | None:
        """The process that pays, and its CPU seconds per message; None: negligible or unknown."""
        return {
            "chunks": ("replay", INSERT_S + CHUNK_S),
            "samples": ("replay", SAMPLE_S),
            "weights": ("router", self.message_bytes * RELAYED_BYTE_S),
            "statistics": ("router", STATS_S),
        }.get(self.name)


@dataclass(frozen=True, slots=True)
class Pace:
    """The rates of a run."""

    actors: int
    transitions_per_s: float  # of all actors
    publications_per_s: float

    @property
    def hosts(self) -> int:
        """Hosts besides the learner's."""
        return math.ceil(self.actors / ACTORS_PER_HOST)

    @classmethod
    def free(cls, actors: int, rate: float, publications_per_s: float = 1.0) -> "Pace":
        """Actors do not wait for the learner. rate: robot steps per second of an actor."""
        return cls(actors, actors * rate, publications_per_s)

    @classmethod
    def throttled(cls, config: Config, actors: int, rate: float, updates_per_s: float) -> "Pace":
        """The rate limiter admits as much as the learner's updates sample."""
        admitted = updates_per_s * config.learner.batch_size / config.replay.samples_per_insert
        learner = config.learner
        publications_per_s = updates_per_s / learner.publish_period
        if learner.publish_interval_s:
            publications_per_s = min(publications_per_s, 1 / learner.publish_interval_s)
        if learner.publish_bytes_per_s:
            fan_out_bytes = weights_bytes(config) * math.ceil(actors / ACTORS_PER_HOST)
            publications_per_s = min(
                publications_per_s, learner.publish_bytes_per_s / fan_out_bytes
            )
        return cls(actors, min(admitted, actors * rate), publications_per_s)


@dataclass(frozen=True, slots=True)
class Need:
    """The resources that a pace needs."""

    replay_cores: float
    relay_cores: float
    relay_bytes_per_s: float  # through the router
    shards: int
    routers: int
    first: str  # what fills up first, with one of each


def flows(config: Config, pace: Pace) -> list[Flow]:
    """All messages between actors, replay and learner, without retransmissions."""
    chunk_bytes, chunk_length = _chunk(config)
    chunks_per_s = pace.transitions_per_s / chunk_length
    samples_per_s = pace.transitions_per_s * config.replay.samples_per_insert
    size = config.learner.sample_size
    episodes_per_s = pace.transitions_per_s / EPISODE_FRAMES / config.arena.num_robots
    request, samples = SampleRequest(size), _samples(config, size)
    found = [
        Flow("chunks", "actor → replay", chunk_bytes, chunks_per_s),
        Flow("acknowledgements", "replay → actor", _size(InsertReply(10**5, False, 10**8)),
             chunks_per_s),
        Flow("notices of weights", "learner → actors", _size(_notice()),
             pace.publications_per_s * pace.actors),
        Flow("weights", "learner → hosts", weights_bytes(config),
             pace.publications_per_s * pace.hosts),
        Flow("statistics", "actor → watchers", _size(_stats()), pace.actors),
        Flow("episodes", "actor → watchers", _size(_episode()), episodes_per_s),
        Flow("sample requests", "learner → replay", _size(request), samples_per_s / size),
        Flow("samples", "replay → learner", _size(samples), samples_per_s / size),
    ]  # fmt: skip
    if config.replay.prioritized:
        batch = config.learner.batch_size
        errors = Priorities(np.full(batch, 10**8), np.ones(batch, np.float32))
        found += [
            Flow("priorities", "learner → replay", _size(errors), samples_per_s / batch),
            Flow("their acknowledgements", "replay → learner", _size(PrioritiesReply(batch, 0)),
                 samples_per_s / batch),
        ]  # fmt: skip
    return found


def need(config: Config, pace: Pace) -> Need:
    """Resources for this pace, with one chunk per request and every process on its own host."""
    by_name = {flow.name: flow for flow in flows(config, pace)}
    chunks, samples = by_name["chunks"], by_name["samples"]
    sampled = config.learner.sample_size * samples.per_s
    replay_cores = PAYLOAD_S * (chunks.bytes_per_s + samples.bytes_per_s) + replay_cpu(
        inserts=chunks.per_s, chunks=chunks.per_s, samples=sampled
    )
    relay_cores = relay_cpu(
        pace.actors,
        by_name["weights"].bytes_per_s,
        queries=chunks.per_s + samples.per_s,
        notices=by_name["notices of weights"].per_s,
    )
    through = sum(flow.bytes_per_s for flow in by_name.values())
    full = {
        "replay's process": replay_cores / CORE,
        "the router's process": relay_cores / CORE,
        "the router's link": through / LINK_BYTES,
    }
    first = max(full, key=lambda name: full[name])
    return Need(
        replay_cores,
        relay_cores,
        through,
        math.ceil(full["replay's process"]),
        math.ceil(max(full["the router's process"], full["the router's link"])),
        first if full[first] > 1 else "nothing",
    )


def replay_cpu(*, inserts: float, chunks: float, samples: float) -> float:
    """Cores for this many insert requests, chunks in them, and transitions sampled per second."""
    return inserts * INSERT_S + chunks * CHUNK_S + samples / 128 * SAMPLE_S


def relay_cpu(
    actors: int, weights_bytes_per_s: float, *, queries: float, notices: float = 0.0
) -> float:
    """Cores to relay the actors' statistics, weights and notices of them, and queries."""
    passed = weights_bytes_per_s * RELAYED_BYTE_S + queries * RELAYED_QUERY_S
    passed += notices * RELAYED_NOTICE_S
    return actors * STATS_S + passed


def expected(figures: Mapping[str, Any]) -> float:
    """Cores of replay by the model, for figures that `mrcdrl simulate` printed.

    Relaying is included, unless a router did it.
    """
    worked = replay_cpu(
        inserts=figures["inserts_per_s"],
        chunks=figures["chunks_per_s"],
        samples=figures["samples_per_s"],
    )
    if "shared_memory false" in figures["command"]:
        worked += PAYLOAD_S * figures["chunks_per_s"] * figures["chunk_bytes"]
    if "router" in figures["processes"]:
        return worked
    return worked + relay_cpu(figures["actors"], figures["weights_bytes_per_s"], queries=0)


@cache
def weights_bytes(config: Config) -> int:
    """Size of one publication of weights."""
    network = QNetwork(config.agent.kind, stack=config.arena.stack, view_px=config.arena.view_px)
    payload = weights_to_bytes(network, SENT_AS[config.learner.publish_precision])
    return _size(Weights.of(2**60, 10**5, 10**6, payload))


@cache
def _chunk(config: Config) -> tuple[float, float]:
    """Mean bytes and transitions of a chunk."""
    chunks = episode_chunks(config)
    return fmean(map(_size, chunks)), fmean(map(len, chunks))


def _size(message: object) -> int:
    return sum(map(len, encode_parts(message)))


def _samples(config: Config, size: int) -> Samples:
    window = config.arena.stack + config.agent.n_step
    octets, floats = np.ones(size, np.uint8), np.ones(size, np.float32)
    return Samples(
        keys=np.full(size, 10**8),
        probabilities=np.full(size, 1 / size),
        table_size=config.replay.capacity,
        total_priority=1.0,
        actions=octets,
        rewards=floats,
        discounts=floats,
        bootstrap_offsets=octets,
        weights_versions=np.full(size, 10**5),
        records=np.zeros((size, window, config.arena.record_bytes), np.uint8),
    )


def _notice() -> WeightsNotice:
    address = f"{'0' * 36} {10**6} 100 {'0' * 32}"
    return WeightsNotice(2**60, 10**5, 10**6, "0" * 64, 10**7, address)


def _stats() -> Stats:
    metrics = dict.fromkeys(numbers(read(ActorMetrics, {})), 1.0)
    return Stats("actor", "actor-100", metrics, {"incarnation": "1" * 19})


def _episode() -> EpisodeSummary:
    return EpisodeSummary(
        actor="actor-100",
        arena=0,
        episode=10**5,
        outcome=Outcome.SUCCESS,
        frames=EPISODE_FRAMES,
        score=1.0,
        collisions=0,
        epsilon=0.1,
        weights_version=10**5,
        mean_q=1.0,
        num_robots=1,
    )
