"""Worlds that nobody here wrote, learned through the whole ring by `mrcdrl train --env`.

    pip install pygame-ce minigrid
    python -m benchmarks.foreign_worlds pong --minutes 20
    python -m benchmarks.foreign_worlds grid --minutes 20

`pong` is PettingZoo's Cooperative Pong: two paddles, a reward for each moment that the ball stays
in play. Both see the whole screen, so the second one sees it mirrored: its own paddle is on the
left.
`grid` is Minigrid's Empty-5x5 from pictures: one agent that has to find the green square. Prints a
line of JSON: the return of random actions, of the first weights tested and of the best, in the
evaluator's test, and how many of its episodes succeeded.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from benchmarks.machine import emit
from mrcdrl.common.arena import CustomBatch
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.runtime.runs import run_path

_EPISODES = 100  # of random actions, and of each test
_SETTINGS = {
    "pong": {"arena.max_frames": "300", "replay.samples_per_insert": "8"},
    "grid": {
        "arena.max_frames": "100",
        "agent.reward_scale": "10",
        "replay.samples_per_insert": "4",
    },
}
_ROOT = Path(__file__).parents[1]


def pong() -> Any:
    """Cooperative Pong, with the picture mirrored for the paddle on the right."""
    from pettingzoo.butterfly import cooperative_pong_v6
    from pettingzoo.utils import BaseParallelWrapper

    class Mirrored(BaseParallelWrapper):  # type: ignore[misc]
        def _seen(self, observations: dict[str, Any]) -> dict[str, Any]:
            return {a: o[:, ::-1] if a == "paddle_1" else o for a, o in observations.items()}

        def reset(self, seed: int | None = None, options: Any = None) -> Any:
            observations, infos = self.env.reset(seed=seed, options=options)
            return self._seen(observations), infos

        def step(self, actions: Any) -> Any:
            observations, *rest = self.env.step(actions)
            return self._seen(observations), *rest

    return Mirrored(
        cooperative_pong_v6.parallel_env(
            cake_paddle=False, max_cycles=300, max_reward=30, render_mode="rgb_array"
        )
    )


def grid() -> Any:
    """Minigrid's Empty-5x5, whose end within the time is the success."""
    import gymnasium
    import minigrid  # noqa: F401  registers the environments
    from minigrid.wrappers import ImgObsWrapper, RGBImgObsWrapper

    class Told(gymnasium.Wrapper):  # type: ignore[type-arg]
        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = self.env.step(action)
            return observation, reward, terminated, truncated, info | {"success": terminated}

    made = gymnasium.make("MiniGrid-Empty-Random-5x5-v0", render_mode="rgb_array")
    return Told(ImgObsWrapper(RGBImgObsWrapper(made)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("world", choices=_SETTINGS)
    parser.add_argument("--minutes", type=float, default=20.0)
    arguments = parser.parse_args()
    env = f"{__spec__.name}:{arguments.world}"
    settings = _SETTINGS[arguments.world] | {"arena.env": env}
    with tempfile.TemporaryDirectory() as folder:
        flags = [f"--{name}={value}" for name, value in settings.items()]
        flags += [f"--evaluator.episodes={_EPISODES}", "--run.target_success_rate=0"]
        flags += [f"--run.minutes={arguments.minutes}", "--no-plots", "--no-web", "--json"]
        name = f"foreign-{arguments.world}"
        command = [sys.executable, "-m", "mrcdrl", "train", name, "--run-dir", folder, *flags]
        environment = os.environ | {"PYTHONPATH": str(_ROOT)}
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)
        run = run_path(name, Path(folder))
        lines = (run / "evaluations.jsonl").read_text("utf-8").splitlines()
        config = load_config(str(run / "config.toml"), environ={})
    told = [json.loads(line) for line in lines]
    best = max(told, key=lambda each: each["mean_score"])
    emit(
        {
            "bench": "foreign_worlds",
            "world": arguments.world,
            "minutes": arguments.minutes,
            "random_return": random_return(config),
            "first_return": told[0]["mean_score"],
            "best_return": best["mean_score"],
            "best_success": best["success_rate"],
            "learner_step": best["learner_step"],
            "evaluations": len(told),
        }
    )


def random_return(config: Config) -> float:
    """Mean return of random actions, of an agent, over 100 episodes."""
    rng = np.random.default_rng(0)
    world = CustomBatch(config.arena, [rng])
    scores: list[float] = []
    for _ in range(_EPISODES):
        world.reset(0)
        scores.append(0.0)
        outcome = None
        while outcome is None:
            actions = rng.integers(config.arena.action_count, size=(1, config.arena.num_robots))
            steps = world.step(actions)
            scores[-1] += float(steps.rewards.mean())
            outcome = steps.outcomes[0]
    return fmean(scores)


if __name__ == "__main__":
    main()
