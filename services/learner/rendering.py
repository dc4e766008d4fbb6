"""Images that a learner step reads, rendered from records on the host or on its device.

Invariants: both give the same images within one level of intensity; a row's images undergo the
symmetry drawn for it. common.arena.images.views defines what a GPU renders: `rendering.cu` repeats
its scan lines and its order of painting. Records of any bytes give some image.

Shapes: B = rows, W = records of a row, R = bytes of a record, V = width of an image in px.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mrcdrl.common.arena import IDENTITY, SYMMETRIES, ObservationCodec, Symmetry, make_codec
from mrcdrl.common.arena.images.views import (
    DISC_LOSS_PX,
    HEADING_CAP_PX,
    HEADING_HALF_PX,
    HEADING_INTENSITY,
    NODES,
    OBSTACLE_INTENSITY,
    ROBOT_INTENSITY,
    TARGET_INTENSITY,
    WALL_INTENSITY,
    WEIGHTS,
)
from mrcdrl.common.arena.world.obstacles import inner_walls
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Int64Array, UInt8Array
from mrcdrl.common.model.kernels.cuda import KernelError, compile_kernel, source_of

_LOG = logging.getLogger("learner")

SymmetryRows = Sequence[tuple[Symmetry, Int64Array]]
"""Symmetries, each with the rows of the batch it was drawn for."""

_BLOCK_IMAGES = 256  # rendered by one thread at a time in some 0.5 ms; fewer need no second one
_THREADS = 256  # of the device, for one image


class Renderer(Protocol):
    """Turns records into the images that a learner reads."""

    def __call__(self, records: UInt8Array, symmetry_rows: SymmetryRows, /) -> Tensor:
        """Images uint8 [B, W, V, V] on the learner's device, of records [B, W, R]."""
        ...


class HostRenderer:
    """Decodes on the CPU and sends the images to the device."""

    def __init__(
        self, decode: Callable[[UInt8Array], UInt8Array], device: torch.device | str = "cpu"
    ) -> None:
        """decode: records uint8 [B, W, R] to images uint8 [B, W, V, V]."""
        self._decode = decode
        self._device = torch.device(device)

    def __call__(self, records: UInt8Array, symmetry_rows: SymmetryRows) -> Tensor:
        images = np.require(self._decode(records), requirements=["C", "W"])
        for symmetry, rows in symmetry_rows:
            images[rows] = symmetry.apply_to_images(images[rows])
        return to_device(images, self._device)


class ThreadedDecoder:
    """A codec's `decode` for large batches: block by block, by several threads."""

    def __init__(self, codec: ObservationCodec, view_px: int, threads: Executor) -> None:
        self._decode = codec.decode
        self._view_px = view_px
        self._threads = threads

    def __call__(self, records: UInt8Array) -> UInt8Array:
        """Images uint8 [..., V, V] of records [..., R]."""
        flat = records.reshape(-1, records.shape[-1])
        if len(flat) <= _BLOCK_IMAGES:
            return self._decode(records)
        images = np.empty((len(flat), self._view_px, self._view_px), np.uint8)

        def decode_block(start: int) -> None:
            block = slice(start, start + _BLOCK_IMAGES)
            self._decode(flat[block], images[block])

        for _ in self._threads.map(decode_block, range(0, len(flat), _BLOCK_IMAGES)):
            pass  # an error of a block is raised here
        return images.reshape(*records.shape[:-1], *images.shape[1:])


Paint = Callable[[Tensor, Tensor, Tensor], None]
"""Fills images uint8 [B, W, V, V], given scenes float32 [B, W, R / 4] and, of each row, the place
of its symmetry in SYMMETRIES, uint8 [B]."""


class DeviceRenderer:
    """Sends the scenes' records to the device, a fraction of the bytes, and renders there."""

    def __init__(
        self, config: ArenaConfig, device: torch.device | str, paint: Paint | None = None
    ) -> None:
        """paint: replaces the device's own kernel. Raises KernelError where there is none."""
        self._device = torch.device(device)
        self._paint = paint or _device_paint(config, self._device)
        self._record_bytes = config.record_bytes
        self._view_px = config.view_px

    def __call__(self, records: UInt8Array, symmetry_rows: SymmetryRows) -> Tensor:
        if records.dtype != np.uint8 or records.shape[2:] != (self._record_bytes,):
            raise ValueError(
                f"records are {records.dtype} {records.shape}, not uint8 "
                f"[B, W, {self._record_bytes}]"
            )
        which = np.full(len(records), SYMMETRIES.index(IDENTITY), np.uint8)
        for symmetry, rows in symmetry_rows:
            which[rows] = SYMMETRIES.index(symmetry)
        scenes = to_device(np.array(records, order="C").view("<f4"), self._device)
        shape = *records.shape[:2], self._view_px, self._view_px
        images = torch.empty(shape, dtype=torch.uint8, device=self._device)
        if len(records):
            self._paint(scenes, to_device(which, self._device), images)
        return images


def _device_paint(config: ArenaConfig, device: torch.device) -> Paint:
    """The kernel of rendering.cu, compiled for this configuration."""
    macros = definitions(config)
    kernel = compile_kernel(renderer_source(), "render", device, macros, threads=_THREADS)

    def paint(scenes: Tensor, symmetries: Tensor, images: Tensor) -> None:
        rows, width = scenes.shape[:2]
        kernel(rows * width, [scenes, symmetries, images, width])

    return paint


def renderer_source() -> str:
    """CUDA C++ with the function `render`; also valid C++."""
    return source_of("mrcdrl.services.learner", "rendering.cu")


def definitions(config: ArenaConfig) -> dict[str, object]:
    """The macros that rendering.cu takes from a configuration."""
    scale, walls = config.view_px / config.crop_px, inner_walls(config)
    return {
        "VIEW": config.view_px,
        "NUM_ROBOTS": config.num_robots,
        "NUM_TARGETS": config.target_count,
        "NUM_OBSTACLES": config.obstacle_count,
        "NUM_INNER_WALLS": len(walls),
        "INNER_WALLS": _braces([_braces(wall) for wall in walls] or ["{0}"]),
        "HEADING_UP": int(config.orientation == "heading_up"),
        "SCALE": repr(scale),
        "SIZE_PX": repr(float(config.size_px)),
        "WALL_OUTER_PX": repr(float(config.wall_offset_px)),
        "WALL_INNER_PX": repr(float(config.wall_offset_px + config.wall_thickness_px)),
        "CROP_HALF_PX": repr(config.crop_px / 2),
        "TARGET_HALF_PX": repr(config.target_size_px / 2),
        "DISC_LOSS_PX": DISC_LOSS_PX,
        "RADIUS": repr(max(config.robot_radius_px - DISC_LOSS_PX, 0.0) * scale),
        "CAP": repr(HEADING_CAP_PX * scale),
        "HAND_HALF": repr(HEADING_HALF_PX * scale),
        "NODES": _braces(NODES),
        "WEIGHTS": _braces(WEIGHTS),
        "WALL_INTENSITY": WALL_INTENSITY,
        "OBSTACLE_INTENSITY": OBSTACLE_INTENSITY,
        "TARGET_INTENSITY": TARGET_INTENSITY,
        "ROBOT_INTENSITY": ROBOT_INTENSITY,
        "HEADING_INTENSITY": HEADING_INTENSITY,
    }


def _braces(items: Iterable[object]) -> str:
    """The items as C initializes an array."""
    return "{" + ",".join(str(x) for x in items) + "}"


def make_renderer(
    config: ArenaConfig, device: torch.device, threads: Executor | None = None
) -> Renderer:
    """A renderer on the device where it is a GPU that can render the records; else on the host.

    threads: render on the host; None: the caller's thread does.
    """
    scenes = config.codec == "scene" and config.renders_analytically and not config.pixel_noise
    if device.type == "cuda" and scenes:
        try:
            return DeviceRenderer(config, device)
        except KernelError as error:
            _LOG.warning("images are rendered on the CPU: %s", error)
    codec = make_codec(config)
    if threads is None:
        return HostRenderer(codec.decode, device)
    return HostRenderer(ThreadedDecoder(codec, config.view_px, threads), device)


def to_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """The array as a tensor on the device; no copy waits for the device.

    On the CPU the tensor shares the array's memory.
    """
    tensor = torch.from_numpy(array)
    if device.type != "cuda":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)
