"""Hungarian assignment, and only moves after which a robot could circle safely forever.

A robot cannot stop, but it can always drive a circle with a radius of some 6 px. Each robot keeps
one such circle, to its left or right, clear of the walls and of all other robots' circles. It makes
a move only if a circle from its end is clear again; otherwise it continues to circle, which is safe
by induction. So without exploration, and from a start whose circles are clear, no robot ever
collides.

Invariants: the controller sees the true state, which the paper's agents do not. Robots choose one
after another, each given the earlier robots' choices and the later ones' current circles.
"""

import math

import numpy as np

from mrcdrl.common.arena.controllers.heading import (
    bearings_rad,
    directions,
    remaining_rad,
    shortest_assignment,
)
from mrcdrl.common.arena.world.obstacles import reachable_px
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import LEFT, RIGHT, STRAIGHT, Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float64Array, Int64Array, UInt8Array

_MARGIN_PX = 5.0  # extra clearance: about how far one random action moves a circle
_BETTER = 0.9  # another assignment must cost less than this fraction of the current one
_SIDES = np.array([LEFT, RIGHT]) - STRAIGHT
# Each action, then circling to either side: six options.
_ACTIONS = np.repeat(np.arange(NUM_ACTIONS, dtype=np.uint8), len(_SIDES))
_THEN = np.tile(_SIDES, NUM_ACTIONS)


class SafeCircle:
    """Drives each robot straight to its target as long as a circle stays clear."""

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        self._turn_rad = math.radians(config.turn_deg)
        self._radius = config.step_px / (2 * math.sin(self._turn_rad / 2))
        self._assignment: Int64Array | None = None
        self._sides = np.full(config.num_robots, LEFT - STRAIGHT)  # test starts circle left

    def __call__(self, scene: Scene) -> UInt8Array:
        """Chooses actions [K]."""
        self._assign(scene)
        aims = scene.targets[self._assignment] - scene.robots[:, :2]
        remaining = remaining_rad(scene.robots[:, 2], bearings_rad(aims), self._config)
        actions = (STRAIGHT + self._sides).astype(np.uint8)
        poses = self._moved(scene.robots, self._sides)
        for i in np.argsort(np.linalg.norm(aims, axis=1)):
            options = self._moved(scene.robots[i], _ACTIONS.astype(np.int64) - STRAIGHT)
            gaps = self.gaps(options, _THEN, np.delete(poses, i, 0), np.delete(self._sides, i))
            clear = gaps >= _MARGIN_PX
            cost = remaining[i, _ACTIONS] - 1e-3 * gaps
            chosen = int(np.where(clear, cost, np.inf).argmin() if clear.any() else gaps.argmax())
            actions[i], poses[i], self._sides[i] = _ACTIONS[chosen], options[chosen], _THEN[chosen]
        return actions

    def _assign(self, scene: Scene) -> None:
        """Updates the assignment if another is much shorter."""
        squares = target_distances_px(scene) ** 2
        shortest = shortest_assignment(scene, power=2)
        robots = np.arange(len(squares))
        if (
            self._assignment is None
            or squares[robots, shortest].sum() < _BETTER * squares[robots, self._assignment].sum()
        ):
            self._assignment = shortest

    def _moved(self, poses: Float64Array, turns: Int64Array) -> Float64Array:
        """Poses [N, 3] one frame later, after turns of -1, 0 or 1 times turn_deg."""
        headings = poses[..., 2] + turns * self._turn_rad
        places = poses[..., :2] + self._config.step_px * directions(headings)
        return np.concatenate([places, headings[:, None]], axis=1)

    def gaps(
        self, poses: Float64Array, sides: Int64Array, others: Float64Array, other_sides: Int64Array
    ) -> Float64Array:
        """Least gaps [N] px to walls and others [M, 3] while circling forever from poses [N, 3].

        sides: -1 left, 1 right; all robots circle in step. Negative if they overlap.
        """
        centres, spokes = self._circles(poses, sides)
        low, high = reachable_px(self._config)
        walls = np.minimum(centres - low, high - centres).min(axis=1) - self._radius
        if not len(others):
            return np.asarray(walls, np.float64)
        other_centres, other_spokes = self._circles(others, other_sides)
        apart = centres[:, None] - other_centres
        far = np.linalg.norm(apart, axis=2)
        # Two robots turning the same way keep the length of their spokes' difference.
        together = far - np.linalg.norm(spokes[:, None] - other_spokes, axis=2)
        # If they turn opposite ways, the difference oscillates along one line.
        along = bearings_rad(spokes)[:, None] + bearings_rad(other_spokes) + math.pi
        line = directions(along / 2)
        shift = np.clip(-(apart * line).sum(axis=2), -2 * self._radius, 2 * self._radius)
        against = np.linalg.norm(apart + shift[..., None] * line, axis=2)
        gaps = np.where(sides[:, None] == other_sides, together, against)
        robots = gaps.min(axis=1) - 2 * self._config.robot_radius_px
        least: Float64Array = np.minimum(walls, robots)
        return least

    def _circles(self, poses: Float64Array, sides: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Centres [N, 2] of the circles on these sides, and the spokes [N, 2] to the poses."""
        towards = directions(poses[:, 2] + sides * (math.pi + self._turn_rad) / 2)
        spokes = -self._radius * towards
        return poses[:, :2] - spokes, spokes
