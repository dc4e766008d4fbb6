"""Arenas whose robots' states are stacked images, as the paper's network takes them.

Invariants: a state is the newest `stack` images, oldest first; at the start of an episode the first
image is repeated (paper section 4).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.batch import ArenaBatch
from mrcdrl.common.arena.images.codec import make_codec
from mrcdrl.common.arena.images.rendering import render_arena
from mrcdrl.common.arena.world.scene import Start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Int64Array, TimeStep, TimeSteps, UInt8Array


class StackedArenas:
    """Common core of the PettingZoo and Gymnasium environments."""

    def __init__(self, config: ArenaConfig, rngs: Sequence[np.random.Generator]) -> None:
        """rngs: one per arena. Raises ConfigError if robots or targets do not fit."""
        self._config = config
        self._arenas = ArenaBatch(config, rngs)
        self._codec = make_codec(config)
        shape = (len(rngs), config.num_robots, config.stack, config.view_px, config.view_px)
        self.states: UInt8Array = np.zeros(shape, np.uint8)
        """States after the last time step [A, K, S, V, V]; the next step overwrites them."""

    @property
    def present(self) -> Int64Array:
        """Robots of each arena's episode [A]; any others are absent, and their states black."""
        return self._arenas.present

    def reset(self, arena: int, start: Start | None = None) -> TimeStep:
        """Begins an episode of an arena, as ArenaBatch does."""
        time_step = self._arenas.reset(arena, start)
        self.states[arena] = self._codec.decode(time_step.records)[:, None]
        return time_step

    def step(self, actions: ArrayLike, arenas: Int64Array) -> TimeSteps:
        """Plays one frame of these arenas [N], as ArenaBatch does; actions: [N, K]."""
        time_steps = self._arenas.step(actions, arenas)
        for age in range(self._config.stack - 1):
            self.states[arenas, :, age] = self.states[arenas, :, age + 1]
        self.states[arenas, :, -1] = self._codec.decode(time_steps.records)
        return time_steps

    def image(self, arena: int, size_px: int = 600, *, smooth: bool = True) -> UInt8Array:
        """Renders a whole arena as RGB [size_px, size_px, 3], for people to look at."""
        bgr = render_arena(self._arenas.scene(arena), self._config, size_px, smooth=smooth)
        return np.ascontiguousarray(bgr[..., ::-1])
