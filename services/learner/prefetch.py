"""Mini-batches, fetched and decoded by their own thread while the learner computes.

A thread with time to spare, since batches wait, computes a part of the step ahead as well.

Invariant: at most `depth` decoded batches wait; when they do, no further one is requested.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor

from mrcdrl.common.config import Config
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.fitting import Fitting
from mrcdrl.common.messages.trajectory import Samples
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.services.learner.accelerate.side_stream import on_side_stream
from mrcdrl.services.learner.batch import Batch, collate, importance_exponent_at
from mrcdrl.services.learner.demonstrator import demonstrator
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.rendering import make_renderer
from mrcdrl.services.learner.symmetries import LayoutSymmetries
from mrcdrl.services.replay.client import ReplayReader

_LOG = logging.getLogger("learner")
_POLL_S = 0.2


class Prefetcher:
    """Keeps batches ready for the learner."""

    def __init__(
        self,
        reader: ReplayReader,
        collate: Callable[[Samples], Batch],
        depth: int,
        stop: StopSignal,
        ahead: Callable[[Batch], Batch] | None = None,
    ) -> None:
        """ahead: does a part of a batch's step, while another batch waits."""
        self._reader = reader
        self._collate = collate
        self._ahead = ahead
        self._ready: queue.Queue[Batch] = queue.Queue(depth)
        self._stop = stop
        self._error: Exception | None = None
        self.decode_s = 0.0
        self.refused = 0
        self._thread = threading.Thread(target=self._run, name="prefetch")
        self._thread.start()

    @property
    def ready(self) -> int:
        """Number of batches that wait."""
        return self._ready.qsize()

    @property
    def heard_s(self) -> float:
        """Monotonic time of replay's last answer."""
        return self._reader.heard_s

    def next(self, timeout_s: float, most: int = 1) -> list[Batch]:
        """The next batches: `most` or as many as are ready; [] where none is ready in time.

        Raises the error that ended the thread.
        """
        try:
            batches = [self._ready.get(timeout=timeout_s)]
        except queue.Empty:
            if self._error is not None:
                raise self._error from None
            return []
        while len(batches) < most and not self._ready.empty():  # nobody else takes any
            batches.append(self._ready.get_nowait())
        return batches

    def close(self) -> None:
        """End the thread; the stop signal must be set."""
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                samples = self._reader.sample()
                if samples is None:
                    return
                started = time.perf_counter()
                batch = self._collate(samples)
                self.decode_s += time.perf_counter() - started
                if self._ahead is not None and self.ready:
                    batch = self._ahead(batch)
            except WireError as error:
                self.refused += 1
                if is_logged(self.refused):
                    _LOG.warning("mini-batch refused, %d so far: %s", self.refused, error)
                continue
            except Exception as error:  # noqa: BLE001  raised again by next, in the owner's thread
                self._error = error
                return
            self._put(batch)

    def _put(self, batch: Batch) -> None:
        while not self._stop.is_set():
            try:
                self._ready.put(batch, timeout=_POLL_S)
            except queue.Full:
                continue
            return


def make_collate(
    config: Config, learner: Learner, rendering_threads: Executor | None = None
) -> Callable[[Samples], Batch]:
    """A function from samples to the batch of one step, its images rendered by these threads.

    It raises WireError for samples that do not fit the run.
    """
    fitting = Fitting(config)
    symmetries = LayoutSymmetries(config.arena) if config.learner.symmetries else None
    render = make_renderer(config.arena, learner.device, rendering_threads)
    demonstrate = None if config.agent.demonstrator == "none" else demonstrator(config.arena)

    def collated(samples: Samples) -> Batch:
        fitting.check(samples)
        drawn = () if symmetries is None else symmetries.draw(samples.records, learner.rng)
        return collate(
            samples,
            render,
            config.arena.stack,
            symmetry_rows=drawn,
            num_actions=config.arena.action_count,
            beta=importance_exponent_at(config.replay, learner.learner_step),
            demonstrate=demonstrate,
            demonstration_weight=value_at(
                config.agent.demonstration_schedule, learner.learner_step
            ),
        )

    return on_side_stream(collated, learner.device)
