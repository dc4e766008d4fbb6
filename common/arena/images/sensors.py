"""The robots' cameras: they turn scenes into records, with noise and dropped frames.

Invariants: a record determines its image. It carries the seed of its noise, and a dropped frame
repeats the previous record, so everyone who decodes a record sees the same pixels. Random numbers
come from an arena's own generator, and only if the configuration asks for them.
"""

from collections.abc import Sequence

import numpy as np

from mrcdrl.common.arena.images.codec import make_codec
from mrcdrl.common.arena.images.noise import NoiseSeeds
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Int64Array, UInt8Array


class Sensors:
    """The cameras of the robots of A arenas."""

    def __init__(self, config: ArenaConfig, rngs: Sequence[np.random.Generator]) -> None:
        """rngs: one per arena."""
        self._config = config
        self._rngs = rngs
        self._codec = make_codec(config)
        shape = (len(rngs), config.num_robots, self._codec.record_bytes)
        self._last: UInt8Array = np.zeros(shape, np.uint8)

    def first(self, arena: int, scene: Scene) -> UInt8Array:
        """Records an episode's first scene [K, R]; this frame is never dropped."""
        records = self._codec.encode(scene, self._noise_seeds(arena))
        self._last[arena] = records
        return records

    def read(self, arenas: Int64Array, scenes: Scene) -> UInt8Array:
        """Records the arenas' scenes [N, ...] as [N, K, R]."""
        config = self._config
        seeds = None
        if config.pixel_noise:
            drawn = [self._noise_seeds(arena) for arena in arenas.tolist()]
            seeds = np.array(drawn, np.uint32).reshape(len(arenas), config.num_robots)
        records = self._codec.encode(scenes, seeds)
        if config.dropped_frame_probability:
            for n, arena in enumerate(arenas.tolist()):
                draws = self._rngs[arena].random(config.num_robots)
                dropped = draws < config.dropped_frame_probability
                records[n, dropped] = self._last[arena, dropped]
            self._last[arenas] = records
        return records

    def _noise_seeds(self, arena: int) -> NoiseSeeds | None:
        """Seeds [K], or None without noise."""
        if not self._config.pixel_noise:
            return None
        return self._rngs[arena].integers(2**32, size=self._config.num_robots, dtype=np.uint32)
