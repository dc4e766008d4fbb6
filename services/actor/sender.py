"""A bounded spool between the arenas and replay, emptied by its own thread.

Invariants: chunks leave in order, all waiting chunks in one request; none is dropped. A full spool
makes `put` wait, which is how replay's rate limiter throttles the arenas.
"""

import contextlib
import queue
import threading
from collections.abc import Callable, Sequence

from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.replay.client import ReplayWriter

_POLL_S = 0.2


class Sender:
    """Sends chunks to replay in the background."""

    def __init__(self, writer: ReplayWriter, spool_chunks: int) -> None:
        self._writer = writer
        self._spool: queue.Queue[Chunk | None] = queue.Queue(spool_chunks)  # None: closing
        self._closing = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="sender")
        self.chunks = 0
        self.transitions = 0
        self._thread.start()

    @property
    def spooled(self) -> int:
        """Chunks waiting to be sent."""
        return self._spool.qsize()

    @property
    def heard_s(self) -> float:
        """When replay last answered, on the monotonic clock."""
        return self._writer.heard_s

    def put(self, chunk: Chunk, timeout_s: float) -> bool:
        """Spool the chunk; False if there was no room within the time.

        Raises the error that stopped the sender, such as RefusedError with replay's reason.
        """
        self.check()
        try:
            self._spool.put(chunk, timeout=timeout_s)
        except queue.Full:
            return False
        return True

    def check(self) -> None:
        """Raise the error that stopped the sender, if one did."""
        if self._error is not None:
            raise self._error

    def put_all(
        self, chunks: Sequence[Chunk], stop: StopSignal, meanwhile: Callable[[], None]
    ) -> None:
        """Spool them in order; once stopped, give up at the first for which there is no room.

        meanwhile: called several times a second while there is no room.
        """
        for chunk in chunks:
            while not self.put(chunk, _POLL_S):
                if stop.is_set():
                    return
                meanwhile()

    def close(self) -> None:
        """Send the spooled chunks if replay accepts them at once, then end the thread."""
        self._closing.set()
        with contextlib.suppress(queue.Full):  # then the thread does not wait, and sees the flag
            self._spool.put_nowait(None)
        self._thread.join()

    def _run(self) -> None:
        while chunks := self._take():
            try:
                reply = self._writer.insert(chunks)
            except Exception as error:  # noqa: BLE001  re-raised by put, in the owner's thread
                self._error = error
                return
            if reply is None:
                return
            self.chunks += len(chunks)
            self.transitions += sum(map(len, chunks))

    def _take(self) -> list[Chunk]:
        """All chunks that wait, at least one; none when closing."""
        waiting = [] if self._closing.is_set() else [self._spool.get()]
        with contextlib.suppress(queue.Empty):
            while True:
                waiting.append(self._spool.get_nowait())
        return [chunk for chunk in waiting if chunk is not None]
