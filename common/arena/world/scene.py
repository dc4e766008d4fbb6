"""What there is to see: the state of the world at one frame, and the words for actions.

Invariants: coordinates are continuous pixels of the arena, x to the right and y down as in
images, pixel i covering [i, i + 1); a heading of 0 looks along +x and grows clockwise to the
viewer, because y points down.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float64Array, UInt8Array

LEFT = 0
"""Heading decreases by `turn_deg`: anticlockwise to the viewer. Then the robot moves on."""
STRAIGHT = 1
"""Moves on."""
RIGHT = 2
"""Heading increases by `turn_deg`: clockwise to the viewer. Then the robot moves on."""


def _none() -> Float64Array:
    return np.empty((0, 3))


@dataclass(frozen=True, slots=True)
class Layout:
    """What stays where it is for an episode: M targets and O obstacles."""

    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px


@dataclass(frozen=True, slots=True)
class Scene:
    """Poses of K robots, places of M targets, and O obstacles."""

    robots: Float64Array  # [K, 3], x px, y px, heading rad
    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px


@dataclass(frozen=True, slots=True)
class Start:
    """Where an episode begins: the same arrays as a scene's."""

    robots: Float64Array  # [K, 3], x px, y px, heading rad
    targets: Float64Array  # [M, 2], x px, y px
    obstacles: Float64Array = field(default_factory=_none)  # [O, 3], x px, y px, radius px


def checked_actions(actions: ArrayLike, shape: tuple[int, ...]) -> UInt8Array:
    """actions as uint8 of this shape; raises ValueError for another shape, kind or value."""
    array = np.asarray(actions)
    if array.shape != shape or array.dtype.kind not in "iu":
        raise ValueError(f"actions are {array.dtype} {array.shape}, not integers {shape}")
    if ((array < 0) | (array >= NUM_ACTIONS)).any():
        raise ValueError(f"actions {array.tolist()} are not all in 0..{NUM_ACTIONS - 1}")
    return array.astype(np.uint8)
