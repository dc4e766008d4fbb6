"""The paper's test (section 5.3): fixed starts; one collision, or running out of time, fails.

Invariants: the same starts, seed and weights give the same result. Many episodes are played at
once; an arena takes the next start when its episode ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mrcdrl.common.arena import ArenaBatch, CustomBatch, ObservationCodec, Scene, Start
from mrcdrl.common.arena.controllers import Controller
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    BoolArray,
    Float32Array,
    Float64Array,
    Outcome,
    TimeStep,
    UInt8Array,
)
from mrcdrl.common.model.policy import FrameStack, Policy
from mrcdrl.common.sync.broadcast import ARENA, Broadcast, Moment
from mrcdrl.services.evaluator.navigation import Journey, journey

MAX_ARENAS = 64  # played at once
MAX_CUSTOM = 8  # copies of a custom world likewise
EPISODES_PER_BLOCK = 100  # of Table 2


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One evaluated episode."""

    outcome: Outcome
    frames: int
    score: float  # sum of rewards, mean over robots
    targets: Float64Array  # [M, 2] px
    obstacles: Float64Array  # [O, 3] px
    robots: Float64Array  # [frames + 1, K, 3]; [0, K, 3] if paths are not kept
    explored: BoolArray  # [frames, K], actions that exploration changed; [0, K] likewise
    journey: Journey


class Player(Protocol):
    """Chooses the actions of several arenas at once."""

    explored: BoolArray
    """Whether exploration changed the actions chosen last, [len(arenas), K]."""

    def begin(self, arena: int, time_step: TimeStep) -> None:
        """Begin an episode in this arena."""
        ...

    def act(self, arenas: NDArray[np.int64], scenes: Sequence[Scene]) -> UInt8Array:
        """Choose actions, [len(arenas), K]."""
        ...

    def observe(self, arenas: NDArray[np.int64], records: UInt8Array) -> None:
        """See the records after the step, [len(arenas), K, R]."""
        ...


class PolicyPlayer:
    """Acts on images alone."""

    def __init__(
        self,
        config: ArenaConfig,
        codec: ObservationCodec,
        policy: Policy,
        epsilon: float,
        rng: np.random.Generator,
    ) -> None:
        self._num_robots = config.num_robots
        self._codec = codec
        self._policy = policy
        self.epsilon = epsilon
        self._rng = rng
        self._q_values: Float32Array = np.zeros((0, NUM_ACTIONS), np.float32)
        self._frames = FrameStack(MAX_ARENAS * config.num_robots, config.stack, config.view_px)
        self.explored = np.zeros((0, config.num_robots), np.bool_)

    def begin(self, arena: int, time_step: TimeStep) -> None:
        first = arena * self._num_robots
        robots = slice(first, first + self._num_robots)
        self._frames.reset(robots, self._codec.decode(time_step.records))

    def act(self, arenas: NDArray[np.int64], scenes: Sequence[Scene]) -> UInt8Array:
        stacks = self._frames.stacks[self._robots(arenas)]
        selection = self._policy.select_actions(stacks, self.epsilon, self._rng)
        self._q_values = selection.q_values
        actions = selection.actions.reshape(len(arenas), self._num_robots)
        self.explored = actions != selection.q_values.argmax(axis=1).reshape(actions.shape)
        return actions

    def observe(self, arenas: NDArray[np.int64], records: UInt8Array) -> None:
        images = self._codec.decode(records.reshape(-1, records.shape[-1]))
        self._frames.push(images, self._robots(arenas))

    @property
    def first_q_values(self) -> Float32Array:
        """Values [K, A] by which the actions of the first arena were chosen last."""
        return self._q_values[: self._num_robots]

    @property
    def first_images(self) -> UInt8Array:
        """A copy of the newest images [K, V, V] of the arena ARENA."""
        images: UInt8Array = self._frames.stacks[: self._num_robots, -1].copy()
        return images

    def _robots(self, arenas: NDArray[np.int64]) -> NDArray[np.int64]:
        robots: NDArray[np.int64] = arenas[:, None] * self._num_robots + np.arange(self._num_robots)
        return robots.reshape(-1)


class ControllerPlayer:
    """Acts by controllers that see the true state; explores as a policy does."""

    def __init__(
        self,
        make_controller: Callable[[], Controller],
        epsilon: float,
        rng: np.random.Generator,
    ) -> None:
        """make_controller: called for each episode; a controller plays one."""
        self._make_controller = make_controller
        self._controllers: dict[int, Controller] = {}
        self._epsilon = epsilon
        self._rng = rng
        self.explored = np.zeros((0, 0), np.bool_)

    def begin(self, arena: int, time_step: TimeStep) -> None:
        self._controllers[arena] = self._make_controller()

    def act(self, arenas: NDArray[np.int64], scenes: Sequence[Scene]) -> UInt8Array:
        pairs = zip(arenas.tolist(), scenes, strict=True)
        actions = np.stack([self._controllers[arena](scene) for arena, scene in pairs])
        explores = self._rng.random(actions.shape) < self._epsilon
        uniform = self._rng.integers(NUM_ACTIONS, size=actions.shape, dtype=np.uint8)
        self.explored = explores & (uniform != actions)
        return np.where(explores, uniform, actions)

    def observe(self, arenas: NDArray[np.int64], records: UInt8Array) -> None:
        """Ignore the images."""


class Show:
    """Shows people the arena ARENA of those that a policy's player plays."""

    def __init__(self, broadcast: Broadcast, player: PolicyPlayer, weights_version: int) -> None:
        self._broadcast = broadcast
        self._player = player
        self._weights_version = weights_version

    @property
    def watched(self) -> bool:
        """Whether anybody watches."""
        return self._broadcast.watched

    def acts(self, frame: int, scene: Scene, actions: UInt8Array) -> None:
        """Show the scene before a step, and the actions [K] chosen in it."""
        self._broadcast.acts(self._moment(frame, scene), self._player.first_q_values, actions)

    def stepped(self, frame: int, scene: Scene, time_step: TimeStep) -> None:
        """Show what the step came to."""
        last = self._moment(frame, scene) if time_step.last else None
        self._broadcast.stepped(time_step.collided, last, time_step.outcome)

    def _moment(self, frame: int, scene: Scene) -> Moment:
        images, epsilon = self._player.first_images, self._player.epsilon
        return Moment(frame, scene, images, self._weights_version, epsilon)


@dataclass(slots=True)
class _Running:
    """An episode in progress."""

    number: int
    score: float = 0.0
    frames: int = 0


def play(
    config: ArenaConfig,
    starts: Sequence[Start],
    player: Player,
    *,
    keep_paths: bool = False,
    keep_failed_paths: bool = False,
    keep_going: Callable[[int], bool] = lambda _done: True,
    show: "Show | None" = None,
) -> list[EpisodeResult] | None:
    """Play an episode from each start; return the results in the order of the starts.

    keep_paths: keep each episode's poses and explored actions; keep_failed_paths: those of failures
    only. keep_going: called before each step with the number of finished episodes; None is returned
    as soon as it returns False. show: is shown the arena ARENA, while anybody watches.
    """
    num_arenas = min(len(starts), MAX_CUSTOM if config.is_custom else MAX_ARENAS)
    # Starts are given; the generators serve random failures only.
    rngs = [np.random.default_rng(i) for i in range(num_arenas)]
    arenas: ArenaBatch | CustomBatch
    if config.is_custom:
        arenas = CustomBatch(config, rngs)
    else:
        arenas = ArenaBatch(config, rngs, max_collisions=1)
    results: dict[int, EpisodeResult] = {}
    # One array: many small ones that outlive the network's tensors would fragment the memory.
    paths = np.empty((len(arenas), config.max_frames + 1, config.num_robots, 3), np.float64)
    explored = np.empty((len(arenas), config.max_frames, config.num_robots), np.bool_)
    waiting = iter(enumerate(starts))
    running: dict[int, _Running] = {}

    def begin(index: int) -> None:
        following = next(waiting, None)
        if following is None:
            running.pop(index, None)
            return
        number, start = following
        player.begin(index, arenas.reset(index, start))
        running[index] = _Running(number)

    for index in range(len(arenas)):
        begin(index)
    while running:
        if not keep_going(len(results)):
            return None
        active = np.array(sorted(running))
        scenes = [arenas.scene(i) for i in active]
        actions = player.act(active, scenes)
        shown = show is not None and active[0] == ARENA and show.watched
        if show is not None and shown:
            show.acts(running[ARENA].frames, scenes[0], actions[0])
        steps = arenas.step(actions, active)
        player.observe(active, steps.records)
        if show is not None and shown:
            show.stepped(running[ARENA].frames + 1, arenas.scene(ARENA), steps[0])
        for i, (index, scene) in enumerate(zip(active.tolist(), scenes, strict=True)):
            episode = running[index]
            episode.score += float(steps.rewards[i].mean())
            paths[index, episode.frames] = scene.robots
            explored[index, episode.frames] = player.explored[i]
            episode.frames += 1
            outcome = steps.outcomes[i]
            if outcome is not None:
                last = arenas.scene(index)
                paths[index, episode.frames] = last.robots
                path = paths[index, : episode.frames + 1]
                kept = keep_paths or (keep_failed_paths and outcome is not Outcome.SUCCESS)
                results[episode.number] = _result(
                    config,
                    episode.score,
                    path,
                    explored[index, : episode.frames],
                    last,
                    steps[i],
                    keep_path=kept,
                )
                begin(index)
    return [results[number] for number in range(len(starts))]


def _result(
    config: ArenaConfig,
    score: float,
    path: Float64Array,
    explored: BoolArray,
    scene: Scene,
    last: TimeStep,
    *,
    keep_path: bool,
) -> EpisodeResult:
    """The result of an episode, from its path [frames + 1, K, 3], explored actions [frames, K],
    last scene and last time step."""
    if last.outcome is None:
        raise ValueError("the episode has not ended")
    return EpisodeResult(
        outcome=last.outcome,
        frames=len(path) - 1,
        score=score,
        targets=scene.targets,
        obstacles=scene.obstacles,
        robots=path.copy() if keep_path else path[:0].copy(),
        explored=explored.copy() if keep_path else explored[:0].copy(),
        journey=journey(
            path,
            scene.targets,
            last.collided & ~last.hit_wall,
            last.hit_wall,
            config.robot_radius_px,
        ),
    )
