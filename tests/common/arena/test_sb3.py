"""The arena in stable-baselines3: ends, states and seeds; and the example trains."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

from mrcdrl.common.arena.envs.parallel_env import ArenaParallelEnv
from mrcdrl.common.arena.envs.sb3 import ArenaVecEnv
from mrcdrl.common.config import ArenaConfig
from tests.common.arena.shared import example

SHORT = ArenaConfig(num_robots=2, view_px=32, max_frames=3)


def test_robots_see_and_get_what_those_of_the_parallel_form_do() -> None:
    config = ArenaConfig(num_robots=3, view_px=32)
    envs, env = ArenaVecEnv(2, config), ArenaParallelEnv(config)
    envs.seed(5)
    states = envs.reset()
    assert states.shape == (6, 4, 32, 32)
    observed, _ = env.reset(seed=5)  # the first robot's seed is its arena's
    np.testing.assert_array_equal(states[:3], np.stack(list(observed.values())))
    for _ in range(10):
        states, rewards, ends, infos = envs.step(np.array([0, 1, 2, 0, 0, 0]))
        observed, paid, _, _, expected = env.step({"robot_0": 0, "robot_1": 1, "robot_2": 2})
        np.testing.assert_array_equal(states[:3], np.stack(list(observed.values())))
        np.testing.assert_array_equal(rewards[:3], np.array(list(paid.values()), np.float32))
        assert infos[:3] == list(expected.values())
        assert not ends.any()


def test_the_end_brings_the_next_start_and_the_last_state() -> None:
    envs = ArenaVecEnv(1, SHORT)
    envs.reset()
    go = np.ones(2, np.int64)
    for _ in range(2):
        before = [envs.step(go)[0] for _ in range(2)][-1]
        states, _, ends, infos = envs.step(go)
        assert ends.tolist() == [True, True]
        assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
        assert [info["outcome"] for info in infos] == ["timeout"] * 2
        last = np.stack([info["terminal_observation"] for info in infos])
        np.testing.assert_array_equal(last[:, :-1], before[:, 1:])
        assert (states == states[:, :1]).all(), "the first image is repeated"
        assert (states != last).any()


def test_a_seed_applies_to_one_reset() -> None:
    envs = ArenaVecEnv(2, SHORT)
    envs.seed(1)
    first, second = envs.reset(), envs.reset()
    assert (first != second).any()
    envs.seed(1)
    np.testing.assert_array_equal(first, envs.reset())


def test_attributes_and_methods_of_robots_are_those_of_their_arenas() -> None:
    envs = ArenaVecEnv(2, SHORT, render_mode="rgb_array")
    envs.reset()
    assert envs.get_attr("render_mode", indices=[0, 3]) == ["rgb_array"] * 2
    envs.set_attr("noted", 7, indices=2)
    assert envs.get_attr("noted", indices=3) == [7]
    assert len(envs.env_method("render")) == 4
    assert envs.env_is_wrapped(ArenaVecEnv) == [False] * 4
    first, second, third, _ = envs.get_images()
    np.testing.assert_array_equal(first, second)
    assert (first != third).any()
    envs.close()
    with pytest.raises(ValueError, match="num_arenas 0 is not at least 1"):
        ArenaVecEnv(0)


def test_the_example_trains(capsys: pytest.CaptureFixture[str]) -> None:
    model = example("sb3_dqn.py", 35).main(400, buffer_size=500, learning_starts=100)
    assert model.num_timesteps >= 400
    assert model._n_updates > 0
    assert "episodes succeeded" in capsys.readouterr().out


def test_absent_robots_see_and_get_nothing() -> None:
    envs = ArenaVecEnv(2, ArenaConfig(robots=(1, 3), view_px=32, max_frames=2))
    envs.seed(0)
    states, numbers = envs.reset(), set()
    for _ in range(30):
        black = ~states.reshape(6, -1).any(axis=1)
        states, rewards, ends, infos = envs.step(np.ones(6, np.int64))
        present = np.array([info.get("present", True) for info in infos])
        np.testing.assert_array_equal(present, ~black)
        numbers |= set(present.reshape(2, 3).sum(axis=1).tolist())
        assert not rewards[~present].any()
        assert all("terminal_observation" in info for info in np.array(infos)[ends])
    assert numbers == {1, 3}
