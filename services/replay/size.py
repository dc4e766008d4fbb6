"""How large a shard of the table a configuration asks for: in transitions, and in bytes."""

from common.config import Config
from common.errors import ConfigError
from services.replay.sum_tree import MAX_NODES, NODE_BYTES
from services.replay.table import bytes_per_transition


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
