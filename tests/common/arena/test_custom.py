"""Worlds that somebody else wrote: what is told of a wrong one, and how right ones are played."""

import re
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

from mrcdrl.common.arena import CustomBatch, layout_symmetries, looked_up
from mrcdrl.common.arena import test_starts as starts_of
from mrcdrl.common.arena.envs.custom import CustomWorld
from mrcdrl.common.arena.images.pictures import image_of
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome

MODULE = "a_strangers_world"
PICTURE = Box(0, 255, (40, 50, 3), np.uint8)


class Counting(ParallelEnv):  # type: ignore[misc]
    """Two agents see how many steps were made; the world ends after 5, or as `last` says."""

    metadata: dict[str, Any] = {"name": "counting"}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, **changed: Any) -> None:
        self.possible_agents = ["red", "blue"]
        self.seen: dict[str, Any] = dict.fromkeys(self.possible_agents, PICTURE)
        self.done: dict[str, Any] = {agent: Discrete(5) for agent in self.possible_agents}
        self.reward: Any = 1.0
        self.infos: dict[str, Any] = {}
        self.terminates, self.truncates = ["red", "blue"], list[str]()
        self.picture: Callable[[int], Any] = lambda steps: np.full((40, 50, 3), steps, np.uint8)
        for name, value in changed.items():
            setattr(self, name, value)

    def observation_space(self, agent: str) -> Any:
        return self.seen[agent]

    def action_space(self, agent: str) -> Any:
        return self.done[agent]

    def _observations(self) -> dict[str, Any]:
        return {agent: self.picture(self.steps) for agent in self.agents}

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.steps = list(self.possible_agents), 0
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        self.steps += 1
        agents, observations, over = self.agents, self._observations(), self.steps == 5
        terminations = {agent: over and agent in self.terminates for agent in agents}
        truncations = {agent: over and agent in self.truncates for agent in agents}
        self.agents = [a for a in agents if not (terminations[a] or truncations[a])]
        infos = dict.fromkeys(agents, self.infos)
        return observations, dict.fromkeys(agents, self.reward), terminations, truncations, infos

    def render(self) -> Any:
        return np.zeros((20, 30, 3), np.uint8)


class Single(gymnasium.Env):  # type: ignore[type-arg]
    """A Gymnasium environment of three steps."""

    observation_space, action_space = Box(0, 255, (32, 32), np.uint8), Discrete(4)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps = 0
        return np.zeros((32, 32), np.uint8), {}

    def step(self, action: int) -> Any:
        self.steps += 1
        ends = self.steps == 3
        return np.zeros((32, 32), np.uint8), 0.5, ends, False, {"is_success": ends}


def config(monkeypatch: pytest.MonkeyPatch, make: Any, **settings: str) -> Config:
    """The configuration of the world that this makes."""
    module = ModuleType(MODULE)
    module.make = make  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, MODULE, module)
    given = {f"arena.{name}": value for name, value in settings.items()}
    return load_config("quick", {"arena.env": f"{MODULE}:make", **given}, environ={})


def fails() -> None:
    raise RuntimeError("no\ndisplay")


def both(red: Any, blue: Any) -> dict[str, Any]:
    return {"red": red, "blue": blue}


WRONG = {
    "odd shapes": (
        {"seen": both(Box(0, 255, (7,), np.uint8), PICTURE)},
        "red observes Box.* not a uint8 picture .*; render one",
    ),
    "float pictures": (
        {"seen": both(*[Box(0, 1, (40, 50, 3), np.float32)] * 2)},
        "red observes Box.*float32.*, not a uint8 picture .* convert it: values 0 to 255",
    ),
    "heterogeneous pictures": (
        {"seen": both(PICTURE, Box(0, 255, (20, 20), np.uint8))},
        "blue observes .*, red .*: one network plays all agents; pad them",
    ),
    "heterogeneous actions": (
        {"done": both(Discrete(5), Discrete(4))},
        r"blue acts by Discrete\(4\), red Discrete\(5\): one network",
    ),
    "continuous actions": (
        {"done": both(*[Box(-1, 1, (2,), np.float32)] * 2)},
        r"red acts by Box.*, not Discrete\(n\) from 0; let a wrapper",
    ),
    "nothing to choose": ({"done": both(Discrete(1), Discrete(1))}, "red has 1 actions, not 2 to"),
    "an agent that dies": (
        {"terminates": ["red"]},
        "red ended before blue: all agents live until the end of the episode; let those",
    ),
    "too many agents": (
        {"possible_agents": [str(i) for i in range(11)]},
        "11 agents, where 1 to 10 can be played",
    ),
    "other pictures than said": (
        {"picture": lambda steps: np.zeros((9, 9), np.uint8)},
        r"red observes uint8 \[9, 9\], where its space says uint8 \[40, 50, 3\]",
    ),
    "a reward that is none": ({"reward": np.nan}, "red's reward is nan, not a finite number"),
    "a large reward": (
        {"reward": -1000},
        "red's reward is -1000, more than arena.largest_reward 100: set that, or scale",
    ),
    "an error in a step": (
        {"picture": lambda steps: np.full((40, 50, 3), 255 // (3 - steps), np.uint8)},
        r"step raised ZeroDivisionError: .* \(test_custom.py:\d+\)",
    ),
    "no picture of the whole": (
        {"render": lambda: np.zeros(3)},
        r"render\(\) returns float64 \[3\], not uint8 \[H, W, 3\]",
    ),
}


@pytest.mark.parametrize(("changed", "told"), WRONG.values(), ids=WRONG)
def test_a_wrong_world_is_one_clear_line_before_a_run_starts(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], told: str
) -> None:
    with pytest.raises(ConfigError, match=f"^arena.env {MODULE}:make: {told}") as refused:
        looked_up(config(monkeypatch, lambda: Counting(**changed)))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("env", "told"),
    [
        ("no_such_package.worlds:make", "no module no_such_package; install it, or put its folder"),
        ("json.nowhere:make", "no module json.nowhere; install it"),
        ("json:nowhere", "json has no function nowhere"),
        (f"{MODULE}:make", r"make\(\) raised RuntimeError: no display \(test_custom.py:\d+\)"),
        ("collections:OrderedDict", r"make\(\) returned a OrderedDict, not a PettingZoo"),
        ("mrcdrl.common.arena.envs.parallel_env:env", ".*of PettingZoo's AEC form take parallel"),
    ],
)
def test_a_world_that_cannot_be_made_is_one_clear_line(
    monkeypatch: pytest.MonkeyPatch, env: str, told: str
) -> None:
    config(monkeypatch, fails)
    with pytest.raises(ConfigError, match=f"^arena.env {re.escape(env)}: {told}") as refused:
        looked_up(load_config("quick", {"arena.env": env}, environ={}))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"arena.env": "worlds"}, "arena.env: name a module and what makes .*package.module:make"),
        ({"arena.env": "a:b", "arena.codec": "scene"}, 'set codec = "frames"'),
        ({"arena.env": "a:b", "arena.kind": "counting"}, "a custom world needs env"),
        ({"arena.kind": "custom", "arena.codec": "frames"}, "a custom world needs env"),
        ({"arena.num_actions": "4"}, "num_actions 4 is of a custom world: give env too"),
        ({"arena.env": "a:b", "arena.robots": "[1, 2]"}, "needs a fixed number of robots"),
        ({"arena.env": "a:b", "agent.shaping_per_px": "1"}, "agent.shaping_per_px needs the paper"),
    ],
)
def test_settings_that_contradict_a_custom_world_are_refused(
    given: dict[str, str], told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        load_config("quick", given, environ={})


def test_the_world_tells_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = config(monkeypatch, Counting)
    arena = looked_up(asked).arena
    assert (arena.kind, arena.codec, arena.num_robots) == ("custom", "frames", 2)
    assert (arena.num_actions, arena.action_count, asked.arena.action_count) == (5, 5, 0)
    assert looked_up(looked_up(asked)).arena == arena
    with pytest.raises(ConfigError, match="2 agents with 5 actions, where the run has 3 with 5"):
        looked_up(config(monkeypatch, Counting, num_robots="3", num_actions="5"))
    with pytest.raises(ConfigError, match=f"mrcdrl config --env {MODULE}:make"):
        CustomBatch(asked.arena, [np.random.default_rng(0)])
    assert len(layout_symmetries(arena)) == 1
    paper = load_config("quick", {}, environ={})
    assert looked_up(paper) is paper
    assert paper.arena.action_count == 3


@pytest.mark.parametrize(
    ("changed", "outcome", "discount"),
    [
        ({}, Outcome.COLLISION, 0.0),
        ({"infos": {"success": True}}, Outcome.SUCCESS, 0.0),
        ({"infos": {"success": False}}, Outcome.COLLISION, 0.0),
        ({"terminates": [], "truncates": ["red", "blue"]}, Outcome.TIMEOUT, 1.0),
    ],
)
def test_an_episode_ends_as_the_world_says(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], outcome: Outcome, discount: float
) -> None:
    arena = looked_up(config(monkeypatch, lambda: Counting(**changed))).arena
    batch = CustomBatch(arena, [np.random.default_rng(i) for i in range(3)])
    first = batch.reset(1, starts_of(arena, 1, 0)[0])
    assert first.records.shape == (2, 3600)
    assert not first.records.any()
    for number in range(1, 6):
        steps = batch.step(np.array([[0, 4]]), np.array([1]))
        assert (steps.records == number).all()
        assert steps.rewards.tolist() == [[1.0, 1.0]]
    assert (steps[0].last, steps[0].outcome, steps[0].discount) == (True, outcome, discount)
    with pytest.raises(ValueError, match="no episode is running"):
        batch.step(np.array([[0, 0]]), np.array([1]))
    batch.reset(1)
    with pytest.raises(ValueError, match=r"not all in 0\.\.4"):
        batch.step(np.array([[0, 5]]), np.array([1]))


def test_the_time_limit_truncates(monkeypatch: pytest.MonkeyPatch) -> None:
    arena = looked_up(config(monkeypatch, Counting, max_frames="2")).arena
    world = CustomWorld(arena)
    world.reset(0)
    outcomes = [world.step(np.zeros(2, np.uint8)).outcome for _ in range(2)]
    assert outcomes == [None, Outcome.TIMEOUT]


def test_a_gymnasium_environment_is_a_world_of_one_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    arena = looked_up(config(monkeypatch, Single)).arena
    assert (arena.num_robots, arena.num_actions) == (1, 4)
    world = CustomWorld(arena)
    assert world.reset(0).shape == (1, 60, 60)
    outcomes = [world.step(np.zeros(1, np.uint8)).outcome for _ in range(3)]
    assert outcomes == [None, None, Outcome.SUCCESS]
    assert world.render() is None


def test_pictures_become_images() -> None:
    gray = np.arange(60 * 60, dtype=np.uint32).astype(np.uint8).reshape(60, 60)
    assert (image_of(gray, 60) == gray).all()
    assert (image_of(gray[..., None], 60) == gray).all()
    white = np.full((90, 120, 3), 255, np.uint8)
    assert (image_of(white, 60) == 255).all()
    red = np.zeros((30, 60, 3), np.uint8)
    red[..., 0] = 255
    assert (image_of(red, 60) == 76).all()  # 0.299 of white: RGB, not BGR
