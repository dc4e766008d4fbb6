"""Fixed obstacles: outer walls, inner walls and discs.

Invariants: obstacles are discs [O, 3] of x, y, radius; walls are lines with a width [S, 5]: x, y of
both ends and half the width; all in px. A robot has room to pass between a random obstacle and
everything else that is fixed, so that random obstacles cut off no part of the arena.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array

_CANDIDATES = 64  # positions drawn at once for one obstacle or target
_RESTARTS = 200  # after which obstacles or targets that do not fit are given up
_PASSAGE_PX = 10.0  # margin for a robot that passes between obstacles
STANDING_PX = 5.0  # margin for a robot on a random target


def reachable_px(config: ArenaConfig) -> tuple[float, float]:
    """Least and greatest coordinate that a robot's centre can have."""
    low = config.wall_offset_px + config.wall_thickness_px + config.robot_radius_px
    return low, config.size_px - low


def outer_walls(config: ArenaConfig) -> Float64Array:
    """The four outer walls [4, 5].

    They extend two steps outwards from their inner face, so that no step can cross one.
    """
    half = config.step_px
    inner = config.wall_offset_px + config.wall_thickness_px
    low, high = inner - half, config.size_px - inner + half
    corners = [(low, low), (high, low), (high, high), (low, high)]
    lines = zip(corners, corners[1:] + corners[:1], strict=True)
    return np.array([(*start, *end, half) for start, end in lines])


@cache
def inner_walls(config: ArenaConfig) -> Float64Array:
    """The configuration's inner walls [S, 5]; read-only."""
    half = config.wall_thickness_px / 2
    return np.array([(*wall, half) for wall in config.inner_walls_px]).reshape(-1, 5)


@cache
def given_obstacles(config: ArenaConfig) -> Float64Array:
    """The configuration's obstacles [G, 3]; read-only."""
    return np.array(config.obstacles_px, np.float64).reshape(-1, 3)


def obstacles_for(
    config: ArenaConfig, targets: Float64Array, rng: np.random.Generator
) -> Float64Array:
    """Obstacles [O, 3] of the next episode: the configured ones, then those drawn with rng.

    targets: [M, 2], on which robots must still be able to stand. Raises ConfigError if the
    obstacles do not fit.
    """
    given = given_obstacles(config)
    if not config.num_obstacles:
        return given.copy()
    radius = config.obstacle_radius_px
    passage = 2 * config.robot_radius_px + _PASSAGE_PX
    low, high = reachable_px(config)
    beyond = radius + passage - config.robot_radius_px

    def clear(places: Float64Array) -> BoolArray:
        from_targets = np.linalg.norm(places[:, None] - targets, axis=2)
        near = from_targets < radius + config.robot_radius_px + STANDING_PX
        free: BoolArray = (clearance_px(config, places, given) >= beyond) & ~near.any(axis=1)
        return free

    drawn = scatter(
        config.num_obstacles, (low + beyond, high - beyond), 2 * radius + passage, clear, rng
    )
    if drawn is None:
        raise ConfigError(
            f"{config.num_obstacles} random obstacles of radius {radius:g} px do not fit in an "
            f"arena of {config.size_px} px with robots passing between them; fewer or smaller "
            "obstacles, or a larger arena"
        )
    return np.concatenate([given, np.insert(drawn, 2, radius, axis=1)])


def clearance_px(
    config: ArenaConfig, places: Float64Array, obstacles: Float64Array
) -> Float64Array:
    """Gap [...] between a robot's rim at places [..., 2] and the nearest obstacle or inner wall.

    Negative if they overlap, infinite if there are none.
    """
    offsets, widths = offsets_from(config, places, obstacles)
    gaps = np.linalg.norm(offsets, axis=-1) - widths - config.robot_radius_px
    return np.asarray(gaps.min(axis=-1, initial=np.inf), np.float64)


def offsets_from(
    config: ArenaConfig, places: Float64Array, obstacles: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Offsets [..., O + S, 2] of places [..., 2] from each obstacle's centre and inner wall's axis.

    Also returns the half-widths [O + S] of the obstacles and walls.
    """
    walls = inner_walls(config)
    starts, lines = walls[:, :2], walls[:, 2:4] - walls[:, :2]
    from_starts = places[..., None, :] - starts
    fractions = (from_starts * lines).sum(axis=-1) / (lines * lines).sum(axis=-1)
    from_walls = from_starts - np.clip(fractions, 0, 1)[..., None] * lines
    from_obstacles = places[..., None, :] - obstacles[:, :2]
    offsets = np.concatenate([from_obstacles, from_walls], axis=-2)
    return offsets, np.concatenate([obstacles[:, 2], walls[:, 4]])


def scatter(
    num: int,
    bounds: tuple[float, float],
    apart: float,
    clear: Callable[[Float64Array], BoolArray],
    rng: np.random.Generator,
) -> Float64Array | None:
    """Draws clear places [num, 2] one by one, each at least `apart` from all before.

    Returns None if there is no room.
    """
    low, high = bounds
    for _ in range(_RESTARTS if high >= low else 0):
        places = np.empty((0, 2))
        while len(places) < num:
            candidates = rng.uniform(low, high, (_CANDIDATES, 2))
            gaps = np.linalg.norm(candidates[:, None] - places, axis=2)
            free = (gaps >= apart).all(axis=1) & clear(candidates)
            if not free.any():
                break
            places = np.concatenate([places, candidates[None, free.argmax()]])
        else:
            return places
    return None
