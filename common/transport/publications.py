"""Publications, which nobody answers: messages in order, the newest only, and presence.

Invariants: Zenoh's callbacks only enqueue; each object is read by one thread; every queue says
what happens when it is full.
"""

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import zenoh

from mrcdrl.common.errors import TransportError

T = TypeVar("T")
_WAITING_BYTES = 1 << 24  # of publications that wait for their reader


class Publisher:
    """Publishes bytes on one key."""

    def __init__(self) -> None:
        self._publisher: Any = None

    def attach(self, publisher: Any) -> None:
        """Use this publisher of Zenoh's from now on."""
        self._publisher = publisher

    def put(self, payload: bytes) -> None:
        """Publish; without a subscriber the message is lost, and no error raised."""
        publisher = self._publisher
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            if publisher is not self._publisher:  # the session was replaced meanwhile
                return self.put(payload)
            raise TransportError(f"cannot publish: {error}") from error


class WatchedPublisher(Publisher):
    """A publisher that knows whether anybody listens, at the cost of reading a flag."""

    watched = False
    listener: Any = None  # Zenoh's, which tells `observe` while it is held

    def observe(self, status: Any) -> None:
        """Zenoh's callback."""
        self.watched = bool(status.matching)


def as_it_is(payload: bytes) -> bytes:
    """The payload itself."""
    return payload


class LatestSubscriber(Generic[T]):
    """The newest publication, for one reading thread."""

    def __init__(self, max_message_bytes: int, opened: Callable[[bytes], T]) -> None:
        """opened: what to keep of a payload; called by Zenoh's thread, so it must be quick."""
        self._max_bytes = max_message_bytes
        self._opened = opened
        self._changed = threading.Condition()
        self._newest: T | None = None
        self.oversized = 0

    def offer(self, sample: Any) -> None:
        """Zenoh's callback."""
        if len(sample.payload) > self._max_bytes:
            self.oversized += 1
            return
        newest = self._opened(sample.payload.to_bytes())
        with self._changed:
            self._newest = newest
            self._changed.notify_all()

    def take(self, timeout_s: float = 0.0) -> T | None:
        """The newest, if not taken yet; None if none came within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
            return newest


class QueueSubscriber:
    """Publications in the order of their arrival, for one reading thread.

    At most `capacity` wait, with no more bytes in all than 16 MiB, or than one of the largest size.
    """

    def __init__(self, max_message_bytes: int, capacity: int) -> None:
        self._max_bytes = max_message_bytes
        self._waiting: queue.Queue[tuple[str, bytes]] = queue.Queue(capacity)
        self._lock = threading.Lock()
        self._bytes = 0
        self.dropped = 0

    def offer(self, sample: Any) -> None:
        """Zenoh's callback."""
        size = len(sample.payload)
        with self._lock:
            most = max(self._max_bytes, _WAITING_BYTES)
            full = self._waiting.full() or self._bytes + size > most
            if full or size > self._max_bytes:
                self.dropped += 1
                return
            self._bytes += size
            self._waiting.put_nowait((str(sample.key_expr), sample.payload.to_bytes()))

    def take(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next (key, payload); None if none came within `timeout_s`."""
        try:
            item = self._waiting.get(timeout_s > 0, timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            self._bytes -= len(item[1])
        return item

    def drain(self) -> Iterator[tuple[str, bytes]]:
        """Yield what is now in the queue, and nothing that arrives meanwhile."""
        for _ in range(self._waiting.qsize()):
            if (item := self.take(0.0)) is not None:
                yield item


class Presence:
    """The liveliness tokens now held."""

    def __init__(self) -> None:
        self._changes: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()
        self._alive: set[str] = set()

    def offer(self, sample: Any) -> None:
        """Zenoh's callback."""
        self._changes.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def changes(self) -> Iterator[tuple[str, bool]]:
        """Yield (key, alive) for each change from the last call until now, in order."""
        for _ in range(self._changes.qsize()):
            key, alive = self._changes.get_nowait()
            (self._alive.add if alive else self._alive.discard)(key)
            yield key, alive

    def alive(self) -> frozenset[str]:
        """The keys of all tokens now held."""
        for _ in self.changes():
            pass
        return frozenset(self._alive)
