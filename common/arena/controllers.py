"""Players that see the true state: to exercise the arena and to compare learned ones with.

Invariants: pure functions of the scene and the injected generator.
"""

from collections.abc import Callable

import numpy as np

from common.arena.rewards import target_distances_px
from common.arena.scene import STRAIGHT, Scene
from common.config import ArenaConfig
from common.errors import ConfigError
from common.trajectory import NUM_ACTIONS, Int64Array, UInt8Array

Controller = Callable[[Scene], UInt8Array]


def random_actions(scene: Scene, rng: np.random.Generator) -> UInt8Array:
    """Actions [K], each with the same probability."""
    return rng.integers(0, NUM_ACTIONS, len(scene.robots), dtype=np.uint8)


def greedy_actions(scene: Scene, config: ArenaConfig) -> UInt8Array:
    """Actions [K] that head straight for a free target, with no eye for collisions.

    It sees the true state, which the paper's agents do not. Each robot heads for the nearest
    target that no nearer robot has taken, by the turn that leaves the least bearing.
    """
    aims = scene.targets[_free_targets(scene)] - scene.robots[:, :2]
    bearings = np.arctan2(aims[:, 1], aims[:, 0]) - scene.robots[:, 2]
    turns = (np.arange(NUM_ACTIONS) - STRAIGHT) * np.radians(config.turn_deg)
    left_over = np.abs(np.angle(np.exp(1j * (bearings[:, None] - turns))))
    actions: UInt8Array = left_over.argmin(axis=1).astype(np.uint8)
    return actions


def controller(name: str, config: ArenaConfig, rng: np.random.Generator) -> Controller:
    """The controller called `random` or `greedy`; raises ConfigError for another name."""
    if name == "random":
        return lambda scene: random_actions(scene, rng)
    if name == "greedy":
        return lambda scene: greedy_actions(scene, config)
    raise ConfigError(f"unknown controller {name!r}; there are random and greedy")


def _free_targets(scene: Scene) -> Int64Array:
    """A target [K] for each robot: the nearest pair first, then the nearest of the rest."""
    distances = target_distances_px(scene)
    chosen = np.zeros(len(distances), np.int64)
    for _ in range(len(distances)):
        robot, target = np.unravel_index(int(distances.argmin()), distances.shape)
        chosen[robot] = target
        distances[robot, :] = np.inf
        distances[:, target] = np.inf
    return chosen
