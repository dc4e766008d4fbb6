"""Moves the robots of many arenas and finds their collisions, compiled.

Each robot turns, then proposes a move of step_px. Two proposals that overlap undo each other; one
into a wall or an obstacle is undone (the turn stays). A proposal that overlaps a robot restored in
this way is undone too, until none does. Every robot whose move was undone has collided. With
back_off_frames, a robot that collided is driven straight backwards for that many frames, whatever
its action. It may be blocked again meanwhile, which is not counted and does not prolong it.

Invariants: after every move no two robots' centres are nearer than two radii, and no robot overlaps
a wall or an obstacle (touching is allowed). The outcome does not depend on the robots' order. A
robot whose pose is NaN is absent: it meets nothing and goes nowhere.
Numbers are computed as pymunk does, to the same bits (mrcdrl.common.arena.world.pymunk_physics).
"""

import math
from typing import Protocol

import numpy as np

from mrcdrl.common.arena.world.obstacles import inner_walls, outer_walls, reachable_px
from mrcdrl.common.arena.world.scene import STRAIGHT
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array, Int64Array, UInt8Array
from mrcdrl.common.runtime.compiled import compiled


class Physics(Protocol):
    """The robots of A arenas; each arena must be placed before it moves."""

    @property
    def robots(self) -> Float64Array:
        """Poses [A, K, 3], NaN of those that are absent; read-only."""
        ...

    def place(self, arena: int, robots: Float64Array, obstacles: Float64Array) -> None:
        """Puts an arena's first robots at the poses [..., 3] and forgets their collisions.

        Any others are absent. obstacles: fixed discs [O, 3]. Raises ValueError if a robot overlaps
        anything.
        """
        ...

    def move(
        self, arenas: Int64Array, actions: UInt8Array, failed: BoolArray
    ) -> tuple[BoolArray, BoolArray]:
        """Turns and moves every robot of the arenas [N] at once; actions: [N, K].

        failed: robots [N, K] that stand still as obstacles to the others. Returns the robots that
        collided [N, K] and those of them that hit a wall or an obstacle [N, K].
        """
        ...


class ArrayPhysics:
    """Physics as one compiled loop over arrays."""

    def __init__(self, config: ArenaConfig, num_arenas: int) -> None:
        self._config = config
        self._walls = np.concatenate([outer_walls(config), inner_walls(config)])
        self._obstacles = np.zeros((num_arenas, config.obstacle_count, 3))
        self._robots = np.zeros((num_arenas, config.num_robots, 3))
        self._back_off = np.zeros((num_arenas, config.num_robots), np.int64)

    @property
    def robots(self) -> Float64Array:
        return self._robots

    def place(self, arena: int, robots: Float64Array, obstacles: Float64Array) -> None:
        check_placed(self._config, robots, obstacles)
        self._robots[arena] = np.nan
        self._robots[arena, : len(robots)] = robots
        self._obstacles[arena] = obstacles
        self._back_off[arena] = 0

    def move(
        self, arenas: Int64Array, actions: UInt8Array, failed: BoolArray
    ) -> tuple[BoolArray, BoolArray]:
        collided = np.empty(actions.shape, np.bool_)
        hit_wall = np.empty(actions.shape, np.bool_)
        config = self._config
        _move_all(
            arenas,
            actions,
            failed,
            self._robots,
            self._back_off,
            self._walls,
            self._obstacles,
            math.radians(config.turn_deg),
            config.step_px,
            config.robot_radius_px,
            config.back_off_frames,
            collided,
            hit_wall,
        )
        return collided, hit_wall


def check_placed(config: ArenaConfig, robots: Float64Array, obstacles: Float64Array) -> None:
    """Raises ValueError if a robot at the poses [..., 3] overlaps anything."""
    bounds, radius = reachable_px(config), config.robot_radius_px
    i, problem = _first_misplaced(robots, bounds, radius, inner_walls(config), obstacles)
    if problem:
        what = ("is not between the walls", "overlaps an obstacle or wall", "overlaps another")
        raise ValueError(f"robot {i} at {tuple(robots[i].tolist())} {what[problem - 1]}")


@compiled
def _first_misplaced(robots, bounds, radius, walls, obstacles):  # type: ignore[no-untyped-def]
    """The first misplaced robot, and why: 1 out of bounds, 2 on something fixed, 3 on a robot."""
    low, high = bounds
    for i in range(len(robots)):
        x, y, heading = robots[i]
        if not (low <= x <= high and low <= y <= high and math.isfinite(heading)):
            return i, 1
        if _meets_fixed(x, y, radius, walls, obstacles):
            return i, 2
        if _meets_robot(i, robots, radius):
            return i, 3
    return 0, 0


@compiled
def _move_all(  # type: ignore[no-untyped-def]
    arenas,
    actions,
    failed,
    robots,
    back_off,
    walls,
    obstacles,
    turn_rad,
    step_px,
    radius,
    back_off_frames,
    collided,
    hit_wall,
):
    num_robots = robots.shape[1]
    places = np.empty((num_robots, 2), np.float64)
    hits = np.empty(num_robots, np.bool_)
    for n in range(len(arenas)):
        poses, backs = robots[arenas[n]], back_off[arenas[n]]
        blocked, beyond = collided[n], hit_wall[n]
        for i in range(num_robots):
            if failed[n, i]:
                places[i, 0], places[i, 1] = poses[i, 0], poses[i, 1]
                beyond[i] = False
                continue
            if backs[i] == 0 and actions[n, i] != STRAIGHT:
                turn = (np.int64(actions[n, i]) - STRAIGHT) * turn_rad
                poses[i, 2] = _wrapped(poses[i, 2] + turn)
            distance = -step_px if backs[i] > 0 else step_px
            places[i, 0] = poses[i, 0] + distance * math.cos(poses[i, 2])
            places[i, 1] = poses[i, 1] + distance * math.sin(poses[i, 2])
            beyond[i] = _meets_fixed(
                places[i, 0], places[i, 1], radius, walls, obstacles[arenas[n]]
            )
        blocked[:] = failed[n]
        _block(poses, places, radius, beyond, blocked, hits)
        for i in range(num_robots):
            poses[i, 0], poses[i, 1] = places[i, 0], places[i, 1]
            if failed[n, i]:
                blocked[i] = False
            elif backs[i] > 0:
                backs[i] -= 1
                blocked[i] = beyond[i] = False
            elif blocked[i]:
                backs[i] = back_off_frames


@compiled
def _block(poses, places, radius, beyond, blocked, hits):  # type: ignore[no-untyped-def]
    """Resets places [K, 2] that cannot be taken to the poses, and marks them blocked.

    Robots that are blocked already do not move.
    """
    again = True
    while again:
        again = False
        for i in range(len(places)):
            hits[i] = not blocked[i] and (beyond[i] or _meets_robot(i, places, radius))
        for i in range(len(places)):
            if hits[i]:
                places[i, 0], places[i, 1] = poses[i, 0], poses[i, 1]
                blocked[i] = again = True


@compiled
def _meets_robot(i, places, radius):  # type: ignore[no-untyped-def]
    reach = radius + radius
    for j in range(len(places)):
        across = places[i, 0] - places[j, 0]
        along = places[i, 1] - places[j, 1]
        if j != i and across * across + along * along < reach * reach:
            return True
    return False


@compiled
def _meets_fixed(x, y, radius, walls, obstacles):  # type: ignore[no-untyped-def]
    """Whether the disc overlaps an obstacle, or a wall by its nearest point."""
    for n in range(len(obstacles)):
        across, along = obstacles[n, 0] - x, obstacles[n, 1] - y
        reach = radius + obstacles[n, 2]
        if across * across + along * along < reach * reach:
            return True
    for ax, ay, bx, by, half in walls:
        dx, dy = bx - ax, by - ay
        t = (dx * (x - ax) + dy * (y - ay)) / (dx * dx + dy * dy)
        t = max(0.0, min(t, 1.0))
        across, along = ax + dx * t - x, ay + dy * t - y
        reach = radius + half
        if across * across + along * along < reach * reach:
            return True
    return False


@compiled
def _wrapped(angle):  # type: ignore[no-untyped-def]
    """Computes math.remainder(angle, math.tau), which numba lacks; both are exact."""
    rest = np.fmod(angle, math.tau)
    if rest > math.pi:
        return rest - math.tau
    return rest + math.tau if rest < -math.pi else rest
