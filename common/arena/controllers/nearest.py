"""The simplest controllers: random actions, and straight to the nearest free target.

Invariants: pure functions of the scene and the injected generator.
"""

import numpy as np

from mrcdrl.common.arena.controllers.heading import actions_towards, bearings_rad
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Int64Array, UInt8Array


def random_actions(scene: Scene, rng: np.random.Generator) -> UInt8Array:
    """Draws actions [K], each with the same probability."""
    return rng.integers(0, NUM_ACTIONS, len(scene.robots), dtype=np.uint8)


def greedy_actions(scene: Scene, config: ArenaConfig) -> UInt8Array:
    """Actions [K] that head straight for a free target and ignore collisions.

    The controller sees the true state, which the paper's agents do not. Each robot heads for the
    nearest target that no nearer robot has taken, with the turn that leaves the smallest angle.
    """
    aims = scene.targets[_free_targets(scene)] - scene.robots[:, :2]
    return actions_towards(scene.robots[:, 2], bearings_rad(aims), config)


def _free_targets(scene: Scene) -> Int64Array:
    """Targets [K] of the robots: the nearest pair first, then the nearest of the rest."""
    distances = target_distances_px(scene)
    chosen = np.zeros(len(distances), np.int64)
    for _ in range(len(distances)):
        robot, target = np.unravel_index(int(distances.argmin()), distances.shape)
        chosen[robot] = target
        distances[robot, :] = np.inf
        distances[:, target] = np.inf
    return chosen
