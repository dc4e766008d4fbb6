"""The eight symmetries of the square, as they act on images, actions and scenes.

Invariants: the transpose comes first, then the flips. Images and scenes are mapped alike, so that
the image of the mapped scene is the mapped image of the scene.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float64Array, UInt8Array


@dataclass(frozen=True, slots=True)
class Symmetry:
    """One of the 8 symmetries of the arena about its centre."""

    transpose: bool  # swaps x and y
    flip_x: bool  # swaps left and right
    flip_y: bool  # swaps top and bottom

    @property
    def mirrors(self) -> bool:
        """Whether it maps left turns to right turns, so that actions must be swapped."""
        return self.transpose ^ self.flip_x ^ self.flip_y

    def apply_to_images(self, images: UInt8Array) -> UInt8Array:
        """Maps images [..., V, V]; returns a contiguous copy."""
        if self.transpose:
            images = images.swapaxes(-1, -2)
        if self.flip_x:
            images = images[..., ::-1]
        if self.flip_y:
            images = images[..., ::-1, :]
        return np.array(images, order="C")

    def apply_to_actions(self, actions: UInt8Array) -> UInt8Array:
        """Maps actions [...] to those that do the same in the mapped scene."""
        return (NUM_ACTIONS - 1 - actions).astype(np.uint8) if self.mirrors else actions.copy()

    def apply_to_points(self, points: Float64Array, size_px: float) -> Float64Array:
        """Maps points [N, 2] px of an arena of size_px."""
        x, y = points.T
        if self.transpose:
            x, y = y, x
        return np.stack(
            [size_px - x if self.flip_x else x, size_px - y if self.flip_y else y], axis=1
        )

    def apply_to_scene(self, scene: Scene, size_px: float) -> Scene:
        """Maps the scene of an arena of size_px."""
        headings = scene.robots[:, 2]
        if self.transpose:
            headings = np.pi / 2 - headings
        if self.flip_x:
            headings = np.pi - headings
        if self.flip_y:
            headings = -headings
        places = self.apply_to_points(scene.robots[:, :2], size_px)
        robots = np.concatenate([places, headings[:, None]], axis=1)
        centres = self.apply_to_points(scene.obstacles[:, :2], size_px)
        obstacles = np.concatenate([centres, scene.obstacles[:, 2:]], axis=1)
        return Scene(robots, self.apply_to_points(scene.targets, size_px), obstacles)


SYMMETRIES = tuple(Symmetry(*flags) for flags in product((False, True), repeat=3))
IDENTITY = SYMMETRIES[0]
