"""Many arenas stepped together, each playing one episode after another.

Invariants: each arena is reset, stepped until its LAST time step, and reset again. An arena draws
every random number from its own generator, so a seed gives the same episodes in every process,
whatever the other arenas do. Actions are LEFT, STRAIGHT and RIGHT of the scene module.

Where the number of robots differs between episodes, arrays are as long as for the most robots, and
an episode's robots are the first ones. The others are absent: their poses are NaN, and so are the
targets that an episode does not have. They have failed from the start, meet nothing, are not
rendered, and get no reward; their actions are ignored.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.counting import CountingBatch
from mrcdrl.common.arena.envs.custom_batch import CustomBatch
from mrcdrl.common.arena.images.sensors import Sensors
from mrcdrl.common.arena.world.layout import layout_for
from mrcdrl.common.arena.world.physics import ArrayPhysics, Physics
from mrcdrl.common.arena.world.pymunk_physics import PymunkPhysics
from mrcdrl.common.arena.world.rewards import drawn_to_occupied, frame_rewards
from mrcdrl.common.arena.world.scene import Scene, Start, checked_actions
from mrcdrl.common.arena.world.starts import training_start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Float64Array,
    Int64Array,
    Outcome,
    StepType,
    TimeStep,
    TimeSteps,
)


class ArenaBatch:
    """A copies of the paper's arena (section 3)."""

    def __init__(
        self,
        config: ArenaConfig,
        rngs: Sequence[np.random.Generator],
        *,
        max_collisions: int | None = None,
    ) -> None:
        """rngs: one per arena. max_collisions: robot collisions that end an episode;
        config.max_collisions if None.

        Raises ConfigError if robots or targets do not fit.
        """
        if max_collisions is not None and max_collisions < 1:
            raise ValueError(f"max_collisions {max_collisions} is not at least 1")
        self._config = config
        self._rngs = rngs
        self._max_collisions = config.max_collisions if max_collisions is None else max_collisions
        self._sensors = Sensors(config, rngs)
        self._physics = _make_physics(config, len(rngs))
        self._by_number = {number: config.with_robots(number) for number in config.numbers}
        self._targets = np.zeros((len(rngs), config.target_count, 2))
        self._obstacles = np.zeros((len(rngs), config.obstacle_count, 3))
        self._running = np.zeros(len(rngs), np.bool_)
        self._every = np.arange(len(rngs))
        self.frames: Int64Array = np.zeros(len(rngs), np.int64)
        """Frames played in each arena's episode [A]."""
        self.collisions: Int64Array = np.zeros(len(rngs), np.int64)
        """Robot collisions in each arena's episode [A]; two robots that run into each other
        count as two."""
        self.failed: BoolArray = np.zeros((len(rngs), config.num_robots), np.bool_)
        """Robots that stand still until the end of their episode [A, K]; absent ones among them."""
        self.present: Int64Array = np.full(len(rngs), config.num_robots, np.int64)
        """Robots of each arena's episode [A]; any others are absent."""
        self.chances: Float64Array = np.full(len(config.numbers), 1 / len(config.numbers))
        """Probability with which an episode draws each of config.numbers."""
        for arena in range(len(rngs)):
            self._place(arena, self._random_start(arena))

    def __len__(self) -> int:
        return len(self._rngs)

    def scene(self, arena: int) -> Scene:
        """A copy of the true state of an arena, without what is absent."""
        scene, number = self._scenes(np.array(arena)), int(self.present[arena])
        num_targets = self._by_number[number].target_count
        return Scene(scene.robots[:number], scene.targets[:num_targets], scene.obstacles)

    def reset(self, arena: int, start: Start | None = None) -> TimeStep:
        """Begins an episode of an arena at the given start, or at a random one.

        A start has as many robots as its episode. Raises ValueError if it has wrong shapes or
        overlapping robots.
        """
        self._running[arena] = False
        self._place(arena, self._random_start(arena) if start is None else start)
        self._running[arena] = True
        self.frames[arena] = self.collisions[arena] = 0
        self.failed[arena] = np.arange(self._config.num_robots) >= self.present[arena]
        num_robots = self._config.num_robots
        return TimeStep(
            step_type=StepType.FIRST,
            records=self._sensors.first(arena, self._scenes(np.array(arena))),
            rewards=np.zeros(num_robots, np.float32),
            discount=1.0,
            collided=np.zeros(num_robots, np.bool_),
            hit_wall=np.zeros(num_robots, np.bool_),
        )

    def step(self, actions: ArrayLike, arenas: Int64Array | None = None) -> TimeSteps:
        """Plays one frame in all arenas, or in the given ones: distinct indices [N].

        actions: [N, K] of LEFT, STRAIGHT, RIGHT. Raises ValueError for invalid actions, or if an
        arena has no running episode.
        """
        arenas = self._every if arenas is None else arenas
        if not self._running[arenas].all():
            raise ValueError("no episode is running: reset first")
        checked = checked_actions(actions, (len(arenas), self._config.num_robots))
        self._fail(arenas)
        failed = self.failed[arenas]
        collided, hit_wall = self._physics.move(arenas, checked, failed)
        self.frames[arenas] += 1
        self.collisions[arenas] += collided.sum(axis=1)
        scene = self._scenes(arenas)
        frames = self.frames[arenas]
        rewards, success = frame_rewards(scene, collided, failed, frames, self._config)
        outcomes = self._outcomes(arenas, success)
        self._running[arenas] = [outcome is None for outcome in outcomes]
        return TimeSteps(
            records=self._sensors.read(arenas, scene),
            rewards=rewards,
            collided=collided,
            hit_wall=hit_wall,
            outcomes=outcomes,
        )

    def assigned_distances_px(self, arenas: Int64Array) -> Float64Array:
        """Distances [N, K] of robots to their targets in these arenas, assigned anew each time.

        Targets are distinct, and the sum is the least. A robot that has failed needs none: 0.
        """
        # Imported here because scipy takes long to load, and few runs need it.
        from mrcdrl.common.arena.controllers.heading import assigned_distances_px

        return assigned_distances_px(self._scenes(arenas), ~self.failed[arenas])

    def drawn_to_occupied(self, arenas: Int64Array) -> BoolArray:
        """Whether another robot is nearer to a robot's nearest target, in these arenas [N, K]."""
        return drawn_to_occupied(self._scenes(arenas))

    def _fail(self, arenas: Int64Array) -> None:
        """Draws which robots fail in this frame; the last working robot never does."""
        probability = self._config.failure_probability
        for arena in arenas.tolist() if probability else ():
            draws = self._rngs[arena].random(self._config.num_robots)
            working = ~self.failed[arena]
            self.failed[arena] |= draws < probability
            if self.failed[arena].all():
                self.failed[arena, np.where(working, draws, -1).argmax()] = False

    def _scenes(self, arenas: Int64Array) -> Scene:
        """A copy of the state of these arenas [...]; its arrays are [..., K, 3] and so on."""
        return Scene(self._physics.robots[arenas], self._targets[arenas], self._obstacles[arenas])

    def _outcomes(self, arenas: Int64Array, success: BoolArray) -> tuple[Outcome | None, ...]:
        stopped = self.collisions[arenas] >= self._max_collisions
        late = self.frames[arenas] >= self._config.max_frames
        outcomes: list[Outcome | None] = [None] * len(arenas)
        for i in np.flatnonzero(success | stopped | late).tolist():
            if success[i]:
                outcomes[i] = Outcome.SUCCESS
            else:
                outcomes[i] = Outcome.COLLISION if stopped[i] else Outcome.TIMEOUT
        return tuple(outcomes)

    def _random_start(self, arena: int) -> Start:
        rng, config = self._rngs[arena], self._config
        if config.mixes_numbers:
            config = self._by_number[int(rng.choice(config.numbers, p=self.chances))]
        return training_start(config, layout_for(config, rng), rng)

    def _place(self, arena: int, start: Start) -> None:
        number = len(start.robots)
        config = self._by_number.get(number, self._config)
        shapes = (start.robots.shape, start.targets.shape, start.obstacles.shape)
        expected = (config.num_robots, 3), (config.target_count, 2), (config.obstacle_count, 3)
        if shapes != expected:
            raise ValueError(
                f"start has robots, targets and obstacles {shapes}; this arena has {expected}"
            )
        if not np.isfinite(start.targets).all():
            raise ValueError(f"start has targets that are not finite: {start.targets.tolist()}")
        self._physics.place(arena, start.robots, start.obstacles)
        self._targets[arena] = np.nan
        self._targets[arena, : config.target_count] = start.targets
        self._obstacles[arena] = start.obstacles
        self.present[arena] = number


Arenas = ArenaBatch | CountingBatch | CustomBatch
"""What an actor steps."""


def make_arenas(
    config: ArenaConfig, rngs: Sequence[np.random.Generator], identities: Sequence[int]
) -> Arenas:
    """The arenas that config.kind names. identities: the numbers in counting arenas' images."""
    if config.kind == "counting":
        return CountingBatch(config, identities)
    return CustomBatch(config, rngs) if config.is_custom else ArenaBatch(config, rngs)


def _make_physics(config: ArenaConfig, num_arenas: int) -> Physics:
    physics = ArrayPhysics if config.physics == "array" else PymunkPhysics
    return physics(config, num_arenas)
