"""Threads that share work: each takes a slice of a batch's rows, of a layer's units, of parameters.

Invariants: results come in the order of the slices; the calling thread takes the first slice.
Threads meet once a `map`. Threads inside an operation would meet at every layer, and wait each
time for the one whose core another process holds.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import torch

T = TypeVar("T")


class DataParallel:
    """Works on up to `num_threads` slices at once, each with one thread of torch's."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads
        self.active = num_threads
        """Threads that work now: 1 ... num_threads."""
        self._pool = (
            ThreadPoolExecutor(num_threads - 1, "slice", partial(torch.set_num_threads, 1))
            if num_threads > 1
            else None
        )

    def map(self, work: Callable[[slice], T], size: int) -> list[T]:
        """The results of the work on each slice of `size` rows; raises what the work raises."""
        num = min(self.active, size)
        first, *others = (slice(i * size // num, (i + 1) * size // num) for i in range(num))
        if self._pool is None or not others:
            return [work(first)]
        begun = [self._pool.submit(work, other) for other in others]
        return [work(first), *(future.result() for future in begun)]
