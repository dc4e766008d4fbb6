"""Questions and answers: a client asks a server, and every wait has an end.

Invariants: Zenoh's callbacks only enqueue; a request is answered once, by a reply, a refusal, or
"held", which asks for the same again; no reply at all becomes a DeadlineError that names the peer.

A large message between processes of one host goes through a slot (`slots.py`); the query says so:

    attachment of a request   "slot ADDRESS"               a large answer may be put there
                              "slot ADDRESS START LENGTH"  and the request is there already
                              "far"                        no slot: you could not open one
    attachment of a reply     "near"                       the slot was opened
                              "near START LENGTH"          and the message is there
                              "far: REASON"                it could not be opened

Between peers that are far from each other a large message is compressed (`compression.py`).
"""

import contextlib
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
from mrcdrl.common.transport.compression import compressed, expanded
from mrcdrl.common.transport.shared_memory import LARGE_BYTES, Lender, Slot, Slots, put, room

_HELD = "held: "
_FAR = "far: "
_KNOWN_FAR = "far"
_OFFER = re.compile(r"slot (\S+ \d+ \d+ \S+)(?: (\d{1,12}) (\d{1,12}))?")
_NEAR = re.compile(r"near(?: (\d{1,12}) (\d{1,12}))?")
_WAITING = 4  # messages of the largest size that may wait for a server
_LATE_S = 1.0  # Zenoh ends a query at its own timeout; this more is for a callback that is late


class Request:
    """A query to be answered once, by `reply`, `refuse` or `hold`."""

    __slots__ = ("_far", "_memory", "_near", "_query", "arrived_s", "payload")

    def __init__(self, query: Any, payload: Part) -> None:
        self._query = query
        self._memory: memoryview | None = None  # that the client lends
        self._near: str | None = None  # what the reply says of it
        self._far = False  # the client is, and knows compressed messages
        self.payload = payload
        self.arrived_s = time.monotonic()

    def open(self, slots: Slots, max_message_bytes: int) -> None:
        """Reach for the slot that the client lends, if it does.

        Raises SharedMemoryError where the payload is in a slot that is out of reach, WireError
        where it is compressed and damaged.
        """
        if isinstance(self.payload, bytes):
            self.payload = expanded(self.payload, max_message_bytes)
        if self._query.attachment is None:
            return
        said = self._query.attachment.to_bytes().decode("ascii", "replace")
        self._far = said == _KNOWN_FAR
        if self._far:
            return
        offer = _OFFER.fullmatch(said)
        try:
            if offer is None:
                raise SharedMemoryError("no offer of a slot")
            self._memory = slots.open(offer[1])
        except SharedMemoryError as error:
            if offer is not None and offer[2]:
                raise
            self._near, self._far = f"{_FAR}{error}", True
            return
        self._near = "near"
        if offer[2]:
            self.payload = _within(self._memory, int(offer[2]), int(offer[3]), max_message_bytes)

    def room(self, size: int) -> memoryview | None:
        """Memory of the client for the last `size` bytes of a large reply, if it lends any."""
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
        self._answer(lambda: self._query.reply(self._query.key_expr, message, attachment=near))

    def refuse(self, reason: str) -> None:
        """The peer's request is wrong; asking again would not help."""
        self._answer(lambda: self._query.reply_err(reason.encode()))

    def throttle(self, reason: str) -> None:
        """Not now; the peer is to ask again."""
        self.refuse(_HELD + reason)

    def cannot_open(self, reason: str) -> None:
        """The peer is to ask again over the network."""
        self.refuse(_FAR + reason)

    def _answer(self, answer: Callable[[], None]) -> None:
        # A peer that is gone by now asks again when it is back: nothing to report here.
        with contextlib.suppress(zenoh.ZError):
            answer()
        self._query.drop()


class Server:
    """Requests in the order of their arrival, for one serving thread.

    At most `capacity` wait, and no more bytes of them than of four messages of the largest size.
    """

    def __init__(self, max_message_bytes: int, capacity: int) -> None:
        self._max_bytes = max_message_bytes
        self._waiting: queue.Queue[tuple[Request, int]] = queue.Queue(capacity)
        self._lock = threading.Lock()
        self._bytes = 0
        self._slots = Slots()
        self.refused = 0  # because they were too large
        self.throttled = 0  # because too many waited

    def offer(self, query: Any) -> None:
        """For Zenoh's callback."""
        size = 0 if query.payload is None else len(query.payload)
        if size > self._max_bytes:
            self.refused += 1
            Request(query, b"").refuse(f"{size} bytes exceed the limit of {self._max_bytes}")
            return
        request = Request(query, query.payload.to_bytes() if size else b"")
        with self._lock:
            full = self._waiting.full() or self._bytes + size > _WAITING * self._max_bytes
            if not full:
                self._bytes += size
                self._waiting.put_nowait((request, size))
        if full:
            self.throttled += 1
            request.throttle(f"{self._waiting.qsize()} requests are waiting")

    def take(self, timeout_s: float) -> Request | None:
        """The next request; None where none came within `timeout_s`."""
        try:
            request, size = self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None
        with self._lock:
            self._bytes -= size
        try:
            request.open(self._slots, self._max_bytes)
        except SharedMemoryError as error:
            request.cannot_open(str(error))
            return None
        except WireError as error:
            self.refused += 1
            request.refuse(str(error))
            return None
        return request


class PendingReply:
    """The reply to one query that is under way; for the thread that asked."""

    def __init__(
        self,
        whom: str,
        timeout_s: float,
        max_message_bytes: int,
        lender: Lender,
        slot: Slot | None,
    ) -> None:
        self._whom = whom
        self._deadline = time.monotonic() + timeout_s + _LATE_S
        self._max_bytes = max_message_bytes
        self._lender = lender
        self._slot = slot
        self._reply: Any = None
        self._ended = threading.Event()

    def offer(self, reply: Any) -> None:
        """For Zenoh's callback."""
        if self._reply is None:
            self._reply = reply
        self._ended.set()

    def end(self) -> None:
        """For Zenoh's callback: no further reply will come."""
        self._ended.set()

    def wait(self, timeout_s: float) -> bool:
        """Whether `result` would not have to wait; waits up to `timeout_s` until it is so."""
        left = self._deadline - time.monotonic()
        return self._ended.wait(max(min(timeout_s, left), 0.0)) or left <= timeout_s

    def result(self) -> Part:
        """The reply's payload, valid until `release`.

        Raises ThrottledError or RefusedError for a refusal, DeadlineError where no reply came,
        WireError where it is compressed and damaged.
        """
        self._ended.wait(max(self._deadline - time.monotonic(), 0.0))
        reply = self._reply
        if reply is None:
            raise DeadlineError(f"no answer from {self._whom}")
        if reply.ok is not None:
            return self._payload(reply.ok)
        text = reply.err.payload.to_bytes().decode("utf-8", "replace")
        if text == "Timeout":
            raise DeadlineError(f"no answer from {self._whom} in time")
        self.release()
        if text.startswith(_FAR):
            self._lender.refused(text.removeprefix(_FAR))
            raise ThrottledError(text)
        if text.startswith(_HELD):
            raise ThrottledError(text.removeprefix(_HELD))
        raise RefusedError(f"{self._whom} refused: {text}")

    def release(self) -> None:
        """What `result` returned is no longer read.

        Only after an answer: a peer that gave none may yet write to the slot.
        """
        if self._slot is not None:
            self._lender.give_back(self._slot)
            self._slot = None

    def _payload(self, sample: Any) -> Part:
        said = "" if sample.attachment is None else sample.attachment.to_bytes().decode()
        near = _NEAR.fullmatch(said)
        if near:
            self._lender.opened()
        elif said.startswith(_FAR):
            self._lender.refused(said.removeprefix(_FAR))
        try:
            if near and near[1] and self._slot is not None:
                start, length = int(near[1]), int(near[2])
                return _within(self._slot.memory, start, length, self._max_bytes)
        except SharedMemoryError as error:
            raise RefusedError(f"the answer of {self._whom}: {error}") from error
        self.release()
        if len(sample.payload) > self._max_bytes:
            raise RefusedError(f"the answer of {self._whom} exceeds {self._max_bytes} bytes")
        return expanded(sample.payload.to_bytes(), self._max_bytes)


class Client:
    """Sends queries to one key; any number may be under way, all of one thread."""

    def __init__(self, whom: str, timeout_s: float, max_message_bytes: int, lender: Lender) -> None:
        self._querier: Any = None
        self._whom = whom
        self._timeout_s = timeout_s
        self._max_bytes = max_message_bytes
        self._lender = lender

    def attach(self, querier: Any) -> None:
        """Go on with this one of Zenoh's."""
        self._querier = querier

    def ask(self, payload: Part | Sequence[Part], *, reply_bytes: int = 0) -> PendingReply:
        """Send a query, given whole or in parts; its answer is waited for with `result`.

        reply_bytes: about how large an answer is due.
        """
        parts = [payload] if isinstance(payload, Part) else payload
        length = sum(map(len, parts))
        slot = self._lend(max(length, reply_bytes))
        attachment = _KNOWN_FAR if self._lender.near is False else None
        if slot is not None:
            attachment = f"slot {slot.address}"
            if self._lender.near and length >= LARGE_BYTES:
                place = put(slot.memory, parts)
                if place is not None:
                    attachment, parts = f"{attachment} {place[0]} {place[1]}", ()
        pending = PendingReply(self._whom, self._timeout_s, self._max_bytes, self._lender, slot)
        handler = zenoh.handlers.Callback(pending.offer, pending.end, indirect=False)
        message = _over_network(parts, far=self._lender.near is False)
        self._get(handler, message, attachment)
        return pending

    def _get(self, handler: Any, message: bytes, attachment: str | None) -> None:
        querier = self._querier
        try:
            querier.get(handler, payload=message, attachment=attachment)
        except zenoh.ZError as error:
            if querier is not self._querier:  # the session was renewed meanwhile
                return self._get(handler, message, attachment)
            raise TransportError(f"cannot ask {self._whom}: {error}") from error

    def _lend(self, size: int) -> Slot | None:
        """A slot for a large message, or a first one to see whether the peer can open it."""
        if size < LARGE_BYTES and self._lender.near is not None:
            return None
        return self._lender.borrow(size)


def _over_network(parts: Sequence[Part], *, far: bool) -> bytes:
    """What crosses the network; compressed where it is large and goes to another host."""
    if far and sum(map(len, parts)) >= LARGE_BYTES:
        return compressed(parts)
    return b"".join(parts)


def _within(memory: memoryview, start: int, length: int, max_bytes: int) -> memoryview:
    if start + length > len(memory) or length > max_bytes:
        raise SharedMemoryError(f"{length} bytes at {start} of a slot of {len(memory)}")
    return memory[start : start + length]
