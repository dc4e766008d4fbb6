"""gym-pusht's pictures at 60 x 60, as benchmarks/arena.py asks for them.

Prints pictures a second of processor time, one line for every line that comes in with seconds.
Imports nothing of ours, so that it runs by a Python of its own, one that has gym-pusht.
"""

import sys
import time

import gym_pusht  # noqa: F401  registers the environment
import gymnasium

SIDE_PX = 60


def main() -> None:
    env = gymnasium.make(
        "gym_pusht/PushT-v0",
        obs_type="pixels",
        observation_width=SIDE_PX,
        observation_height=SIDE_PX,
    )
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(256)]
    env.reset(seed=0)
    for line in sys.stdin:
        started, steps = time.process_time(), 0
        while time.process_time() - started < float(line):
            _, _, terminated, truncated, _ = env.step(actions[steps % len(actions)])
            if terminated or truncated:
                env.reset()
            steps += 1
        print(steps / (time.process_time() - started), flush=True)


if __name__ == "__main__":
    main()
