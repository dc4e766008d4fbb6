"""Where the targets stand, and which symmetries of the square leave the layout as it is.

Invariants: in every layout that leaves here each target is near enough to a place where a robot
can be, and no two are so near that two robots cannot stand on them together.
"""

from functools import cache
from itertools import product

import numpy as np

from mrcdrl.common.arena.world.obstacles import (
    STANDING_PX,
    given_obstacles,
    inner_walls,
    obstacles_for,
    reachable_px,
    room_px,
    scattered,
)
from mrcdrl.common.arena.world.scene import Layout
from mrcdrl.common.arena.world.symmetry import IDENTITY, SYMMETRIES, Symmetry
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float64Array

_LAYOUT_SIZE_PX = 600
_TRIES = 2000  # of all targets at once

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

    Raises ConfigError for a number without a layout.
    """
    if num_targets not in _FIXED:
        raise ConfigError(
            f"no fixed layout for {num_targets} targets; there is one for 1 to 10: give targets_px "
            'or target_layout = "random"'
        )
    return np.array(_FIXED[num_targets], np.float64)


def layout_for(config: ArenaConfig, rng: np.random.Generator) -> Layout:
    """Targets and obstacles of the next episode: the fixed ones, or drawn with rng.

    Raises ConfigError when no such layout fits, naming what does not.
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
    """The symmetries of the square under which an agent's experience stays true.

    Unrotated images: those that map onto itself whatever is not random: targets, obstacles and
    inner walls; all 8 if nothing is fixed. Heading-up images: a rotation of the arena changes
    nothing in them, a reflection mirrors them left to right; so the identity, and the mirror if a
    reflection maps the layout onto itself.
    """
    kept = tuple(symmetry for symmetry in SYMMETRIES if _maps_onto_itself(symmetry, config))
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
        targets = scattered(
            config.target_count,
            (low, high),
            apart,
            lambda places: room_px(config, places, obstacles) >= STANDING_PX,
            rng,
        )
        if targets is not None:
            return targets
    else:  # as ever, so that a seed's episodes stay what they were
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
    way = np.hypot(*(targets - np.clip(targets, low, high)).T)
    if (way >= config.success_radius_px).any():
        x, y = targets[int(way.argmax())]
        raise ConfigError(
            f"target ({x:g}, {y:g}) cannot be reached: robots' centres stay between {low:g} and "
            f"{high:g} px, success needs {config.success_radius_px:g} px"
        )
    room = room_px(config, targets, given_obstacles(config))
    if (room < 0).any():
        x, y = targets[int(room.argmin())]
        raise ConfigError(
            f"target ({x:g}, {y:g}) cannot be reached: a robot on it would overlap an obstacle or "
            "an inner wall; move the one or the other"
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
    """Whether all that is not random stays where it is."""

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
    return all(_same_rows(rows, images) for rows, images in fixed)


def _both_ways(ends: Float64Array, others: Float64Array) -> Float64Array:
    """Lines [2 S, 4], each from either end."""
    there, back = np.concatenate([ends, others], 1), np.concatenate([others, ends], 1)
    return np.concatenate([there, back])


def _same_rows(rows: Float64Array, images: Float64Array) -> bool:
    gaps = np.abs(images[:, None] - rows[None]).max(axis=2)
    return bool((gaps.min(axis=1, initial=np.inf) < 1e-6).all())
