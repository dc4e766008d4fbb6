"""One Zenoh session and what it declares; every wait has a deadline, every queue a limit.

Invariants: Zenoh's callbacks only enqueue; the one thread here, `renew`, belongs to the session
and is joined by `close`; attempts to join are repeated at random times, so that many processes
that lost one router do not come back at once; Zenoh's errors become ours at this boundary; leaving
the `with` block closes the session and everything it declared.
"""

import contextlib
import json
import logging
import queue
import re
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, overload

import zenoh

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import (
    ConfigError,
    DeadlineError,
    EndpointError,
    TransportError,
    UnreachableError,
)
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.open_files import allow_open_files
from mrcdrl.common.runtime.pauses import random_pauses
from mrcdrl.common.transport.places import Places
from mrcdrl.common.transport.priority import Priority
from mrcdrl.common.transport.publications import (
    LatestSubscriber,
    Presence,
    Publisher,
    QueueSubscriber,
    WatchedPublisher,
    as_it_is,
)
from mrcdrl.common.transport.queries import Client, Server
from mrcdrl.common.transport.shared_memory import BufferPool

ROUTER_FILE = Path(str(resources.files("mrcdrl.configs"))) / "router.json5"
_LOG = logging.getLogger("transport")
_PROBE_S = 1.0
_SPARE_FILES = 200
_NOBODY = "mrcdrl/nobody"  # a key without a liveliness token
_NEVER_MS = 1 << 40  # until Zenoh connects a lost session again, after a first attempt
_ZENOH_FILE = re.compile(r"\.? at /")
_ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/\S+")
_ENCRYPTED = "tls/"
_PORT_0 = re.compile(r"[^?#]*:0+(?![^?#])")
_TCP = re.compile(r"tcp/\[?([^?#]*?)\]?:(\d+)(?![^?#])")
_LOOPBACK = re.compile(r"[a-z]+/(127\.|\[::1\]|localhost:)")
T = TypeVar("T")
_CLIENT_SETTINGS: dict[str, Any] = {
    "mode": "client",
    "connect/timeout_ms": 0,  # one attempt: `random_pauses` says when to try again
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": _NEVER_MS, "period_max_ms": _NEVER_MS},
    "transport/unicast/open_timeout": 5_000,  # ms
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    # Batches of 64 KiB that may wait to be sent, by priority.
    "transport/link/tx/queue/size/data": 16,
    "transport/link/tx/queue/size/data_low": 4,
    # µs that a full link blocks its sender before it is closed.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
    "transport/shared_memory/enabled": False,  # shared_memory.py has no pool to overflow
    "transport/link/tls/enable_mtls": True,
    "transport/link/tls/close_link_on_expiration": True,
}


@dataclass(slots=True)
class _Declaration:
    """A declaration, repeated on each Zenoh session that replaces a lost one."""

    make: Callable[[zenoh.Session], Any]
    use: Callable[[Any], None]
    declared: Any = None

    def on(self, session: zenoh.Session) -> None:
        self.declared = self.make(session)
        self.use(self.declared)


class Session(Closing):
    """An open Zenoh session: a router where it listens, a client otherwise.

    A client whose link is lost goes on with a new Zenoh session of another identity, on which
    everything is declared again. Under the old identity, a router still clearing away the lost
    link would remove the new declarations too, and the client would hear nothing (zenoh#1886).
    The lost session tries once to come back, at once, so as not to take a second place. It may
    have found the router again by then: it is closed only when the router has the new declarations,
    so that no liveliness token ends with it.

    router_file: the router's configuration; by default configs/router.json5. Endpoints that
    `config` gives take the place of the file's.

    Raises EndpointError if an endpoint cannot be listened on, nobody answers within
    `open_timeout_s`, or certificates are missing; ConfigError for a bad `router_file`.
    """

    def __init__(
        self,
        config: TransportConfig,
        *,
        open_timeout_s: float = 30.0,
        router_file: Path | None = None,
    ) -> None:
        self._config = config
        routes = bool(config.listen or router_file)
        settings = _read(router_file or ROUTER_FILE) if routes else zenoh.Config()
        self._listen = config.listen or (_endpoints(settings, "listen") if routes else ())
        self._connect = config.connect or (_endpoints(settings, "connect") if routes else ())
        _check_endpoints(config, (*self._listen, *self._connect))
        ends = {"listen/endpoints": self._listen, "connect/endpoints": self._connect}
        how = _router_settings(config) if routes else _CLIENT_SETTINGS
        for key, value in (how | ends | _certificates(config)).items():
            settings.insert_json5(key, json.dumps(value))
        self._settings = settings
        self._declarations: list[_Declaration] = []
        self._lock = threading.Lock()  # of the declarations and the session they are on
        self._closed = threading.Event()
        self._lost: queue.SimpleQueue[zenoh.Session | None] = queue.SimpleQueue()  # None: closed
        self._session = self._open(settings, time.monotonic() + open_timeout_s)
        self._listener: Any = None
        self._renewer: threading.Thread | None = None
        self._places: Places | None = None
        if self._listen:
            self._log_who_may_join()
            self._places = Places(self._session, config.max_peers)
        else:
            self._watch(self._session)
            # daemon: a session that nobody closes must not keep the process alive
            self._renewer = threading.Thread(target=self._renew, name="renew", daemon=True)
            self._renewer.start()

    def close(self) -> None:
        """Undeclare everything and close; harmless if repeated."""
        self._closed.set()
        self._lost.put(None)
        if self._renewer is not None:
            self._renewer.join()
        if self._places is not None:
            self._places.close()
        with self._lock:
            declarations, self._declarations = self._declarations, []
            for declaration in reversed(declarations):
                with contextlib.suppress(zenoh.ZError):
                    declaration.declared.undeclare()
            if not self._session.is_closed():
                with contextlib.suppress(zenoh.ZError):  # with many peers it may take too long
                    self._session.close()  # type: ignore[no-untyped-call]

    def _watch(self, session: zenoh.Session) -> None:
        """Have `_renew` replace the session once its link is lost."""

        def offer(event: Any) -> None:
            if event.kind == zenoh.SampleKind.DELETE:
                self._lost.put(session)

        handler = zenoh.handlers.Callback(offer, indirect=False)
        self._listener = session.info.declare_transport_events_listener(handler)

    def _renew(self) -> None:
        """Replace each lost session; the thread `renew`, until the session is closed."""
        while (lost := self._lost.get()) is not None:
            pauses = random_pauses()
            while lost is self._session and not self._closed.wait(next(pauses)):
                with contextlib.suppress(zenoh.ZError):
                    self._move_to(self._heard(self._settings))

    def _move_to(self, fresh: zenoh.Session) -> None:
        """Declare everything on another session and close the present one; raises ZError."""
        other = fresh  # to be closed
        try:
            self._watch(fresh)
            with self._lock:
                for declaration in self._declarations:
                    declaration.on(fresh)
                other, self._session = self._session, fresh
            try:
                _settle(fresh, self._config.timeout_s)
            except zenoh.ZError:
                self._lost.put(fresh)
                raise
        finally:
            with contextlib.suppress(zenoh.ZError):
                other.close()  # type: ignore[no-untyped-call]

    def publisher(self, key: str, priority: Priority = Priority.HIGH) -> Publisher:
        """Publisher whose `put` blocks, rather than drops, when the link is full."""
        publisher = Publisher()
        block = zenoh.CongestionControl.BLOCK
        self._declare(
            lambda on: on.declare_publisher(key, congestion_control=block, priority=priority.value),
            publisher.attach,
        )
        return publisher

    @property
    def shares_memory(self) -> bool:
        """Whether large messages may go through the memory of this host."""
        return self._config.shared_memory and sys.platform == "linux"

    def watched_publisher(self, key: str, priority: Priority | None = None) -> WatchedPublisher:
        """Publisher whose `watched` says whether anybody has subscribed.

        priority: `put` blocks when the link is full. None: the message is dropped then; only for
        messages that may be lost, and that one batch of the link can hold (64 KiB).
        """
        publisher = WatchedPublisher()
        handler = zenoh.handlers.Callback(publisher.observe, indirect=False)
        control, given = zenoh.CongestionControl.BLOCK, zenoh.Priority.BACKGROUND
        if priority is None:
            control = zenoh.CongestionControl.DROP
        else:
            given = priority.value

        def make(on: zenoh.Session) -> Any:
            declared = on.declare_publisher(key, congestion_control=control, priority=given)
            publisher.listener = declared.declare_matching_listener(handler)
            return declared

        self._declare(make, publisher.attach)
        return publisher

    @overload
    def latest_subscriber(self, key: str) -> LatestSubscriber[bytes]: ...
    @overload
    def latest_subscriber(self, key: str, opened: Callable[[bytes], T]) -> LatestSubscriber[T]: ...

    def latest_subscriber(
        self, key: str, opened: Callable[[bytes], Any] = as_it_is
    ) -> LatestSubscriber[Any]:
        """Subscriber that keeps the newest publication only: older ones are overwritten.

        opened: what to keep of a payload; called by Zenoh's thread, so it must be quick.
        """
        latest = LatestSubscriber(self._config.max_message_bytes, opened)
        handler = zenoh.handlers.Callback(latest.offer, indirect=False)
        self._declare(lambda on: on.declare_subscriber(key, handler))
        return latest

    def queue_subscriber(
        self, key: str, capacity: int = 4096, max_message_bytes: int | None = None
    ) -> QueueSubscriber:
        """Subscriber that keeps publications in order; when full, it drops and counts new ones.

        max_message_bytes: larger ones are dropped; None: as the configuration says.
        """
        waiting = QueueSubscriber(max_message_bytes or self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(waiting.offer, indirect=False)
        self._declare(lambda on: on.declare_subscriber(key, handler))
        return waiting

    def passing_subscriber(
        self, key: str, capacity: int, max_message_bytes: int
    ) -> tuple[QueueSubscriber, Callable[[], None]]:
        """A queue subscriber, and what withdraws it."""
        waiting = QueueSubscriber(max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(waiting.offer, indirect=False)
        declaration = self._declare(lambda on: on.declare_subscriber(key, handler))
        return waiting, lambda: self._withdraw(declaration)

    def server(self, key: str, capacity: int = 256) -> Server:
        """Server of queries on `key`; while `capacity` wait, it throttles new ones."""
        server = Server(key, self._config.max_message_bytes, capacity)
        handler = zenoh.handlers.Callback(server.offer, indirect=False)
        self._declare(lambda on: on.declare_queryable(key, handler, complete=True))
        return server

    def client(
        self,
        key: str,
        whom: str,
        timeout_s: float | None = None,
        *,
        priority: Priority = Priority.NORMAL,
        shared_memory: bool = False,
    ) -> Client:
        """Client of the queryable on `key`; `whom` names the peer in errors and in the log.

        priority: of its queries, and of their answers. shared_memory: large messages go through
        shared memory if the peer can reach it.
        """
        timeout = self._config.timeout_s if timeout_s is None else timeout_s
        pool = BufferPool(whom, enabled=shared_memory and self._config.shared_memory)
        client = Client(whom, timeout, self._config.max_message_bytes, pool)
        self._declare(
            lambda on: on.declare_querier(
                key,
                target=zenoh.QueryTarget.BEST_MATCHING,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
                priority=priority.value,
            ),
            client.attach,
        )
        return client

    def announce(self, key: str) -> Callable[[], None]:
        """Hold a liveliness token on `key` while the session is open; return what withdraws it."""
        declaration = self._declare(lambda on: on.liveliness().declare_token(key))
        return lambda: self._withdraw(declaration)

    def tokens(self, key: str) -> frozenset[str]:
        """The keys of the liveliness tokens that are held on `key`; raises TransportError."""
        try:
            with self._lock:
                asked = self._session.liveliness().get(key, timeout=self._config.timeout_s)
            replies = [reply.ok for reply in asked]
        except zenoh.ZError as error:
            raise TransportError(f"cannot ask who is there: {_first_line(error)}") from error
        held = frozenset(str(sample.key_expr) for sample in replies if sample is not None)
        if None in replies:
            raise DeadlineError("the router does not answer who is there")
        return held

    def presence(self, key: str) -> "Presence":
        """The liveliness tokens on `key`, including those held already."""
        presence = Presence()
        handler = zenoh.handlers.Callback(presence.offer, indirect=False)
        self._declare(lambda on: on.liveliness().declare_subscriber(key, handler, history=True))
        return presence

    def _declare(
        self, make: Callable[[zenoh.Session], Any], use: Callable[[Any], None] = lambda _: None
    ) -> _Declaration:
        """make: declares it on a Zenoh session. use: takes the result, each time."""
        declaration = _Declaration(make, use)
        with self._lock:
            declaration.on(self._session)
            self._declarations.append(declaration)
        return declaration

    def _withdraw(self, declaration: _Declaration) -> None:
        with self._lock, contextlib.suppress(zenoh.ZError):
            self._declarations.remove(declaration)
            declaration.declared.undeclare()

    def _open(self, settings: zenoh.Config, deadline: float) -> zenoh.Session:
        """Open a Zenoh session; a client tries again until the deadline, and says why it must."""
        if self._listen:
            allowed = allow_open_files(_files(self._config.max_peers))
            if allowed < self._config.max_peers + _SPARE_FILES:
                _LOG.warning(
                    "transport.max_peers is %d, but the system allows %d open files: raise that "
                    "limit (ulimit -Hn), or fewer can join",
                    *(self._config.max_peers, allowed),
                )
        told, pauses = False, random_pauses()
        while True:
            try:
                return zenoh.open(settings) if self._listen else self._heard(settings)
            except zenoh.ZError as error:
                if self._listen:
                    raise EndpointError(
                        f"cannot listen on {', '.join(self._listen)}: in use, or not an address of "
                        f"this machine ({_first_line(error)})"
                    ) from error
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise UnreachableError(f"{self._refusal()} ({_first_line(error)})") from error
                if not told and any(map(_is_open, self._connect)):
                    _LOG.warning("%s; trying again for %.0f s", self._refusal(), left_s)
                    told = True
                time.sleep(min(next(pauses), left_s))

    def _heard(self, settings: zenoh.Config) -> zenoh.Session:
        """Open a client's session that the router answers; raises ZError.

        In a storm of joins a router may drop one half-made, and never hear its session.
        """
        session = zenoh.open(settings)
        try:
            _settle(session, self._config.timeout_s)
        except zenoh.ZError:
            session.close()  # type: ignore[no-untyped-call]
            raise
        return session

    def _refusal(self) -> str:
        """Why this client is not let in, as far as that can be known from outside."""
        where, full = ", ".join(self._connect), "all places (its transport.max_peers) are taken"
        if self._config.key:
            return (
                f"nobody answers at {where}, or does not accept this certificate, or {full}; "
                "is the run up?"
            )
        if any(map(_is_open, self._connect)):
            return f"{where} does not let this process in: {full}, it hangs, or it is not a router"
        return f"nobody answers at {where}; is the run up?"

    def _log_who_may_join(self) -> None:
        where = ", ".join(self._listen)
        if self._config.key:
            _LOG.info("listening on %s, encrypted, for certificates of %s", where, self._config.ca)
        elif all(map(_LOOPBACK.match, self._listen)):
            _LOG.info("listening on %s, not encrypted: reachable from this machine only", where)
        else:
            _LOG.warning(
                "listening on %s, not encrypted: anyone who can reach it can read and alter every "
                "run; docs/security.md says how to change that",
                where,
            )

    def __repr__(self) -> str:
        ends = self._listen or self._connect
        state = "closed" if self._session.is_closed() else "open"
        return f"<Session {', '.join(ends)} {state}>"


def _settle(session: zenoh.Session, timeout_s: float) -> None:
    """Wait until the router knows all that the session declared; raises ZError.

    It handles the messages of a link in order, but those of two links in any.
    """
    for reply in session.liveliness().get(_NOBODY, timeout=timeout_s):
        if reply.ok is None:
            raise zenoh.ZError("connected, but the router does not answer")


def _files(max_peers: int) -> int:
    """Open files of a router: peers that have joined, as many that are about to, and others."""
    return 2 * max_peers + _SPARE_FILES


def _is_open(endpoint: str) -> bool:
    """Whether a process listens on a TCP endpoint, whoever it is."""
    found = _TCP.match(endpoint)
    if found is None:
        return False
    try:
        socket.create_connection((found[1], int(found[2])), _PROBE_S).close()
    except (OSError, OverflowError):
        return False
    return True


def free_endpoint() -> str:
    """A TCP endpoint on loopback with a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _first_line(error: Exception) -> str:
    """What Zenoh says, without the file of its own that it names."""
    return _ZENOH_FILE.split(str(error).splitlines()[0])[0][:120].strip()


def _endpoints(settings: zenoh.Config, side: str) -> tuple[str, ...]:
    return tuple(json.loads(settings.get_json(f"{side}/endpoints")))


def _check_endpoints(config: TransportConfig, endpoints: tuple[str, ...]) -> None:
    """Raise EndpointError if one is missing, malformed, or not as secure as configured."""
    if not endpoints:
        raise EndpointError("no endpoint: give --connect or --listen, such as tcp/127.0.0.1:7447")
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise EndpointError(f"{endpoint!r} is not an endpoint; write one as tcp/127.0.0.1:7447")
        if _PORT_0.match(endpoint):
            raise EndpointError(
                f"{endpoint}: port 0 is any free one, which nobody else would know; give a port"
            )
        if config.key and not endpoint.startswith(_ENCRYPTED):
            raise EndpointError(
                f"{endpoint} is not encrypted, but transport.certificate is given; "
                f"write {_ENCRYPTED}{endpoint.partition('/')[2]}"
            )
        if endpoint.startswith(_ENCRYPTED) and not config.key:
            raise EndpointError(
                f"{endpoint} needs transport.ca, transport.certificate and transport.key; "
                "`mrcdrl certs` makes some for trials"
            )
    for name in ("ca", "certificate", "key"):
        try:
            if path := getattr(config, name):
                Path(path).read_bytes()
        except OSError as error:
            raise EndpointError(f"transport.{name} {path}: {error.strerror}") from error


def _read(file: Path) -> zenoh.Config:
    try:
        return zenoh.Config.from_json5(file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, zenoh.ZError) as error:
        reason = getattr(error, "strerror", None) or _first_line(error)
        raise ConfigError(f"config '{file}': {reason}") from error


def _router_settings(config: TransportConfig) -> dict[str, Any]:
    """Settings that the router's file leaves to this process."""
    return {
        "access_control/enabled": bool(config.key),
        "transport/link/rx/max_message_size": 2 * config.max_message_bytes,
        "transport/unicast/max_sessions": config.max_peers,
        "transport/unicast/accept_pending": config.max_peers,
    }


def _certificates(config: TransportConfig) -> dict[str, str]:
    if not config.key:
        return {}
    return {
        "transport/link/tls/root_ca_certificate": config.ca,
        "transport/link/tls/listen_certificate": config.certificate,
        "transport/link/tls/listen_private_key": config.key,
        "transport/link/tls/connect_certificate": config.certificate,
        "transport/link/tls/connect_private_key": config.key,
    }
