"""From records to the pictures that a learner step reads, drawn on the host or on its device.

Invariants: both give the same pictures within one grey level; a row's pictures undergo the
symmetry drawn for it. What `DeviceViews` draws is defined by common.arena.views, whose scan lines
and order of painting it repeats for all records at once: places in float64, shares of pixels in
float32. Records of any bytes give some picture.

Shapes: N = records, V = width of a picture in px, P and Q = rows and columns of the patch of a
picture that holds a shape.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from common.arena import ObservationCodec, Symmetry, make_codec
from common.arena.views import (
    DISC_LOSS_PX,
    HEADING_CAP_PX,
    HEADING_GREY,
    HEADING_HALF_PX,
    ROBOT_GREY,
    TARGET_GREY,
    WALL_GREY,
)
from common.config import ArenaConfig
from common.trajectory import Int64Array, UInt8Array

Turns = Sequence[tuple[Symmetry, Int64Array]]
"""Symmetries, each with the rows of the batch it was drawn for."""

_BLOCK_PICTURES = 256  # that a thread draws at a time, some 0.5 ms; so few are not worth a second

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)  # scan lines a row, as on the host


class Drawing(Protocol):
    """How a learner gets its pictures."""

    def __call__(self, records: UInt8Array, turns: Turns, /) -> Tensor:
        """uint8 [B, W, V, V] on the learner's device, of records [B, W, R]."""
        ...


class HostDrawing:
    """Decodes on the CPU and sends the pictures to the device."""

    def __init__(
        self, decode: Callable[[UInt8Array], UInt8Array], device: torch.device | str = "cpu"
    ) -> None:
        """decode: records uint8 [B, W, R] to pictures uint8 [B, W, V, V]."""
        self._decode = decode
        self._device = torch.device(device)

    def __call__(self, records: UInt8Array, turns: Turns) -> Tensor:
        pictures = np.require(self._decode(records), requirements=["C", "W"])
        for symmetry, rows in turns:
            pictures[rows] = symmetry.apply_to_pictures(pictures[rows])
        return to_device(pictures, self._device)


class ThreadedDecode:
    """A codec's `decode` for large batches: block by block, by several threads."""

    def __init__(self, codec: ObservationCodec, view_px: int, threads: Executor) -> None:
        self._decode = codec.decode
        self._view_px = view_px
        self._threads = threads

    def __call__(self, records: UInt8Array) -> UInt8Array:
        """Pictures uint8 [..., V, V] of records [..., R]."""
        flat = records.reshape(-1, records.shape[-1])
        if len(flat) <= _BLOCK_PICTURES:
            return self._decode(records)
        pictures = np.empty((len(flat), self._view_px, self._view_px), np.uint8)

        def decode_block(start: int) -> None:
            block = slice(start, start + _BLOCK_PICTURES)
            self._decode(flat[block], pictures[block])

        for _ in self._threads.map(decode_block, range(0, len(flat), _BLOCK_PICTURES)):
            pass  # an error of a block is raised here
        return pictures.reshape(*records.shape[:-1], *pictures.shape[1:])


class DeviceDrawing:
    """Sends the scenes' records to the device, a fraction of the bytes, and draws there."""

    def __init__(self, config: ArenaConfig, device: torch.device | str) -> None:
        self._views = DeviceViews(config, device)
        self._record_bytes = config.record_bytes
        self._device = torch.device(device)

    def __call__(self, records: UInt8Array, turns: Turns) -> Tensor:
        if records.dtype != np.uint8 or records.shape[-1] != self._record_bytes:
            raise ValueError(
                f"records are {records.dtype} {records.shape}, not uint8 "
                f"[..., {self._record_bytes}]"
            )
        numbers = np.array(records, order="C").reshape(-1, records.shape[-1]).view("<f4")
        flat = self._views.draw(to_device(numbers, self._device))
        pictures = flat.reshape(*records.shape[:-1], *flat.shape[1:])
        for symmetry, rows in turns:
            at = to_device(rows, self._device)
            pictures[at] = turned(pictures[at], symmetry)
        return pictures


def make_drawing(
    config: ArenaConfig, device: torch.device, threads: Executor | None = None
) -> Drawing:
    """On the device where it is a GPU and draws all that records hold; else on the host.

    threads: that draw on the host; the caller's own if None.
    """
    scenes = config.codec == "scene" and config.draws_analytically
    more = config.obstacle_count or config.inner_walls_px or config.pixel_noise
    if device.type == "cuda" and scenes and not more:
        return DeviceDrawing(config, device)
    codec = make_codec(config)
    if threads is None:
        return HostDrawing(codec.decode, device)
    return HostDrawing(ThreadedDecode(codec, config.view_px, threads), device)


def to_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """The array as a tensor there, sharing its memory on the CPU; no copy waits for the device."""
    tensor = torch.from_numpy(array)
    if device.type != "cuda":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def turned(pictures: Tensor, symmetry: Symmetry) -> Tensor:
    """Pictures [..., V, V] as the symmetry maps them."""
    if symmetry.transpose:
        pictures = pictures.transpose(-1, -2)
    flips = [-1] * symmetry.flip_x + [-2] * symmetry.flip_y
    return pictures.flip(flips)


class DeviceViews:
    """The analytic renderer of one configuration, in torch's operations."""

    def __init__(self, config: ArenaConfig, device: torch.device | str) -> None:
        self._num_robots = config.num_robots
        self._upright = config.orientation == "unrotated"
        self._size = config.view_px
        self._scale = config.view_px / config.crop_px
        self._near = config.wall_offset_px, config.wall_offset_px + config.wall_thickness_px
        self._far = config.size_px - self._near[0], config.size_px - self._near[1]
        self._crop_half_px = config.crop_px / 2
        self._target_half_px = config.target_size_px / 2
        self._radius = max(config.robot_radius_px - DISC_LOSS_PX, 0.0) * self._scale
        self._nodes = torch.tensor((_NODES + 1) / 2, device=device)
        self._weights = torch.tensor(_WEIGHTS / 2, device=device)

    def draw(self, scenes: Tensor) -> Tensor:
        """uint8 [N, V, V] of float32 [N, 3 K + 2 M]: own pose, other robots', targets."""
        split = 3 * self._num_robots
        places = scenes.double()
        headings = scenes[:, 2:split:3]
        cos, sin = headings.cos().double(), headings.sin().double()
        own = places[:, :2]
        # places map to (c x - s y, s x + c y) about the robot
        if self._upright:
            c, s = torch.ones_like(own[:, 0]), torch.zeros_like(own[:, 0])
            own = _on_grid(own, self._crop_half_px)
        else:
            c, s = -sin[:, 0], -cos[:, 0]
        canvas = scenes.new_zeros(len(scenes), self._size**2)
        self._walls(canvas, own, c, s)
        half = self._target_half_px * self._scale
        for j in range(split, scenes.shape[1], 2):
            x, y = self._map(_on_grid(places[:, j : j + 2], self._target_half_px) - own, c, s)
            self._bar(canvas, (x, y), (c, s), (-half, half), half, TARGET_GREY, self._upright)
        robots = [
            self._map(places[:, 3 * k : 3 * k + 2] - own, c, s) for k in range(self._num_robots)
        ]
        for x, y in robots:
            self._disc(canvas, x, y)
        cap, hand_half = HEADING_CAP_PX * self._scale, HEADING_HALF_PX * self._scale
        reach = self._radius + cap
        for k, (x, y) in enumerate(robots):
            ahead = c * cos[:, k] - s * sin[:, k], s * cos[:, k] + c * sin[:, k]
            seen = self._sees(x, reach) & self._sees(y, reach)
            x, y = x.where(seen, torch.nan), y.where(seen, torch.nan)
            self._bar(canvas, (x, y), ahead, (-cap, reach), hand_half, HEADING_GREY, upright=False)
        return canvas.to(torch.uint8).reshape(-1, self._size, self._size)

    def _map(self, gaps: Tensor, c: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Picture coordinates of places [N, 2] relative to the robot."""
        x, y = gaps.unbind(1)
        middle = 0.5 * self._size
        return (c * x - s * y) * self._scale + middle, (s * x + c * y) * self._scale + middle

    def _sees(self, at: Tensor, reach: float) -> Tensor:
        return (at > -reach) & (at < self._size + reach)

    def _walls(self, canvas: Tensor, own: Tensor, c: Tensor, s: Tensor) -> None:
        """Top and bottom from corner to corner, left and right between them."""
        (outer, inner), (_, far_inner) = self._near, self._far
        half = 0.5 * (inner - outer)
        length, short = self._far[0] - outer, far_inner - inner
        for at in (outer + half, self._far[0] - half):
            for corner, way, end in (
                ((outer, at), (c, s), length),
                ((at, inner), (-s, c), short),
            ):
                x, y = self._map(own.new_tensor(corner) - own, c, s)
                ends, width = (0.0, end * self._scale), half * self._scale
                self._bar(canvas, (x, y), way, ends, width, WALL_GREY, self._upright)

    def _disc(self, canvas: Tensor, x: Tensor, y: Tensor) -> None:
        radius = self._radius
        rows, columns = self._patch(y - radius, 2 * radius), self._patch(x - radius, 2 * radius)
        lines, tall = self._scan_lines(rows, y, y - radius, y + radius)
        chord = (radius**2 - lines.square()).clamp(min=0).sqrt()
        x = x[:, None, None]
        share = _share(x - chord, x + chord, tall, columns)
        self._paint(canvas, rows[:, :, None] * self._size + columns[:, None], share, ROBOT_GREY)

    def _bar(
        self,
        canvas: Tensor,
        place: tuple[Tensor, Tensor],
        way: tuple[Tensor, Tensor],
        ends: tuple[float, float],
        half: float,
        grey: int,
        upright: bool,
    ) -> None:
        """The rectangle from ends[0] to ends[1] along the way [N], half to either side.

        Scan lines cross it the short way: the picture's axes change places where it lies flat.
        upright: every way is along an axis, which bounds the patch.
        """
        flat = way[0].abs() >= way[1].abs()
        x, y = torch.where(flat, place[1], place[0]), torch.where(flat, place[0], place[1])
        dx, dy = torch.where(flat, way[1], way[0]), torch.where(flat, way[0], way[1])
        start, end = ends
        low_y = y + torch.minimum(start * dy, end * dy) - half * dx.abs()
        high_y = y + torch.maximum(start * dy, end * dy) + half * dx.abs()
        low_x = x + torch.minimum(start * dx, end * dx) - half * dy.abs()
        reach = math.hypot(end - start, 2 * half)
        rows = self._patch(low_y, reach)
        columns = self._patch(low_x, 2 * half if upright else reach)
        t, tall = self._scan_lines(rows, y, low_y, high_y)
        x, dx, dy = x[:, None, None], dx[:, None, None], dy[:, None, None]
        middle, width = x + t * dx / dy, half / dy.abs()
        low, high = middle - width, middle + width
        slanted = dx.abs() > 1e-9
        across = dx.where(slanted, 1.0)
        one, other = x + (start - t * dy) / across, x + (end - t * dy) / across
        within = (start <= t * dy) & (t * dy <= end)
        low = torch.where(slanted, torch.maximum(low, torch.minimum(one, other)), low)
        cut = torch.minimum(high, torch.maximum(one, other))
        high = torch.where(slanted, cut, high.where(within, low))
        share = _share(low, high, tall, columns)
        down = torch.where(flat, 1, self._size)[:, None, None]  # a step to the next row
        right = torch.where(flat, self._size, 1)[:, None, None]
        self._paint(canvas, rows[:, :, None] * down + columns[:, None] * right, share, grey)

    def _patch(self, low: Tensor, extent: float) -> Tensor:
        """Rows or columns [N, P] of the picture that hold all of it in [low, low + extent]."""
        width = min(self._size, math.ceil(extent) + 1)
        first = low.floor().nan_to_num(0).clamp(0, self._size - width).long()
        return first[:, None] + torch.arange(width, device=low.device)

    def _scan_lines(
        self, rows: Tensor, y: Tensor, low: Tensor, high: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Lines [N, P, 4] relative to y within [low, high], and the height that each stands for."""
        top = torch.maximum(rows.double(), low[:, None]) - y[:, None]
        tall = (torch.minimum(rows + 1.0, high[:, None]) - y[:, None] - top).clamp(min=0)
        return top[..., None] + self._nodes * tall[..., None], self._weights * tall[..., None]

    def _paint(self, canvas: Tensor, pixels: Tensor, share: Tensor, grey: int) -> None:
        """Each pixel after a shape covered a share of it, rounded as a byte is."""
        at = pixels.flatten(1)
        value = canvas.gather(1, at)
        canvas.scatter_(1, at, (value + (grey - value) * share.flatten(1) + 0.5).floor())


def _on_grid(middles: Tensor, half: float) -> Tensor:
    """The middles of squares, half to either side, once their edges lie between pixels."""
    return (middles - half).round() + half


def _share(low: Tensor, high: Tensor, tall: Tensor, columns: Tensor) -> Tensor:
    """Of each pixel, covered by the spans [low, high] of its lines [N, P, 4]; float32 [N, P, Q]."""
    first = columns[:, :1, None]
    pixels = torch.arange(columns.shape[1], device=columns.device, dtype=torch.float32)
    before = ((low - first).float()[..., None] - pixels).clamp(0, 1)
    until = ((high - first).float()[..., None] - pixels).clamp(0, 1)
    spans = (until - before).clamp(min=0) * tall.float()[..., None]
    return spans.sum(2).nan_to_num(0).clamp(max=1)
