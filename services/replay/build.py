"""What a configuration asks for: the table, its sampler, the rate limiter and the log."""

from pathlib import Path

import numpy as np

from mrcdrl.common.config import Config, ReplayConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import SegmentLog
from mrcdrl.services.replay.sampler import PrioritizedSampler, Sampler, UniformSampler
from mrcdrl.services.replay.sum_tree import MAX_NODES, NODE_BYTES
from mrcdrl.services.replay.table import Table, bytes_per_transition


def open_log(config: Config, directory: Path) -> SegmentLog | None:
    """The log a configuration asks for."""
    if config.replay.fsync == "off":
        return None
    return SegmentLog(
        directory,
        segment_bytes=config.replay.segment_bytes,
        fsync=config.replay.fsync == "always",
    )


def build(config: Config, *, record_bytes: int | None = None) -> tuple[Table, RateLimiter]:
    """The table and limiter a configuration asks for.

    record_bytes: kept of each record, if not all of it. Raises ConfigError where
    replay.capacity_bytes leave no room for replay.min_size.
    """
    capacity = capacity_of(config)
    lockstep = config.run.turn_size > 0
    table = Table(
        capacity=capacity,
        stack=config.arena.stack,
        n_step=config.agent.n_step,
        # In turns the capacity alone decides what goes, not where chunks happen to lie.
        chunk_length=1 if lockstep else config.actor.chunk_length,
        record_bytes=config.arena.record_bytes if record_bytes is None else record_bytes,
        sampler=make_sampler(config.replay, capacity),
    )
    limiter = RateLimiter.with_tolerance(
        0.0 if lockstep else config.replay.samples_per_insert,
        config.replay.shard_min_size,
        config.replay.tolerance,
        largest_insert=config.actor.chunk_length,
        largest_sample=config.learner.sample_size,
    )
    return table, limiter


def make_sampler(replay: ReplayConfig, capacity: int) -> Sampler:
    """The sampler a configuration asks for."""
    rng = np.random.default_rng(replay.seed)
    if replay.prioritized:
        return PrioritizedSampler(capacity, replay.priority_exponent, rng)
    return UniformSampler(rng)


def capacity_of(config: Config) -> int:
    """Transitions of one shard: as configured, or what replay.capacity_bytes allow.

    Raises ConfigError where that leaves no room for replay.min_size.
    """
    replay = config.replay
    if not replay.capacity_bytes:
        return replay.shard_capacity
    each = _each_bytes(config)
    room = int(replay.capacity_bytes / replay.shards / each)
    if room < replay.shard_min_size:
        raise ConfigError(
            f"replay.capacity_bytes {replay.capacity_bytes} holds {room * replay.shards} "
            f"transitions of {each:.0f} bytes, fewer than replay.min_size {replay.min_size}"
        )
    return min(replay.shard_capacity, room)


def table_bytes(config: Config) -> int:
    """About what the table of one shard takes; raises ConfigError as `capacity_of`."""
    return round(capacity_of(config) * _each_bytes(config))


def _each_bytes(config: Config) -> float:
    """Of a transition, with what its sampler takes."""
    window = config.arena.stack + config.agent.n_step
    each = bytes_per_transition(window, config.actor.chunk_length, config.arena.record_bytes)
    return each + MAX_NODES * NODE_BYTES * config.replay.prioritized
