"""Draws every robot's picture straight from poses: the area each shape covers of each pixel.

Invariants: a picture pixel is the mean over its square of crop_px / view_px arena pixels; the
window is centred exactly on the robot where it turns with it, and else cuts out whole pixels of the
arena, as the literal pipeline does; targets fill whole pixels in both. Shapes are painted over one
another in the order walls, obstacles, targets, robots, headings on a black floor, and black lies
outside the arena. Coordinates are continuous (pixel i covers [i, i + 1)), so a mapped scene gives
the mapped picture. Records of any bytes give some picture: what is not finite is not drawn.
"""

import math

import numpy as np
from numba import njit

from common.arena.obstacles import inner_walls
from common.config import ArenaConfig
from common.trajectory import Float32Array, UInt8Array

WALL_GREY = 76  # red, green, blue and white by OpenCV's weights
OBSTACLE_GREY = 150
TARGET_GREY = 29
ROBOT_GREY = 255
HEADING_GREY = 0
HEADING_WIDTH_PX = 2.0
# What OpenCV paints of whole pixels, in the mean over places and directions:
HEADING_HALF_PX = 1.475  # half the width of the line of HEADING_WIDTH_PX
HEADING_CAP_PX = 1.0  # of the line, beyond the robot's centre and rim
DISC_LOSS_PX = 0.04  # of a radius of 15 to 40 px
_NUM_LINES = 4  # scan lines a row of pixels, at Gauss-Legendre nodes: 5 grey levels off at most
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(_NUM_LINES)
_NODES, _WEIGHTS = (_LEGENDRE_NODES + 1) / 2, _LEGENDRE_WEIGHTS / 2  # on [0, 1]


class AnalyticViews:
    """The renderer of one configuration."""

    def __init__(self, config: ArenaConfig) -> None:
        self._counts = (config.num_robots, config.target_count, config.obstacle_count)
        self._inner_walls = inner_walls(config)
        self._heading_up = config.orientation == "heading_up"
        scale = config.view_px / config.crop_px
        outer = config.wall_offset_px
        self._scale = scale
        self._wall = (outer, outer + config.wall_thickness_px, float(config.size_px))
        self._halves_px = (config.crop_px / 2, config.target_size_px / 2)
        self._radius = max(config.robot_radius_px - DISC_LOSS_PX, 0.0) * scale

    def draw(self, scenes: Float32Array, out: UInt8Array) -> None:
        """Fills out [N, V, V] from scenes [N, 3 K + 2 M + 3 O] of SceneCodec."""
        _draw_views(
            scenes,
            out,
            self._counts,
            self._heading_up,
            self._scale,
            self._wall,
            self._inner_walls,
            self._halves_px,
            self._radius,
        )


@njit(nogil=True, cache=True, error_model="numpy")
def _draw_views(  # type: ignore[no-untyped-def]
    scenes, out, counts, heading_up, scale, wall, inner_walls, halves_px, radius
):
    num_robots, num_targets, num_obstacles = counts
    targets, obstacles = 3 * num_robots, 3 * num_robots + 2 * num_targets
    size = out.shape[1]
    cover = np.zeros((_NUM_LINES, 3), np.float64)
    crop_half_px, target_half_px = halves_px
    target_half = target_half_px * scale
    hand_half, cap = HEADING_HALF_PX * scale, HEADING_CAP_PX * scale
    reach = radius + cap
    for n in range(len(scenes)):
        scene = scenes[n]
        view = out[n]
        view[:] = 0
        own_x = np.float64(scene[0])
        own_y = np.float64(scene[1])
        c, s = 1.0, 0.0
        if heading_up:
            c, s = -math.sin(scene[2]), -math.cos(scene[2])
        else:
            own_x, own_y = _on_grid(own_x, crop_half_px), _on_grid(own_y, crop_half_px)
        # places map to (c x - s y, s x + c y) about the robot
        if heading_up:
            _walls_slanted(view, cover, own_x, own_y, c, s, scale, wall)
        else:
            _walls_upright(view, own_x, own_y, scale, wall)
        _inner_walls(view, cover, own_x, own_y, c, s, scale, inner_walls)
        for j in range(obstacles, obstacles + 3 * num_obstacles, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            _disc(view, cover, x, y, (scene[j + 2] - DISC_LOSS_PX) * scale, OBSTACLE_GREY)
        for j in range(targets, obstacles, 2):
            x, y = _on_grid(scene[j], target_half_px), _on_grid(scene[j + 1], target_half_px)
            x, y = _map(x - own_x, y - own_y, c, s, scale, size)
            if heading_up:
                _bar(view, cover, x, y, c, s, -target_half, target_half, target_half, TARGET_GREY)
            else:
                _box(
                    view,
                    x - target_half,
                    x + target_half,
                    y - target_half,
                    y + target_half,
                    TARGET_GREY,
                )
        for j in range(0, 3 * num_robots, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            _disc(view, cover, x, y, radius, ROBOT_GREY)
        for j in range(0, 3 * num_robots, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            if -reach < x < size + reach and -reach < y < size + reach:
                cos, sin = math.cos(scene[j + 2]), math.sin(scene[j + 2])
                across, along = c * cos - s * sin, s * cos + c * sin
                _bar(view, cover, x, y, across, along, -cap, reach, hand_half, HEADING_GREY)


@njit(nogil=True, cache=True, error_model="numpy")
def _on_grid(middle, half):  # type: ignore[no-untyped-def]
    """The middle of the square, half to either side, once its edges lie between pixels."""
    return np.rint(np.float64(middle) - half) + half


@njit(nogil=True, cache=True, error_model="numpy")
def _map(x, y, c, s, scale, size):  # type: ignore[no-untyped-def]
    """Picture coordinates of a place relative to the robot."""
    return (c * x - s * y) * scale + 0.5 * size, (s * x + c * y) * scale + 0.5 * size


@njit(nogil=True, cache=True, error_model="numpy")
def _walls_upright(view, own_x, own_y, scale, wall):  # type: ignore[no-untyped-def]
    outer, inner, size_px = wall
    half = 0.5 * view.shape[0]
    left, left_in = (outer - own_x) * scale + half, (inner - own_x) * scale + half
    right_in = (size_px - inner - own_x) * scale + half
    right = (size_px - outer - own_x) * scale + half
    top, top_in = (outer - own_y) * scale + half, (inner - own_y) * scale + half
    bottom_in = (size_px - inner - own_y) * scale + half
    bottom = (size_px - outer - own_y) * scale + half
    _box(view, left, right, top, top_in, WALL_GREY)
    _box(view, left, right, bottom_in, bottom, WALL_GREY)
    _box(view, left, left_in, top_in, bottom_in, WALL_GREY)
    _box(view, right_in, right, top_in, bottom_in, WALL_GREY)


@njit(nogil=True, cache=True, error_model="numpy")
def _walls_slanted(view, cover, own_x, own_y, c, s, scale, wall):  # type: ignore[no-untyped-def]
    outer, inner, size_px = wall
    size = view.shape[0]
    width = 0.5 * (inner - outer) * scale
    length = (size_px - 2 * outer) * scale
    short = (size_px - 2 * inner) * scale
    near = 0.5 * (outer + inner)
    far = size_px - near
    for at in (near, far):
        x, y = _map(outer - own_x, at - own_y, c, s, scale, size)
        _bar(view, cover, x, y, c, s, 0.0, length, width, WALL_GREY)
        x, y = _map(at - own_x, inner - own_y, c, s, scale, size)
        _bar(view, cover, x, y, -s, c, 0.0, short, width, WALL_GREY)


@njit(nogil=True, cache=True, error_model="numpy")
def _inner_walls(view, cover, own_x, own_y, c, s, scale, walls):  # type: ignore[no-untyped-def]
    for ax, ay, bx, by, half in walls:
        length = math.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay))
        dx, dy = (bx - ax) / length, (by - ay) / length
        x, y = _map(ax - own_x, ay - own_y, c, s, scale, view.shape[0])
        across, along = c * dx - s * dy, s * dx + c * dy
        _bar(view, cover, x, y, across, along, 0.0, length * scale, half * scale, WALL_GREY)


@njit(nogil=True, cache=True, error_model="numpy")
def _blend(value, grey, share):  # type: ignore[no-untyped-def]
    """A pixel after a shape covered a share of it."""
    return np.uint8(value + (grey - np.float64(value)) * share + 0.5)


@njit(nogil=True, cache=True, error_model="numpy")
def _box(view, x0, x1, y0, y1, grey):  # type: ignore[no-untyped-def]
    """Paints the upright rectangle [x0, x1] x [y0, y1]."""
    size = view.shape[0]
    if not (x1 > 0 and x0 < size and y1 > 0 and y0 < size):
        return
    x0, x1 = max(x0, 0.0), min(x1, np.float64(size))
    y0, y1 = max(y0, 0.0), min(y1, np.float64(size))
    for i in range(int(y0), math.ceil(y1)):
        tall = min(i + 1.0, y1) - max(np.float64(i), y0)
        for j in range(int(x0), math.ceil(x1)):
            wide = min(j + 1.0, x1) - max(np.float64(j), x0)
            view[i, j] = _blend(view[i, j], grey, tall * wide)


@njit(nogil=True, cache=True, error_model="numpy")
def _paint_row(row, cover, grey):  # type: ignore[no-untyped-def]
    """Paints in a row of pixels what its scan lines cover: from low to high, with a weight each."""
    low, high = cover[0, 0], cover[0, 1]
    for k in range(1, _NUM_LINES):
        low, high = min(low, cover[k, 0]), max(high, cover[k, 1])
    for j in range(int(min(low, high)), math.ceil(high)):
        share = 0.0
        for k in range(_NUM_LINES):
            part = min(j + 1.0, cover[k, 1]) - max(np.float64(j), cover[k, 0])
            share += cover[k, 2] * max(part, 0.0)
        row[j] = _blend(row[j], grey, min(share, 1.0))


@njit(nogil=True, cache=True, error_model="numpy")
def _disc(view, cover, x, y, radius, grey):  # type: ignore[no-untyped-def]
    """Paints a disc: exact along x, sampled by scan lines along y."""
    size = view.shape[0]
    if not (x + radius > 0 and x - radius < size and y + radius > 0 and y - radius < size):
        return
    for i in range(int(max(y - radius, 0.0)), math.ceil(min(y + radius, np.float64(size)))):
        top = max(np.float64(i), y - radius) - y
        tall = min(i + 1.0, y + radius) - y - top
        for k in range(_NUM_LINES):
            dy = top + _NODES[k] * tall
            chord = math.sqrt(max(radius * radius - dy * dy, 0.0))
            cover[k, 0] = max(x - chord, 0.0)
            cover[k, 1] = min(x + chord, np.float64(size))
            cover[k, 2] = _WEIGHTS[k] * tall
        _paint_row(view[i], cover, grey)


@njit(nogil=True, cache=True, error_model="numpy")
def _bar(view, cover, x, y, dx, dy, start, end, half, grey):  # type: ignore[no-untyped-def]
    """Paints the rectangle from start to end along (dx, dy) from (x, y), half to either side.

    Scan lines cross it the short way, where its extent is exact.
    """
    if abs(dx) >= abs(dy):
        _bar_across(view.T, cover, y, x, dy, dx, start, end, half, grey)
    else:
        _bar_across(view, cover, x, y, dx, dy, start, end, half, grey)


@njit(nogil=True, cache=True, error_model="numpy")
def _bar_across(view, cover, x, y, dx, dy, start, end, half, grey):  # type: ignore[no-untyped-def]
    """_bar with scan lines along the view's rows, for |dy| >= |dx|."""
    size = view.shape[0]
    low_y = y + min(start * dy, end * dy) - half * abs(dx)
    high_y = y + max(start * dy, end * dy) + half * abs(dx)
    low_x = x + min(start * dx, end * dx) - half * abs(dy)
    high_x = x + max(start * dx, end * dx) + half * abs(dy)
    if not (high_x > 0 and low_x < size and high_y > 0 and low_y < size):
        return
    width = half / abs(dy)
    for i in range(int(max(low_y, 0.0)), math.ceil(min(high_y, np.float64(size)))):
        top = max(np.float64(i), low_y) - y
        tall = min(i + 1.0, high_y) - y - top
        for k in range(_NUM_LINES):
            t = top + _NODES[k] * tall
            middle = x + t * dx / dy
            low, high = max(middle - width, 0.0), min(middle + width, np.float64(size))
            if abs(dx) > 1e-9:
                one, other = x + (start - t * dy) / dx, x + (end - t * dy) / dx
                low, high = max(low, min(one, other)), min(high, max(one, other))
            elif not start <= t * dy <= end:
                high = low
            cover[k, 0], cover[k, 1], cover[k, 2] = low, high, _WEIGHTS[k] * tall
        _paint_row(view[i], cover, grey)
