"""Work cut into slices, each done by a thread of its own: rows of a batch, units, parameters.

Invariants: results come in the order of the slices; the calling thread takes the first of them;
threads meet once a map. Inside an operation they would meet at every layer, and each time wait
for the one that another process keeps from its core.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import torch

T = TypeVar("T")


class Slices:
    """Up to `num` slices at once; the calling thread's torch should compute with one thread."""

    def __init__(self, num: int) -> None:
        self.num = num
        self._threads = (
            ThreadPoolExecutor(num - 1, "slice", partial(torch.set_num_threads, 1))
            if num > 1
            else None
        )

    def map(self, work: Callable[[slice], T], size: int) -> list[T]:
        """What the work gives for each slice of `size` rows; raises what it raises."""
        num = min(self.num, size)
        first, *others = (slice(i * size // num, (i + 1) * size // num) for i in range(num))
        if self._threads is None:
            return [work(first)]
        begun = [self._threads.submit(work, other) for other in others]
        return [work(first), *(future.result() for future in begun)]
