"""The arena in PettingZoo and Gymnasium: their own tests, and what those do not cover."""

import hashlib
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from pettingzoo import test as pettingzoo_tests
from pettingzoo.utils import BaseWrapper

from mrcdrl.common.arena import make_codec
from mrcdrl.common.arena.envs import parallel_env, vector_env
from mrcdrl.common.arena.envs.vector_env import ENV_ID, ArenaVectorEnv
from mrcdrl.common.arena.world import starts
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array
from tests.common.arena.shared import example, in_another_process, start

SMALL = ArenaConfig(num_robots=2, view_px=32, max_frames=40)


# -- their own tests ---------------------------------------------------------------------


@pytest.mark.parametrize("num_robots", [1, 3])
def test_pettingzoo_accepts_the_parallel_form(num_robots: int) -> None:
    config = ArenaConfig(num_robots=num_robots, view_px=32)
    pettingzoo_tests.parallel_api_test(parallel_env.parallel_env(config), num_cycles=100)


def test_pettingzoo_accepts_the_aec_form() -> None:
    pettingzoo_tests.api_test(parallel_env.env(SMALL), num_cycles=100)


def test_pettingzoo_finds_the_parallel_form_seeded() -> None:
    pettingzoo_tests.parallel_seed_test(lambda: parallel_env.parallel_env(SMALL), num_cycles=50)


def test_pettingzoo_finds_max_cycles_kept() -> None:
    pettingzoo_tests.max_cycles_test(parallel_env)


def test_pettingzoo_accepts_the_images(capsys: pytest.CaptureFixture[str]) -> None:
    def make(render_mode: str) -> object:
        return parallel_env.env(SMALL, render_mode=render_mode)

    pettingzoo_tests.render_test(make)
    assert "▀" in capsys.readouterr().out  # `human` renders in the terminal


def test_pettingzoo_saves_the_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """PettingZoo's test takes one image, not a stack, so it gets the newest."""

    class Newest(BaseWrapper):  # type: ignore[misc]
        def observation_space(self, agent: str) -> Box:
            return Box(0, 255, super().observation_space(agent).shape[1:], np.uint8)

        def observe(self, agent: str) -> UInt8Array:
            newest: UInt8Array = super().observe(agent)[-1]
            return newest

    monkeypatch.chdir(tmp_path)
    env = Newest(parallel_env.env(SMALL))
    pettingzoo_tests.test_save_obs(env)
    assert "did not save" not in capsys.readouterr().out
    saved = {path.stem: path for path in tmp_path.rglob("*.png")}
    assert set(saved) == {"robot_0", "robot_1"}
    for agent, path in saved.items():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, env.observe(agent))


def test_pettingzoo_measures_its_performance(capsys: pytest.CaptureFixture[str]) -> None:
    """Runs five seconds with many ends and resets; the rate itself is not checked."""
    pettingzoo_tests.performance_benchmark(parallel_env.env(SMALL))
    assert "turns per second" in capsys.readouterr().out


class OneRobot(gymnasium.Env[UInt8Array, np.int64]):
    """A vector environment of one robot as the single environment that the checker takes."""

    def __init__(self) -> None:
        self._envs = ArenaVectorEnv(1, ArenaConfig(num_robots=1, view_px=32))
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8Array, dict[str, Any]]:
        super().reset(seed=seed)
        states, infos = self._envs.reset(seed=seed, options=options)
        return states[0], infos

    def step(self, action: np.int64) -> tuple[UInt8Array, float, bool, bool, dict[str, Any]]:
        states, rewards, ends, cuts, infos = self._envs.step(np.array([action]))
        return states[0], float(rewards[0]), bool(ends[0]), bool(cuts[0]), infos


def test_gymnasiums_checker_accepts_a_robot_of_the_vector_form() -> None:
    env_checker.check_env(OneRobot(), skip_render_check=True)


def test_gymnasiums_checker_finds_the_vector_form_seeded() -> None:
    vector_env.register()
    made = gymnasium.make_vec(ENV_ID, num_envs=4, config=SMALL)
    env_checker.check_reset_seed_determinism(made)
    env_checker.check_reset_options(made)


@pytest.mark.filterwarnings("ignore:.*Casting input x to numpy array:UserWarning")
def test_gymnasiums_wrappers_accept_the_vector_form() -> None:
    vector_env.register()
    vector_env.register()
    made = gymnasium.make_vec(ENV_ID, num_envs=6, config=SMALL)
    assert isinstance(made.unwrapped, ArenaVectorEnv)
    counted = RecordEpisodeStatistics(made)
    counted.action_space.seed(0)
    observations, _ = counted.reset(seed=0)
    ends = 0
    for _ in range(100):
        assert counted.observation_space.contains(observations)
        observations, _, _, _, infos = counted.step(counted.action_space.sample())
        if "episode" in infos:
            ends += int(infos["_episode"].sum())
            assert (infos["episode"]["l"][infos["_episode"]] <= SMALL.max_frames).all()
    assert ends >= 6
    counted.close()


# -- the parallel form -------------------------------------------------------------------


def test_a_state_is_the_newest_images_with_the_first_repeated() -> None:
    env = parallel_env.parallel_env(SMALL)
    codec = make_codec(SMALL)
    before, _ = env.reset(seed=1)
    first = before["robot_0"]
    assert first.shape == (4, 32, 32)
    assert (first == first[0]).all()
    copy = first.copy()
    after, *_ = env.step({"robot_0": 0, "robot_1": 2})
    np.testing.assert_array_equal(after["robot_0"][:3], first[1:])
    assert (after["robot_0"][3] != first[3]).any()
    np.testing.assert_array_equal(first, copy)
    assert env.observation_space("robot_0").contains(after["robot_0"])
    assert codec.record_bytes == SMALL.record_bytes


@pytest.mark.parametrize(
    ("robots", "outcome", "terminated"),
    [
        ([(150, 300, 0), (450, 300, np.pi)], "success", True),
        ([(300, 500, 0), (350, 500, np.pi)], "collision", True),
        ([(100, 100, 0), (100, 500, 0)], "timeout", False),
    ],
)
def test_an_end_is_terminated_or_truncated(
    robots: list[tuple[float, float, float]], outcome: str, terminated: bool
) -> None:
    env = parallel_env.parallel_env(SMALL)
    _, infos = env.reset(options={"start": start(*robots)})
    assert [info["outcome"] for info in infos.values()] == [None, None]
    agents = env.agents
    while env.agents:
        _, rewards, ends, cuts, infos = env.step(dict.fromkeys(agents, 1))
        if env.agents:
            assert not any([*ends.values(), *cuts.values()])
    assert ends == dict.fromkeys(agents, terminated)
    assert cuts == dict.fromkeys(agents, not terminated)
    assert {info["outcome"] for info in infos.values()} == {outcome}
    assert all(info["collided"] for info in infos.values()) is (outcome == "collision")
    assert not any(info["hit_wall"] for info in infos.values())
    if outcome == "success":
        assert rewards == dict.fromkeys(agents, 200.0)
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_misuse_of_the_parallel_form_is_refused() -> None:
    with pytest.raises(ValueError, match="is not human or rgb_array"):
        parallel_env.parallel_env(SMALL, render_mode="window")
    with pytest.raises(ValueError, match="max_frames"):
        parallel_env.parallel_env(SMALL, max_cycles=0)
    env = parallel_env.parallel_env(SMALL)
    env.reset()
    with pytest.raises(ValueError, match="no action for robot_1"):
        env.step({"robot_0": 1})
    with pytest.raises(ValueError, match="actions"):
        env.step({"robot_0": 1, "robot_1": 3})


def test_a_terminal_image_is_half_blocks_in_colour() -> None:
    image = np.zeros((2, 1, 3), np.uint8)
    image[0, 0] = (1, 2, 3)
    assert parallel_env.terminal_image(image) == "\x1b[38;2;1;2;3;48;2;0;0;0m▀\x1b[0m\n"


# -- the vector form ---------------------------------------------------------------------


def test_robots_of_an_arena_end_together_and_the_next_step_resets_them() -> None:
    envs = ArenaVectorEnv(4, ArenaConfig(view_px=32, max_frames=3))
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    envs.reset(seed=0)
    go = np.ones(4, np.int64)
    for _ in range(2):
        for frame in (1, 2, 3):
            states, _, ends, cuts, infos = envs.step(go)
            assert cuts.tolist() == [frame == 3] * 4
            assert not ends.any()
            assert infos["outcome"].tolist() == ["timeout" if frame == 3 else None] * 4
            assert infos["_outcome"].tolist() == [frame == 3] * 4
        assert (states[:, 0] != states[:, -1]).any()
        states, rewards, ends, cuts, infos = envs.step(go)
        assert not (ends | cuts).any()
        assert rewards.tolist() == [0] * 4
        assert (states[:, 0] == states[:, -1]).all()


def test_robots_of_the_vector_form_see_what_those_of_the_parallel_form_see() -> None:
    config = ArenaConfig(num_robots=3, view_px=32)
    envs = ArenaVectorEnv(3, config, render_mode="rgb_array")
    envs.reset(seed=5)
    child = np.random.SeedSequence(5).spawn(1)[0]
    env = parallel_env.ArenaParallelEnv(config, render_mode="rgb_array")
    env.reset(seed=child)
    for _ in range(10):
        states, rewards, *_ = envs.step(np.array([0, 1, 2]))
        observed, paid, *_ = env.step({"robot_0": 0, "robot_1": 1, "robot_2": 2})
        np.testing.assert_array_equal(states, np.stack(list(observed.values())))
        assert rewards.tolist() == list(paid.values())
    images = envs.render()
    assert images is not None
    np.testing.assert_array_equal(images[2], env.render())


def test_misuse_of_the_vector_form_is_refused() -> None:
    with pytest.raises(ValueError, match="num_envs 3 does not fill arenas of 2 robots"):
        ArenaVectorEnv(3, SMALL)
    with pytest.raises(ValueError, match="is not rgb_array"):
        ArenaVectorEnv(2, SMALL, render_mode="human")
    envs = ArenaVectorEnv(None, SMALL)
    assert envs.render() is None
    envs.reset()
    with pytest.raises(ValueError, match="actions are"):
        envs.step(np.ones(3, np.int64))


# -- both --------------------------------------------------------------------------------


def fingerprint() -> str:
    """Hashes 1 000 seeded steps of both forms."""
    config = ArenaConfig(num_robots=3, view_px=32, target_layout="random", max_frames=300)
    total = hashlib.sha256()
    rng = np.random.default_rng(3)
    env = parallel_env.parallel_env(config)
    env.reset(seed=11)
    envs = ArenaVectorEnv(6, config)
    envs.reset(seed=11)
    for _ in range(1000):
        actions = rng.integers(0, 3, 6)
        if not env.agents:
            env.reset()
        observed, paid, ends, cuts, infos = env.step(
            dict(zip(env.agents, actions.tolist(), strict=False))
        )
        total.update(np.stack(list(observed.values())).tobytes())
        total.update(repr((paid, ends, cuts, infos)).encode())
        states, rewards, ended, cut, _ = envs.step(actions)
        for array in (states, rewards, ended, cut):
            total.update(array.tobytes())
    return total.hexdigest()


def test_a_seed_gives_the_same_1000_steps_in_another_process() -> None:
    assert in_another_process(__file__, "fingerprint()") == fingerprint()


def test_test_starts_can_be_played() -> None:
    env = parallel_env.parallel_env(SMALL)
    (begin,) = starts.test_starts(SMALL, 1, seed=0)
    one, _ = env.reset(seed=1, options={"start": begin})
    other, _ = env.reset(seed=2, options={"start": begin})
    np.testing.assert_array_equal(one["robot_1"], other["robot_1"])


def test_the_example_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example("parallel_env.py", 30).main(str(tmp_path / "film.gif"), max_cycles=5)
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF89a")
    assert "after 5 frames" in capsys.readouterr().out


# -- episodes that differ in their number of robots ----------------------------------------

MIXED = ArenaConfig(robots=(1, 2, 4), view_px=32, max_frames=5)


@pytest.mark.filterwarnings("ignore:No agents present but not all possible_agents")
def test_pettingzoo_accepts_agents_that_are_there_in_some_episodes_only() -> None:
    pettingzoo_tests.parallel_api_test(parallel_env.parallel_env(MIXED), num_cycles=100)
    env, seen = parallel_env.parallel_env(MIXED), set()
    for episode in range(20):
        observations, infos = env.reset(seed=episode)
        there = env.agents
        seen.add(len(there))
        assert there == env.possible_agents[: len(there)]
        while env.agents:
            assert list(observations) == list(infos) == there
            observations, rewards, *_, infos = env.step(dict.fromkeys(there, 1))
            assert list(rewards) == there
    assert seen == {1, 2, 4}


def test_absent_robots_of_the_vector_form_see_and_get_nothing() -> None:
    envs = ArenaVectorEnv(3 * 4, MIXED)
    states, infos = envs.reset(seed=0)
    numbers = set()
    for _ in range(60):
        present = infos["present"]
        numbers |= set(present.reshape(3, 4).sum(axis=1).tolist())
        assert states[present].reshape(present.sum(), -1).any(axis=1).all()
        assert not states[~present].any()
        states, rewards, _, _, after = envs.step(np.ones(12, int))
        stayed = ~present & ~after["present"]
        assert not rewards[stayed].any()
        assert not after["collided"][stayed].any()
        infos = after
    assert numbers == {1, 2, 4}
