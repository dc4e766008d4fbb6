"""Serves the application over HTTP: few connections, short waits, and an orderly end.

Invariants: a connection that asks nothing in time is closed; of too many, the newest are; headers
of proxies are not believed.
"""

import asyncio
import contextlib
import errno
import logging
import socket
import ssl
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from mrcdrl.common.errors import EndpointError
from mrcdrl.common.runtime.files import reason
from mrcdrl.common.runtime.process import StopSignal

MAX_CONNECTIONS = 256
REQUEST_S = 10.0  # from the first byte of a request, or the connection, to the whole request
_KEEP_ALIVE_S = 5
_HEADER_BYTES = 1 << 14
_TICKS_A_SECOND = 5
_END_S = 3  # for answers under way, when the server ends


@dataclass(frozen=True, slots=True)
class Certificates:
    """Files for HTTPS."""

    certificate: Path
    key: Path
    client_ca: Path | None = None  # whose clients alone are let in


class LimitedProtocol(H11Protocol):
    """One connection."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take it, if there are not too many."""
        if len(self.connections) >= MAX_CONNECTIONS:
            self.transport = transport
            transport.abort()
            return
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Take a piece of a request."""
        super().data_received(data)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        if self._timer is not None:
            self._timer.cancel()
        super().connection_lost(exc)

    def _wait(self) -> None:
        """Wait for the whole request, for a limited time."""
        if self._timer is None and not self._answers:
            self._timer = self.loop.call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        self._timer = None
        if not self._answers:
            self.transport.close()

    @property
    def _answers(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete


def listen(host: str, port: int | None, usual: int) -> socket.socket:
    """A socket that listens there; port 0: a free one; None: the usual one, or else a free one.

    Raises EndpointError if the address is in use, or not one of this machine.
    """
    try:
        return _bound(host, usual if port is None else port)
    except OSError as error:
        if port is None and error.errno == errno.EADDRINUSE:
            return listen(host, 0, usual)
        raise EndpointError(f"cannot listen on {host}, port {port}: {reason(error)}") from error


def _bound(host: str, port: int) -> socket.socket:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, _, _, _, address = found[0]
    return socket.create_server(address[:2], family=family, backlog=128)


async def serve(
    app: ASGIApp,
    listener: socket.socket,
    certificates: Certificates | None,
    stop: StopSignal,
    each_second: Callable[[], None],
    end: Callable[[], Awaitable[None]],
) -> None:
    """Answer requests until stopped; end: ends the answers that would go on."""
    config = uvicorn.Config(
        app,
        http=LimitedProtocol,
        ws="none",
        loop="asyncio",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=_KEEP_ALIVE_S,
        timeout_graceful_shutdown=_END_S,
        h11_max_incomplete_event_size=_HEADER_BYTES,
        **_https(certificates),  # type: ignore[arg-type]
    )
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    server = _Server(config)
    answering = asyncio.create_task(server.serve([listener]))
    ticks = 0
    while not (stop.is_set() or answering.done()):
        if ticks % _TICKS_A_SECOND == 0:
            each_second()
        ticks += 1
        await asyncio.sleep(1 / _TICKS_A_SECOND)
    await end()
    server.should_exit = True
    await answering


class _Server(uvicorn.Server):
    """A server that leaves signals to its process."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def _https(certificates: Certificates | None) -> dict[str, object]:
    if certificates is None:
        return {}
    found: dict[str, object] = {
        "ssl_certfile": certificates.certificate,
        "ssl_keyfile": certificates.key,
    }
    if certificates.client_ca is not None:
        found |= {"ssl_ca_certs": certificates.client_ca, "ssl_cert_reqs": ssl.CERT_REQUIRED}
    return found
