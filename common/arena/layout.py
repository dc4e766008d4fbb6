"""Where the targets stand, and which symmetries of the square leave them where they are.

Invariants: every layout that leaves here can be solved: each target is near enough to a place a
robot can reach, and no two are so near that two robots cannot stand on them together.
"""

from functools import cache
from itertools import product

import numpy as np

from common.arena.symmetry import IDENTITY, Symmetry
from common.config import ArenaConfig
from common.errors import ConfigError
from common.trajectory import Float64Array

_LAYOUT_SIZE_PX = 600
_TRIES = 2000  # of all targets at once
_CANDIDATES = 64  # places drawn at once for one target
_RESTARTS = 200  # of targets drawn one after the other
_WALL_MARGIN_PX = 5.0

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


def layout_for(config: ArenaConfig, rng: np.random.Generator) -> Float64Array:
    """Target centres [M, 2] px for the next episode: the fixed ones, or drawn with rng.

    Raises ConfigError when no such layout fits, naming what does not.
    """
    if config.target_layout == "random":
        return _random_layout(config, rng)
    return _given_layout(config).copy()


@cache
def _given_layout(config: ArenaConfig) -> Float64Array:
    if config.targets_px:
        targets = np.array(config.targets_px, np.float64)
    else:
        targets = fixed_layout(config.target_count) * (config.size_px / _LAYOUT_SIZE_PX)
    _check_solvable(config, targets)
    return targets


def layout_symmetries(config: ArenaConfig) -> tuple[Symmetry, ...]:
    """The symmetries of the square under which an agent's experience stays true.

    Unrotated pictures: those that map the target layout onto itself, all 8 if targets are
    random. Heading-up pictures: a rotation of the arena changes nothing in them, a reflection
    mirrors them left to right; so the identity, and the mirror if a reflection maps the layout
    onto itself.
    """
    every = tuple(Symmetry(*flags) for flags in product((False, True), repeat=3))
    if config.target_layout == "random":
        kept = every
    else:
        targets = layout_for(config, np.random.default_rng(0))
        kept = tuple(s for s in every if _maps_onto_itself(s, targets, config.size_px))
    if config.orientation == "unrotated":
        return kept
    mirror = Symmetry(transpose=False, flip_x=True, flip_y=False)
    return (IDENTITY, mirror) if any(s.mirrors for s in kept) else (IDENTITY,)


def reachable_px(config: ArenaConfig) -> tuple[float, float]:
    """Least and greatest coordinate at which a robot's centre can be."""
    low = config.wall_offset_px + config.wall_thickness_px + config.robot_radius_px
    return low, config.size_px - low


def wall_segments(config: ArenaConfig) -> Float64Array:
    """The walls as lines with a width [4, 5]: x, y of both ends, half the width, px.

    From the inner face outwards they are two steps wide, so that no step leads over one.
    """
    half = config.step_px
    inner = config.wall_offset_px + config.wall_thickness_px
    low, high = inner - half, config.size_px - inner + half
    corners = [(low, low), (high, low), (high, high), (low, high)]
    lines = zip(corners, corners[1:] + corners[:1], strict=True)
    return np.array([(*start, *end, half) for start, end in lines])


def _random_layout(config: ArenaConfig, rng: np.random.Generator) -> Float64Array:
    low, high = reachable_px(config)
    low, high = low + _WALL_MARGIN_PX, high - _WALL_MARGIN_PX
    apart = 2 * config.robot_radius_px + 2 * config.success_radius_px
    if config.target_count == config.num_robots:
        for _ in range(_TRIES if high >= low else 0):
            targets = rng.uniform(low, high, (config.num_robots, 2))
            if _nearest_pair_px(targets) >= apart:
                return targets
    else:
        scattered = _scattered(config.target_count, low, high, apart, rng)
        if scattered is not None:
            return scattered
    raise ConfigError(
        f"{config.target_count} random targets {apart:g} px apart do not fit in an arena of "
        f"{config.size_px} px; fewer targets or a larger arena"
    )


def _scattered(
    num: int, low: float, high: float, apart: float, rng: np.random.Generator
) -> Float64Array | None:
    """Places [num, 2] drawn one after the other, each `apart` from all before; None: no room."""
    for _ in range(_RESTARTS if high >= low else 0):
        places = np.empty((0, 2))
        while len(places) < num:
            candidates = rng.uniform(low, high, (_CANDIDATES, 2))
            gaps = np.hypot(*(candidates[:, None] - places[None]).transpose(2, 0, 1))
            free = (gaps >= apart).all(axis=1)
            if not free.any():
                break
            places = np.concatenate([places, candidates[None, free.argmax()]])
        else:
            return places
    return None


def _check_solvable(config: ArenaConfig, targets: Float64Array) -> None:
    low, high = reachable_px(config)
    way = np.hypot(*(targets - np.clip(targets, low, high)).T)
    if (way >= config.success_radius_px).any():
        x, y = targets[int(way.argmax())]
        raise ConfigError(
            f"target ({x:g}, {y:g}) cannot be reached: robots' centres stay between {low:g} and "
            f"{high:g} px, success needs {config.success_radius_px:g} px"
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


def _maps_onto_itself(symmetry: Symmetry, targets: Float64Array, size_px: float) -> bool:
    image = symmetry.apply_to_points(targets, size_px)
    gaps = np.abs(image[:, None] - targets[None]).max(axis=2)
    return bool((gaps.min(axis=1) < 1e-6).all())
