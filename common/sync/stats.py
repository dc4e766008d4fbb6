"""Statistics: a service publishes its metrics once a second, and keeps its heartbeat.

Invariant: while a function is being compiled, which may hold up the main loop, they say so.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import TransportError
from mrcdrl.common.messages.metrics import Metrics, numbers
from mrcdrl.common.messages.trajectory import COMPILING, DOING, Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.compiling import compiling, tell_compiling
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.versions import versions
from mrcdrl.common.transport import Publisher

_WARM_UP_S = 600.0  # to compile what the first work needs, where ten others want the cores, too


@dataclass(frozen=True, slots=True)
class Report:
    """What a service of a run last reported about itself."""

    run: str
    role: str
    worker: str
    metrics: Mapping[str, float]


class StatsReporter:
    """Publishes a service's metrics and writes its heartbeat, from the service's main loop."""

    def __init__(
        self, publisher: Publisher, role: str, worker: str, *, warms_up: bool = False
    ) -> None:
        """warms_up: the first work may take minutes; no hang is told before `warmed_up`."""
        self._publisher = publisher
        self._role = role
        self._worker = worker
        self._metrics: dict[str, float] = {}  # as last published; replaced, never changed
        self._text = {"incarnation": str(time.time_ns()), **versions()}
        self._heartbeat = Heartbeat.from_environment()
        self._patience_s = _WARM_UP_S if warms_up else 0.0
        self._due_s = 0.0
        self._lock = threading.Lock()
        tell_compiling(self._publish_compiling)

    def warmed_up(self) -> None:
        """Note that the first work is done: from now on a long silence is a hang."""
        self._patience_s = 0.0

    def worked(self, at_s: float | None = None) -> None:
        """Note that work was done, or that there is none to do, at `at_s` (now by default)."""
        self._heartbeat.worked(at_s)

    def publish_if_due(self, metrics: Callable[[], Metrics]) -> None:
        """Publish if a second has passed since the last time."""
        if time.monotonic() >= self._due_s:
            self.publish(metrics)

    def publish(self, metrics: Callable[[], Metrics]) -> None:
        """Publish now, whether due or not."""
        self._metrics = numbers(metrics())
        self._publish()

    def last(self, run: str) -> Report:
        """What was published last; from any thread."""
        return Report(run, self._role, self._worker, self._metrics)

    def _publish_compiling(self) -> None:
        """Publish, from any thread, that this process compiles; at most once a second."""
        self._heartbeat.worked()
        if time.monotonic() >= self._due_s:
            self._publish()

    def _publish(self) -> None:
        self._due_s = time.monotonic() + 1.0
        text = {**self._text, "clock_ns": str(time.time_ns())}
        if compiling():
            text[DOING] = COMPILING
        try:
            with self._lock:
                stats = Stats(self._role, self._worker, self._metrics, text)
                self._publisher.put(encode(stats))
        except TransportError as error:
            logging.getLogger(self._role).warning("statistics not published: %s", error)
        self._heartbeat.beat(self._patience_s)


def serve_statistics(
    transport: TransportConfig, role: str, run: str = "", reporter: StatsReporter | None = None
) -> AbstractContextManager[None]:
    """Serve a process's own statistics to Prometheus meanwhile, if transport.metrics_port says so.

    reporter: None for a process that publishes none.
    """
    if not transport.metrics_port:
        return nullcontext()
    from mrcdrl.common.sync.exposition import process_registry
    from mrcdrl.common.sync.metrics_server import serve_registry

    report = None if reporter is None else partial(reporter.last, run)
    return serve_registry(transport, role, lambda: process_registry(report))
