"""Images from records of codec `scene`, and the network's values: docs/wire.md, in numpy alone.

Nothing of this project is imported, so that it can be read as the protocol's second implementation.
It is slow, and renders as `renderer = "analytic"` does.
"""

import io
import json
from typing import Any

import numpy as np

WALL, OBSTACLE, TARGET, ROBOT, HEADING = 76, 150, 29, 255, 0
DISC_LOSS, HEADING_HALF, HEADING_CAP = 0.04, 1.475, 1.0  # px of the arena
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)  # on [-1, 1]


def counts(arena: dict[str, Any]) -> tuple[int, int, int]:
    """Robots, targets and obstacles in a record of this configuration, absent ones among them."""
    robots = arena["num_robots"]
    obstacles = len(arena["obstacles_px"]) + arena["num_obstacles"]
    return robots, arena["num_targets"] or robots, obstacles


def record_bytes(arena: dict[str, Any]) -> int:
    """Length of a record, R."""
    if arena["codec"] == "frames":
        return arena["view_px"] ** 2
    robots, targets, obstacles = counts(arena)
    return 4 * (3 * robots + 2 * targets + 3 * obstacles + (arena["pixel_noise"] > 0))


def render(record: bytes, arena: dict[str, Any]) -> np.ndarray:
    """The image, uint8 [V, V], of a record of codec `scene`."""
    robots, targets, obstacles = counts(arena)
    numbers = np.frombuffer(record, "<f4").astype(float)
    own, others = numbers[:3], numbers[: 3 * robots].reshape(-1, 3)
    squares = numbers[3 * robots :][: 2 * targets].reshape(-1, 2)
    discs = numbers[3 * robots + 2 * targets :][: 3 * obstacles].reshape(-1, 3)
    view = View(arena, *own)
    near, thick, size = arena["wall_offset_px"], arena["wall_thickness_px"], arena["size_px"]
    middle, far = near + thick / 2, size - near - thick / 2
    for at in (middle, far):
        view.bar((near, at), (size - near, at), thick / 2, WALL)
    for at in (middle, far):
        view.bar((at, near + thick), (at, size - near - thick), thick / 2, WALL)
    for ax, ay, bx, by in arena["inner_walls_px"]:
        view.bar((ax, ay), (bx, by), thick / 2, WALL)
    for x, y, radius in discs:
        view.disc(x, y, radius - DISC_LOSS, OBSTACLE)
    half = arena["target_size_px"] / 2
    for x, y in present(squares):
        x, y = np.rint(x - half) + half, np.rint(y - half) + half
        view.bar((x - half, y), (x + half, y), half, TARGET)
    radius = arena["robot_radius_px"] - DISC_LOSS
    for x, y, _ in present(others):
        view.disc(x, y, radius, ROBOT)
    for x, y, heading in present(others):
        along = np.array([np.cos(heading), np.sin(heading)])
        start, end = (x, y) - HEADING_CAP * along, (x, y) + (radius + HEADING_CAP) * along
        view.bar(start, end, HEADING_HALF, HEADING)
    if arena["pixel_noise"] > 0:
        return noisy(view.image, np.frombuffer(record, "<u4")[-1:], arena["pixel_noise"])
    return view.image


def present(rows: np.ndarray) -> np.ndarray:
    """The rows of what is there: an absent robot's or target's numbers are NaN."""
    return rows[np.isfinite(rows).all(axis=1)]


def noisy(image: np.ndarray, seed: np.ndarray, deviation: float) -> np.ndarray:
    """The image with the noise of a seed, uint32 [1]."""
    step = np.uint64(0x9E3779B97F4A7C15)
    states = mixed(seed * step) + step * np.arange(1, image.size + 1, dtype=np.uint64)
    parts = mixed(states).view("<u2").reshape(*image.shape, 4)
    offsets = (parts.sum(axis=2, dtype=float) - 131_070) * deviation / np.sqrt((65_536**2 - 1) / 3)
    return np.clip(image + offsets + 0.5, 0, 255).astype(np.uint8)


def mixed(z: np.ndarray) -> np.ndarray:
    """Splitmix64's mixture of 64-bit numbers."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


class View:
    """One robot's image; shapes are given in px of the arena."""

    def __init__(self, arena: dict[str, Any], x: float, y: float, heading: float) -> None:
        self.size, window = arena["view_px"], arena["crop_px"]
        self.scale = self.size / window
        self.image = np.zeros((self.size, self.size), np.uint8)
        self.turn = np.eye(2)
        self.own = np.rint(np.array([x, y]) - window / 2) + window / 2  # whole px are cropped
        if arena["orientation"] == "heading_up":
            c, s = -np.sin(heading), -np.cos(heading)
            self.turn, self.own = np.array([[c, -s], [s, c]]), np.array([x, y])

    def place(self, point: Any) -> np.ndarray:
        """Column and row of a point: pixel (i, j) covers [j, j + 1) and [i, i + 1)."""
        return self.turn @ (np.asarray(point) - self.own) * self.scale + self.size / 2

    def disc(self, x: float, y: float, radius: float, intensity: int) -> None:
        """Cover a disc, by scan lines along its rows."""
        (x, y), radius = self.place((x, y)), radius * self.scale

        def chord(at: float) -> tuple[float, float]:
            half = np.sqrt(max(radius**2 - (at - y) ** 2, 0.0))
            return x - half, x + half

        self._cover(self.image, y - radius, y + radius, chord, intensity)

    def bar(self, start: Any, end: Any, half: float, intensity: int) -> None:
        """Cover a rectangle around the line from start to end, by lines that cross it."""
        (x0, y0), (x1, y1), half = self.place(start), self.place(end), half * self.scale
        image = self.image
        if abs(x1 - x0) >= abs(y1 - y0):  # lines along its columns
            image, x0, y0, x1, y1 = image.T, y0, x0, y1, x1
        length = np.hypot(x1 - x0, y1 - y0)
        dx, dy = (x1 - x0) / length, (y1 - y0) / length
        reach = half * abs(dx)

        def chord(at: float) -> tuple[float, float]:
            middle, width = x0 + (at - y0) * dx / dy, half / abs(dy)
            if abs(dx) < 1e-9:
                return middle - width, middle + width
            ends = x0 - (at - y0) * dy / dx, x0 + (length - (at - y0) * dy) / dx
            return max(middle - width, min(ends)), min(middle + width, max(ends))

        self._cover(image, min(y0, y1) - reach, max(y0, y1) + reach, chord, intensity)

    def _cover(self, image: np.ndarray, low: float, high: float, chord: Any, value: int) -> None:
        """Blend a shape that reaches from row `low` to row `high`, four scan lines a row."""
        for i in range(max(int(low), 0), min(int(np.ceil(high)), self.size)):
            top, bottom = max(i, low), min(i + 1, high)
            covered = np.zeros(self.size)
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                left, right = chord(top + (node + 1) / 2 * (bottom - top))
                columns = np.arange(self.size)
                part = np.minimum(columns + 1, right) - np.maximum(columns, left)
                covered += weight / 2 * (bottom - top) * np.maximum(part, 0)
            before = image[i].astype(float)
            image[i] = np.floor(before + (value - before) * np.minimum(covered, 1) + 0.5)


def weights_of(payload: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The metadata of published weights, and their arrays as float32."""
    file = io.BytesIO(payload)
    header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    metadata = json.loads(header.pop("__metadata__")["mrcdrl"])
    data, arrays = file.read(), {}
    for name, entry in header.items():
        raw = data[slice(*entry["data_offsets"])]
        if entry["dtype"] == "BF16":  # the upper half of a float32
            values = (np.frombuffer(raw, "<u2").astype("<u4") << 16).view("<f4")
        else:
            values = np.frombuffer(raw, {"F32": "<f4", "F16": "<f2"}[entry["dtype"]])
        arrays[name] = values.astype(np.float32).reshape(entry["shape"])
    return metadata, arrays


def q_values(state: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Values [3] (left, straight, right) of a state, uint8 [S, V, V], oldest image first."""
    x = _convolved(state / np.float32(255), arrays, "conv1", stride=2)
    side = x.shape[1] // 2
    x = x[:, : 2 * side, : 2 * side].reshape(len(x), side, 2, side, 2).max(axis=(2, 4))
    x = _convolved(np.maximum(x, 0), arrays, "conv2", stride=2)
    x = _convolved(np.maximum(x, 0), arrays, "conv3", stride=1)
    features = np.maximum(x, 0).ravel()  # channel by channel, each row by row
    if "value.weight" not in arrays:
        return _stream(features, arrays, "hidden", "action_value")
    value = _stream(features, arrays, "value_hidden", "value")
    advantage = _stream(features, arrays, "advantage_hidden", "advantage")
    return value + advantage - advantage.mean()


def _convolved(x: np.ndarray, arrays: dict[str, np.ndarray], name: str, stride: int) -> np.ndarray:
    kernel, bias = arrays[f"{name}.weight"], arrays[f"{name}.bias"]
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], axis=(1, 2))
    windows = windows[:, ::stride, ::stride]
    return np.einsum("chwij,ocij->ohw", windows, kernel, optimize=True) + bias[:, None, None]


def _stream(features: np.ndarray, arrays: dict[str, np.ndarray], *names: str) -> np.ndarray:
    hidden, out = names
    units = np.maximum(arrays[f"{hidden}.weight"] @ features + arrays[f"{hidden}.bias"], 0)
    return arrays[f"{out}.weight"] @ units + arrays[f"{out}.bias"]
