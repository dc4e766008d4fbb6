"""One arena: an episode after another of K robots that must stand on K targets together.

Invariants: those of common.arena.batch, of which it is a batch of one.
"""

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.batch import ArenaBatch
from mrcdrl.common.arena.world.scene import Scene, Start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import TimeStep


class Arena:
    """The paper's arena (section 3), in dm_env's terms."""

    def __init__(
        self,
        config: ArenaConfig,
        rng: np.random.Generator,
        *,
        max_collisions: int | None = None,
    ) -> None:
        """max_collisions: robot collisions that end an episode; the configuration's if None.

        Raises ConfigError when robots or targets do not fit.
        """
        self._batch = ArenaBatch(config, [rng], max_collisions=max_collisions)

    def __repr__(self) -> str:
        return f"Arena(frame={self.frame}, collisions={self.collisions}, scene={self.scene})"

    @property
    def scene(self) -> Scene:
        """The true state, a copy."""
        return self._batch.scene(0)

    @property
    def frame(self) -> int:
        """Frames of this episode so far."""
        return int(self._batch.frames[0])

    @property
    def collisions(self) -> int:
        """Robot collisions of this episode: two when two robots run into one another."""
        return int(self._batch.collisions[0])

    def reset(self, start: Start | None = None) -> TimeStep:
        """Begins an episode, at random or at the given start.

        Raises ValueError for a start with other shapes, or robots that overlap.
        """
        return self._batch.reset(0, start)

    def step(self, actions: ArrayLike) -> TimeStep:
        """Plays one frame; actions: [K] of LEFT, STRAIGHT, RIGHT.

        Raises ValueError for other actions, and when no episode is running.
        """
        return self._batch.step(np.asarray(actions)[None])[0]
