"""An arena whose images encode counters, so that a test can prove none is torn or misplaced.

Invariants: everything is a function of (identity, episode, step); actions have no effect. An image
repeats its counters from the first pixel to the last, and a magic byte tells it from an empty one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.arena.world.scene import Scene, Start, checked_actions
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Float64Array,
    Int64Array,
    Outcome,
    StepType,
    TimeStep,
    TimeSteps,
    UInt8Array,
)

_MAGIC = 0xC5
_COUNTERS = np.dtype(
    [("magic", "u1"), ("robot", "u1"), ("identity", "<u2"), ("episode", "<u4"), ("step", "<u4")]
)
_LONGEST = 23


@dataclass(frozen=True, slots=True)
class Counters:
    """Counters read from images [..., V, V]."""

    identity: Int64Array  # [...]
    robot: Int64Array  # [...]
    episode: Int64Array  # [...], from 0
    step: Int64Array  # [...], 0 after a reset


def counting_frames(identity: int, episode: int) -> int:
    """Number of steps of an episode, 1 to 23."""
    return 1 + (5 * identity + 7 * episode) % _LONGEST


def counting_outcome(identity: int, episode: int) -> Outcome:
    """Outcome of an episode: alternately terminated (success) and truncated (timeout)."""
    return Outcome.TIMEOUT if (identity + episode) % 2 else Outcome.SUCCESS


def counting_reward(episode: int, step: int) -> float:
    """Reward of every robot for reaching this step; exact in float32."""
    return step + episode % 8 / 8


class CountingArena:
    """An arena with the interface of Arena and counters as images."""

    def __init__(self, config: ArenaConfig, *, identity: int = 0) -> None:
        if not 0 <= identity < 2**16:
            raise ValueError(f"identity {identity} is not in 0..65535")
        self._num_robots = config.num_robots
        self._view_px = config.view_px
        self._identity = identity
        self._episode = -1
        self._running = False
        self.frame = 0
        self.collisions = 0

    def __repr__(self) -> str:
        return (
            f"CountingArena(identity={self._identity}, episode={self._episode}, frame={self.frame})"
        )

    @property
    def scene(self) -> Scene:
        """A scene whose robots and targets stay at the origin."""
        return Scene(np.zeros((self._num_robots, 3)), np.zeros((self._num_robots, 2)))

    def reset(self, start: Start | None = None) -> TimeStep:
        """Begins the next episode and ignores the start."""
        self._episode += 1
        self._running = True
        self.frame = 0
        return self._time_step(StepType.FIRST, 0.0, None)

    def step(self, actions: ArrayLike) -> TimeStep:
        """Counts one step; actions: [K], checked as Arena does."""
        if not self._running:
            raise ValueError("no episode is running: reset first")
        checked_actions(actions, (self._num_robots,))
        self.frame += 1
        reward = counting_reward(self._episode, self.frame)
        if self.frame < counting_frames(self._identity, self._episode):
            return self._time_step(StepType.MID, reward, None)
        self._running = False
        outcome = counting_outcome(self._identity, self._episode)
        return self._time_step(StepType.LAST, reward, outcome)

    def _time_step(self, step_type: StepType, reward: float, outcome: Outcome | None) -> TimeStep:
        return TimeStep(
            step_type=step_type,
            records=self._records(),
            rewards=np.full(self._num_robots, reward, np.float32),
            discount=0.0 if outcome is Outcome.SUCCESS else 1.0,
            collided=np.zeros(self._num_robots, np.bool_),
            hit_wall=np.zeros(self._num_robots, np.bool_),
            outcome=outcome,
        )

    def _records(self) -> UInt8Array:
        """Records [K, V * V] with the current counters."""
        counters = np.zeros(self._num_robots, _COUNTERS)
        counters["magic"] = _MAGIC
        counters["robot"] = np.arange(self._num_robots)
        counters["identity"] = self._identity
        counters["episode"] = self._episode
        counters["step"] = self.frame
        marks = counters.view(np.uint8).reshape(self._num_robots, -1)
        pixels = self._view_px**2
        return np.tile(marks, -(-pixels // _COUNTERS.itemsize))[:, :pixels].copy()


class CountingBatch:
    """Counting arenas with the interface of ArenaBatch."""

    def __init__(self, config: ArenaConfig, identities: Sequence[int]) -> None:
        """identities: one per arena."""
        self._num_robots = config.num_robots
        self._arenas = [CountingArena(config, identity=identity) for identity in identities]
        self.present: Int64Array = np.full(len(identities), config.num_robots, np.int64)
        """Robots of each arena's episode [A]: all of them."""
        self.chances: Float64Array = np.ones(1)
        """Probability of each number of robots: there is one."""

    def __len__(self) -> int:
        return len(self._arenas)

    def scene(self, arena: int) -> Scene:
        """The scene of an arena."""
        return self._arenas[arena].scene

    def reset(self, arena: int, start: Start | None = None) -> TimeStep:
        """Begins the next episode of an arena."""
        return self._arenas[arena].reset(start)

    def step(self, actions: ArrayLike) -> TimeSteps:
        """Counts one step in all arenas; actions: [A, K]."""
        pairs = zip(self._arenas, np.asarray(actions), strict=True)
        steps = [arena.step(own) for arena, own in pairs]
        return TimeSteps(
            records=np.stack([step.records for step in steps]),
            rewards=np.stack([step.rewards for step in steps]),
            collided=np.stack([step.collided for step in steps]),
            hit_wall=np.stack([step.hit_wall for step in steps]),
            outcomes=tuple(step.outcome for step in steps),
        )

    def assigned_distances_px(self, arenas: Int64Array) -> Float64Array:
        """Zeros [N, K]: robots and targets stay at the origin."""
        return np.zeros((len(arenas), self._num_robots))

    def drawn_to_occupied(self, arenas: Int64Array) -> BoolArray:
        """False, [N, K]: nobody occupies a target."""
        return np.zeros((len(arenas), self._num_robots), np.bool_)


def decode_counters(images: UInt8Array) -> Counters:
    """Reads the counters of images [..., V, V]; raises ValueError if any image is torn."""
    leading = images.shape[:-2]
    pixels = np.ascontiguousarray(images).reshape(-1, images.shape[-2] * images.shape[-1])
    marks = np.ascontiguousarray(pixels[:, : _COUNTERS.itemsize])
    repeats = -(-pixels.shape[1] // _COUNTERS.itemsize)
    whole = (np.tile(marks, repeats)[:, : pixels.shape[1]] == pixels).all(axis=1)
    counters = marks.view(_COUNTERS)[:, 0]
    torn = ~whole | (counters["magic"] != _MAGIC)
    if torn.any():
        raise ValueError(f"{int(torn.sum())} of {len(torn)} images are torn or hold no counters")

    def field(name: str) -> Int64Array:
        return counters[name].astype(np.int64).reshape(leading)

    return Counters(field("identity"), field("robot"), field("episode"), field("step"))
