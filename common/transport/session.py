"""One Zenoh session and what it declares, with every wait bounded and every queue's end stated.

Invariants: Zenoh's callbacks only enqueue; all threads here belong to callers; foreign errors
become ours at this boundary; leaving the `with` block closes the session and everything it
declared. What Zenoh loses and when: docs/wire.md.
"""

import contextlib
import json
import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

import zenoh

from common.config import TransportConfig
from common.errors import DeadlineError, EndpointError, HeldError, RefusedError, TransportError

_HELD = "held: "
_ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/\S+")
_OPEN_ATTEMPT_MS = 2_000


class Session:
    """An open Zenoh session: a router where it listens, a client otherwise.

    Raises EndpointError when an endpoint cannot be listened on, or nobody answers where it
    connects within `open_timeout_s`.
    """

    def __init__(self, config: TransportConfig, *, open_timeout_s: float = 30.0) -> None:
        self._config = config
        self._session = _open(config, time.monotonic() + open_timeout_s)
        self._declared = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare everything and close; again is harmless."""
        with contextlib.suppress(zenoh.ZError):
            self._declared.close()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def publisher(self, key: str) -> "Publisher":
        """A publisher whose `put` waits rather than drops when the link is full."""
        declared = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK
        )
        return Publisher(self._declare(declared))

    def latest_subscriber(self, key: str) -> "LatestSubscriber":
        """Keeps the newest publication only: older ones are overwritten."""
        latest = LatestSubscriber(self._config.max_message_bytes)
        handler = zenoh.handlers.Callback(latest.offer, indirect=False)
        self._declare(self._session.declare_subscriber(key, handler))
        return latest

    def queue_subscriber(self, key: str, capacity: int = 4096) -> "QueueSubscriber":
        """Keeps publications in order; when full, new ones are dropped and counted."""
        waiting = QueueSubscriber(self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(waiting.offer, indirect=False)
        self._declare(self._session.declare_subscriber(key, handler))
        return waiting

    def server(self, key: str, capacity: int = 256) -> "Server":
        """Answers queries on `key`; when `capacity` wait already, a new one is refused."""
        server = Server(self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(server.offer, indirect=False)
        self._declare(self._session.declare_queryable(key, handler, complete=True))
        return server

    def client(self, key: str, whom: str, timeout_s: float | None = None) -> "Client":
        """Asks the queryable on `key`; `whom` names it in errors."""
        timeout = self._config.timeout_s if timeout_s is None else timeout_s
        querier = self._session.declare_querier(
            key,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        return Client(self._declare(querier), whom, timeout, self._config.max_message_bytes)

    def announce(self, key: str) -> None:
        """Hold a liveliness token on `key` for as long as the session is open."""
        self._declare(self._session.liveliness().declare_token(key))

    def presence(self, key: str) -> "Presence":
        """Follows the liveliness tokens on `key`, those already there included."""
        presence = Presence()
        handler = zenoh.handlers.Callback(presence.offer, indirect=False)
        self._declare(self._session.liveliness().declare_subscriber(key, handler, history=True))
        return presence

    def _declare(self, declared: Any) -> Any:
        self._declared.callback(declared.undeclare)
        return declared

    def __repr__(self) -> str:
        ends = self._config.listen or self._config.connect
        state = "closed" if self._session.is_closed() else "open"
        return f"<Session {', '.join(ends)} {state}>"


class Publisher:
    """Puts bytes on one key."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def put(self, payload: bytes) -> None:
        """Publish; what nobody subscribes to is lost without an error."""
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            raise TransportError(f"cannot publish: {error}") from error


class LatestSubscriber:
    """The newest publication, for one reading thread."""

    def __init__(self, max_message_bytes: int) -> None:
        self._max_bytes = max_message_bytes
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        self.oversized = 0

    def offer(self, sample: Any) -> None:
        """For Zenoh's callback."""
        if len(sample.payload) > self._max_bytes:
            self.oversized += 1
            return
        payload = sample.payload.to_bytes()
        with self._changed:
            self._newest = payload
            self._changed.notify_all()

    def take(self, timeout_s: float = 0.0) -> bytes | None:
        """The newest not taken yet; None where none came within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
            return newest


class QueueSubscriber:
    """Publications in the order of their arrival, for one reading thread."""

    def __init__(self, max_message_bytes: int, capacity: int) -> None:
        self._max_bytes = max_message_bytes
        self._waiting: queue.Queue[tuple[str, bytes]] = queue.Queue(capacity)
        self.dropped = 0

    def offer(self, sample: Any) -> None:
        """For Zenoh's callback."""
        try:
            if len(sample.payload) > self._max_bytes:
                raise queue.Full
            self._waiting.put_nowait((str(sample.key_expr), sample.payload.to_bytes()))
        except queue.Full:
            self.dropped += 1

    def take(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next (key, payload); None where none came within `timeout_s`."""
        try:
            if timeout_s <= 0:
                return self._waiting.get_nowait()
            return self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def drain(self) -> Iterator[tuple[str, bytes]]:
        """Everything that waits now."""
        while (item := self.take(0.0)) is not None:
            yield item


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


class Presence:
    """Who holds a liveliness token now."""

    def __init__(self) -> None:
        self._changes: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()
        self._alive: set[str] = set()

    def offer(self, sample: Any) -> None:
        """For Zenoh's callback."""
        self._changes.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def changes(self) -> Iterator[tuple[str, bool]]:
        """(key, alive) of what changed since the last call, in order."""
        while True:
            try:
                key, alive = self._changes.get_nowait()
            except queue.Empty:
                return
            (self._alive.add if alive else self._alive.discard)(key)
            yield key, alive

    def alive(self) -> frozenset[str]:
        """The keys of all tokens now held."""
        for _ in self.changes():
            pass
        return frozenset(self._alive)


def free_endpoint() -> str:
    """A TCP endpoint on loopback whose port nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _open(config: TransportConfig, deadline: float) -> zenoh.Session:
    if not config.listen and not config.connect:
        raise EndpointError("no endpoint: give --connect or --listen, such as tcp/127.0.0.1:7447")
    for endpoint in (*config.listen, *config.connect):
        if not _ENDPOINT.fullmatch(endpoint):
            raise EndpointError(f"{endpoint!r} is no endpoint; write one as tcp/127.0.0.1:7447")
    while True:
        try:
            return zenoh.open(_zenoh_config(config))
        except zenoh.ZError as error:
            if config.listen:
                raise EndpointError(
                    f"cannot listen on {', '.join(config.listen)}: in use, or not an address of "
                    f"this machine ({_first_line(error)})"
                ) from error
            if time.monotonic() > deadline:
                raise EndpointError(
                    f"nobody answers at {', '.join(config.connect)}; is the run up? "
                    f"({_first_line(error)})"
                ) from error


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120]


def _zenoh_config(config: TransportConfig) -> zenoh.Config:
    result = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "router" if config.listen else "client",
        "listen/endpoints": list(config.listen),
        "connect/endpoints": list(config.connect),
        "connect/timeout_ms": _OPEN_ATTEMPT_MS,
        "connect/exit_on_failure": True,
        "connect/retry": {
            "period_init_ms": 200,
            "period_max_ms": 1000,
            "period_increase_factor": 1.5,
        },
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
        "transport/shared_memory/enabled": config.shared_memory,
    }
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result
