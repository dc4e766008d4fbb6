"""Curves in braille characters: two points a column, four levels a row.

Invariants: pure; every line is exactly as wide as asked for.
"""

import itertools
from collections.abc import Sequence

# Bits of the dots of U+2800, [column 0 or 1][row 0 (top) ... 3].
DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
BLANK = 0x2800


def resample(values: Sequence[float], num_points: int) -> list[float]:
    """The values as so many points: means of equal shares of many, lines between few."""
    count = len(values)
    if count == 0:
        return []
    if count < num_points:
        return [_between(values, i * (count - 1) / (num_points - 1)) for i in range(num_points)]
    bounds = [i * count // num_points for i in range(num_points + 1)]
    return [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(bounds)]


def _between(values: Sequence[float], position: float) -> float:
    """The value at a position between two indices."""
    index = min(int(position), len(values) - 1)
    after = min(index + 1, len(values) - 1)
    return values[index] + (position - index) * (values[after] - values[index])


def braille_curve(
    values: Sequence[float], width: int, height: int, low: float, high: float
) -> list[str]:
    """`height` lines of `width` characters with the curve of `values` between low and high.

    Neighbouring points are joined by upright strokes; values outside are drawn at the edge.
    """
    cells = [[BLANK] * width for _ in range(height)]
    top = 4 * height - 1
    before: int | None = None
    for x, value in enumerate(resample(values, 2 * width)):
        share = min(1.0, max(0.0, (value - low) / (high - low)))
        level = top - round(share * top)
        start = level if before is None else before + (level > before) - (level < before)
        for y in range(min(start, level), max(start, level) + 1):
            cells[y // 4][x // 2] |= DOTS[x % 2][y % 4]
        before = level
    return ["".join(map(chr, row)) for row in cells]
