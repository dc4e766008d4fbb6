"""Layouts of targets and obstacles, and the symmetries that leave a layout unchanged.

Invariants: in every layout each target is within reach of a place where a robot can stand, and no
two targets are too close for two robots to stand on them at the same time.
"""

from functools import cache
from itertools import product

import numpy as np

from mrcdrl.common.arena.world.obstacles import (
    STANDING_PX,
    clearance_px,
    given_obstacles,
    inner_walls,
    obstacles_for,
    reachable_px,
    scatter,
)
from mrcdrl.common.arena.world.scene import Layout
from mrcdrl.common.arena.world.symmetry import IDENTITY, SYMMETRIES, Symmetry
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float64Array

_LAYOUT_SIZE_PX = 600
_TRIES = 2000  # each draws all targets at once

_FIXED: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((300, 300),),
    2: ((175, 300), (425, 300)),
    3: ((300, 175), (175, 425), (425, 425)),
    4: ((175, 175), (425, 175), (175, 425), (425, 425)),
    5: ((150, 150), (450, 150), (300, 300), (150, 450), (450, 450)),
    6: tuple((x, y) for y in (200, 400) for x in (120, 300, 480)),
    7: ((210, 140), (390, 140), (120, 300), (300, 300), (480, 300), (210, 460), (390, 460)),
    8: tuple((x, y) for y, x in product((120, 300, 480), repeat=2) if (x, y) != (300, 300)),
    9: tuple((x, y) for y, x in product((120, 300, 480), repeat=2)),
    10: (
        *((x, 140) for x in (150, 300, 450)),
        *((x, 300) for x in (75, 225, 375, 525)),
        *((x, 460) for x in (150, 300, 450)),
    ),
}


def fixed_layout(num_targets: int) -> Float64Array:
    """Target centres [M, 2] px of the built-in layout in an arena of 600 px.

    Raises ConfigError if there is no layout for this number.
    """
    if num_targets not in _FIXED:
        raise ConfigError(
            f"no fixed layout for {num_targets} targets, only for 1 to 10; set targets_px or "
            'target_layout = "random"'
        )
    return np.array(_FIXED[num_targets], np.float64)


def layout_for(config: ArenaConfig, rng: np.random.Generator) -> Layout:
    """Targets and obstacles of the next episode, fixed or drawn with rng.

    Raises ConfigError if they do not fit, naming those that do not.
    """
    if config.target_layout == "random":
        obstacles = obstacles_for(config, np.empty((0, 2)), rng)
        return Layout(_random_targets(config, obstacles, rng), obstacles)
    targets = _given_targets(config)
    return Layout(targets.copy(), obstacles_for(config, targets, rng))


@cache
def _given_targets(config: ArenaConfig) -> Float64Array:
    if config.targets_px:
        targets = np.array(config.targets_px, np.float64)
    else:
        targets = fixed_layout(config.target_count) * (config.size_px / _LAYOUT_SIZE_PX)
    _check_solvable(config, targets)
    return targets


def layout_symmetries(config: ArenaConfig) -> tuple[Symmetry, ...]:
    """Symmetries of the square under which an agent's experience stays valid.

    Unrotated images: those that map all fixed targets, obstacles and inner walls onto themselves,
    for each number of robots; all 8 if nothing is fixed. Heading-up images do not change when the
    arena is rotated, and a reflection mirrors them left to right: so the identity, and the mirror
    if a reflection maps the layout onto itself. A custom world's layout is not known: the identity.
    """
    if config.is_custom:
        return (IDENTITY,)
    each = [config.with_robots(number) for number in config.numbers]
    kept = tuple(s for s in SYMMETRIES if all(_maps_onto_itself(s, one) for one in each))
    if config.orientation == "unrotated":
        return kept
    mirror = Symmetry(transpose=False, flip_x=True, flip_y=False)
    return (IDENTITY, mirror) if any(s.mirrors for s in kept) else (IDENTITY,)


def _random_targets(
    config: ArenaConfig, obstacles: Float64Array, rng: np.random.Generator
) -> Float64Array:
    low, high = reachable_px(config)
    low, high = low + STANDING_PX, high - STANDING_PX
    apart = 2 * config.robot_radius_px + 2 * config.success_radius_px
    if config.target_count > config.num_robots or len(obstacles) or config.inner_walls_px:
        targets = scatter(
            config.target_count,
            (low, high),
            apart,
            lambda places: clearance_px(config, places, obstacles) >= STANDING_PX,
            rng,
        )
        if targets is not None:
            return targets
    else:  # the original rule, so that a seed still gives the same episodes
        for _ in range(_TRIES if high >= low else 0):
            targets = rng.uniform(low, high, (config.num_robots, 2))
            if _nearest_pair_px(targets) >= apart:
                return targets
    raise ConfigError(
        f"{config.target_count} random targets {apart:g} px apart do not fit in an arena of "
        f"{config.size_px} px; fewer targets or obstacles, or a larger arena"
    )


def _check_solvable(config: ArenaConfig, targets: Float64Array) -> None:
    low, high = reachable_px(config)
    distances = np.hypot(*(targets - np.clip(targets, low, high)).T)
    if (distances >= config.success_radius_px).any():
        x, y = targets[int(distances.argmax())]
        raise ConfigError(
            f"target ({x:g}, {y:g}) cannot be reached: robots' centres stay between {low:g} and "
            f"{high:g} px, success needs {config.success_radius_px:g} px"
        )
    clearances = clearance_px(config, targets, given_obstacles(config))
    if (clearances < 0).any():
        x, y = targets[int(clearances.argmin())]
        raise ConfigError(
            f"target ({x:g}, {y:g}) cannot be reached: a robot on it would overlap an obstacle or "
            "an inner wall; move the target or the obstacle"
        )
    nearest = _nearest_pair_px(targets)
    if nearest + 2 * config.success_radius_px <= 2 * config.robot_radius_px:
        raise ConfigError(
            f"targets {nearest:g} px apart: two robots of radius {config.robot_radius_px:g} px "
            f"cannot both be within {config.success_radius_px:g} px of them"
        )


def _nearest_pair_px(targets: Float64Array) -> float:
    first, second = np.triu_indices(len(targets), 1)
    if not len(first):
        return float("inf")
    return float(np.hypot(*(targets[first] - targets[second]).T).min())


def _maps_onto_itself(symmetry: Symmetry, config: ArenaConfig) -> bool:
    """Whether the symmetry leaves everything fixed unchanged."""

    def mapped(points: Float64Array) -> Float64Array:
        return symmetry.apply_to_points(points, config.size_px)

    obstacles, walls = given_obstacles(config), inner_walls(config)
    ends, others = mapped(walls[:, :2]), mapped(walls[:, 2:4])
    fixed = [
        (obstacles, np.concatenate([mapped(obstacles[:, :2]), obstacles[:, 2:]], axis=1)),
        (_both_ways(walls[:, :2], walls[:, 2:4]), _both_ways(ends, others)),
    ]
    if config.target_layout == "fixed":
        targets = _given_targets(config)
        fixed.append((targets, mapped(targets)))
    return all(_same_rows(rows, mapped_rows) for rows, mapped_rows in fixed)


def _both_ways(ends: Float64Array, others: Float64Array) -> Float64Array:
    """Lines [2 S, 4], each in both directions."""
    forwards, backwards = np.concatenate([ends, others], 1), np.concatenate([others, ends], 1)
    return np.concatenate([forwards, backwards])


def _same_rows(rows: Float64Array, others: Float64Array) -> bool:
    gaps = np.abs(others[:, None] - rows[None]).max(axis=2)
    return bool((gaps.min(axis=1, initial=np.inf) < 1e-6).all())
