"""Statistics over recent reports: rate of a counter, mean of a share, spread of a value.

Invariants: no clock inside; times come with the calls and never fall. Nothing older than the
window is kept, so memory is bounded by the reports of one window.
"""

import math
from collections import deque
from dataclasses import dataclass

WINDOW_S = 10.0
SPREAD_S = 600.0


@dataclass(frozen=True, slots=True)
class Spread:
    """Minimum, mean and 99th percentile of the values in a window."""

    min: float
    mean: float
    p99: float


class Rate:
    """Increments of one counter of one service over the last WINDOW_S seconds."""

    def __init__(self, persistent: bool, counted: float = 0.0) -> None:
        """persistent: the counter outlives its service. When it falls (back to a checkpoint),
        nothing was counted; any other counter restarted at 0. counted: the part of its first
        value that was counted before."""
        self._persistent = persistent
        self._counted = counted
        self._last: float | None = None
        self._since_s = self._until_s = 0.0
        self._increments: deque[tuple[float, float]] = deque()

    def observe(self, value: float, now: float, restarted: bool = False) -> float:
        """Take the counter's value; return the increase since the previous one."""
        if self._last is None:
            self._last = value
            self._since_s = self._until_s = now
            return value - self._counted if value >= self._counted else value
        increment = value - self._last
        if increment < 0 or (restarted and not self._persistent):
            increment = 0.0 if self._persistent else value
        self._last, self._until_s = value, now
        self._increments.append((now, increment))
        self._forget(now)
        return increment

    def per_second(self, now: float) -> float:
        """Increase over the window, or from the first value to the last if that was shorter."""
        self._forget(now)
        whole = now - self._since_s >= WINDOW_S
        span = WINDOW_S if whole else self._until_s - self._since_s
        return sum(increment for _, increment in self._increments) / span if span > 0 else 0.0

    def _forget(self, now: float) -> None:
        while self._increments and self._increments[0][0] <= now - WINDOW_S:
            self._increments.popleft()


class Share:
    """Mean of a share or flag over the reports of the last WINDOW_S seconds."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float]] = deque()

    def observe(self, value: float, now: float) -> None:
        self._values.append((now, value))
        while self._values[0][0] <= now - WINDOW_S:
            self._values.popleft()

    @property
    def mean(self) -> float:
        """0 when nothing was reported."""
        return sum(value for _, value in self._values) / max(1, len(self._values))


class SpreadWindow:
    """Spread of the values of the last SPREAD_S seconds."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float]] = deque()

    def observe(self, value: float, now: float) -> None:
        self._values.append((now, value))
        while self._values[0][0] <= now - SPREAD_S:
            self._values.popleft()

    @property
    def spread(self) -> Spread | None:
        """None if nothing was reported; p99 is the smallest value that 99 % do not exceed."""
        if not self._values:
            return None
        values = sorted(value for _, value in self._values)
        p99 = values[math.ceil(0.99 * len(values)) - 1]
        return Spread(values[0], sum(values) / len(values), p99)
