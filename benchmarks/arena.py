"""The arena alone, one thread: physics, rewards and records; drawing; new episodes.

Prints one line of JSON: robot steps a second of processor time of each, and of all together, under
random actions, whose short episodes ask for more starts than a policy's.
"""

import argparse
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.machine import emit, spread
from common.arena import ArenaBatch, make_codec
from common.config import ArenaConfig
from common.trajectory import NUM_ACTIONS


@dataclass
class Seconds:
    """Processor time of each part."""

    step: float = 0.0
    draw: float = 0.0
    reset: float = 0.0

    @property
    def all(self) -> float:
        return self.step + self.draw + self.reset


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--arenas", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--physics", nargs="+", default=["array", "pymunk"])
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    for physics in arguments.physics:
        config = ArenaConfig.model_validate({"num_robots": arguments.robots, "physics": physics})
        for num_arenas in arguments.arenas:
            played = [play(config, num_arenas, arguments.frames) for _ in range(arguments.repeats)]
            steps = arguments.frames * num_arenas * config.num_robots
            figures = {
                f"{part}_robot_steps_per_s": spread([steps / getattr(s, part) for s in played], 0)
                for part in ("step", "draw", "reset", "all")
            }
            sizes = {"physics": physics, "robots": arguments.robots, "arenas": num_arenas}
            emit({"bench": "arena", **sizes, **figures})


def play(config: ArenaConfig, num_arenas: int, frames: int) -> Seconds:
    """Random actions for so many frames, after a warm-up."""
    arenas = ArenaBatch(config, [np.random.default_rng(i) for i in range(num_arenas)])
    codec = make_codec(config)
    rng = np.random.default_rng(0)
    every = [arenas.reset(arena) for arena in range(num_arenas)]
    codec.decode(np.stack([time_step.records for time_step in every]))
    seconds = Seconds()
    for _ in range(frames):
        actions = rng.integers(NUM_ACTIONS, size=(num_arenas, config.num_robots))
        began = time.process_time()
        time_steps = arenas.step(actions)
        stepped = time.process_time()
        codec.decode(time_steps.records)
        drawn = time.process_time()
        for arena, outcome in enumerate(time_steps.outcomes):
            if outcome is not None:
                arenas.reset(arena)
        seconds.step += stepped - began
        seconds.draw += drawn - stepped
        seconds.reset += time.process_time() - drawn
    return seconds


if __name__ == "__main__":
    main()
