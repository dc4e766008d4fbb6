"""The arena as a PettingZoo ParallelEnv; every robot is an agent that sees its own images.

Invariants: all robots live until the end of the episode. Where episodes differ in their number of
robots, `agents` are those of the episode, and the absent ones have no observation. Success and too
many collisions terminate it; the time limit truncates it. The same seed and actions give the same
episodes in every process.
"""

import sys
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import parallel_to_aec, wrappers

from mrcdrl.common.arena.envs.stacked import StackedArenas
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Outcome, TimeStep, UInt8Array

_TERMINAL_PX = 48  # rows of the image in a terminal; a line of text shows two of them
_ONLY = np.array([0])  # the one arena

Infos = dict[str, dict[str, Any]]


class ArenaParallelEnv(ParallelEnv):  # type: ignore[misc]
    """PettingZoo environment of one arena.

    Observations: uint8 [stack, V, V]. Actions: 0 left, 1 straight, 2 right; all move forward.
    infos of an agent: `collided`, whether its move of this frame was undone; `hit_wall`, whether a
    wall or an obstacle did so; `outcome`, at the end "success", "collision" or "timeout", else
    None.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "mrcdrl_arena_v0",
        "render_modes": ["human", "rgb_array"],
        "render_fps": 30,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        config: ArenaConfig | None = None,
        *,
        max_cycles: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """max_cycles: frames of an episode; config.max_frames if None.

        render_mode: `rgb_array`, render() returns an image; `human`, rendered in the terminal after
        each step, because our OpenCV has no window system. Raises ConfigError if robots or targets
        do not fit, ValueError for another mode or length.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r} is not human or rgb_array")
        config = config or ArenaConfig()
        if max_cycles is not None:
            config = ArenaConfig.model_validate({**config.model_dump(), "max_frames": max_cycles})
        self.render_mode = render_mode
        self.possible_agents = [f"robot_{i}" for i in range(config.num_robots)]
        self.agents: list[str] = []
        shape = (config.stack, config.view_px, config.view_px)
        self.observation_spaces = {
            agent: Box(0, 255, shape, np.uint8) for agent in self.possible_agents
        }
        self.action_spaces = {agent: Discrete(NUM_ACTIONS) for agent in self.possible_agents}
        self._config = config
        self._arenas = StackedArenas(config, [np.random.default_rng()])
        self._rendered = False

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, UInt8Array], Infos]:
        """Begins an episode. seed: for this episode and all that follow, until the next seed.

        options: {"start": Start} to begin there, such as one of `test_starts`; other names are
        ignored.
        """
        if seed is not None:
            self._arenas = StackedArenas(self._config, [np.random.default_rng(seed)])
        time_step = self._arenas.reset(0, (options or {}).get("start"))
        self.agents = self.possible_agents[: int(self._arenas.present[0])]
        self._render_in_terminal()
        return self._observations(), self._infos(time_step)

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[dict[str, UInt8Array], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Plays one frame with an action for every agent; five empty dicts after the end.

        Raises ValueError if an agent has no action or one other than 0, 1, 2.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {', '.join(missing)}")
        agents = self.agents
        chosen = np.ones((1, len(self.possible_agents)), np.int64)
        chosen[0, : len(agents)] = [actions[agent] for agent in agents]
        time_step = self._arenas.step(chosen, _ONLY)[0]
        truncated = time_step.outcome is Outcome.TIMEOUT
        terminated = time_step.last and not truncated
        if time_step.last:
            self.agents = []
        self._render_in_terminal()
        return (
            self._observations(),
            dict(zip(agents, time_step.rewards.tolist(), strict=False)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            self._infos(time_step),
        )

    def render(self) -> UInt8Array | None:
        """Renders the arena as RGB [600, 600, 3] in the mode rgb_array; else returns None."""
        return self._arenas.image(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Does nothing; there is nothing to close."""

    def _observations(self) -> dict[str, UInt8Array]:
        states = self._arenas.states[0, : self._arenas.present[0]].copy()
        return dict(zip(self.possible_agents, states, strict=False))

    def _infos(self, time_step: TimeStep) -> Infos:
        outcome = None if time_step.outcome is None else time_step.outcome.value
        hits = zip(time_step.collided.tolist(), time_step.hit_wall.tolist(), strict=True)
        return {
            agent: {"collided": collided, "hit_wall": hit_wall, "outcome": outcome}
            for agent, (collided, hit_wall) in zip(self._present(), hits, strict=False)
        }

    def _present(self) -> list[str]:
        """The agents of the episode, also once it has ended."""
        return self.possible_agents[: int(self._arenas.present[0])]

    def _render_in_terminal(self) -> None:
        """Overwrites the previous image in the terminal, in the mode human."""
        if self.render_mode == "human":
            back = f"\x1b[{_TERMINAL_PX // 2}A" if self._rendered else ""
            image = self._arenas.image(0, _TERMINAL_PX, smooth=False)
            sys.stdout.write(back + terminal_image(image))
            sys.stdout.flush()
            self._rendered = True


def terminal_image(image: UInt8Array) -> str:
    """Encodes an RGB image [H, W, 3] as H / 2 lines of half blocks in 24-bit colour."""
    lines = []
    for upper, lower in zip(image[::2].tolist(), image[1::2].tolist(), strict=True):
        blocks = (
            f"\x1b[38;2;{a[0]};{a[1]};{a[2]};48;2;{b[0]};{b[1]};{b[2]}m▀"
            for a, b in zip(upper, lower, strict=True)
        )
        lines.append("".join(blocks) + "\x1b[0m\n")
    return "".join(lines)


def parallel_env(
    config: ArenaConfig | None = None,
    *,
    max_cycles: int | None = None,
    render_mode: str | None = None,
) -> ArenaParallelEnv:
    """Makes the environment, under the name that PettingZoo's users expect."""
    return ArenaParallelEnv(config, max_cycles=max_cycles, render_mode=render_mode)


def env(
    config: ArenaConfig | None = None,
    *,
    max_cycles: int | None = None,
    render_mode: str | None = None,
) -> AECEnv:
    """Makes the environment that plays one robot at a time (PettingZoo's AEC form)."""
    parallel = parallel_env(config, max_cycles=max_cycles, render_mode=render_mode)
    return wrappers.OrderEnforcingWrapper(parallel_to_aec(parallel))
