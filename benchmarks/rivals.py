"""The paper's test of policies and of the controllers, in the paper's arena and in harder ones.

    python -m benchmarks.rivals --conditions fixed --epsilons 0 0.01        # 1 100 starts a line
    python -m benchmarks.rivals --weights pretrained:4robots --episodes 200

Prints one line of JSON for each player, condition, number of robots and epsilon: rates, their
interval and the measures of navigation. Controllers see the true state, policies pictures only.
What a controller does not support is left out. With the paper's 1 100 starts a line takes minutes.
"""

import argparse
import dataclasses
import sys
from itertools import product

from benchmarks.machine import emit
from mrcdrl.common.arena.controllers import CONTROLLERS
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.evaluate import evaluate
from mrcdrl.services.tools.subject import subject

CONDITIONS = {
    "fixed": (),
    "random": ("--arena.target_layout=random",),
    "obstacles": ("--arena.num_obstacles=3",),
    "failing": ("--arena.failure_probability=5e-4",),
    "noise": ("--arena.pixel_noise=5", "--arena.dropped_frame_probability=0.05"),
}
"""The settings that each condition changes in the paper's arena: those of the preset `hard`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--controllers", nargs="*", default=CONTROLLERS)
    parser.add_argument("--weights", nargs="*", default=[])
    parser.add_argument("--robots", nargs="+", type=int, default=[1, 2, 3, 4, 6, 8, 10])
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=[*CONDITIONS])
    parser.add_argument("--epsilons", nargs="+", type=float, default=[0.01])
    parser.add_argument("--episodes", type=int, default=1100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    players = [(name, True) for name in arguments.controllers]
    players += [(name, False) for name in arguments.weights]
    runs = product(players, arguments.conditions, arguments.robots, arguments.epsilons)
    for (name, sees_state), condition, num_robots, epsilon in runs:
        if sees_state and condition == "noise":
            continue  # it looks at no picture
        settings = [*CONDITIONS[condition], f"--robots={num_robots}"]
        settings += [f"--evaluator.epsilon={epsilon}"]
        if sees_state:
            settings.append(f"--controller={name}")
        else:
            settings.append(name)
        given = subject(flags.evaluate().parse_args(settings))
        try:
            result, measures, _ = evaluate(
                given, arguments.episodes, arguments.seed, lambda _done: None
            )
        except ConfigError as error:
            print(f"{name}, {condition}: left out: {error}", file=sys.stderr)
            continue
        emit(
            {
                "bench": "rivals",
                "player": name,
                "sees": "the true state" if sees_state else "pictures",
                "condition": condition,
                "robots": num_robots,
                "epsilon": epsilon,
                "episodes": arguments.episodes,
                "seed": arguments.seed,
                "success_interval": [round(bound, 4) for bound in result.success_interval],
                "wall_s": round(result.wall_s, 1),
                "navigation": dataclasses.asdict(measures),
            }
        )


if __name__ == "__main__":
    main()
