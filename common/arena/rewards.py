"""What a frame is worth to each robot (paper section 3).

Invariants: pure functions of the scene after the frame; success is all robots' or none's.
"""

import math

import numpy as np

from common.arena.scene import Scene
from common.config import ArenaConfig
from common.trajectory import BoolArray, Float32Array, Float64Array


def frame_rewards(
    scene: Scene, collided: BoolArray, frame: int, config: ArenaConfig
) -> tuple[Float32Array, bool]:
    """Rewards [K] of a frame, and whether it is success.

    scene: after the frame's moves. collided: [K]. frame: f of the paper, 1 after the first move.
    A robot that collided gets collision_reward, wherever it stands.
    """
    distances = target_distances_px(scene)
    if not collided.any() and _each_has_its_own(distances < config.success_radius_px):
        return np.full(len(collided), config.success_reward, np.float32), True
    nearest = distances.min(axis=1)
    reach = on_target_px(config)
    proximity = config.proximity_weight
    frames_left = 1 - min(frame, config.f_max) / config.f_max
    on_target = (1 - nearest / reach) * proximity + frames_left * (1 - proximity)
    rewards = np.where(nearest < reach, on_target, config.step_reward)
    return np.where(collided, config.collision_reward, rewards).astype(np.float32), False


def target_distances_px(scene: Scene) -> Float64Array:
    """chi: distances [K, M] of the robots' centres from the targets'."""
    gaps = scene.robots[:, None, :2] - scene.targets[None]
    distances: Float64Array = np.sqrt((gaps * gaps).sum(axis=2))
    return distances


def on_target_px(config: ArenaConfig) -> float:
    """sqrt(s_w^2 + s_h^2 + c_r) as printed: nearer than this is "on" a target."""
    return math.sqrt(2 * config.target_size_px**2 + config.robot_radius_px)


def _each_has_its_own(within: BoolArray) -> bool:
    """Whether every robot [K] has a target [M] within reach that no other needs."""
    if not within.any(axis=1).all() or within.any(axis=0).sum() < len(within):
        return False
    owners: dict[int, int] = {}

    def seat(robot: int, tried: set[int]) -> bool:
        """Gives the robot a target, moving owners on where that helps (an augmenting path)."""
        for target in np.flatnonzero(within[robot]).tolist():
            if target not in tried:
                tried.add(target)
                if target not in owners or seat(owners[target], tried):
                    owners[target] = robot
                    return True
        return False

    return all(seat(robot, set()) for robot in range(len(within)))
