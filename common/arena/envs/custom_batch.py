"""Copies of a custom world stepped together, with the interface of ArenaBatch.

Invariants: those of mrcdrl.common.arena.batch, as far as the world keeps to its seeds. There are no
poses: scenes stand at the origin, and nobody collides.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.envs.custom import CustomWorld, check_numbers
from mrcdrl.common.arena.world.scene import Scene, Start, checked_actions
from mrcdrl.common.arena.world.starts import MOST_SEEDS
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Float64Array,
    Int64Array,
    StepType,
    TimeStep,
    TimeSteps,
    UInt8Array,
)


class CustomBatch:
    """A copies of the world that config.env names."""

    def __init__(self, config: ArenaConfig, rngs: Sequence[np.random.Generator]) -> None:
        """rngs: one per copy, for the seeds of its episodes.

        Raises ConfigError if the world cannot be played, or is not that of the configuration.
        """
        self._rngs = rngs
        self._shape = (config.num_robots, config.record_bytes)
        self._num_actions = config.action_count
        self._worlds = [CustomWorld(config) for _ in rngs]
        for world in self._worlds[:1]:
            check_numbers(world, config)
        self._running = np.zeros(len(rngs), np.bool_)
        self.present: Int64Array = np.full(len(rngs), config.num_robots, np.int64)
        """Agents of each copy's episode [A]: all of them."""
        self.chances: Float64Array = np.ones(1)
        """Probability of each number of agents: there is one."""

    def __len__(self) -> int:
        return len(self._worlds)

    def scene(self, arena: int) -> Scene:
        """A scene whose robots and targets stay at the origin."""
        num = self._shape[0]
        return Scene(np.zeros((num, 3)), np.zeros((num, 2)))

    def render(self, arena: int) -> UInt8Array | None:
        """A copy of the world as people see it, uint8 RGB [H, W, 3]; None if it renders nothing."""
        return self._worlds[arena].render()

    def reset(self, arena: int, start: Start | None = None) -> TimeStep:
        """Begins an episode by the start's seed, or by a random one."""
        seed = int(self._rngs[arena].integers(MOST_SEEDS)) if start is None else start.seed
        images = self._worlds[arena].reset(seed)
        self._running[arena] = True
        num = self._shape[0]
        return TimeStep(
            step_type=StepType.FIRST,
            records=images.reshape(self._shape),
            rewards=np.zeros(num, np.float32),
            discount=1.0,
            collided=np.zeros(num, np.bool_),
            hit_wall=np.zeros(num, np.bool_),
        )

    def step(self, actions: ArrayLike, arenas: Int64Array | None = None) -> TimeSteps:
        """Plays one step in all copies, or in the given ones: distinct indices [N].

        actions: [N, K]. Raises ValueError for invalid actions, or if no episode is running;
        ConfigError for what the world does wrong.
        """
        arenas = np.arange(len(self)) if arenas is None else arenas
        if not self._running[arenas].all():
            raise ValueError("no episode is running: reset first")
        num = self._shape[0]
        checked = checked_actions(actions, (len(arenas), num), self._num_actions)
        steps = [
            self._worlds[arena].step(own)
            for arena, own in zip(arenas.tolist(), checked, strict=True)
        ]
        outcomes = tuple(step.outcome for step in steps)
        self._running[arenas] = [outcome is None for outcome in outcomes]
        nobody = np.zeros((len(arenas), num), np.bool_)
        return TimeSteps(
            records=np.stack([step.images.reshape(self._shape) for step in steps]),
            rewards=np.stack([step.rewards for step in steps]),
            collided=nobody,
            hit_wall=nobody.copy(),
            outcomes=outcomes,
        )

    def assigned_distances_px(self, arenas: Int64Array) -> Float64Array:
        """Zeros [N, K]: robots and targets stay at the origin."""
        return np.zeros((len(arenas), self._shape[0]))

    def drawn_to_occupied(self, arenas: Int64Array) -> BoolArray:
        """False, [N, K]: nobody occupies a target."""
        return np.zeros((len(arenas), self._shape[0]), np.bool_)
