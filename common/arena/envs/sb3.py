"""The arena as stable-baselines3's VecEnv for one shared policy; every robot is a sub-environment.

Invariants: the robots of an arena are adjacent and end together. The step that ends an episode
returns the first states of the next one, and the last of the old one as `terminal_observation`.
Where episodes differ in their number of robots, absent robots see black, get no reward and their
actions are ignored; their infos say "present": False.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.vec_env import VecEnv

from mrcdrl.common.arena.envs.parallel_env import ArenaParallelEnv
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float32Array, UInt8Array


class ArenaVecEnv(VecEnv):  # type: ignore[misc]
    """Vector environment whose N robots fill several arenas.

    Observations: uint8 [N, stack, V, V]. Actions: [N] of 0 left, 1 straight, 2 right. infos of a
    robot: those of ArenaParallelEnv, and at an end `terminal_observation` and
    `TimeLimit.truncated`, as stable-baselines3 expects.
    """

    def __init__(
        self,
        num_arenas: int = 1,
        config: ArenaConfig | None = None,
        *,
        render_mode: str | None = None,
    ) -> None:
        """Raises ConfigError if robots or targets do not fit, ValueError for an unknown mode."""
        if num_arenas < 1:
            raise ValueError(f"num_arenas {num_arenas} is not at least 1")
        self._arenas = [
            ArenaParallelEnv(config, render_mode=render_mode) for _ in range(num_arenas)
        ]
        self._agents = self._arenas[0].possible_agents
        self._actions: list[dict[str, int]] = []
        agent = self._agents[0]
        self._black = np.zeros(self._arenas[0].observation_space(agent).shape, np.uint8)
        super().__init__(
            num_arenas * len(self._agents),
            self._arenas[0].observation_space(agent),
            self._arenas[0].action_space(agent),
        )

    def reset(self) -> UInt8Array:
        """Begins an episode in every arena; uses the seeds given to `seed` once."""
        states: list[UInt8Array] = []
        for number, arena in enumerate(self._arenas):
            observations, _ = arena.reset(self._seeds[number * len(self._agents)])
            states += self._of_all(observations, self._black)
        self._reset_seeds()
        return np.stack(states)

    def step_async(self, actions: ArrayLike) -> None:
        """Keeps the actions [N] for step_wait."""
        by_arena = np.asarray(actions).reshape(len(self._arenas), len(self._agents)).tolist()
        self._actions = [dict(zip(self._agents, own, strict=True)) for own in by_arena]

    def step_wait(self) -> tuple[UInt8Array, Float32Array, BoolArray, list[dict[str, Any]]]:
        """Plays one frame in every arena, and begins an episode where one ended."""
        states: list[UInt8Array] = []
        rewards: list[float] = []
        ends: list[bool] = []
        infos: list[dict[str, Any]] = []
        for arena, actions in zip(self._arenas, self._actions, strict=True):
            observations, paid, terminated, truncated, arena_infos = arena.step(actions)
            ended = not arena.agents
            rewards += self._of_all(paid, 0.0)
            robots = self._of_all(arena_infos, None)
            robots = [{"present": False} if info is None else info for info in robots]
            infos += robots
            if ended:
                cut = any(truncated.values()) and not any(terminated.values())
                lasts = self._of_all(observations, self._black)
                for info, last in zip(robots, lasts, strict=True):
                    info["terminal_observation"] = last
                    info["TimeLimit.truncated"] = cut
                observations, _ = arena.reset()
            states += self._of_all(observations, self._black)
            ends += [ended] * len(self._agents)
        return np.stack(states), np.array(rewards, np.float32), np.array(ends), infos

    def _of_all(self, values: Mapping[str, Any], absent: Any) -> list[Any]:
        """The values of all robots of an arena; `absent` for those that are not there."""
        return [values.get(agent, absent) for agent in self._agents]

    def close(self) -> None:
        """Does nothing; there is nothing to close."""

    def get_images(self) -> Sequence[UInt8Array | None]:
        """Renders each robot's arena as RGB [600, 600, 3]; None unless the mode is rgb_array."""
        images = [arena.render() for arena in self._arenas]
        return [image for image in images for _ in self._agents]

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Reads an attribute of each robot's arena."""
        return [getattr(arena, attr_name) for arena in self._arenas_of(indices)]

    def set_attr(
        self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None
    ) -> None:
        """Sets an attribute of each robot's arena."""
        for arena in self._arenas_of(indices):
            setattr(arena, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Calls a method of each robot's arena."""
        return [
            getattr(arena, method_name)(*method_args, **method_kwargs)
            for arena in self._arenas_of(indices)
        ]

    def env_is_wrapped(
        self, wrapper_class: type, indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Returns False for every robot; no arena is wrapped."""
        return [isinstance(arena, wrapper_class) for arena in self._arenas_of(indices)]

    def _arenas_of(self, indices: int | Iterable[int] | None) -> list[ArenaParallelEnv]:
        """The arenas of these robots, or of all robots if None."""
        return [self._arenas[robot // len(self._agents)] for robot in self._get_indices(indices)]
