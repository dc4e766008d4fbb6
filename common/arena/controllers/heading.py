"""What controllers share: who goes where, and which action turns a robot to a wanted heading.

Invariants: pure; headings and turns as in common.arena.scene.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.arena.world.scene import STRAIGHT, Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float64Array, Int64Array, UInt8Array

Controller = Callable[[Scene], UInt8Array]
"""Actions [K] for a scene; one controller plays one episode."""


def shortest_assignment(scene: Scene, power: float = 1.0) -> Int64Array:
    """A target [K] of its own for each robot, so that the sum of distances ** power is least.

    The Hungarian method. With power 2 a robot that stands in another's way takes the farther
    target.
    """
    _, targets = linear_sum_assignment(target_distances_px(scene) ** power)
    return np.asarray(targets, np.int64)


def left_over_rad(
    headings: Float64Array, wanted: Float64Array, config: ArenaConfig
) -> Float64Array:
    """Angles [K, 3] that remain to the wanted headings [K] after each action's turn."""
    turns = (np.arange(NUM_ACTIONS) - STRAIGHT) * np.radians(config.turn_deg)
    remaining: Float64Array = np.abs(wrapped_rad(wanted[:, None] - headings[:, None] - turns))
    return remaining


def actions_towards(
    headings: Float64Array, wanted: Float64Array, config: ArenaConfig
) -> UInt8Array:
    """Actions [K] that turn headings [K] nearest to the wanted ones [K]."""
    actions: UInt8Array = left_over_rad(headings, wanted, config).argmin(axis=1).astype(np.uint8)
    return actions


def wrapped_rad(angles: Float64Array) -> Float64Array:
    """Angles brought to -pi ... pi."""
    wrapped: Float64Array = np.angle(np.exp(1j * angles))
    return wrapped


def bearings_rad(vectors: Float64Array) -> Float64Array:
    """Headings [...] of vectors [..., 2]."""
    return np.arctan2(vectors[..., 1], vectors[..., 0])


def directions(headings: Float64Array) -> Float64Array:
    """Unit vectors [..., 2] of headings [...]."""
    return np.stack([np.cos(headings), np.sin(headings)], axis=-1)
