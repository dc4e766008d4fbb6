"""TD errors on their way back to replay, sent by their own thread while the learner computes.

Invariants: the learner never waits for it, not even for the device: `put` takes tensors, and the
thread reads them. One message is under way at a time. At most `capacity` batches wait; the oldest
are dropped and counted, which is harmless: the next sample of a transition brings a newer error.
"""

import threading
from collections import deque

import numpy as np
import torch

from mrcdrl.common.messages.trajectory import Int64Array, Priorities
from mrcdrl.services.replay.client import PriorityWriter

_GATHER_S = 0.01  # a message waits so long for more batches: it costs more than its content
_GATHER_BATCHES = 16  # a message with so many does not wait


class PrioritiesSender:
    """Sends absolute TD errors; batches that wait share one message."""

    def __init__(self, writer: PriorityWriter, capacity: int) -> None:
        self._writer = writer
        self._waiting: deque[tuple[Int64Array, torch.Tensor]] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closing = False
        self._error: Exception | None = None
        self.dropped = 0
        """Number of batches whose errors never reached replay."""
        self._thread = threading.Thread(target=self._run, name="priorities")
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of batches whose errors are not sent yet."""
        return len(self._waiting)

    def put(self, keys: Int64Array, td_errors: torch.Tensor) -> None:
        """Send TD errors float32 [B], on any device, of the transitions keys int64 [B].

        Raises the error that ended the thread, such as a refusal by replay.
        """
        if self._error is not None:
            raise self._error
        with self._changed:
            if len(self._waiting) == self._capacity:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((keys, td_errors))
            if len(self._waiting) in (1, _GATHER_BATCHES):
                self._changed.notify()

    def close(self) -> None:
        """End the thread after the message under way; batches that wait are dropped."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while (batches := self._take()) is not None:
            try:
                errors = [td_errors.abs().cpu().numpy() for _, td_errors in batches]
                keys, found = np.concatenate([k for k, _ in batches]), np.concatenate(errors)
                finite = bool(np.isfinite(found).all())  # else learning diverged
                reply = self._writer.update(Priorities(keys, found)) if finite else None
            except Exception as error:  # noqa: BLE001  raised again by put, in the owner's thread
                self._error = error
                return
            if reply is None:
                with self._changed:
                    self.dropped += len(batches)

    def _take(self) -> list[tuple[Int64Array, torch.Tensor]] | None:
        """All batches that wait, shortly after the first one arrived; None when closing."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._waiting)
            self._changed.wait_for(
                lambda: self._closing or len(self._waiting) >= _GATHER_BATCHES, _GATHER_S
            )
            if self._closing:
                return None
            batches = list(self._waiting)
            self._waiting.clear()
            return batches
