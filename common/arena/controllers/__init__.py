"""Controllers that see the true state, to exercise the arena and to compare learned policies with.

Invariants: a controller plays one episode and is called with each of its scenes in order, so that
it may keep state; every random number comes from the injected generator. All see the scene itself,
which the paper's agents never do: say so wherever one is compared with a learned policy.
"""

import difflib

import numpy as np

from mrcdrl.common.arena.controllers.heading import Controller, shortest_assignment
from mrcdrl.common.arena.controllers.nearest import greedy_actions, random_actions
from mrcdrl.common.arena.controllers.orca import Orca
from mrcdrl.common.arena.controllers.potential_field import PotentialField
from mrcdrl.common.arena.controllers.safe_circle import SafeCircle
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError

__all__ = [
    "CONTROLLERS",
    "Controller",
    "Orca",
    "PotentialField",
    "SafeCircle",
    "check_controller",
    "greedy_actions",
    "make_controller",
    "random_actions",
    "shortest_assignment",
]

CONTROLLERS = ("random", "greedy", "potential_field", "orca", "safe_circle")
"""Names that `make_controller` accepts."""
_OPEN_FIELD = ("orca", "safe_circle")  # expect nothing between the outer walls


def check_controller(name: str) -> str:
    """Returns the name; raises ConfigError with the closest match if it is unknown."""
    if name in CONTROLLERS:
        return name
    near = difflib.get_close_matches(name, CONTROLLERS, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else f"choose from {', '.join(CONTROLLERS)}"
    raise ConfigError(f"unknown controller {name!r}; {hint}")


def make_controller(name: str, config: ArenaConfig, rng: np.random.Generator) -> Controller:
    """Makes a controller for one episode.

    Raises ConfigError for an unknown name, or if the controller does not support the world.
    """
    check_controller(name)
    if name in _OPEN_FIELD and (config.obstacle_count or config.inner_walls_px):
        raise ConfigError(
            f"controller {name!r} does not support obstacles or inner walls; "
            "use potential_field, greedy or random"
        )
    if name == "safe_circle" and config.failure_probability:
        raise ConfigError(
            "controller 'safe_circle' does not support robots that fail; "
            "use orca, potential_field, greedy or random"
        )
    match name:
        case "greedy":
            return lambda scene: greedy_actions(scene, config)
        case "potential_field":
            return PotentialField(config)
        case "orca":
            return Orca(config)
        case "safe_circle":
            return SafeCircle(config)
        case _:
            return lambda scene: random_actions(scene, rng)
