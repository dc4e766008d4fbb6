"""Rewards of a frame (paper section 3), for many arenas at once.

Invariants: pure functions of the scene after the frame; the robots succeed together or not at all.
"""

import math

import numpy as np

from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float32Array, Float64Array, Int64Array
from mrcdrl.common.runtime.compiled import compiled


def frame_rewards(
    scene: Scene, collided: BoolArray, failed: BoolArray, frames: Int64Array, config: ArenaConfig
) -> tuple[Float32Array, BoolArray]:
    """Rewards [N, K] of a frame of N arenas, and the mask [N] of those that succeed.

    scene: all the arenas [N, ...], after the frame's moves. collided, failed: [N, K]. frames: the
    paper's f [N], 1 after the first move. A robot that collided gets collision_reward wherever it
    is; one that failed is rewarded like any other, and success does not wait for it. One that is
    absent, with a pose of NaN, gets 0; it must count as failed.
    """
    rewards = np.empty(collided.shape, np.float32)
    success = np.empty(len(collided), np.bool_)
    _reward_all(
        scene.robots,
        scene.targets,
        collided,
        failed,
        frames,
        config.success_radius_px,
        on_target_px(config),
        config.proximity_weight,
        config.f_max,
        (config.success_reward, config.collision_reward, config.step_reward),
        rewards,
        success,
    )
    return rewards, success


def target_distances_px(scene: Scene) -> Float64Array:
    """Distances [..., K, M] from the robots' centres to the targets' (the paper's chi)."""
    gaps = scene.robots[..., :, None, :2] - scene.targets[..., None, :, :]
    distances: Float64Array = np.sqrt((gaps * gaps).sum(axis=-1))
    return distances


def drawn_to_occupied(scene: Scene) -> BoolArray:
    """Whether another robot is nearer to the target that is nearest to each robot, [..., K].

    scene: arenas [...], with K robots each. A robot that is absent, with a pose of NaN, is drawn to
    none and occupies none.
    """
    distances = np.nan_to_num(target_distances_px(scene), nan=np.inf)
    own = distances.min(axis=-1)
    nearest_robot = distances.min(axis=-2)  # of each target, [..., M]
    target = distances.argmin(axis=-1)
    occupied: BoolArray = (np.take_along_axis(nearest_robot, target, -1) < own) & np.isfinite(own)
    return occupied


def on_target_px(config: ArenaConfig) -> float:
    """Distance below which a robot is "on" a target: sqrt(s_w^2 + s_h^2 + c_r), as printed."""
    return math.sqrt(2 * config.target_size_px**2 + config.robot_radius_px)


@compiled
def _reward_all(  # type: ignore[no-untyped-def]
    robots,
    targets,
    collided,
    failed,
    frames,
    delta,
    reach,
    proximity,
    f_max,
    reward_values,
    rewards,
    success,
):
    success_reward, collision_reward, step_reward = reward_values
    num_robots, num_targets = robots.shape[1], targets.shape[1]
    distances = np.empty((num_robots, num_targets), np.float64)
    nearest = np.empty(num_robots, np.float64)
    for n in range(len(robots)):
        for i in range(num_robots):
            nearest[i] = np.inf
            for j in range(num_targets):
                across = robots[n, i, 0] - targets[n, j, 0]
                along = robots[n, i, 1] - targets[n, j, 1]
                distances[i, j] = math.sqrt(across * across + along * along)
                if distances[i, j] < nearest[i]:  # not that of an absent target
                    nearest[i] = distances[i, j]
        success[n] = not collided[n].any() and _all_on_distinct_targets(
            distances, nearest, delta, failed[n]
        )
        frames_left = 1 - min(frames[n], f_max) / f_max
        for i in range(num_robots):
            if math.isnan(robots[n, i, 0]):
                rewards[n, i] = 0.0
            elif success[n]:
                rewards[n, i] = success_reward
            elif collided[n, i]:
                rewards[n, i] = collision_reward
            elif nearest[i] < reach:
                closeness = 1 - nearest[i] / reach
                rewards[n, i] = closeness * proximity + frames_left * (1 - proximity)
            else:
                rewards[n, i] = step_reward


@compiled
def _all_on_distinct_targets(distances, nearest, delta, failed):  # type: ignore[no-untyped-def]
    """Whether every working robot [K] can be given its own target [M] nearer than delta."""
    num_robots, num_targets = distances.shape
    for robot in range(num_robots):
        if not failed[robot] and nearest[robot] >= delta:
            return False
    owners = np.full(num_targets, -1, np.int64)
    tried = np.empty(num_targets, np.bool_)
    for robot in range(num_robots):
        tried[:] = False
        if not failed[robot] and not _assign(robot, distances, delta, owners, tried):
            return False
    return True


@compiled
def _assign(robot, distances, delta, owners, tried):  # type: ignore[no-untyped-def]
    """Gives the robot a target, reassigning owners if that helps (an augmenting path)."""
    for target in range(len(owners)):
        if distances[robot, target] < delta and not tried[target]:
            tried[target] = True
            if owners[target] < 0 or _assign(owners[target], distances, delta, owners, tried):
                owners[target] = robot
                return True
    return False
