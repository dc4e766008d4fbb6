"""One arena: an episode after another of K robots that must stand on K targets together.

Invariants: reset, then step until LAST, then reset; every random number comes from the injected
generator, so a seed gives the same episodes in every process. Actions are LEFT, STRAIGHT, RIGHT
of common.arena.scene.
"""

import numpy as np
from numpy.typing import ArrayLike

from common.arena.actions import checked_actions
from common.arena.codec import make_codec
from common.arena.counting import CountingArena
from common.arena.layout import layout_for
from common.arena.physics import World
from common.arena.rewards import frame_rewards
from common.arena.scene import Scene, Start
from common.arena.starts import training_start
from common.config import ArenaConfig
from common.trajectory import Outcome, StepType, TimeStep


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
        if max_collisions is not None and max_collisions < 1:
            raise ValueError(f"max_collisions {max_collisions} would end episodes unplayed")
        self._config = config
        self._rng = rng
        self._max_collisions = config.max_collisions if max_collisions is None else max_collisions
        self._codec = make_codec(config)
        start = self._random_start()
        self._world = World(config, start.robots)
        self._targets = start.targets
        self._running = False
        self.frame = 0
        """Frames of this episode so far."""
        self.collisions = 0
        """Robot collisions of this episode: two when two robots run into one another."""

    def __repr__(self) -> str:
        return f"Arena(frame={self.frame}, collisions={self.collisions}, scene={self.scene})"

    @property
    def scene(self) -> Scene:
        """The true state, a copy."""
        return Scene(self._world.robots, self._targets.copy())

    def reset(self, start: Start | None = None) -> TimeStep:
        """Begins an episode, at random or at the given start.

        Raises ValueError for a start with other shapes, or robots that overlap.
        """
        start = self._random_start() if start is None else start
        shape = (self._config.num_robots, 3)
        if start.robots.shape != shape or start.targets.shape != (shape[0], 2):
            raise ValueError(
                f"start has robots {start.robots.shape} and targets {start.targets.shape}; "
                f"this arena has {shape[0]} of each"
            )
        if not np.isfinite(start.targets).all():
            raise ValueError(f"start has targets {start.targets.tolist()}")
        self._running = False
        self._world.place(start.robots)
        self._targets = start.targets.copy()
        self._running = True
        self.frame = self.collisions = 0
        return TimeStep(
            step_type=StepType.FIRST,
            records=self._codec.encode(self.scene),
            rewards=np.zeros(shape[0], np.float32),
            discount=1.0,
            collided=np.zeros(shape[0], np.bool_),
            hit_wall=np.zeros(shape[0], np.bool_),
        )

    def step(self, actions: ArrayLike) -> TimeStep:
        """Plays one frame; actions: [K] of LEFT, STRAIGHT, RIGHT.

        Raises ValueError for other actions, and when no episode is running.
        """
        if not self._running:
            raise ValueError("the episode has ended or not begun: reset first")
        collided = self._world.move(checked_actions(actions, self._config.num_robots))
        self.frame += 1
        self.collisions += int(collided.sum())
        scene = Scene(self._world.robots, self._targets)
        rewards, success = frame_rewards(scene, collided, self.frame, self._config)
        outcome = self._outcome(success)
        self._running = outcome is None
        terminated = outcome is not None and outcome is not Outcome.TIMEOUT
        return TimeStep(
            step_type=StepType.MID if outcome is None else StepType.LAST,
            records=self._codec.encode(scene),
            rewards=rewards,
            discount=0.0 if terminated else 1.0,
            collided=collided,
            hit_wall=self._world.hit_wall,
            outcome=outcome,
        )

    def _outcome(self, success: bool) -> Outcome | None:
        if success:
            return Outcome.SUCCESS
        if self.collisions >= self._max_collisions:
            return Outcome.COLLISION
        return Outcome.TIMEOUT if self.frame >= self._config.max_frames else None

    def _random_start(self) -> Start:
        return training_start(self._config, layout_for(self._config, self._rng), self._rng)


def make_arena(
    config: ArenaConfig,
    rng: np.random.Generator,
    *,
    identity: int = 0,
    max_collisions: int | None = None,
) -> Arena | CountingArena:
    """The arena that config.kind names; identity is what a counting arena's pictures carry."""
    if config.kind == "counting":
        return CountingArena(config, identity=identity)
    return Arena(config, rng, max_collisions=max_collisions)
