"""How many threads share a batch: measured while the learner runs, since it depends on the others.

A second thread is worth a core that would idle. Beside busy neighbours it costs more than it
brings, because the threads wait for each other.

Invariants: pure, the clock is the caller's; every count is tried in turns with the others, so that
a neighbour that comes or goes meanwhile does not decide.
"""

import logging
import time
from collections.abc import Callable, Sequence
from statistics import median

_LOG = logging.getLogger("learner")
_BLOCK = 20  # steps in a row with one count
_ROUNDS = 3  # blocks of each count before a choice
_FIRST_HOLD_S = 8.0  # between a choice and the next trial: while kernels compile, it is soon wrong
_HOLD_S = 60.0  # at most, twice as long each time


class ThreadTuner:
    """Tells how many threads the next step should have."""

    def __init__(self, counts: Sequence[int], clock: Callable[[], float] = time.monotonic) -> None:
        """counts: to choose from, at least one."""
        self._counts = tuple(counts)
        self._clock = clock
        self._chosen = 0
        self._hold_s = _FIRST_HOLD_S
        self._begin_trial()

    def _begin_trial(self) -> None:
        self._hold_until_s: float | None = None
        self._seconds: dict[int, list[float]] = {count: [] for count in self._counts}
        self._blocks = [*self._counts] * _ROUNDS
        self._begin_block()

    def _begin_block(self) -> None:
        self.count = self._blocks.pop()
        self._left = _BLOCK

    def took(self, seconds: float) -> None:
        """Take the duration of a step with `count` threads; `count` may change by it."""
        if self._hold_until_s is not None:
            if self._clock() >= self._hold_until_s:
                self._begin_trial()
            return
        self._seconds[self.count].append(seconds)
        self._left -= 1
        if self._left:
            return
        if self._blocks:
            self._begin_block()
            return
        self.count = min(self._counts, key=lambda count: median(self._seconds[count]))
        self._hold_until_s = self._clock() + self._hold_s
        self._hold_s = min(2 * self._hold_s, _HOLD_S)
        if self.count != self._chosen:
            _LOG.info("%d of up to %d threads share a batch", self.count, max(self._counts))
        self._chosen = self.count


def thread_counts(cores: int) -> list[int]:
    """Counts worth a trial on so many cores: powers of two, and all of them."""
    return sorted({*(1 << i for i in range(cores.bit_length()) if 1 << i <= cores), cores})
