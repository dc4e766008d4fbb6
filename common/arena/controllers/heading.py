"""Helpers of the controllers: assignment of targets, and actions that turn towards a heading.

Invariants: pure functions; headings and turns as in mrcdrl.common.arena.world.scene.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import STRAIGHT, Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    BoolArray,
    Float64Array,
    Int64Array,
    UInt8Array,
)

Controller = Callable[[Scene], UInt8Array]
"""Chooses actions [K] for a scene; one controller plays one episode."""


def shortest_assignment(scene: Scene, power: float = 1.0) -> Int64Array:
    """Distinct targets [K] for the robots, with the least sum of distances ** power.

    Uses the Hungarian method. With power 2, a robot in another's way takes the farther target.
    """
    _, targets = linear_sum_assignment(target_distances_px(scene) ** power)
    return np.asarray(targets, np.int64)


def assigned_distances_px(scene: Scene, taking_part: BoolArray) -> Float64Array:
    """Distances [N, K] of robots to distinct targets, in each of N arenas with the least sum.

    taking_part: [N, K]; the others leave all targets to these, and their distance is 0. Nobody
    gets a target whose place is NaN.
    """
    distances = np.nan_to_num(target_distances_px(scene), nan=np.inf)
    distances[~taking_part] = 0.0
    return np.array([each[linear_sum_assignment(each)] for each in distances])


def first_assigned(costs: Float64Array) -> int:
    """The target that the least sum of costs [K, M] assigns to the first robot; NaN: absent.

    The cheapest one where there are too few targets; 0 where there is none, or no first robot.
    """
    known = np.isfinite(costs)
    if not known[0].any():
        return 0
    robots, targets = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known[0])
    those = np.nan_to_num(costs[np.ix_(robots, targets)], posinf=np.finfo(np.float64).max)
    rows, columns = linear_sum_assignment(those)
    own = columns[rows == 0]
    return int(targets[own[0] if own.size else those[0].argmin()])


def remaining_rad(
    headings: Float64Array, wanted: Float64Array, config: ArenaConfig
) -> Float64Array:
    """Angles [K, 3] left to the wanted headings [K] after each action's turn."""
    turns = (np.arange(NUM_ACTIONS) - STRAIGHT) * np.radians(config.turn_deg)
    remaining: Float64Array = np.abs(wrapped_rad(wanted[:, None] - headings[:, None] - turns))
    return remaining


def actions_towards(
    headings: Float64Array, wanted: Float64Array, config: ArenaConfig
) -> UInt8Array:
    """Actions [K] that turn headings [K] closest to the wanted ones [K]."""
    actions: UInt8Array = remaining_rad(headings, wanted, config).argmin(axis=1).astype(np.uint8)
    return actions


def wrapped_rad(angles: Float64Array) -> Float64Array:
    """Wraps angles to -pi ... pi."""
    wrapped: Float64Array = np.angle(np.exp(1j * angles))
    return wrapped


def bearings_rad(vectors: Float64Array) -> Float64Array:
    """Headings [...] of vectors [..., 2]."""
    return np.arctan2(vectors[..., 1], vectors[..., 0])


def directions(headings: Float64Array) -> Float64Array:
    """Unit vectors [..., 2] of headings [...]."""
    return np.stack([np.cos(headings), np.sin(headings)], axis=-1)
