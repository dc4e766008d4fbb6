"""One arena: episodes of K robots that must all stand on targets at once.

Invariants: those of mrcdrl.common.arena.batch; it is a batch of one.
"""

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.batch import ArenaBatch
from mrcdrl.common.arena.world.scene import Scene, Start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import TimeStep


class Arena:
    """The paper's arena (section 3), with the interface of dm_env."""

    def __init__(
        self,
        config: ArenaConfig,
        rng: np.random.Generator,
        *,
        max_collisions: int | None = None,
    ) -> None:
        """max_collisions: robot collisions that end an episode; config.max_collisions if None.

        Raises ConfigError if robots or targets do not fit.
        """
        self._batch = ArenaBatch(config, [rng], max_collisions=max_collisions)

    def __repr__(self) -> str:
        return f"Arena(frame={self.frame}, collisions={self.collisions}, scene={self.scene})"

    @property
    def scene(self) -> Scene:
        """A copy of the true state."""
        return self._batch.scene(0)

    @property
    def frame(self) -> int:
        """Frames played in this episode."""
        return int(self._batch.frames[0])

    @property
    def collisions(self) -> int:
        """Robot collisions in this episode; two robots that run into each other count as two."""
        return int(self._batch.collisions[0])

    def reset(self, start: Start | None = None) -> TimeStep:
        """Begins an episode at the given start, or at a random one.

        Raises ValueError if the start has wrong shapes or overlapping robots.
        """
        return self._batch.reset(0, start)

    def step(self, actions: ArrayLike) -> TimeStep:
        """Plays one frame; actions: [K] of LEFT, STRAIGHT, RIGHT.

        Raises ValueError for invalid actions, or if no episode is running.
        """
        return self._batch.step(np.asarray(actions)[None])[0]
