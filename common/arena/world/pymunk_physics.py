"""The collision rule with pymunk, the reference for the compiled physics.

Invariants: those of mrcdrl.common.arena.world.physics.
"""

import math

import numpy as np
import pymunk

from mrcdrl.common.arena.world.obstacles import inner_walls, outer_walls
from mrcdrl.common.arena.world.physics import check_placed
from mrcdrl.common.arena.world.scene import STRAIGHT
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array, Int64Array, UInt8Array

Pose = tuple[float, float, float]
_ABSENT: Pose = (math.nan, math.nan, math.nan)


class PymunkPhysics:
    """Physics with one pymunk space per arena."""

    def __init__(self, config: ArenaConfig, num_arenas: int) -> None:
        self._worlds = [World(config) for _ in range(num_arenas)]

    @property
    def robots(self) -> Float64Array:
        return np.stack([world.robots for world in self._worlds])

    def place(self, arena: int, robots: Float64Array, obstacles: Float64Array) -> None:
        self._worlds[arena].place(robots, obstacles)

    def move(
        self, arenas: Int64Array, actions: UInt8Array, failed: BoolArray
    ) -> tuple[BoolArray, BoolArray]:
        collided = np.empty(actions.shape, np.bool_)
        hit_wall = np.empty(actions.shape, np.bool_)
        for n, arena in enumerate(arenas.tolist()):
            collided[n], hit_wall[n] = self._worlds[arena].move(actions[n], failed[n])
        return collided, hit_wall


class World:
    """K robots between walls (paper section 3)."""

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        self._turn_rad = math.radians(config.turn_deg)
        num_robots = config.num_robots
        self._space = pymunk.Space()
        self._still = self._space.static_body
        for ax, ay, bx, by, half in (*outer_walls(config), *inner_walls(config)):
            self._space.add(pymunk.Segment(self._still, (ax, ay), (bx, by), half))
        self._obstacles: list[pymunk.Circle] = []
        self._bodies = [pymunk.Body(body_type=pymunk.Body.KINEMATIC) for _ in range(num_robots)]
        self._shapes = [pymunk.Circle(body, config.robot_radius_px) for body in self._bodies]
        self._space.add(*self._bodies, *self._shapes)
        self._poses: list[Pose] = [(0.0, 0.0, 0.0)] * num_robots
        self._back_off = [0] * num_robots
        self._present = range(num_robots)

    @property
    def robots(self) -> Float64Array:
        """A copy of the poses [K, 3]."""
        return np.array(self._poses, np.float64)

    def place(self, robots: Float64Array, obstacles: Float64Array) -> None:
        """Places this arena's robots, as Physics.place does."""
        check_placed(self._config, robots, obstacles)
        self._space.remove(*self._obstacles)
        self._obstacles = [pymunk.Circle(self._still, r, (x, y)) for x, y, r in obstacles.tolist()]
        self._space.add(*self._obstacles)
        self._space.remove(*(self._shapes[i] for i in self._present))
        self._present = range(len(robots))
        self._space.add(*(self._shapes[i] for i in self._present))
        absent = [_ABSENT] * (len(self._bodies) - len(robots))
        self._poses = [(x, y, heading) for x, y, heading in robots.tolist()] + absent
        self._back_off = [0] * len(self._poses)

    def move(self, actions: UInt8Array, failed: BoolArray) -> tuple[BoolArray, BoolArray]:
        """Moves this arena's robots and returns masks [K], as Physics.move does."""
        waiting = {i for i in self._present if not failed[i]}
        turned, proposals = self._poses.copy(), self._poses.copy()
        for i in waiting:
            turned[i] = self._turn(i, int(actions[i]))
            proposals[i] = self._advance(i, turned[i])
        for i in self._present:
            self._put(i, proposals[i])
        beyond = {i for i in waiting if self._meets_fixed(i)}
        blocked: set[int] = set()
        while hits := {i for i in waiting if self._space.shape_query(self._shapes[i])}:
            for i in hits:
                self._put(i, turned[i])
            blocked |= hits
            waiting -= hits
        self._poses = [
            turned[i] if i in blocked else proposal for i, proposal in enumerate(proposals)
        ]
        collided = np.zeros(len(proposals), np.bool_)
        hit_wall = np.zeros(len(proposals), np.bool_)
        for i, frames in enumerate(self._back_off):
            if frames and not failed[i]:
                self._back_off[i] = frames - 1
            elif i in blocked:
                self._back_off[i] = self._config.back_off_frames
                collided[i] = True
                hit_wall[i] = i in beyond
        return collided, hit_wall

    def _turn(self, i: int, action: int) -> Pose:
        x, y, heading = self._poses[i]
        if self._back_off[i] or action == STRAIGHT:
            return x, y, heading
        return x, y, math.remainder(heading + (action - STRAIGHT) * self._turn_rad, math.tau)

    def _advance(self, i: int, pose: Pose) -> Pose:
        x, y, heading = pose
        distance = -self._config.step_px if self._back_off[i] else self._config.step_px
        return x + distance * math.cos(heading), y + distance * math.sin(heading), heading

    def _meets_fixed(self, i: int) -> bool:
        met = self._space.shape_query(self._shapes[i])
        return any(info.shape is not None and info.shape.body is self._still for info in met)

    def _put(self, i: int, pose: Pose) -> None:
        body = self._bodies[i]
        body.position = pose[:2]
        self._space.reindex_shapes_for_body(body)
