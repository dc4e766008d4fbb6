"""The paper's test of the controllers, all of which see the true state.

Prints one line of JSON for each controller, number of robots and epsilon: rates, their interval and
the measures of navigation. With the paper's 1 100 starts a line takes minutes.
"""

import argparse
import dataclasses
from itertools import product

from benchmarks.machine import emit
from mrcdrl.common.arena.controllers import CONTROLLERS, check_controller
from mrcdrl.common.config import load_config
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.services.tools.evaluate import evaluate
from mrcdrl.services.tools.subject import Subject


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--controllers", nargs="+", default=CONTROLLERS)
    parser.add_argument("--robots", nargs="+", type=int, default=[2, 3, 4, 6, 8])
    parser.add_argument("--epsilons", nargs="+", type=float, default=[0.0, 0.01])
    parser.add_argument("--episodes", type=int, default=1100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--layout", choices=["fixed", "random"], default="fixed")
    arguments = parser.parse_args()
    runs = product(arguments.controllers, arguments.robots, arguments.epsilons)
    for name, num_robots, epsilon in runs:
        overrides = {
            "arena.num_robots": str(num_robots),
            "arena.target_layout": arguments.layout,
            "evaluator.epsilon": str(epsilon),
        }
        config = load_config("quick", overrides, environ={})
        subject = Subject(config, None, check_controller(name), Weights.of(0, 0, 0, b""))
        result, measures, _ = evaluate(
            subject, arguments.episodes, arguments.seed, lambda _done: None
        )
        emit(
            {
                "bench": "rivals",
                "controller": name,
                "sees": "the true state",
                "robots": num_robots,
                "layout": arguments.layout,
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
