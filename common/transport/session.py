"""One Zenoh session and what it declares, with every wait bounded and every queue's end stated.

Invariants: Zenoh's callbacks only enqueue; all threads here belong to callers; foreign errors
become ours at this boundary; leaving the `with` block closes the session and everything it
declared. What Zenoh loses and when: docs/wire.md.
"""

import contextlib
import json
import re
import socket
import time
from types import TracebackType
from typing import Any, Self

import zenoh

from common.config import TransportConfig
from common.errors import EndpointError
from common.transport.publications import LatestSubscriber, Presence, Publisher, QueueSubscriber
from common.transport.queries import Client, Server
from common.transport.slots import Lender

_ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/\S+")
_OPEN_ATTEMPT_MS = 2_000
# How long a full link holds up its sender before it is closed. A router gives up soon: a peer that
# is stopped would hold up all others, until they lose their leases (10 s) too.
_PATIENCE_US = {"router": 5_000_000, "client": 60_000_000}


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

    def publisher(self, key: str) -> Publisher:
        """A publisher whose `put` waits rather than drops when the link is full."""
        declared = self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK
        )
        return Publisher(self._declare(declared))

    def latest_subscriber(self, key: str) -> LatestSubscriber:
        """Keeps the newest publication only: older ones are overwritten."""
        latest = LatestSubscriber(self._config.max_message_bytes)
        handler = zenoh.handlers.Callback(latest.offer, indirect=False)
        self._declare(self._session.declare_subscriber(key, handler))
        return latest

    def queue_subscriber(self, key: str, capacity: int = 4096) -> QueueSubscriber:
        """Keeps publications in order; when full, new ones are dropped and counted."""
        waiting = QueueSubscriber(self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(waiting.offer, indirect=False)
        self._declare(self._session.declare_subscriber(key, handler))
        return waiting

    def server(self, key: str, capacity: int = 256) -> Server:
        """Answers queries on `key`; when `capacity` wait already, a new one is refused."""
        server = Server(self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(server.offer, indirect=False)
        self._declare(self._session.declare_queryable(key, handler, complete=True))
        return server

    def client(
        self, key: str, whom: str, timeout_s: float | None = None, *, lends: bool = False
    ) -> Client:
        """Asks the queryable on `key`; `whom` names it in errors and in the log.

        lends: large messages go through shared memory where the peer can reach it.
        """
        timeout = self._config.timeout_s if timeout_s is None else timeout_s
        querier = self._session.declare_querier(
            key,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        )
        lender = Lender(whom, enabled=lends and self._config.shared_memory)
        max_bytes = self._config.max_message_bytes
        return Client(self._declare(querier), whom, timeout, max_bytes, lender)

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
    mode = "router" if config.listen else "client"
    settings: dict[str, Any] = {
        "mode": mode,
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
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _PATIENCE_US[mode],
        "transport/shared_memory/enabled": False,  # our own, in slots.py, has no pool to overflow
    }
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result
