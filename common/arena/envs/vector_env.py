"""The arena as a Gymnasium VectorEnv for one shared policy; every robot is a sub-environment.

Invariants: the robots of an arena are adjacent and end together, because they share its episode.
Where episodes differ in their number of robots, absent robots see black, get no reward, and their
actions are ignored; `present` of the infos tells who is there. The step after an end resets that
arena, ignores its actions and gives reward 0 (AutoresetMode.NEXT_STEP). The same seed and actions
give the same episodes in every process.
"""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from mrcdrl.common.arena.envs.stacked import StackedArenas
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    BoolArray,
    Float64Array,
    Int64Array,
    Outcome,
    TimeStep,
    UInt8Array,
)

ENV_ID = "mrcdrl/Arena-v0"


class ArenaVectorEnv(VectorEnv[UInt8Array, Int64Array, Any]):
    """Vector environment whose N robots fill several arenas.

    Observations: uint8 [N, stack, V, V]. Actions: [N] of 0 left, 1 straight, 2 right. infos, each
    with a mask of the same name after an underscore: `collided`, `hit_wall`, `present`, bool [N];
    `outcome`, object [N], "success", "collision" or "timeout" at an end, else None.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _ended: BoolArray  # [A], arenas whose episode the last step ended

    def __init__(
        self,
        num_envs: int | None = None,
        config: ArenaConfig | None = None,
        *,
        render_mode: str | None = None,
    ) -> None:
        """num_envs: robots of all arenas together; the robots of one arena if None.

        Raises ConfigError if robots or targets do not fit, ValueError for an unknown mode or if
        the robots do not fill whole arenas.
        """
        config = config or ArenaConfig()
        num_envs = config.num_robots if num_envs is None else num_envs
        if num_envs < 1 or num_envs % config.num_robots:
            raise ValueError(
                f"num_envs {num_envs} does not fill arenas of {config.num_robots} robots"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r} is not rgb_array")
        self.num_envs = num_envs
        self.render_mode = render_mode
        shape = (config.stack, config.view_px, config.view_px)
        self.single_observation_space = Box(0, 255, shape, np.uint8)
        self.single_action_space = Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._config = config
        self._num_arenas = num_envs // config.num_robots
        self._seed(None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8Array, dict[str, Any]]:
        """Begins an episode in every arena. seed: for these episodes and all that follow."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed(seed)
        steps = [self._arenas.reset(arena) for arena in range(self._num_arenas)]
        self._ended[:] = False
        return self._states(), self._infos(steps)

    def step(
        self, actions: ArrayLike
    ) -> tuple[UInt8Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Plays one frame in every arena; where an episode has ended, begins the next instead.

        Raises ValueError for actions other than [N] of 0, 1, 2.
        """
        chosen = np.asarray(actions)
        if chosen.shape != (self.num_envs,):
            raise ValueError(f"actions are {chosen.shape}, not [{self.num_envs}]")
        running = np.flatnonzero(~self._ended)
        by_arena = chosen.reshape(self._num_arenas, -1)
        played = iter(self._arenas.step(by_arena[running], running))
        steps = [
            self._arenas.reset(arena) if ended else next(played)
            for arena, ended in enumerate(self._ended.tolist())
        ]
        self._ended = np.array([step.last for step in steps])
        truncated = np.array([step.outcome is Outcome.TIMEOUT for step in steps])
        return (
            self._states(),
            np.concatenate([step.rewards for step in steps]).astype(np.float64),
            self._each(self._ended & ~truncated),
            self._each(truncated),
            self._infos(steps),
        )

    def render(self) -> tuple[UInt8Array, ...] | None:
        """Renders each robot's arena as RGB [600, 600, 3]; None without a mode."""
        if self.render_mode is None:
            return None
        images = [self._arenas.image(arena) for arena in range(self._num_arenas)]
        return tuple(image for image in images for _ in range(self._config.num_robots))

    def _seed(self, seed: int | None) -> None:
        """Makes new arenas, each with its own generator."""
        seeds = np.random.SeedSequence(seed).spawn(self._num_arenas)
        self._arenas = StackedArenas(self._config, [np.random.default_rng(s) for s in seeds])
        self._ended = np.ones(self._num_arenas, np.bool_)

    def _states(self) -> UInt8Array:
        states = self._arenas.states
        return states.reshape(self.num_envs, *states.shape[2:]).copy()

    def _infos(self, steps: list[TimeStep]) -> dict[str, Any]:
        known = np.ones(self.num_envs, np.bool_)
        outcomes = np.array([None if s.outcome is None else s.outcome.value for s in steps], object)
        return {
            "collided": np.concatenate([s.collided for s in steps]),
            "_collided": known,
            "hit_wall": np.concatenate([s.hit_wall for s in steps]),
            "_hit_wall": known,
            "present": self._present(),
            "_present": known,
            "outcome": np.repeat(outcomes, self._config.num_robots),
            "_outcome": self._each(np.array([s.last for s in steps])),
        }

    def _present(self) -> BoolArray:
        """Whether each robot [N] is there in its arena's episode."""
        there = np.arange(self._config.num_robots) < self._arenas.present[:, None]
        return np.asarray(there.reshape(-1), np.bool_)

    def _each(self, arenas: BoolArray) -> BoolArray:
        """Repeats a value per arena for each of its robots [N]."""
        return np.repeat(arenas, self._config.num_robots)


def register() -> None:
    """Registers "mrcdrl/Arena-v0" for gymnasium.make_vec(…, num_envs=…, config=…)."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, vector_entry_point=f"{__name__}:ArenaVectorEnv")
