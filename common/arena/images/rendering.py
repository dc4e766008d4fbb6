"""Renders the arena with OpenCV, and crops the robots' images from it as the paper does.

Invariants: position x of the arena is rendered at OpenCV's coordinate x - 1/2, because OpenCV
counts from pixel centres and the arena from pixel edges. Filled shapes cover the area they have in
the world (OpenCV fills a disc's rim too, so discs are rendered half a pixel smaller). What is
absent, NaN, is not rendered.
"""

import math

import cv2
import numpy as np

from mrcdrl.common.arena.images.views import HEADING_WIDTH_PX
from mrcdrl.common.arena.world.obstacles import inner_walls
from mrcdrl.common.arena.world.scene import Scene
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import Float64Array, UInt8Array

BLACK = (0, 0, 0)
WHITE = (255, 255, 255)
RED = (0, 0, 255)
GREEN = (0, 255, 0)
BLUE = (255, 0, 0)
Colour = tuple[int, int, int]  # blue, green, red
_SHIFT = 8  # fractional bits of OpenCV's coordinates


def render_arena(
    scene: Scene, config: ArenaConfig, size: int = 600, *, smooth: bool = False
) -> UInt8Array:
    """Renders the arena as BGR [size, size, 3]; smooth: anti-aliased, for people to look at."""
    scale = size / config.size_px
    image = np.zeros((size, size, 3), np.uint8)
    line_type = cv2.LINE_AA if smooth else cv2.LINE_8
    outer = config.wall_offset_px
    inner = outer + config.wall_thickness_px
    _fill(image, outer * scale, size - outer * scale, RED)
    _fill(image, inner * scale, size - inner * scale, BLACK)
    for wall in inner_walls(config):
        _render_wall(image, wall * scale, line_type)
    for x, y, radius in _there(scene.obstacles * scale):
        _render_disc(image, x, y, radius, GREEN, line_type)
    half = config.target_size_px / 2
    for x, y in _there(scene.targets):
        corners = np.array([[x - half, y - half], [x + half, y + half]]) * scale
        (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
        image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = BLUE
    radius = config.robot_radius_px * scale
    for x, y, _ in _there(scene.robots):
        _render_disc(image, x * scale, y * scale, radius, WHITE, line_type)
    width = max(1, round(HEADING_WIDTH_PX * scale))
    for x, y, heading in _there(scene.robots):
        rim = (x * scale + radius * math.cos(heading), y * scale + radius * math.sin(heading))
        start = _fixed(x * scale, y * scale)
        cv2.line(image, start, _fixed(*rim), BLACK, width, line_type, _SHIFT)
    return image


def literal_views(scene: Scene, config: ArenaConfig) -> UInt8Array:
    """Renders images [K, V, V] by the paper's steps (section 4, Fig. 3).

    The arena is rendered at one pixel per px and converted to grayscale. The square centred on the
    robot (rounded to whole pixels) is cropped, zeros beyond the border, and resized by area.
    """
    image = render_arena(scene, config, config.size_px)
    grayscale = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    views = np.zeros((len(scene.robots), config.view_px, config.view_px), np.uint8)
    for i, (x, y, heading) in enumerate(scene.robots.tolist()):
        if not math.isfinite(x + y + heading):
            continue  # an absent robot sees nothing
        window = (
            _turned_window(grayscale, x, y, heading, config)
            if config.orientation == "heading_up"
            else _window(grayscale, x, y, config)
        )
        size = (config.view_px, config.view_px)
        views[i] = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
    return views


def _there(rows: Float64Array) -> list[list[float]]:
    """The rows [..., 2 or 3] of what is not absent."""
    kept: list[list[float]] = rows[np.isfinite(rows).all(axis=1)].tolist()
    return kept


def _window(grayscale: UInt8Array, x: float, y: float, config: ArenaConfig) -> UInt8Array:
    """Crops the square of crop_px around (x, y), zeros beyond the border."""
    width = round(config.crop_px)
    left, top = round(x - config.crop_px / 2), round(y - config.crop_px / 2)
    window = np.zeros((width, width), np.uint8)
    height, length = grayscale.shape
    x0, x1 = max(left, 0), min(left + width, length)
    y0, y1 = max(top, 0), min(top + width, height)
    window[y0 - top : y1 - top, x0 - left : x1 - left] = grayscale[y0:y1, x0:x1]
    return window


def _turned_window(
    grayscale: UInt8Array, x: float, y: float, heading: float, config: ArenaConfig
) -> UInt8Array:
    """Crops the square of crop_px around (x, y), rotated so that the heading points up."""
    width = round(config.crop_px)
    c, s = -math.sin(heading), -math.cos(heading)
    x, y = x - 0.5, y - 0.5  # in OpenCV's coordinates
    centre = config.crop_px / 2 - 0.5
    turn = np.array([[c, -s, centre - c * x + s * y], [s, c, centre - s * x - c * y]])
    return np.asarray(cv2.warpAffine(grayscale, turn, (width, width)), np.uint8)


def _fill(image: UInt8Array, low: float, high: float, colour: Colour) -> None:
    first, last = round(low), round(high) - 1
    cv2.rectangle(image, (first, first), (last, last), colour, -1)  # ten times faster than numpy


def _render_disc(
    image: UInt8Array, x: float, y: float, radius: float, colour: Colour, line_type: int
) -> None:
    rim = round(max(radius - 0.5, 0) * 2**_SHIFT)
    cv2.circle(image, _fixed(x, y), rim, colour, -1, line_type, _SHIFT)


def _render_wall(image: UInt8Array, wall: Float64Array, line_type: int) -> None:
    """Fills the rectangle of a wall [5], half a pixel smaller on all sides."""
    ends, half = wall[:4].reshape(2, 2), max(wall[4] - 0.5, 0)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across = half * np.array([-along[1], along[0]])
    start, end = ends[0] + 0.5 * along, ends[1] - 0.5 * along
    corners = [start - across, start + across, end + across, end - across]
    points = np.array([_fixed(x, y) for x, y in corners])
    cv2.fillConvexPoly(image, points, RED, line_type, _SHIFT)


def _fixed(x: float, y: float) -> tuple[int, int]:
    """Converts a position to OpenCV's fixed-point coordinates."""
    return round((x - 0.5) * 2**_SHIFT), round((y - 0.5) * 2**_SHIFT)
