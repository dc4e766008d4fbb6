"""An arena whose robots' states are pictures, stacked as the paper's network gets them.

Invariants: a state is the newest `stack` pictures, oldest first; at an episode's start the first
one is repeated (paper section 4). States handed out are never written to again.
"""

import numpy as np

from common.arena.arena import Arena
from common.arena.codec import make_codec
from common.arena.rendering import draw_arena
from common.arena.scene import Start
from common.config import ArenaConfig
from common.trajectory import TimeStep, UInt8Array


class StackedArena:
    """What the environments of PettingZoo and Gymnasium have in common."""

    def __init__(self, config: ArenaConfig, rng: np.random.Generator) -> None:
        """Raises ConfigError when robots or targets do not fit."""
        self._config = config
        self._arena = Arena(config, rng)
        self._codec = make_codec(config)
        shape = (config.num_robots, config.stack, config.view_px, config.view_px)
        self.states: UInt8Array = np.zeros(shape, np.uint8)
        """Of the last time step, [K, S, V, V]."""

    def reset(self, start: Start | None = None) -> TimeStep:
        """Begins an episode, as Arena does."""
        time_step = self._arena.reset(start)
        pictures = self._codec.decode(time_step.records)
        self.states = np.repeat(pictures[:, None], self._config.stack, axis=1)
        return time_step

    def step(self, actions: UInt8Array) -> TimeStep:
        """Plays one frame, as Arena does."""
        time_step = self._arena.step(actions)
        pictures = self._codec.decode(time_step.records)
        self.states = np.concatenate([self.states[:, 1:], pictures[:, None]], axis=1)
        return time_step

    def picture(self, size_px: int = 600, *, smooth: bool = True) -> UInt8Array:
        """The whole arena as RGB [size_px, size_px, 3], for people to look at."""
        bgr = draw_arena(self._arena.scene, self._config, size_px, smooth=smooth)
        return np.ascontiguousarray(bgr[..., ::-1])
