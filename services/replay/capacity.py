"""How many transitions a shard's table holds, and the memory they take."""

from mrcdrl.common.config import Config
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.replay.sum_tree import MAX_NODES, NODE_BYTES

_COLUMNS_BYTES = 4 + 1 + 4 + 1 + 4 + 4 + 1 + 8  # per transition
TAILS_PER_CHUNK = 0.8  # tails set apart at once: an episode has some 1.25 chunks, or more


def bytes_per_transition(window: int, chunk_length: int, record_bytes: int) -> float:
    """Bytes of records and columns per transition, without the sampler's."""
    return record_bytes * (1 + TAILS_PER_CHUNK * (window - 1) / chunk_length) + _COLUMNS_BYTES


def capacity_of(config: Config) -> int:
    """Transitions of one shard: as configured, or as many as replay.capacity_bytes allows.

    Raises ConfigError where that leaves no room for replay.min_size.
    """
    replay = config.replay
    if not replay.capacity_bytes:
        return replay.shard_capacity
    each = _bytes_each(config)
    room = int(replay.capacity_bytes / replay.shards / each)
    if room < replay.shard_min_size:
        raise ConfigError(
            f"replay.capacity_bytes {replay.capacity_bytes} holds {room * replay.shards} "
            f"transitions of {each:.0f} bytes, fewer than replay.min_size {replay.min_size}"
        )
    return min(replay.shard_capacity, room)


def table_bytes(config: Config) -> int:
    """Approximate memory of one shard's table; raises ConfigError as `capacity_of` does."""
    return round(capacity_of(config) * _bytes_each(config))


def _bytes_each(config: Config) -> float:
    """Bytes per transition, the sampler's included."""
    window = config.arena.stack + config.agent.n_step
    each = bytes_per_transition(window, config.actor.chunk_length, config.arena.record_bytes)
    return each + MAX_NODES * NODE_BYTES * config.replay.prioritized
