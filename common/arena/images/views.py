"""Renders every robot's image straight from poses, by the area of each pixel a shape covers.

Invariants: an image pixel is the mean over its square of crop_px / view_px arena pixels. A window
that rotates with its robot is centred exactly on it; an unrotated one crops whole pixels of the
arena, as the literal pipeline does. Targets fill whole pixels in both. Shapes cover one another in
the order walls, obstacles, targets, robots, headings; the floor and everything outside the arena
are black. Coordinates are continuous (pixel i covers [i, i + 1)), so a mapped scene gives the
mapped image. Records of any bytes give some image: shapes that are not finite are not rendered.
"""

import math

import numpy as np

from mrcdrl.common.arena.world.obstacles import inner_walls
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float32Array, UInt8Array
from mrcdrl.common.runtime.compiled import compiled, inlined

WALL_INTENSITY = 76  # OpenCV's grayscale weights, applied to red, green, blue and white
OBSTACLE_INTENSITY = 150
TARGET_INTENSITY = 29
ROBOT_INTENSITY = 255
HEADING_INTENSITY = 0
HEADING_WIDTH_PX = 2.0
# Measured on the whole pixels that OpenCV fills, in the mean over positions and directions:
HEADING_HALF_PX = 1.475  # half the width of the line of HEADING_WIDTH_PX
HEADING_CAP_PX = 1.0  # of the line, beyond the robot's centre and rim
DISC_LOSS_PX = 0.04  # of a radius of 15 to 40 px
_NUM_LINES = 4  # scan lines per row of pixels, at Gauss-Legendre nodes: an error of at most 5
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(_NUM_LINES)
NODES, WEIGHTS = (_LEGENDRE_NODES + 1) / 2, _LEGENDRE_WEIGHTS / 2  # on [0, 1]
_BLOCK = 8  # pixels of a row that a disc fills at once; a row has 31 or more


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

    def render(self, scenes: Float32Array, out: UInt8Array) -> None:
        """Renders scenes [N, 3 K + 2 M + 3 O] of SceneCodec into out [N, V, V]."""
        _render_views(
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


@compiled
def _render_views(  # type: ignore[no-untyped-def]
    scenes, out, counts, heading_up, scale, wall, inner_walls, halves_px, radius
):
    num_robots, num_targets, num_obstacles = counts
    targets, obstacles = 3 * num_robots, 3 * num_robots + 2 * num_targets
    size = out.shape[1]
    lines = np.empty((2, _NUM_LINES * size))
    crop_half_px, target_half_px = halves_px
    half = target_half_px * scale  # of a target
    line_half, cap = HEADING_HALF_PX * scale, HEADING_CAP_PX * scale
    reach = radius + cap
    for n in range(len(scenes)):
        scene = scenes[n]
        view = out[n]
        view[:] = 0
        own_x = np.float64(scene[0])
        own_y = np.float64(scene[1])
        c, s = 1.0, 0.0  # positions map to (c x - s y, s x + c y) about the robot
        if heading_up:
            c, s = -math.sin(scene[2]), -math.cos(scene[2])
        else:
            own_x, own_y = _on_grid(own_x, crop_half_px), _on_grid(own_y, crop_half_px)
        if heading_up:  # only here are c and s float64, as numba types them
            _walls_slanted(view, lines, own_x, own_y, c, s, scale, wall)
        else:
            _walls_upright(view, own_x, own_y, scale, wall)
        _inner_walls(view, lines, own_x, own_y, c, s, scale, inner_walls)
        for j in range(obstacles, obstacles + 3 * num_obstacles, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            _disc(view, lines, x, y, (scene[j + 2] - DISC_LOSS_PX) * scale, OBSTACLE_INTENSITY)
        for j in range(targets, obstacles, 2):
            x, y = _on_grid(scene[j], target_half_px), _on_grid(scene[j + 1], target_half_px)
            x, y = _map(x - own_x, y - own_y, c, s, scale, size)
            if heading_up:
                _bar(view, lines, x, y, c, s, -half, half, half, TARGET_INTENSITY)
            else:
                _box(view, x - half, x + half, y - half, y + half, TARGET_INTENSITY)
        for j in range(0, 3 * num_robots, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            _disc(view, lines, x, y, radius, ROBOT_INTENSITY)
        for j in range(0, 3 * num_robots, 3):
            x, y = _map(scene[j] - own_x, scene[j + 1] - own_y, c, s, scale, size)
            if -reach < x < size + reach and -reach < y < size + reach:
                cos, sin = math.cos(scene[j + 2]), math.sin(scene[j + 2])
                across, along = c * cos - s * sin, s * cos + c * sin
                _bar(view, lines, x, y, across, along, -cap, reach, line_half, HEADING_INTENSITY)


@compiled
def _on_grid(middle, half):  # type: ignore[no-untyped-def]
    """Moves the middle of a square of half-width half so that its edges lie between pixels."""
    return np.rint(np.float64(middle) - half) + half


@compiled
def _map(x, y, c, s, scale, size):  # type: ignore[no-untyped-def]
    """Image coordinates of a position relative to the robot."""
    return (c * x - s * y) * scale + 0.5 * size, (s * x + c * y) * scale + 0.5 * size


@compiled
def _walls_upright(view, own_x, own_y, scale, wall):  # type: ignore[no-untyped-def]
    outer, inner, size_px = wall
    half = 0.5 * view.shape[0]
    left, left_in = (outer - own_x) * scale + half, (inner - own_x) * scale + half
    right_in = (size_px - inner - own_x) * scale + half
    right = (size_px - outer - own_x) * scale + half
    top, top_in = (outer - own_y) * scale + half, (inner - own_y) * scale + half
    bottom_in = (size_px - inner - own_y) * scale + half
    bottom = (size_px - outer - own_y) * scale + half
    _box(view, left, right, top, top_in, WALL_INTENSITY)
    _box(view, left, right, bottom_in, bottom, WALL_INTENSITY)
    _box(view, left, left_in, top_in, bottom_in, WALL_INTENSITY)
    _box(view, right_in, right, top_in, bottom_in, WALL_INTENSITY)


@compiled
def _walls_slanted(view, lines, own_x, own_y, c, s, scale, wall):  # type: ignore[no-untyped-def]
    outer, inner, size_px = wall
    size = view.shape[0]
    width = 0.5 * (inner - outer) * scale
    length = (size_px - 2 * outer) * scale
    short = (size_px - 2 * inner) * scale
    near = 0.5 * (outer + inner)
    far = size_px - near
    for at in (near, far):
        x, y = _map(outer - own_x, at - own_y, c, s, scale, size)
        _bar(view, lines, x, y, c, s, 0.0, length, width, WALL_INTENSITY)
        x, y = _map(at - own_x, inner - own_y, c, s, scale, size)
        _bar(view, lines, x, y, -s, c, 0.0, short, width, WALL_INTENSITY)


@compiled
def _inner_walls(view, lines, own_x, own_y, c, s, scale, walls):  # type: ignore[no-untyped-def]
    for ax, ay, bx, by, half in walls:
        length = math.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay))
        dx, dy = (bx - ax) / length, (by - ay) / length
        x, y = _map(ax - own_x, ay - own_y, c, s, scale, view.shape[0])
        across, along = c * dx - s * dy, s * dx + c * dy
        _bar(view, lines, x, y, across, along, 0.0, length * scale, half * scale, WALL_INTENSITY)


@compiled
def _blend(value, intensity, coverage):  # type: ignore[no-untyped-def]
    """A pixel's value once a shape covers this fraction of it."""
    return np.uint8(value + (intensity - np.float64(value)) * coverage + 0.5)


@compiled
def _box(view, x0, x1, y0, y1, intensity):  # type: ignore[no-untyped-def]
    """Renders the upright rectangle [x0, x1] x [y0, y1]."""
    size = view.shape[0]
    if not (x1 > 0 and x0 < size and y1 > 0 and y0 < size):
        return
    left, right = _pixels(x0, x1, size)
    top, bottom = _pixels(y0, y1, size)
    x0, x1 = max(x0, 0.0), min(x1, np.float64(size))
    y0, y1 = max(y0, 0.0), min(y1, np.float64(size))
    if right - left < bottom - top:  # a wall: a few long loops are faster than many short ones
        for j in range(left, right):
            wide = min(j + 1.0, x1) - max(np.float64(j), x0)
            for i in range(top, bottom):
                tall = min(i + 1.0, y1) - max(np.float64(i), y0)
                view[i, j] = _blend(view[i, j], intensity, tall * wide)
    else:
        for i in range(top, bottom):
            tall = min(i + 1.0, y1) - max(np.float64(i), y0)
            for j in range(left, right):
                wide = min(j + 1.0, x1) - max(np.float64(j), x0)
                view[i, j] = _blend(view[i, j], intensity, tall * wide)


@compiled
def _pixels(low, high, size):  # type: ignore[no-untyped-def]
    """First and last + 1 of the rows, or columns, that [low, high] covers at least in part.

    Unsigned, because an index that might count from the end keeps LLVM from vectorizing a loop.
    """
    return np.uintp(max(low, 0.0)), np.uintp(math.ceil(min(high, np.float64(size))))


@compiled
def _slice(i, low, high, y):  # type: ignore[no-untyped-def]
    """The part of [low, high] in row i: its top relative to y, and its height."""
    top = max(np.float64(i), low) - y
    return top, min(i + 1.0, high) - y - top


@compiled
def _place_lines(lines, first, last, low, high, y):  # type: ignore[no-untyped-def]
    """Writes the rows' scan lines, relative to y, to lines[0]; returns their number."""
    num = np.uintp(0)
    for i in range(first, last):
        top, tall = _slice(i, low, high, y)
        for k in range(_NUM_LINES):
            lines[0, num] = top + NODES[k] * tall
            num += np.uintp(1)
    return num


@compiled
def _of_row(numbers, row):  # type: ignore[no-untyped-def]
    """The numbers of a row's scan lines; row 0 is the first that has any."""
    at = np.uintp(_NUM_LINES) * row
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    return numbers[at], numbers[at + one], numbers[at + two], numbers[at + three]


@inlined
def _coverage(left, tall, lows, highs):  # type: ignore[no-untyped-def]
    """Fraction of the pixel [left, left + 1] that its scan lines cover from low to high.

    Inlined by numba: around a mere call LLVM would unroll the loops first and not vectorize them.
    """
    coverage = WEIGHTS[0] * tall * _part(left, lows[0], highs[0])
    coverage += WEIGHTS[1] * tall * _part(left, lows[1], highs[1])
    coverage += WEIGHTS[2] * tall * _part(left, lows[2], highs[2])
    coverage += WEIGHTS[3] * tall * _part(left, lows[3], highs[3])
    return min(coverage, 1.0)


@compiled
def _part(left, low, high):  # type: ignore[no-untyped-def]
    """Length of [left, left + 1] that lies in [low, high]."""
    return max(0.0, min(left + 1.0, high) - max(left, low))


@compiled
def _disc(view, lines, x, y, radius, intensity):  # type: ignore[no-untyped-def]
    """Renders a disc: exact along x, sampled by scan lines along y.

    It fills whole blocks of a row's pixels, covered or not: a block is a vector or two.
    """
    size = view.shape[0]
    if not (x + radius > 0 and x - radius < size and y + radius > 0 and y - radius < size):
        return
    low, high = y - radius, y + radius
    first, last = _pixels(low, high, size)
    left, right = _pixels(x - radius, x + radius, size)
    chords = lines[0]
    for n in range(_place_lines(lines, first, last, low, high, y)):
        chords[n] = math.sqrt(max(radius * radius - chords[n] * chords[n], 0.0))
    for start in range(int(left), int(right), _BLOCK):
        edge = np.float64(start)  # the block before has filled what lies left of it
        column = np.uintp(min(start, size - _BLOCK))
        for i in range(first, last):
            tall = _slice(i, low, high, y)[1]
            c0, c1, c2, c3 = _of_row(chords, i - first)
            lows = max(x - c0, edge), max(x - c1, edge), max(x - c2, edge), max(x - c3, edge)
            highs = x + c0, x + c1, x + c2, x + c3
            for k in range(_BLOCK):
                j = column + np.uintp(k)
                coverage = _coverage(np.float64(column) + k, tall, lows, highs)
                view[i, j] = _blend(view[i, j], intensity, coverage)


@compiled
def _bar(view, lines, x, y, dx, dy, start, end, half, intensity):  # type: ignore[no-untyped-def]
    """Renders the rectangle from start to end along (dx, dy) from (x, y), half to either side.

    Scan lines cross it the short way, where its extent is exact.
    """
    if abs(dx) >= abs(dy):
        _bar_across(view.T, lines, y, x, dy, dx, start, end, half, intensity)
    else:
        _bar_across(view, lines, x, y, dx, dy, start, end, half, intensity)


@compiled
def _bar_across(view, lines, x, y, dx, dy, start, end, half, intensity):  # type: ignore[no-untyped-def]
    """Renders a _bar with scan lines along the view's rows, for |dy| >= |dx|."""
    size = view.shape[0]
    low_y = y + min(start * dy, end * dy) - half * abs(dx)
    high_y = y + max(start * dy, end * dy) + half * abs(dx)
    low_x = x + min(start * dx, end * dx) - half * abs(dy)
    high_x = x + max(start * dx, end * dx) + half * abs(dy)
    if not (high_x > 0 and low_x < size and high_y > 0 and low_y < size):
        return
    first, last = _pixels(low_y, high_y, size)
    width, slope = half / abs(dy), dx / dy
    across = 1.0 / (dx if abs(dx) > 1e-9 else 1e-9)  # to an end, per px along
    lows, highs = lines[0], lines[1]
    for n in range(_place_lines(lines, first, last, low_y, high_y, y)):
        t = lows[n]
        middle = x + t * slope
        one, other = x + (start - t * dy) * across, x + (end - t * dy) * across
        lows[n] = max(max(middle - width, 0.0), min(one, other))
        highs[n] = min(min(middle + width, np.float64(size)), max(one, other))
    for i in range(first, last):
        tall = _slice(i, low_y, high_y, y)[1]
        its_lows, its_highs = _of_row(lows, i - first), _of_row(highs, i - first)
        low, high = min(its_lows), max(its_highs)
        for j in range(int(min(low, high)), math.ceil(high)):  # signed: too few for a vector
            coverage = _coverage(np.float64(j), tall, its_lows, its_highs)
            view[i, j] = _blend(view[i, j], intensity, coverage)
