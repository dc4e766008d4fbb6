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
        num = len(scene.robots)
        others = np.repeat(scene.robots[None, :, :2], num, axis=0)
        others[np.arange(num), np.arange(num)] = np.nan
        obstacles = np.broadcast_to(scene.obstacles, (num, *scene.obstacles.shape))
        targets = scene.targets[self._assignment]
        return field_actions(scene.robots, targets, others, obstacles, self._config)


def field_actions(
    poses: Float64Array,
    targets: Float64Array,
    others: Float64Array,
    obstacles: Float64Array,
    config: ArenaConfig,
) -> UInt8Array:
    """Actions [N] along the forces on robots at poses [N, 3], whose targets [N, 2] attract them.

    others: [N, J, 2], the robots beside each; obstacles: [N, O, 3]. What is NaN is not there.
    """
    places = poses[:, :2]
    aims = targets - places
    forces = aims / np.maximum(np.linalg.norm(aims, axis=1, keepdims=True), _LEAST_PX)
    forces = forces + _from_walls(places, config)
    radius = config.robot_radius_px
    robots = np.full(others.shape[:-1], radius)
    forces = forces + _from_discs(places[:, None] - others, robots, radius, _ROBOTS_FROM_PX)
    discs = places[:, None] - obstacles[..., :2]
    forces = forces + _from_discs(discs, obstacles[..., 2], radius, _WALLS_FROM_PX)
    walls, widths = offsets_from(config, places, np.empty((0, 3)))
    forces = forces + _from_discs(walls, widths, radius, _WALLS_FROM_PX)
    return actions_towards(poses[:, 2], bearings_rad(forces), config)


def _from_discs(
    offsets: Float64Array, radii: Float64Array, own_radius: float, from_px: float
) -> Float64Array:
    """Repulsion [N, 2] at these offsets [N, J, 2] from the centres of discs with these radii."""
    distances = np.linalg.norm(offsets, axis=2)
    strength = _strength(distances - radii - own_radius, from_px)
    push: Float64Array = np.nan_to_num((strength / distances)[..., None] * offsets).sum(axis=1)
    return push


def _from_walls(places: Float64Array, config: ArenaConfig) -> Float64Array:
    """Repulsion [N, 2] from the four outer walls."""
    low, high = reachable_px(config)
    near = _strength(places - low, _WALLS_FROM_PX)
    far = _strength(high - places, _WALLS_FROM_PX)
    return near - far


def _strength(gaps_px: Float64Array, from_px: float) -> Float64Array:
    """Repulsion at these gaps: none from `from_px` on, _REPULSION at half of it."""
    gaps = np.maximum(gaps_px, _LEAST_PX)
    return _REPULSION * np.maximum(from_px / gaps - 1, 0)
