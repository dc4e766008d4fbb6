"""Hungarian assignment and a potential field (Khatib 1986).

Invariants: the controller sees the true state, which the paper's agents do not; it keeps the
assignment of the episode's first scene.
"""

import numpy as np

from mrcdrl.common.arena.controllers.heading import (
    actions_towards,
    bearings_rad,
    shortest_assignment,
)
from mrcdrl.common.arena.world.obstacles import offsets_from, reachable_px
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float64Array, Int64Array, UInt8Array

_ROBOTS_FROM_PX = 60.0  # gap between two robots below which they repel each other
_WALLS_FROM_PX = 15.0  # gap between a robot and a wall below which it is repelled
_REPULSION = 1.0  # relative to the attraction, at half the gap
_LEAST_PX = 1.0  # a smaller gap repels no more than this one


class PotentialField:
    """Attracts each robot to its target and repels it from everything near."""

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        self._assignment: Int64Array | None = None

    def __call__(self, scene: Scene) -> UInt8Array:
        """Chooses actions [K] along the force on each robot."""
        if self._assignment is None:
            self._assignment = shortest_assignment(scene)
        places = scene.robots[:, :2]
        aims = scene.targets[self._assignment] - places
        distances = np.linalg.norm(aims, axis=1, keepdims=True)
        forces = aims / np.maximum(distances, _LEAST_PX)
        forces = forces + self._from_robots(places) + self._from_walls(places)
        forces = forces + self._from_obstacles(places, scene.obstacles)
        return actions_towards(scene.robots[:, 2], bearings_rad(forces), self._config)

    def _from_robots(self, places: Float64Array) -> Float64Array:
        """Repulsion [K, 2] from the other robots."""
        apart = places[:, None] - places[None]
        distances = np.linalg.norm(apart, axis=2)
        np.fill_diagonal(distances, np.inf)
        gaps = distances - 2 * self._config.robot_radius_px
        push: Float64Array = (
            (_strength(gaps, _ROBOTS_FROM_PX) / distances)[..., None] * apart
        ).sum(axis=1)
        return push

    def _from_walls(self, places: Float64Array) -> Float64Array:
        """Repulsion [K, 2] from the four outer walls."""
        low, high = reachable_px(self._config)
        near, far = (
            _strength(places - low, _WALLS_FROM_PX),
            _strength(high - places, _WALLS_FROM_PX),
        )
        return near - far

    def _from_obstacles(self, places: Float64Array, obstacles: Float64Array) -> Float64Array:
        """Repulsion [K, 2] from obstacles and inner walls."""
        offsets, widths = offsets_from(self._config, places, obstacles)
        distances = np.linalg.norm(offsets, axis=2)
        gaps = distances - widths - self._config.robot_radius_px
        push: Float64Array = (
            (_strength(gaps, _WALLS_FROM_PX) / distances)[..., None] * offsets
        ).sum(axis=1)
        return push


def _strength(gaps_px: Float64Array, from_px: float) -> Float64Array:
    """Repulsion at these gaps: none from `from_px` on, _REPULSION at half of it."""
    gaps = np.maximum(gaps_px, _LEAST_PX)
    return _REPULSION * np.maximum(from_px / gaps - 1, 0)
