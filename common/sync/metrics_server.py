"""Serves a registry of metrics over HTTP, for Prometheus, beside a process's own work.

Invariants: it never holds or ends the process: a port that cannot be had is one warning, a request
that fails is answered with an error. Metrics are collected at most once a second, however often
they are asked for. Open connections are bounded: a new one closes the oldest.
"""

import ipaddress
import logging
import socket
import socketserver
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler
from urllib.parse import urlsplit

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.files import reason
from mrcdrl.common.runtime.hosts import host_of, in_url

PATH = "/metrics"
MAX_CONNECTIONS = 16
_FRESH_S = 1.0  # statistics come once a second
_PATIENCE_S = 5.0  # for a client that sends or takes nothing
_LOCAL = ("localhost", "127.0.0.1", "[::1]")  # names by which a browser may ask for loopback


class MetricsServer(Closing):
    """Answers GET /metrics in threads of its own until it is closed; raises OSError.

    port: 0 for a free one. Who listens on loopback answers only requests to that: a page of
    another site, whose name was made to mean this machine, reads nothing.
    """

    def __init__(self, registry: CollectorRegistry, address: str, port: int, role: str) -> None:
        self._server = _Server(registry, address, port, logging.getLogger(role))
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics")
        self._thread.start()

    def __repr__(self) -> str:
        return f"MetricsServer({self.address!r})"

    @property
    def address(self) -> str:
        """Where metrics are, as a URL."""
        host, port = self._server.server_address[:2]
        return f"http://{in_url(str(host))}:{port}{PATH}"

    def close(self) -> None:
        """Stop, and cut off whoever is being answered."""
        self._server.shutdown()
        self._server.server_close()
        self._server.cut_off()
        self._thread.join()


@contextmanager
def serve_registry(
    transport: TransportConfig, role: str, registry: Callable[[], CollectorRegistry]
) -> Iterator[None]:
    """Serve metrics meanwhile, if transport.metrics_port says so; else do nothing."""
    server, log = None, logging.getLogger(role)
    address, port = transport.metrics_address, transport.metrics_port
    if port:
        try:
            server = MetricsServer(registry(), address, port, role)
            log.info("metrics: %s", server.address)
        except OSError as error:
            log.warning(
                "no metrics on %s, port %d (transport.metrics_port): %s; all else goes on",
                *(address, port, reason(error)),
            )
    try:
        yield
    finally:
        if server is not None:
            server.close()


class _Server(socketserver.ThreadingTCPServer):
    """Bounds connections, and keeps what was collected for a second."""

    allow_reuse_address = True
    daemon_threads = True  # `cut_off` ends them; nobody waits for a client

    def __init__(
        self, registry: CollectorRegistry, address: str, port: int, log: logging.Logger
    ) -> None:
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self.loopback = ipaddress.ip_address(address).is_loopback
        self._registry = registry
        self._log = log
        self._failed = False
        self._page, self._collected_s = b"", -_FRESH_S
        self._collecting, self._counting = threading.Lock(), threading.Lock()
        self._open: deque[socket.socket] = deque()
        super().__init__((address, port), _Handler)

    def page(self) -> bytes | None:
        """All metrics as text; None if they cannot be collected, which is said once."""
        with self._collecting:
            if time.monotonic() - self._collected_s >= _FRESH_S:
                try:
                    self._page = generate_latest(self._registry)
                except Exception as error:  # noqa: BLE001
                    if not self._failed:
                        self._log.warning("metrics cannot be collected: %r", error)
                    self._failed = True
                    return None
                self._collected_s = time.monotonic()
            return self._page

    def cut_off(self, keep: int = 0) -> None:
        """Cut off the oldest connections, but for `keep`."""
        with self._counting:
            while len(self._open) > keep:
                with suppress(OSError):
                    self._open.popleft().shutdown(socket.SHUT_RDWR)

    def process_request(  # type: ignore[override]  # a server of TCP is given sockets only
        self, request: socket.socket, client_address: object
    ) -> None:
        self.cut_off(keep=MAX_CONNECTIONS - 1)
        with self._counting:
            self._open.append(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: socket.socket) -> None:  # type: ignore[override]
        with self._counting, suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Forget a client that went away or was cut off."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: _Server
    server_version = sys_version = ""
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        """Send the metrics."""
        if self.server.loopback and host_of(self.headers.get("Host", "")) not in _LOCAL:
            self.send_error(403, explain="metrics are served to localhost only")
        elif urlsplit(self.path).path != PATH:
            self.send_error(404, explain=f"metrics are at {PATH}")
        elif (page := self.server.page()) is None:
            self.send_error(500, explain="metrics cannot be collected")
        else:
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE_PLAIN_0_0_4)
            self.send_header("Content-Length", str(len(page)))
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(page)

    def log_message(self, *_: object) -> None:
        """Log nothing: a client would fill the log."""
