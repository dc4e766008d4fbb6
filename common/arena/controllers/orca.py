"""Hungarian assignment and optimal reciprocal collision avoidance (van den Berg et al. 2011).

ORCA chooses a velocity, but a robot here has few actions: the velocity is mapped to the action that
turns closest to it, or to a circle if it is slow. A robot's disc is enlarged by how far it swerves
on that circle.

Invariants: the controller sees the true state, which the paper's agents do not; it keeps the
assignment of the episode's first scene. Velocities are in px per frame.
"""

import math

import numpy as np

from mrcdrl.common.arena.controllers.heading import (
    actions_towards,
    bearings_rad,
    directions,
    shortest_assignment,
)
from mrcdrl.common.arena.world.obstacles import reachable_px
from mrcdrl.common.arena.world.scene import LEFT, Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float64Array, Int64Array, UInt8Array

_HORIZON_FRAMES = 30.0  # tau: collisions sooner than this are avoided
_SLOW = 0.5  # fraction of the speed below which the robot circles instead
_EASE = 0.2  # preferred speed near the target, px per frame for each px of distance
_SPEEDS, _HEADINGS = 8, 64  # velocities tried besides the preferred one


class Orca:
    """Chooses the velocity v nearest to the preferred one in all half-planes n . v >= bound."""

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        swerve = config.step_px / (2 * math.sin(math.radians(config.turn_deg) / 2))
        self._radius = config.robot_radius_px + swerve
        self._low, self._high = (reachable_px(config)[0] + swerve, reachable_px(config)[1] - swerve)
        speeds = np.linspace(0, config.step_px, _SPEEDS + 1)
        around = directions(np.linspace(0, 2 * math.pi, _HEADINGS, endpoint=False))
        self._tried = (speeds[:, None, None] * around).reshape(-1, 2)
        self._assignment: Int64Array | None = None
        self._velocities = np.zeros((config.num_robots, 2))

    def __call__(self, scene: Scene) -> UInt8Array:
        """Chooses actions [K]."""
        if self._assignment is None:
            self._assignment = shortest_assignment(scene)
        places = scene.robots[:, :2]
        wishes = self._wishes(scene.targets[self._assignment] - places)
        self._velocities = self._nearest(wishes, *self._half_planes(places))
        speeds = np.linalg.norm(self._velocities, axis=1)
        towards = actions_towards(scene.robots[:, 2], bearings_rad(self._velocities), self._config)
        return np.where(speeds < _SLOW * self._config.step_px, np.uint8(LEFT), towards)

    def _wishes(self, aims: Float64Array) -> Float64Array:
        """Preferred velocities [K, 2]: straight to the target, slower near it."""
        distances = np.linalg.norm(aims, axis=1, keepdims=True)
        wishes: Float64Array = aims * np.minimum(
            self._config.step_px / np.maximum(distances, 1e-9), _EASE
        )
        return wishes

    def _half_planes(self, places: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Each robot's normals [K, N, 2] and bounds [K, N], from the other robots and the walls."""
        num = len(places)
        others = np.nonzero(~np.eye(num, dtype=bool))[1].reshape(num, num - 1)
        normals, bounds = self._from_robots(
            places[others] - places[:, None],
            self._velocities[:, None],
            self._velocities[others],
        )
        walls = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        gaps = np.concatenate([places - self._low, self._high - places], axis=1)
        return (
            np.concatenate([normals, np.broadcast_to(walls, (num, 4, 2))], axis=1),
            np.concatenate([bounds, -gaps / _HORIZON_FRAMES], axis=1),
        )

    def _from_robots(
        self, apart: Float64Array, own: Float64Array, velocities: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Half-planes from the others at `apart` [K, K - 1, 2].

        Each side makes half of the least change that avoids a collision. own: velocities
        [K, 1, 2].
        """
        relative = own - velocities
        reach = 2 * self._radius
        distances = np.linalg.norm(apart, axis=2)
        overlap = distances <= reach
        # The cut-off disc: velocities that touch within the horizon, or now if they overlap.
        horizon = np.where(overlap, 1.0, _HORIZON_FRAMES)[..., None]
        from_disc = relative - apart / horizon
        disc_distance = np.linalg.norm(from_disc, axis=2, keepdims=True)
        disc_normal = from_disc / np.maximum(disc_distance, 1e-9)
        disc_change = (reach / horizon - disc_distance) * disc_normal
        # The legs of the cone, on the side where the relative velocity lies.
        side = np.where(_cross(apart, from_disc) > 0, 1.0, -1.0)
        bearing = bearings_rad(apart)
        half = np.arcsin(np.clip(reach / np.maximum(distances, 1e-9), -1, 1))
        leg = directions(bearing + side * half)
        leg_normal = side[..., None] * np.stack([-leg[..., 1], leg[..., 0]], axis=-1)
        leg_change = (relative * leg).sum(axis=2, keepdims=True) * leg - relative
        along = (from_disc * apart).sum(axis=2)
        on_disc = overlap | ((along < 0) & (along**2 > (reach * disc_distance[..., 0]) ** 2))
        normals = np.where(on_disc[..., None], disc_normal, leg_normal)
        changes = np.where(on_disc[..., None], disc_change, leg_change)
        bounds = (normals * (own + changes / 2)).sum(axis=2)
        return normals, bounds

    def _nearest(
        self, wishes: Float64Array, normals: Float64Array, bounds: Float64Array
    ) -> Float64Array:
        """Chooses, among the tried velocities that violate the least, the nearest to the wish."""
        num = len(wishes)
        tried = np.concatenate(
            [wishes[:, None], np.broadcast_to(self._tried, (num, *self._tried.shape))], axis=1
        )
        violation = (bounds[:, :, None] - normals @ tried.transpose(0, 2, 1)).max(axis=1)
        violation = np.round(np.maximum(violation, 0), 3)
        away = np.linalg.norm(tried - wishes[:, None], axis=2)
        away[violation > violation.min(axis=1, keepdims=True)] = np.inf
        nearest: Float64Array = tried[np.arange(num), away.argmin(axis=1)]
        return nearest


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
