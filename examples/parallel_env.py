"""Play an episode of random actions through PettingZoo, and write it as the given GIF."""

import sys

import cv2

from mrcdrl import ArenaConfig, ArenaParallelEnv


def main(out: str, max_cycles: int = 150) -> None:
    config = ArenaConfig(num_robots=3)
    env = ArenaParallelEnv(config, max_cycles=max_cycles, render_mode="rgb_array")
    env.reset(seed=7)
    images, score = [], 0.0
    while env.agents:
        actions = {agent: int(env.action_space(agent).sample()) for agent in env.agents}
        _, rewards, _, _, infos = env.step(actions)
        score += sum(rewards.values()) / len(rewards)
        images.append(cv2.resize(env.render()[..., ::-1], (300, 300)))  # BGR
    animation = cv2.Animation()
    animation.frames, animation.durations = images, [33] * len(images)
    cv2.imwriteanimation(out, animation)
    print(f"{infos['robot_0']['outcome']} after {len(images)} frames, score {score:.1f}")


if __name__ == "__main__":
    main(sys.argv[1])
