"""The arena as a Gymnasium VectorEnv for one shared policy: every robot is a sub-environment.

Invariants: the robots of an arena lie side by side and end together, because they share its
episode; the step after an end resets that arena, takes no notice of its actions and pays nothing
(AutoresetMode.NEXT_STEP). The same seed and actions give the same episodes in every process.
"""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from common.arena.stacked import StackedArena
from common.config import ArenaConfig
from common.trajectory import (
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
    """Observations uint8 [N, stack, V, V]; actions [N] of 0 left, 1 straight, 2 right.

    infos, each with a mask of the same name after an underscore: `collided` and `hit_wall`, bool
    [N]; `outcome`, object [N], "success", "collision" or "timeout" at an end, else None.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int | None = None,
        config: ArenaConfig | None = None,
        *,
        render_mode: str | None = None,
    ) -> None:
        """num_envs: robots of all arenas together; one arena's if None.

        Raises ConfigError when robots or targets do not fit, ValueError for another mode, or
        where the robots do not make whole arenas.
        """
        config = config or ArenaConfig()
        num_envs = config.num_robots if num_envs is None else num_envs
        if num_envs < 1 or num_envs % config.num_robots:
            raise ValueError(
                f"num_envs {num_envs} makes no whole arenas of {config.num_robots} robots"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r}: there is rgb_array")
        self.num_envs = num_envs
        self.render_mode = render_mode
        shape = (config.stack, config.view_px, config.view_px)
        self.single_observation_space = Box(0, 255, shape, np.uint8)
        self.single_action_space = Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._config = config
        self._seed(None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8Array, dict[str, Any]]:
        """Begins an episode in every arena. seed: of these and all that follow."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed(seed)
        steps = [arena.reset() for arena in self._arenas]
        self._ended = [False] * len(steps)
        return self._states(), self._infos(steps)

    def step(
        self, actions: ArrayLike
    ) -> tuple[UInt8Array, Float64Array, BoolArray, BoolArray, dict[str, Any]]:
        """Plays one frame everywhere, but where an episode ended before, begins the next.

        Raises ValueError for actions other than [N] of 0, 1, 2.
        """
        chosen = np.asarray(actions)
        if chosen.shape != (self.num_envs,):
            raise ValueError(f"actions are {chosen.shape}, not [{self.num_envs}]")
        by_arena = chosen.reshape(len(self._arenas), -1)
        steps = [
            arena.reset() if ended else arena.step(own)
            for arena, ended, own in zip(self._arenas, self._ended, by_arena, strict=True)
        ]
        self._ended = [time_step.last for time_step in steps]
        truncated = [time_step.outcome is Outcome.TIMEOUT for time_step in steps]
        return (
            self._states(),
            np.concatenate([time_step.rewards for time_step in steps]).astype(np.float64),
            self._each(np.array(self._ended) & ~np.array(truncated)),
            self._each(np.array(truncated)),
            self._infos(steps),
        )

    def render(self) -> tuple[UInt8Array, ...] | None:
        """Each robot's arena as RGB [600, 600, 3]; None without a mode."""
        if self.render_mode is None:
            return None
        pictures = [arena.picture() for arena in self._arenas]
        return tuple(picture for picture in pictures for _ in range(self._config.num_robots))

    def _seed(self, seed: int | None) -> None:
        """New arenas, each with a generator of its own."""
        num_arenas = self.num_envs // self._config.num_robots
        self._arenas = [
            StackedArena(self._config, np.random.default_rng(child))
            for child in np.random.SeedSequence(seed).spawn(num_arenas)
        ]
        self._ended = [True] * num_arenas

    def _states(self) -> UInt8Array:
        return np.concatenate([arena.states for arena in self._arenas])

    def _infos(self, steps: list[TimeStep]) -> dict[str, Any]:
        known = np.ones(self.num_envs, np.bool_)
        outcomes = np.array([None if s.outcome is None else s.outcome.value for s in steps], object)
        return {
            "collided": np.concatenate([s.collided for s in steps]),
            "_collided": known,
            "hit_wall": np.concatenate([s.hit_wall for s in steps]),
            "_hit_wall": known,
            "outcome": np.repeat(outcomes, self._config.num_robots),
            "_outcome": self._each(np.array([s.last for s in steps])),
        }

    def _each(self, arenas: BoolArray) -> BoolArray:
        """What is true of the arenas, of each of their robots [N]."""
        return np.repeat(arenas, self._config.num_robots)


def register() -> None:
    """Makes gymnasium.make_vec("mrcdrl/Arena-v0", num_envs=…, config=…) known."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, vector_entry_point=f"{__name__}:ArenaVectorEnv")
