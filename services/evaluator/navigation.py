"""Navigation measures beyond the paper's: kind of collision, time, path length, separation.

Invariants: pure; computed from each episode's path after its end. The rates of success, collision
with a robot, collision with a wall, and time-out sum to 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrcdrl.common.arena import Scene
from mrcdrl.common.arena.controllers import shortest_assignment
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array, Outcome


@dataclass(frozen=True, slots=True)
class Journey:
    """What each robot did during one episode."""

    path_px: Float64Array  # [K], length of the path driven
    straight_px: Float64Array  # [K], from the start to its target at the end
    separation_px: Float64Array  # [K], smallest gap to another robot's rim; inf without another
    hit_robot: BoolArray  # [K], stopped by a robot and not by a wall
    hit_wall: BoolArray  # [K], stopped by a wall


@dataclass(frozen=True, slots=True)
class RobotNavigation:
    """Measures of one robot over all episodes; None where there is nothing to measure."""

    collision_with_robot_rate: float  # of the episodes
    collision_with_wall_rate: float  # of the episodes
    path_over_straight: float | None  # of successful episodes
    smallest_separation_px: float | None


@dataclass(frozen=True, slots=True)
class Navigation:
    """Measures of all episodes; None where there is nothing to measure.

    The straight line runs from the start to the centre of the robot's target at the end. Path and
    line lengths are summed before they are divided, because a robot may start on its target.
    """

    success_rate: float
    collision_with_robot_rate: float
    collision_with_wall_rate: float  # and with no robot
    timeout_rate: float
    frames_to_success_mean: float | None
    frames_to_success_p50: float | None
    frames_to_success_p90: float | None
    path_over_straight_mean: float | None  # paths over straight lines, summed over robots
    path_over_straight_p90: float | None
    smallest_separation_px: float | None  # gap between two rims
    smallest_separation_p50_px: float | None  # of the episodes' smallest
    robots: tuple[RobotNavigation, ...]


def journey(
    path: Float64Array,
    targets: Float64Array,
    hit_robot: BoolArray,
    hit_wall: BoolArray,
    radius_px: float,
) -> Journey:
    """Measure a path [T, K, 3] of x px, y px, heading, to targets [M, 2].

    hit_robot, hit_wall: what stopped each robot in the last frame, [K].
    """
    positions = path[..., :2]
    own = targets[shortest_assignment(Scene(path[-1], targets))]
    apart = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=3)
    np.einsum("tkk->tk", apart)[:] = np.inf
    return Journey(
        path_px=np.linalg.norm(np.diff(positions, axis=0), axis=2).sum(axis=0),
        straight_px=np.linalg.norm(own - positions[0], axis=1),
        separation_px=apart.min(axis=(0, 2)) - 2 * radius_px,
        hit_robot=hit_robot,
        hit_wall=hit_wall,
    )


def navigation(
    outcomes: Sequence[Outcome], frames: Sequence[int], journeys: Sequence[Journey]
) -> Navigation:
    """Aggregate episodes, given each one's outcome, number of frames and journey."""
    won = np.array([outcome is Outcome.SUCCESS for outcome in outcomes])
    failed = np.array([outcome is Outcome.COLLISION for outcome in outcomes])
    hit_robot = np.stack([j.hit_robot for j in journeys])
    hit_wall = np.stack([j.hit_wall for j in journeys])
    separations = np.stack([j.separation_px for j in journeys])
    paths = np.stack([j.path_px for j in journeys])[won]
    lines = np.stack([j.straight_px for j in journeys])[won]
    ratios = paths.sum(axis=1) / lines.sum(axis=1)
    lengths = np.array(frames, np.float64)[won]
    with_robot = failed & hit_robot.any(axis=1)
    return Navigation(
        success_rate=float(won.mean()),
        collision_with_robot_rate=float(with_robot.mean()),
        collision_with_wall_rate=float((failed & ~with_robot).mean()),
        timeout_rate=float((~won & ~failed).mean()),
        frames_to_success_mean=_mean(lengths),
        frames_to_success_p50=_percentile(lengths, 50),
        frames_to_success_p90=_percentile(lengths, 90),
        path_over_straight_mean=_mean(ratios),
        path_over_straight_p90=_percentile(ratios, 90),
        smallest_separation_px=_percentile(separations.min(axis=1), 0),
        smallest_separation_p50_px=_percentile(separations.min(axis=1), 50),
        robots=tuple(
            RobotNavigation(
                collision_with_robot_rate=float(hit_robot[:, k].mean()),
                collision_with_wall_rate=float(hit_wall[:, k].mean()),
                path_over_straight=float(paths[:, k].sum() / lines[:, k].sum())
                if won.any()
                else None,
                smallest_separation_px=_percentile(separations[:, k], 0),
            )
            for k in range(hit_robot.shape[1])
        ),
    )


def navigation_table(measures: Navigation) -> str:
    """Format the measures for a terminal."""
    robots = measures.robots
    head = "".join(f"{f'robot {k}':>10}" for k in range(len(robots)))
    return f"""\
  collision with a robot {measures.collision_with_robot_rate:7.2%}, \
with a wall alone {measures.collision_with_wall_rate:.2%}
  frames to success: mean {_shown(measures.frames_to_success_mean)}, \
p50 {_shown(measures.frames_to_success_p50)}, p90 {_shown(measures.frames_to_success_p90)}
  path length ÷ straight line: mean {_shown(measures.path_over_straight_mean, 2)}, \
p90 {_shown(measures.path_over_straight_p90, 2)}
  smallest gap between robots: {_shown(measures.smallest_separation_px, 1)} px, \
median of the episodes' {_shown(measures.smallest_separation_p50_px, 1)} px
  by robot               {head}
    collision with robot {"".join(f"{r.collision_with_robot_rate:10.2%}" for r in robots)}
    collision with wall  {"".join(f"{r.collision_with_wall_rate:10.2%}" for r in robots)}
    path ÷ straight line {"".join(f"{_shown(r.path_over_straight, 2):>10}" for r in robots)}
    smallest gap, px     {"".join(f"{_shown(r.smallest_separation_px, 1):>10}" for r in robots)}
"""


def _mean(values: Float64Array) -> float | None:
    return float(values.mean()) if len(values) else None


def _percentile(values: Float64Array, percent: float) -> float | None:
    """Percentile of the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else None


def _shown(value: float | None, digits: int = 0) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
