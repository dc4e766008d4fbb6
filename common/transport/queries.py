"""Requests and replies: a client asks a server, and every wait has a deadline.

Invariants: Zenoh's callbacks only enqueue, or refuse at once; a request is answered once, by a
reply, a refusal, or "held", which means ask again; no reply becomes a DeadlineError that names the
peer. Of several answers the first that can be read counts; others are counted and told.

A large message between processes of one host goes through a shared buffer (`shared_memory.py`),
which the wire calls a slot:

    attachment of a request   "slot ADDRESS"               a large answer may be put there
                              "slot ADDRESS START LENGTH"  and the request is there already
                              "far"                        no slot: you could not open one
    attachment of a reply     "near"                       the slot was opened
                              "near START LENGTH"          and the message is there
                              "far: REASON"                it could not be opened

Between peers that are far from each other, large messages are compressed (`compression.py`).
"""

import contextlib
import logging
import queue
import re
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from mrcdrl.common.errors import (
    DeadlineError,
    RefusedError,
    SharedMemoryError,
    ThrottledError,
    TransportError,
    WireError,
)
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.runtime.names import printable
from mrcdrl.common.transport.compression import compressed, expanded
from mrcdrl.common.transport.shared_memory import (
    LARGE_BYTES,
    BufferPool,
    OpenedBuffers,
    SharedBuffer,
    put,
    room,
)

_LOG = logging.getLogger("transport")
_HELD = "held: "
_FAR = "far: "
_KNOWN_FAR = "far"
_OFFER = re.compile(r"slot (\S+ \d+ \d+ \S+)(?: (\d{1,12}) (\d{1,12}))?")
_NEAR = re.compile(r"near(?: (\d{1,12}) (\d{1,12}))?")
_REPLIES = 4  # to one query that are looked at
_WAITING = 4  # largest messages that may wait for a server
_LATE_S = 1.0  # added to Zenoh's own timeout of a query, for a late callback


class Request:
    """A query, answered once, by `reply`, `refuse`, `throttle` or `cannot_open`."""

    __slots__ = ("_far", "_key", "_memory", "_near", "_query", "arrived_s", "payload")

    def __init__(self, query: Any, payload: Part, key: str) -> None:
        self._query = query
        self._key = key  # the server's: the query's may have wildcards
        self._memory: memoryview | None = None  # shared by the client
        self._near: str | None = None  # the reply's attachment
        self._far = False  # the client is far, so it reads compressed messages
        self.payload = payload
        self.arrived_s = time.monotonic()

    def open(self, buffers: OpenedBuffers, max_message_bytes: int) -> None:
        """Expand a compressed payload, and open the client's buffer if it offers one.

        Raises SharedMemoryError if the payload is in a buffer that is out of reach, WireError
        if it is compressed and damaged.
        """
        if isinstance(self.payload, bytes):
            self.payload = expanded(self.payload, max_message_bytes)
        if self._query.attachment is None:
            return
        attachment = self._query.attachment.to_bytes().decode("ascii", "replace")
        self._far = attachment == _KNOWN_FAR
        if self._far:
            return
        offer = _OFFER.fullmatch(attachment)
        try:
            if offer is None:
                raise SharedMemoryError("no offer of a slot")
            self._memory = buffers.open(offer[1])
        except SharedMemoryError as error:
            if offer is not None and offer[2]:
                raise
            self._near, self._far = f"{_FAR}{error}", True
            return
        self._near = "near"
        if offer[2]:
            self.payload = _within(self._memory, int(offer[2]), int(offer[3]), max_message_bytes)

    def room(self, size: int) -> memoryview | None:
        """The client's memory for the last `size` bytes of a large reply, if it shares any."""
        if self._memory is None or size < LARGE_BYTES:
            return None
        return room(self._memory, size)

    def reply(self, payload: Part | Sequence[Part]) -> None:
        """Answer with a message, given whole or in parts."""
        parts = [payload] if isinstance(payload, Part) else payload
        near = self._near
        if self._memory is not None and sum(map(len, parts)) >= LARGE_BYTES:
            place = put(self._memory, parts)
            if place is not None:
                near, parts = f"near {place[0]} {place[1]}", ()
        message = _over_network(parts, far=self._far)
        self._answer(lambda: self._query.reply(self._key, message, attachment=near))

    def refuse(self, reason: str) -> None:
        """Answer that the request is wrong: asking again would not help."""
        self._answer(lambda: self._query.reply_err(reason.encode()))

    def throttle(self, reason: str) -> None:
        """Answer "not now": the peer should ask again."""
        self.refuse(_HELD + reason)

    def cannot_open(self, reason: str) -> None:
        """Answer that the peer should ask again over the network."""
        self.refuse(_FAR + reason)

    def _answer(self, answer: Callable[[], None]) -> None:
        # A peer that has left asks again when it is back: nothing to report here.
        with contextlib.suppress(zenoh.ZError):
            answer()
        self._query.drop()


class Server:
    """Requests on a key in the order of their arrival, for one serving thread.

    At most `capacity` wait, with no more bytes in all than four messages of the largest size.
    """

    def __init__(self, key: str, max_message_bytes: int, capacity: int) -> None:
        self._key = key
        self._max_bytes = max_message_bytes
        self._waiting: queue.Queue[tuple[Request, int]] = queue.Queue(capacity)
        self._lock = threading.Lock()
        self._bytes = 0
        self._buffers = OpenedBuffers()
        self.refused = 0  # too large or damaged
        self.throttled = 0  # too many waited

    def offer(self, query: Any) -> None:
        """Zenoh's callback."""
        size = 0 if query.payload is None else len(query.payload)
        if size > self._max_bytes:
            self.refused += 1
            refused = Request(query, b"", self._key)
            refused.refuse(f"{size} bytes exceed the limit of {self._max_bytes}")
            return
        request = Request(query, query.payload.to_bytes() if size else b"", self._key)
        with self._lock:
            full = self._waiting.full() or self._bytes + size > _WAITING * self._max_bytes
            if not full:
                self._bytes += size
                self._waiting.put_nowait((request, size))
        if full:
            self.throttled += 1
            request.throttle(f"{self._waiting.qsize()} requests are waiting")

    def take(self, timeout_s: float) -> Request | None:
        """The next request; None if none came within `timeout_s`."""
        try:
            request, size = self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            self._bytes -= size
        try:
            request.open(self._buffers, self._max_bytes)
        except SharedMemoryError as error:
            request.cannot_open(str(error))
            return None
        except WireError as error:
            self.refused += 1
            request.refuse(str(error))
            return None
        return request


class PendingReply:
    """The reply to one query in flight, for the thread that asked."""

    def __init__(
        self,
        whom: str,
        timeout_s: float,
        max_message_bytes: int,
        pool: BufferPool,
        buffer: SharedBuffer | None,
        another: Callable[[], None],
    ) -> None:
        """another: called by Zenoh's thread for each reply after the first."""
        self._whom = whom
        self._deadline = time.monotonic() + timeout_s + _LATE_S
        self._max_bytes = max_message_bytes
        self._pool = pool
        self._buffer = buffer
        self._another = another
        self._replies: list[Any] = []
        self._ended = threading.Event()

    def offer(self, reply: Any) -> None:
        """Zenoh's callback."""
        if self._replies:
            self._another()
        if len(self._replies) < _REPLIES:
            self._replies.append(reply)
        self._ended.set()

    def end(self) -> None:
        """Zenoh's callback: no further reply will come."""
        self._ended.set()

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s`; whether `result` would now return at once."""
        left = self._deadline - time.monotonic()
        return self._ended.wait(max(min(timeout_s, left), 0.0)) or left <= timeout_s

    def result(self) -> Part:
        """The payload of the first reply that can be read, valid until `release`.

        Raises ThrottledError or RefusedError for a refusal, DeadlineError if no reply came. If none
        can be read: WireError if the first is compressed and damaged, RefusedError otherwise.
        """
        self._ended.wait(max(self._deadline - time.monotonic(), 0.0))
        unreadable: list[RefusedError | WireError] = []
        for reply in self._replies:
            if reply.ok is None:
                raise self._refusal(_text(reply.err.payload))
            try:
                return self._payload(reply.ok)
            except (RefusedError, WireError) as error:
                unreadable.append(error)
        if unreadable:
            raise unreadable[0]
        raise DeadlineError(f"no answer from {self._whom}")

    def release(self) -> None:
        """Give the buffer back: the result is no longer read.

        Not without an answer: a peer that gave none may still write to the buffer.
        """
        if self._buffer is not None:
            self._pool.give_back(self._buffer)
            self._buffer = None

    def _refusal(self, text: str) -> TransportError:
        """The error that an error reply stands for."""
        if text == "Timeout":
            return DeadlineError(f"no answer from {self._whom} in time")
        self.release()
        if text.startswith(_FAR):
            self._pool.refused(text.removeprefix(_FAR))
            return ThrottledError(text)
        if text.startswith(_HELD):
            return ThrottledError(text.removeprefix(_HELD))
        return RefusedError(f"{self._whom} refused: {text}")

    def _payload(self, sample: Any) -> Part:
        attachment = "" if sample.attachment is None else _text(sample.attachment)
        near = _NEAR.fullmatch(attachment)
        if near:
            self._pool.opened()
        elif attachment.startswith(_FAR):
            self._pool.refused(attachment.removeprefix(_FAR))
        try:
            if near and near[1] and self._buffer is not None:
                start, length = int(near[1]), int(near[2])
                return _within(self._buffer.memory, start, length, self._max_bytes)
        except SharedMemoryError as error:
            raise RefusedError(f"the answer of {self._whom}: {error}") from error
        self.release()
        if len(sample.payload) > self._max_bytes:
            raise RefusedError(f"the answer of {self._whom} exceeds {self._max_bytes} bytes")
        return expanded(sample.payload.to_bytes(), self._max_bytes)


class Client:
    """Sends queries to one key; any number may be in flight, all from one thread."""

    def __init__(
        self, whom: str, timeout_s: float, max_message_bytes: int, pool: BufferPool
    ) -> None:
        self._querier: Any = None
        self._whom = whom
        self._timeout_s = timeout_s
        self._max_bytes = max_message_bytes
        self._pool = pool
        self._told = 0
        self.others = 0
        """Replies after the first: another process answers on this key."""

    def attach(self, querier: Any) -> None:
        """Use this querier of Zenoh's from now on."""
        self._querier = querier

    def ask(self, payload: Part | Sequence[Part], *, reply_bytes: int = 0) -> PendingReply:
        """Send a query, given whole or in parts; `result` then waits for its answer.

        reply_bytes: the expected size of the answer, roughly.
        """
        self._tell_of_others()
        parts = [payload] if isinstance(payload, Part) else payload
        length = sum(map(len, parts))
        buffer = self._pool.borrow(max(length, reply_bytes))
        attachment = _KNOWN_FAR if self._pool.near is False else None
        if buffer is not None:
            attachment = f"slot {buffer.address}"
            if self._pool.near and length >= LARGE_BYTES:
                place = put(buffer.memory, parts)
                if place is not None:
                    attachment, parts = f"{attachment} {place[0]} {place[1]}", ()
        pending = PendingReply(
            self._whom, self._timeout_s, self._max_bytes, self._pool, buffer, self._another
        )
        handler = zenoh.handlers.Callback(pending.offer, pending.end, indirect=False)
        message = _over_network(parts, far=self._pool.near is False)
        self._get(handler, message, attachment)
        return pending

    def _another(self) -> None:
        self.others += 1

    def _tell_of_others(self) -> None:
        """Log that others answer, too: the first time, and whenever there are twice as many."""
        others = self.others
        if others >= max(1, 2 * self._told):
            self._told = others
            _LOG.warning(
                "another process answers for %s, too (%d answers so far); the first one counts: "
                "look for a second one under this run's name",
                self._whom,
                others,
            )

    def _get(self, handler: Any, message: bytes, attachment: str | None) -> None:
        querier = self._querier
        try:
            querier.get(handler, payload=message, attachment=attachment)
        except zenoh.ZError as error:
            if querier is not self._querier:  # the session was replaced meanwhile
                return self._get(handler, message, attachment)
            raise TransportError(f"cannot ask {self._whom}: {error}") from error


def _over_network(parts: Sequence[Part], *, far: bool) -> bytes:
    """The bytes for the network, compressed if they are many and the peer is far."""
    if far and sum(map(len, parts)) >= LARGE_BYTES:
        return compressed(parts)
    return b"".join(parts)


def _text(payload: Any) -> str:
    """What a peer says in words, fit for a log."""
    return printable(payload.to_bytes().decode("utf-8", "replace"))


def _within(memory: memoryview, start: int, length: int, max_bytes: int) -> memoryview:
    if start + length > len(memory) or length > max_bytes:
        raise SharedMemoryError(f"{length} bytes at {start} of a slot of {len(memory)}")
    return memory[start : start + length]
