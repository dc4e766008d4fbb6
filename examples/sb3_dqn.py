"""Train stable-baselines3's DQN on the arena, both unchanged: all robots share one policy.

`python examples/sb3_dqn.py 2000000` takes hours, and 3 GB for its replay buffer.
"""

import sys

from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import VecMonitor

from mrcdrl import ArenaConfig, ArenaVecEnv


def main(robot_steps: int, buffer_size: int = 100_000, learning_starts: int = 20_000) -> DQN:
    arenas = ArenaVecEnv(num_arenas=8, config=ArenaConfig(num_robots=2))
    envs = VecMonitor(arenas, info_keywords=("outcome",))
    model = DQN(
        "CnnPolicy", envs, seed=0, verbose=1,
        learning_rate=3e-4, batch_size=32, train_freq=4, gradient_steps=8,
        buffer_size=buffer_size, learning_starts=learning_starts, target_update_interval=4_000,
        exploration_fraction=0.2, exploration_final_eps=0.05,
    )  # fmt: skip
    model.learn(robot_steps)
    outcomes = [episode["outcome"] for episode in model.ep_info_buffer]
    print(f"{outcomes.count('success')} of the last {len(outcomes)} robots' episodes succeeded")
    return model


if __name__ == "__main__":
    main(int(sys.argv[1]))
