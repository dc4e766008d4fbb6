"""Robots' starting poses: random in training, by the paper's rule in the test (section 5.3).

Invariants: in a start no robot overlaps another or a wall; the same configuration and seed give
the same starts in every process.
"""

import math

import numpy as np

from mrcdrl.common.arena.world.layout import layout_for
from mrcdrl.common.arena.world.obstacles import clearance_px, reachable_px
from mrcdrl.common.arena.world.scene import Layout, Start
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array

_CANDIDATES = 32  # poses drawn at once per robot
MOST_SEEDS = 2**31  # of a custom world
_RESTARTS = 200  # after which a placement that got stuck is given up


def training_start(config: ArenaConfig, layout: Layout, rng: np.random.Generator) -> Start:
    """Draws a start with random poses in the layout.

    Raises ConfigError if the robots do not fit.
    """
    poses = _place(config, layout.obstacles, rng, num_turns=0)
    return Start(poses, layout.targets, layout.obstacles)


def test_starts(config: ArenaConfig, num: int, seed: int) -> tuple[Start, ...]:
    """Draws starts of the paper's test: no collision at the start or within one rotation.

    In a rotation all robots turn left every frame until each has completed a circle. Random targets
    are drawn from the seed too. Of a custom world a start is a seed. Raises ConfigError if the
    robots do not fit.
    """
    rng = np.random.default_rng(seed)
    if config.is_custom:
        robots, targets = np.zeros((config.num_robots, 3)), np.zeros((config.num_robots, 2))
        seeds = rng.integers(MOST_SEEDS, size=num).tolist()
        return tuple(Start(robots, targets, seed=each) for each in seeds)
    num_turns = math.ceil(360 / config.turn_deg)
    starts = []
    for _ in range(num):
        layout = layout_for(config, rng)
        poses = _place(config, layout.obstacles, rng, num_turns)
        starts.append(Start(poses, layout.targets, layout.obstacles))
    return tuple(starts)


def _place(
    config: ArenaConfig, obstacles: Float64Array, rng: np.random.Generator, num_turns: int
) -> Float64Array:
    """Draws poses [K, 3] that stay clear while all robots turn left for num_turns frames."""
    for _ in range(_RESTARTS):
        poses = np.empty((config.num_robots, 3))
        paths = np.empty((config.num_robots, num_turns + 1, 2))
        for i in range(config.num_robots):
            candidates = _random_poses(config, rng)
            circles = _circle_paths(config, candidates, num_turns)
            clear = _clear(config, circles, paths[:i], obstacles)
            if not clear.any():
                break
            chosen = int(clear.argmax())
            poses[i], paths[i] = candidates[chosen], circles[chosen]
        else:
            return poses
    raise ConfigError(
        f"{config.num_robots} robots of radius {config.robot_radius_px:g} px do not fit in an "
        f"arena of {config.size_px} px; fewer robots or obstacles, or a larger arena"
    )


def _random_poses(config: ArenaConfig, rng: np.random.Generator) -> Float64Array:
    """Draws candidate poses [C, 3]."""
    low, high = reachable_px(config)
    least = np.array([low, low, -np.pi])
    span = np.array([high, high, np.pi]) - least
    return np.asarray(least + span * rng.random((_CANDIDATES, 3)), np.float64)


def _circle_paths(config: ArenaConfig, poses: Float64Array, num_turns: int) -> Float64Array:
    """Paths [C, num_turns + 1, 2] of robots that turn left every frame from poses [C, 3]."""
    if not num_turns:
        return poses[:, None, :2]
    turns = np.arange(1, num_turns + 1) * math.radians(config.turn_deg)
    headings = poses[:, 2:] - turns
    steps = config.step_px * np.stack([np.cos(headings), np.sin(headings)], axis=2)
    start = poses[:, None, :2]
    return np.concatenate([start, start + steps.cumsum(axis=1)], axis=1)


def _clear(
    config: ArenaConfig, paths: Float64Array, placed: Float64Array, obstacles: Float64Array
) -> BoolArray:
    """Mask [C] of paths [C, T, 2] that keep off walls, obstacles and the placed [P, T, 2]."""
    low, high = reachable_px(config)
    inside = ((paths >= low) & (paths <= high)).all(axis=(1, 2))
    if len(obstacles) or config.inner_walls_px:
        inside &= (clearance_px(config, paths, obstacles) >= 0).all(axis=1)
    gaps = paths[:, None] - placed[None]
    apart = (gaps * gaps).sum(axis=3) >= (2 * config.robot_radius_px) ** 2
    clear: BoolArray = np.logical_and(inside, apart.all(axis=(1, 2)))
    return clear
