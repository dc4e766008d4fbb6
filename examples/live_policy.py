"""Join a run that is up on this machine, and play its arena with the newest weights.

Run `python examples/live_policy.py four` beside `mrcdrl train --name four`.
"""

import sys
from pathlib import Path

import numpy as np

from mrcdrl import ArenaParallelEnv, LivePolicy


def main(run: str | Path, episodes: int = 20) -> None:
    with LivePolicy.of_run(run, epsilon=0.01) as policy:
        env = ArenaParallelEnv(policy.config.arena)
        successes = 0
        for episode in range(1, episodes + 1):
            observations, infos = env.reset()
            while env.agents:
                actions = policy.act(np.stack(list(observations.values())))
                observations, _, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
            successes += infos["robot_0"]["outcome"] == "success"
            print(f"{successes} of {episode}, version {policy.version}")


if __name__ == "__main__":
    main(sys.argv[1])
