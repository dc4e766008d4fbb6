"""A world that somebody else wrote, played through PettingZoo's or Gymnasium's interface.

Invariants: all agents see uint8 pictures of one shape, have the same discrete actions, and live
until the end of the episode; a world of which this does not hold is refused by one ConfigError,
which names what is wrong and what to do. Whatever the world itself raises becomes such an error,
with the line that raised it. Pictures become images on arrival: nothing else leaves this module.
"""

import importlib
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrcdrl.common.arena.images.pictures import image_of, is_picture
from mrcdrl.common.arena.world.starts import MOST_SEEDS
from mrcdrl.common.config import ArenaConfig, Config
from mrcdrl.common.config.schema import MOST_ACTIONS, MOST_ROBOTS
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float32Array, Outcome, UInt8Array
from mrcdrl.common.runtime.extras import require

_SUCCESS = ("success", "is_success")  # in infos; the second is Gymnasium-Robotics' name
_TRIED_STEPS = 100  # with random actions, before a run starts
_ONLY = "agent_0"  # the agent of a Gymnasium environment


@dataclass(frozen=True, slots=True)
class WorldStep:
    """What a step of a world came to."""

    images: UInt8Array  # [K, V, V]
    rewards: Float32Array  # [K]
    outcome: Outcome | None  # set at the end; a termination without success is a COLLISION


class CustomWorld:
    """One copy of the world that config.env names."""

    def __init__(self, config: ArenaConfig) -> None:
        """Make and check the world; raises ConfigError if it cannot be played."""
        require("pettingzoo", "gymnasium", "cv2")
        self._config = config
        self._name = config.env
        maker = _maker(config.env)
        with self._told("make()"):
            self._world = _parallel(maker(), config.env)
        self.agents: tuple[str, ...] = tuple(self._world.possible_agents)
        """The agents, in the order of all arrays."""
        self.num_actions = self._checked_spaces()
        self._frames = 0

    def reset(self, seed: int) -> UInt8Array:
        """Begin an episode; the first images [K, V, V]."""
        with self._told("reset"):
            observations, _ = self._world.reset(seed=seed)
            self._check_agents(self._world.agents, "after reset")
        self._frames = 0
        return self._images(observations)

    def step(self, actions: UInt8Array) -> WorldStep:
        """Play one step; actions: [K]."""
        chosen = dict(zip(self.agents, map(int, actions), strict=True))
        with self._told("step"):
            observations, rewards, terminations, truncations, infos = self._world.step(chosen)
        self._frames += 1
        terminated = [bool(terminations.get(agent)) for agent in self.agents]
        truncated = [bool(truncations.get(agent)) for agent in self.agents]
        over = [a or b for a, b in zip(terminated, truncated, strict=True)]
        if any(over) and not all(over):
            died, lives = self.agents[over.index(True)], self.agents[over.index(False)]
            raise self._error(
                f"{died} ended before {lives}: all agents live until the end of the episode; "
                "let those that are out stay, with black pictures and reward 0"
            )
        if not any(over):
            self._check_agents(self._world.agents, "after a step")
        outcome = self._outcome(any(terminated), all(over), infos)
        return WorldStep(self._images(observations), self._rewards(rewards), outcome)

    def render(self) -> UInt8Array | None:
        """The world as people see it, uint8 RGB [H, W, 3]; None where it renders no such array."""
        if getattr(self._world, "render_mode", None) != "rgb_array":
            return None
        with self._told("render"):
            picture = np.asarray(self._world.render())
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise self._error(
                f"render() returns {picture.dtype} {list(picture.shape)}, not uint8 [H, W, 3]"
            )
        return picture

    def close(self) -> None:
        """Release what the world holds."""
        with self._told("close"):
            self._world.close()

    def _checked_spaces(self) -> int:
        """The number of actions, of spaces that are checked."""
        agents = self.agents
        if not 1 <= len(agents) <= MOST_ROBOTS:
            raise self._error(f"{len(agents)} agents, where 1 to {MOST_ROBOTS} can be played")
        with self._told("its spaces"):
            seen = [self._world.observation_space(agent) for agent in agents]
            done = [self._world.action_space(agent) for agent in agents]
        for agent, space in zip(agents, seen, strict=True):
            shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
            if shape is None or not is_picture(tuple(shape), dtype):
                raise self._error(
                    f"{agent} observes {_short(space)}, not a uint8 picture [H, W], [H, W, 1] or "
                    "[H, W, 3]; render one, or convert it: values 0 to 255"
                )
        for agent, space in zip(agents, done, strict=True):
            count = getattr(space, "n", None)
            if type(space).__name__ != "Discrete" or getattr(space, "start", 0) != 0:
                raise self._error(
                    f"{agent} acts by {_short(space)}, not Discrete(n) from 0; let a wrapper map "
                    "a few discrete actions to it"
                )
            if not 2 <= int(count or 0) <= MOST_ACTIONS:
                raise self._error(f"{agent} has {count} actions, not 2 to {MOST_ACTIONS}")
        for what, spaces in (("observes", seen), ("acts by", done)):
            for agent, space in zip(agents, spaces, strict=True):
                if space != spaces[0]:
                    raise self._error(
                        f"{agent} {what} {_short(space)}, {agents[0]} {_short(spaces[0])}: one "
                        "network plays all agents; pad them to one shape, by SuperSuit or a wrapper"
                    )
        self._shape = tuple(seen[0].shape)
        return int(done[0].n)

    def _check_agents(self, agents: list[str], when: str) -> None:
        if set(agents) != set(self.agents):
            missing = sorted(set(self.agents) - set(agents)) or sorted(agents)
            raise self._error(
                f"{', '.join(map(str, missing[:3]))} {'is' if len(missing) == 1 else 'are'} not "
                f"among the agents {when}: all of possible_agents live until the end of the episode"
            )

    def _images(self, observations: Mapping[str, Any]) -> UInt8Array:
        view_px = self._config.view_px
        images = np.empty((len(self.agents), view_px, view_px), np.uint8)
        for image, agent in zip(images, self.agents, strict=True):
            if agent not in observations:
                raise self._error(f"no observation of {agent}: each agent needs one in every step")
            picture = np.asarray(observations[agent])
            if picture.shape != self._shape or picture.dtype != np.uint8:
                raise self._error(
                    f"{agent} observes {picture.dtype} {list(picture.shape)}, where its space says "
                    f"uint8 {list(self._shape)}"
                )
            image[:] = image_of(picture, view_px)
        return images

    def _rewards(self, rewards: Mapping[str, Any]) -> Float32Array:
        largest = self._config.largest_reward
        array = np.zeros(len(self.agents), np.float32)
        for k, agent in enumerate(self.agents):
            reward = rewards.get(agent)
            try:
                array[k] = np.nan if reward is None else reward
            except (TypeError, ValueError):
                array[k] = np.nan
            if not np.isfinite(array[k]):
                raise self._error(f"{agent}'s reward is {reward!r}, not a finite number")
            if abs(array[k]) > largest:
                raise self._error(
                    f"{agent}'s reward is {array[k]:g}, more than arena.largest_reward "
                    f"{largest:g}: set that, or scale the rewards"
                )
        return array

    def _outcome(
        self, terminated: bool, over: bool, infos: Mapping[str, Mapping[str, Any]]
    ) -> Outcome | None:
        late = self._frames >= self._config.max_frames
        if not over and not late:
            return None
        told = [
            bool(info[key])
            for info in (infos.get(agent) or {} for agent in self.agents)
            for key in _SUCCESS
            if key in info
        ]
        if told and all(told):
            return Outcome.SUCCESS
        return Outcome.COLLISION if terminated else Outcome.TIMEOUT

    @contextmanager
    def _told(self, doing: str) -> Iterator[None]:
        """Turn what the world raises into one line with the place that raised it."""
        try:
            yield
        except ConfigError:
            raise
        except Exception as error:  # whatever a stranger's code raises
            raise self._error(f"{doing} {_raised(error)}") from error

    def _error(self, text: str) -> ConfigError:
        return ConfigError(f"arena.env {self._name}: {text}")


class _SingleAgent:
    """A Gymnasium environment as a world of one agent."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.possible_agents = [_ONLY]
        self.agents: list[str] = []
        self.render_mode = getattr(env, "render_mode", None)

    def observation_space(self, _agent: str) -> Any:
        return self._env.observation_space

    def action_space(self, _agent: str) -> Any:
        return self._env.action_space

    def reset(self, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = self._env.reset(seed=seed)
        self.agents = [_ONLY]
        return {_ONLY: observation}, {_ONLY: info}

    def step(self, actions: Mapping[str, int]) -> tuple[dict[str, Any], ...]:
        return tuple({_ONLY: each} for each in self._env.step(actions[_ONLY]))

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()


def looked_up(config: Config) -> Config:
    """The configuration with the numbers of agents and actions that its custom world has.

    The world is made and played with random actions first, so that its faults come out before a
    run starts. Other arenas' configurations are returned as they are. Raises ConfigError if the
    world cannot be played, or is not the one that the configuration says.
    """
    arena = config.arena
    if not arena.is_custom:
        return config
    world = CustomWorld(arena)
    if arena.num_actions:
        check_numbers(world, arena)
    rng = np.random.default_rng(config.run.seed)
    over = True
    for _ in range(_TRIED_STEPS):
        if over:
            world.reset(int(rng.integers(MOST_SEEDS)))
        step = world.step(rng.integers(world.num_actions, size=len(world.agents), dtype=np.uint8))
        over = step.outcome is not None
    world.render()
    world.close()
    numbers = {"num_robots": len(world.agents), "num_actions": world.num_actions}
    return config.model_copy(update={"arena": arena.model_copy(update=numbers)})


def check_numbers(world: CustomWorld, arena: ArenaConfig) -> None:
    """Raise ConfigError if the world has other numbers of agents or actions than the run."""
    if not arena.num_actions:
        raise ConfigError(
            "arena.num_actions and num_robots are not known: make the run's configuration by "
            f"`mrcdrl config --env {arena.env}`, which asks the world"
        )
    has = (len(world.agents), world.num_actions)
    if has != (arena.num_robots, arena.num_actions):
        raise ConfigError(
            f"arena.env {arena.env}: {has[0]} agents with {has[1]} actions, where the run has "
            f"{arena.num_robots} with {arena.num_actions} (arena.num_robots, arena.num_actions)"
        )


def _maker(env: str) -> Callable[[], Any]:
    """The function that `package.module:make` names."""
    module_name, _, name = env.partition(":")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # whatever a stranger's module raises
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            raise ConfigError(
                f"arena.env {env}: no module {missing}; install it, or put its folder on PYTHONPATH"
            ) from error
        raise ConfigError(f"arena.env {env}: importing it {_raised(error)}") from error
    maker = getattr(module, name, None)
    if not callable(maker):
        raise ConfigError(f"arena.env {env}: {module_name} has no function {name}")
    return maker  # type: ignore[no-any-return]


def _parallel(world: Any, env: str) -> Any:
    """The world by the parallel interface."""
    import gymnasium

    if isinstance(world, gymnasium.Env):
        return _SingleAgent(world)
    needed = ("possible_agents", "observation_space", "action_space", "reset", "step", "close")
    if all(hasattr(world, name) for name in needed) and not hasattr(world, "last"):
        return world
    form = type(world).__name__
    aec = "; of PettingZoo's AEC form take parallel_env" if hasattr(world, "last") else ""
    raise ConfigError(
        f"arena.env {env}: make() returned a {form}, not a PettingZoo ParallelEnv or a Gymnasium "
        f"Env{aec}"
    )


def _raised(error: Exception) -> str:
    """What was raised, and where, on one line."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    said = " ".join(str(error).split())
    place = f"{Path(last.filename).name}:{last.lineno}"
    return f"raised {type(error).__name__}{f': {said}' if said else ''} ({place})"


def _short(space: object) -> str:
    text = " ".join(str(space).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
