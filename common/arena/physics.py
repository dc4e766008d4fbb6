"""Moves robots and finds their collisions with pymunk.

Invariants: after every move no two robots' centres are nearer than two radii and no centre is
nearer than a radius to a wall's inner face (touching is allowed); the outcome does not depend on
the robots' order.
"""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pymunk

from common.arena.layout import reachable_px
from common.arena.scene import STRAIGHT
from common.config import ArenaConfig
from common.trajectory import BoolArray, Float64Array, UInt8Array

_SLACK_PX = 1e-6  # rounding never lets the quick reject overrule pymunk

Pose = tuple[float, float, float]


class World:
    """K robots between four walls (paper section 3)."""

    def __init__(self, config: ArenaConfig, robots: Float64Array) -> None:
        """robots: poses [K, 3]; raises ValueError as place does."""
        self._config = config
        self._turn_rad = math.radians(config.turn_deg)
        radius = config.robot_radius_px
        inner = config.wall_offset_px + config.wall_thickness_px
        self._free_low = inner + radius + _SLACK_PX
        self._free_high = config.size_px - inner - radius - _SLACK_PX
        self._reach_squared = (2 * radius + config.step_px + _SLACK_PX) ** 2
        self._space = pymunk.Space()
        self._add_walls(inner)
        self._bodies = [pymunk.Body(body_type=pymunk.Body.KINEMATIC) for _ in robots]
        self._shapes = [pymunk.Circle(body, radius) for body in self._bodies]
        self._space.add(*self._bodies, *self._shapes)
        self._pairs = tuple(combinations(range(len(robots)), 2))
        self.place(robots)

    def __repr__(self) -> str:
        return f"World(robots={self._poses})"

    @property
    def robots(self) -> Float64Array:
        """Poses [K, 3], a copy."""
        return np.array(self._poses, np.float64)

    def place(self, robots: Float64Array) -> None:
        """Puts the robots at the poses [K, 3] and forgets their collisions.

        Raises ValueError when one overlaps another or a wall.
        """
        low, high = reachable_px(self._config)
        self._poses: list[Pose] = [(x, y, heading) for x, y, heading in robots.tolist()]
        for i, pose in enumerate(self._poses):
            if not (all(low <= place <= high for place in pose[:2]) and math.isfinite(pose[2])):
                raise ValueError(f"robot {i} at {pose} is not between the walls")
            self._put(i, pose)
        for i, shape in enumerate(self._shapes):
            if self._space.shape_query(shape):
                raise ValueError(f"robot {i} at {self._poses[i]} overlaps another")
        self._back_off = [0] * len(self._poses)
        self.hit_wall: BoolArray = np.zeros(len(self._poses), np.bool_)
        """Of those that collided in the last move [K], whose way led beyond a wall."""

    def move(self, actions: UInt8Array) -> BoolArray:
        """Turns and moves every robot at once; returns who collided [K].

        Each robot turns, then proposes its way of step_px. Two proposals that overlap undo each
        other, one beyond a wall is undone (the turn stays); a proposal that overlaps a robot so
        restored is undone too, until none does. All whose way was undone have collided.

        With back_off_frames, a robot that collided is driven straight backwards for that many
        frames, whatever its action; it may be blocked again meanwhile, which neither counts
        as its collision nor prolongs it.
        """
        turned = [self._turn(i, action) for i, action in enumerate(actions.tolist())]
        proposals = [self._advance(i, pose) for i, pose in enumerate(turned)]
        near = self._near(proposals)
        blocked = self._blocked(proposals, turned, near) if near else set()
        self._poses = [
            turned[i] if i in blocked else proposal for i, proposal in enumerate(proposals)
        ]
        collided = np.zeros(len(proposals), np.bool_)
        self.hit_wall = np.zeros(len(proposals), np.bool_)
        for i, frames in enumerate(self._back_off):
            if frames:
                self._back_off[i] = frames - 1
            elif i in blocked:
                self._back_off[i] = self._config.back_off_frames
                collided[i] = True
                self.hit_wall[i] = self._beyond_wall(proposals[i])
        return collided

    def _beyond_wall(self, pose: Pose) -> bool:
        low, high = self._free_low - _SLACK_PX, self._free_high + _SLACK_PX
        return not (low <= pose[0] <= high and low <= pose[1] <= high)

    def _turn(self, i: int, action: int) -> Pose:
        x, y, heading = self._poses[i]
        if self._back_off[i] or action == STRAIGHT:
            return x, y, heading
        return x, y, math.remainder(heading + (action - STRAIGHT) * self._turn_rad, math.tau)

    def _advance(self, i: int, pose: Pose) -> Pose:
        x, y, heading = pose
        way = -self._config.step_px if self._back_off[i] else self._config.step_px
        return x + way * math.cos(heading), y + way * math.sin(heading), heading

    def _near(self, proposals: Sequence[Pose]) -> set[int]:
        """Robots that could be blocked: only for them pymunk is asked."""
        low, high = self._free_low, self._free_high
        near = {
            i for i, (x, y, _) in enumerate(proposals) if not (low < x < high and low < y < high)
        }
        for i, j in self._pairs:
            across = proposals[i][0] - proposals[j][0]
            along = proposals[i][1] - proposals[j][1]
            if across * across + along * along < self._reach_squared:
                near.add(i)
                near.add(j)
        return near

    def _blocked(
        self, proposals: Sequence[Pose], turned: Sequence[Pose], near: set[int]
    ) -> set[int]:
        """Robots whose way is undone."""
        for i, proposal in enumerate(proposals):
            self._put(i, proposal)
        blocked: set[int] = set()
        waiting = near
        while hits := {i for i in waiting if self._space.shape_query(self._shapes[i])}:
            for i in hits:
                self._put(i, turned[i])
            blocked |= hits
            waiting = waiting - hits
        return blocked

    def _put(self, i: int, pose: Pose) -> None:
        body = self._bodies[i]
        body.position = pose[:2]
        self._space.reindex_shapes_for_body(body)

    def _add_walls(self, inner: float) -> None:
        """Segments from the inner face outwards, thicker than a step, so none is jumped over."""
        half = self._config.step_px
        low, high = inner - half, self._config.size_px - inner + half
        corners = [(low, low), (high, low), (high, high), (low, high)]
        for i, corner in enumerate(corners):
            wall = pymunk.Segment(self._space.static_body, corner, corners[(i + 1) % 4], half)
            self._space.add(wall)
