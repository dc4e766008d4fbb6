"""Observation records, and the images decoded from them.

Invariants: both codecs give the same pixels for the same scene, because both render the scene
rounded to float32. A record has a fixed number of bytes, and any bytes decode to an image: a peer
may have sent them.
"""

from itertools import accumulate
from typing import Protocol

import numpy as np

from mrcdrl.common.arena.images.noise import NoiseSeeds, add_noise
from mrcdrl.common.arena.images.rendering import literal_views
from mrcdrl.common.arena.images.views import AnalyticViews
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float32Array, Int64Array, UInt8Array

_NUMBER = np.dtype("<f4")
_SEED = np.dtype("<u4")
_FARTHEST_PX = 1e5  # OpenCV takes no place much farther away


class ObservationCodec(Protocol):
    """Encodes a scene as one record per robot, and decodes records to images."""

    record_bytes: int

    def encode(self, scene: Scene, noise_seeds: NoiseSeeds | None = None) -> UInt8Array:
        """Encodes the robots' views as records [..., K, R]; takes one scene or a stack of them.

        noise_seeds: [..., K], used if the images are noisy; 0 if None.
        """
        ...

    def decode(self, records: UInt8Array, out: UInt8Array | None = None) -> UInt8Array:
        """Decodes records [..., R] to images [..., V, V], in out (C-contiguous) if given."""
        ...


class SceneCodec:
    """Stores the scene, its own robot first; the image is rendered when it is decoded.

    A record holds little-endian float32: own x, y, heading; x, y, heading of the other robots in
    order; x, y of the targets; x, y, radius of the obstacles. What is absent is NaN, and not
    rendered. With pixel_noise, the seed of the noise follows as uint32.
    """

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        num = config.num_robots
        counts = (3 * num, 2 * config.target_count, 3 * config.obstacle_count)
        self._ends = tuple(accumulate(counts))  # robots, targets, obstacles
        self.record_bytes = _NUMBER.itemsize * (self._ends[-1] + bool(config.pixel_noise))
        self._order = np.array([[i, *(j for j in range(num) if j != i)] for i in range(num)])
        self._views = AnalyticViews(config) if config.renders_analytically else None

    def __repr__(self) -> str:
        return f"SceneCodec(record_bytes={self.record_bytes})"

    def encode(self, scene: Scene, noise_seeds: NoiseSeeds | None = None) -> UInt8Array:
        num = len(self._order)
        leading = scene.robots.shape[:-2]
        records = np.empty((*leading, num, self.record_bytes), np.uint8)
        numbers = records.view(_NUMBER)
        robots, targets, obstacles = self._ends
        poses = scene.robots[..., self._order, :]
        numbers[..., :robots] = poses.reshape(*leading, num, robots)
        numbers[..., robots:targets] = scene.targets.reshape(*leading, 1, targets - robots)
        numbers[..., targets:obstacles] = scene.obstacles.reshape(*leading, 1, obstacles - targets)
        if self._config.pixel_noise:
            records.view(_SEED)[..., -1] = 0 if noise_seeds is None else noise_seeds
        return records

    def decode(self, records: UInt8Array, out: UInt8Array | None = None) -> UInt8Array:
        images = _images(records, self.record_bytes, self._config.view_px, out)
        flat = np.require(records.reshape(-1, self.record_bytes), requirements=["C", "A", "W"])
        scenes = flat.view(_NUMBER)
        views = images.reshape(-1, *images.shape[-2:])
        if self._views is not None:
            self._views.render(scenes, views)
        else:
            for view, scene in zip(views, scenes, strict=True):
                view[:] = literal_views(self._scene_of(scene), self._config)[0]
        if self._config.pixel_noise:
            add_noise(views, flat.view(_SEED)[:, -1], self._config.pixel_noise)
        return images

    def present(self, records: UInt8Array) -> Int64Array:
        """How many robots are in the scene of each record [..., R]."""
        count: Int64Array = np.isfinite(self.scenes(records).robots[..., 0]).sum(axis=-1)
        return count

    def scenes(self, records: UInt8Array) -> Scene:
        """The scenes [...] of records [..., R], stacked, in each the record's own robot first."""
        numbers = np.ascontiguousarray(records).view(_NUMBER)
        parts = np.split(numbers, self._ends, axis=-1)[:3]
        shapes = ((*numbers.shape[:-1], -1, width) for width in (3, 2, 3))
        robots, targets, obstacles = (
            part.reshape(shape).astype(np.float64)
            for part, shape in zip(parts, shapes, strict=True)
        )
        return Scene(robots, targets, obstacles)

    def _scene_of(self, numbers: Float32Array) -> Scene:
        with np.errstate(invalid="ignore"):
            near = np.clip(numbers.astype(np.float64), -_FARTHEST_PX, _FARTHEST_PX)
        robots, targets, obstacles = np.split(near, self._ends)[:3]
        return Scene(robots.reshape(-1, 3), targets.reshape(-1, 2), obstacles.reshape(-1, 3))


class FrameCodec:
    """Stores the image's pixels, row by row."""

    def __init__(self, config: ArenaConfig) -> None:
        self._config = config
        self._scenes = SceneCodec(config)
        self.record_bytes = config.view_px**2

    def __repr__(self) -> str:
        return f"FrameCodec(record_bytes={self.record_bytes})"

    def encode(self, scene: Scene, noise_seeds: NoiseSeeds | None = None) -> UInt8Array:
        records = self._scenes.encode(scene, noise_seeds)
        return self._scenes.decode(records).reshape(*records.shape[:-1], self.record_bytes)

    def decode(self, records: UInt8Array, out: UInt8Array | None = None) -> UInt8Array:
        images = _images(records, self.record_bytes, self._config.view_px, out)
        images[:] = records.reshape(images.shape)
        return images


def make_codec(config: ArenaConfig) -> ObservationCodec:
    """The codec that config.codec names."""
    return SceneCodec(config) if config.codec == "scene" else FrameCodec(config)


def _images(
    records: UInt8Array, record_bytes: int, view_px: int, out: UInt8Array | None
) -> UInt8Array:
    """Returns out, or new images if None; raises ValueError if records or out do not fit."""
    if records.dtype != np.uint8 or records.shape[-1:] != (record_bytes,):
        raise ValueError(
            f"records are {records.dtype} {records.shape}, not uint8 [..., {record_bytes}]"
        )
    shape = (*records.shape[:-1], view_px, view_px)
    if out is None:
        return np.empty(shape, np.uint8)
    if out.dtype != np.uint8 or out.shape != shape or not out.flags.carray:
        raise ValueError(
            f"out is {out.dtype} {out.shape}, not C-contiguous writeable uint8 {shape}"
        )
    return out
