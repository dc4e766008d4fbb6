"""The state of the world at one frame, and the actions.

Invariants: coordinates are continuous pixels of the arena, x to the right and y down as in images;
pixel i covers [i, i + 1). A heading of 0 points along +x; headings grow clockwise to the viewer,
because y points down.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float64Array, UInt8Array

LEFT = 0
"""Turns by `turn_deg`, anticlockwise to the viewer, then moves forward."""
STRAIGHT = 1
"""Keeps its heading and moves forward."""
RIGHT = 2
"""Turns by `turn_deg`, clockwise to the viewer, then moves forward."""


def _none() -> Float64Array:
    return np.empty((0, 3))


@dataclass(frozen=True, slots=True)
class Layout:
    """The M targets and O obstacles of an episode, which do not move."""

    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px


@dataclass(frozen=True, slots=True)
class Scene:
    """Poses of K robots, positions of M targets, and O obstacles; NaN of what is absent."""

    robots: Float64Array  # [K, 3], x px, y px, heading rad
    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px


@dataclass(frozen=True, slots=True)
class Start:
    """The state in which an episode begins; the same arrays as a scene's.

    Of a custom world only the seed counts.
    """

    robots: Float64Array  # [K, 3], x px, y px, heading rad
    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px
    seed: int = 0  # of a custom world's episode


def checked_actions(
    actions: ArrayLike, shape: tuple[int, ...], num_actions: int = NUM_ACTIONS
) -> UInt8Array:
    """Converts actions to uint8; raises ValueError if shape, dtype or values are wrong."""
    array = np.asarray(actions)
    if array.shape != shape or array.dtype.kind not in "iu":
        raise ValueError(f"actions are {array.dtype} {array.shape}, not integers {shape}")
    if ((array < 0) | (array >= num_actions)).any():
        raise ValueError(f"actions {array.tolist()} are not all in 0..{num_actions - 1}")
    return array.astype(np.uint8)
