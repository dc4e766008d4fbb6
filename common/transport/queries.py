"""Questions and answers: a client asks a server, and every wait has an end.

Invariants: Zenoh's callbacks only enqueue; a request is answered once, by a reply, a refusal, or
"held", which asks for the same again; no reply at all becomes a DeadlineError that names the peer.
"""

import contextlib
import queue
import time
from collections.abc import Callable
from typing import Any

import zenoh

from common.errors import DeadlineError, HeldError, RefusedError, TransportError

_HELD = "held: "


class Request:
    """A query to be answered once, by `reply`, `refuse` or `hold`."""

    __slots__ = ("_query", "arrived_s", "payload")

    def __init__(self, query: Any, payload: bytes) -> None:
        self._query = query
        self.payload = payload
        self.arrived_s = time.monotonic()

    def reply(self, payload: bytes) -> None:
        self._answer(lambda: self._query.reply(self._query.key_expr, payload))

    def refuse(self, reason: str) -> None:
        """The peer's request is wrong; asking again would not help."""
        self._answer(lambda: self._query.reply_err(reason.encode()))

    def hold(self, reason: str) -> None:
        """Not now; the peer is to ask again."""
        self._answer(lambda: self._query.reply_err((_HELD + reason).encode()))

    def _answer(self, answer: Callable[[], None]) -> None:
        # A peer that is gone by now asks again when it is back: nothing to report here.
        with contextlib.suppress(zenoh.ZError):
            answer()
        self._query.drop()


class Server:
    """Requests in the order of their arrival, for one or more serving threads."""

    def __init__(self, max_message_bytes: int, capacity: int) -> None:
        self._max_bytes = max_message_bytes
        self._waiting: queue.Queue[Request] = queue.Queue(capacity)
        self.refused = 0

    def offer(self, query: Any) -> None:
        """For Zenoh's callback."""
        size = 0 if query.payload is None else len(query.payload)
        if size > self._max_bytes:
            self.refused += 1
            Request(query, b"").refuse(f"{size} bytes exceed the limit of {self._max_bytes}")
            return
        request = Request(query, b"" if query.payload is None else query.payload.to_bytes())
        try:
            self._waiting.put_nowait(request)
        except queue.Full:
            self.refused += 1
            request.hold(f"{self._waiting.maxsize} requests are waiting")

    def take(self, timeout_s: float) -> Request | None:
        """The next request; None where none came within `timeout_s`."""
        try:
            return self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None


class PendingReply:
    """The reply to one query that is under way."""

    def __init__(self, whom: str, timeout_s: float, max_message_bytes: int) -> None:
        self._whom = whom
        self._deadline = time.monotonic() + timeout_s
        self._max_bytes = max_message_bytes
        self._replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.offer = self._replies.put

    def end(self) -> None:
        """For Zenoh's callback: no further reply will come."""
        self._replies.put(None)

    def result(self) -> bytes:
        """The reply's payload.

        Raises HeldError or RefusedError for a refusal, DeadlineError where no reply came.
        """
        # Zenoh ends the query at its own timeout; the second more is for a callback that is late.
        left = self._deadline + 1.0 - time.monotonic()
        try:
            reply = self._replies.get(timeout=max(left, 0.0))
        except queue.Empty:
            reply = None
        if reply is None:
            raise DeadlineError(f"no answer from {self._whom}")
        if reply.ok is not None:
            if len(reply.ok.payload) > self._max_bytes:
                raise RefusedError(f"the answer of {self._whom} exceeds {self._max_bytes} bytes")
            payload: bytes = reply.ok.payload.to_bytes()
            return payload
        text = reply.err.payload.to_bytes().decode("utf-8", "replace")
        if text.startswith(_HELD):
            raise HeldError(text.removeprefix(_HELD))
        if text == "Timeout":
            raise DeadlineError(f"no answer from {self._whom} in time")
        raise RefusedError(f"{self._whom} refused: {text}")


class Client:
    """Sends queries to one key; any number may be under way."""

    def __init__(self, querier: Any, whom: str, timeout_s: float, max_message_bytes: int) -> None:
        self._querier = querier
        self._whom = whom
        self._timeout_s = timeout_s
        self._max_bytes = max_message_bytes

    def ask(self, payload: bytes) -> PendingReply:
        """Send a query; its answer is waited for with `PendingReply.result`."""
        pending = PendingReply(self._whom, self._timeout_s, self._max_bytes)
        handler = zenoh.handlers.Callback(pending.offer, pending.end, indirect=False)
        try:
            self._querier.get(handler, payload=payload)
        except zenoh.ZError as error:
            raise TransportError(f"cannot ask {self._whom}: {error}") from error
        return pending
