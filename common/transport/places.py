"""The places of a router: it logs when all are taken, since Zenoh refuses further peers in silence.

Invariant: Zenoh's callback only enqueues; the thread `places` ends with `close`.
"""

import logging
import queue
import threading
from typing import Any

import zenoh

from mrcdrl.common.runtime.repeats import is_logged

_LOG = logging.getLogger("transport")


class Places:
    """Counts the peers that have joined a router's session."""

    def __init__(self, session: zenoh.Session, max_peers: int) -> None:
        self._max_peers = max_peers
        self._changes: queue.SimpleQueue[int | None] = queue.SimpleQueue()  # None: closed
        self._listener: Any = session.info.declare_transport_events_listener(
            zenoh.handlers.Callback(self._offer, indirect=False)
        )
        self._thread = threading.Thread(target=self._count, name="places", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop counting."""
        self._changes.put(None)
        self._thread.join()

    def _offer(self, event: Any) -> None:
        """Zenoh's callback."""
        self._changes.put(1 if event.kind == zenoh.SampleKind.PUT else -1)

    def _count(self) -> None:
        """Log the 1st, 2nd, 4th, 8th … time that the last place is taken."""
        taken = times = 0
        while (change := self._changes.get()) is not None:
            taken += change
            if change > 0 and taken >= self._max_peers:
                times += 1
                if is_logged(times):
                    _LOG.warning(
                        "%d peers have joined, as many as transport.max_peers allows: others are "
                        "refused",
                        taken,
                    )
