"""Where a page is served and who may read it, as the flags of `add_serving` say.

Invariant: where other machines could reach a page, it asks for a token or a certificate.
"""

import argparse
import ipaddress
import os
import secrets
import socket
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from urllib.parse import urlencode

from starlette.types import ASGIApp

from mrcdrl.common.errors import ConfigError
from mrcdrl.services.web.flags import DEFAULT_PORT, TOKEN_VARIABLE, page_address
from mrcdrl.services.web.guard import Guard
from mrcdrl.services.web.server import Certificates, listen

_SHORTEST_TOKEN = 8  # characters


@dataclass(frozen=True, slots=True)
class Access:
    """Where a page is, and what it takes to read it."""

    host: str
    port: int | None  # None: the usual one, or else a free one
    names: tuple[str, ...]  # by which browsers reach the server besides its addresses
    certificates: Certificates | None
    token: str | None

    def listen(self) -> socket.socket:
        """A socket that listens there; raises EndpointError if none can."""
        return listen(self.host, self.port, DEFAULT_PORT)

    def guard(self, app: ASGIApp, changes: Collection[str] = ()) -> Guard:
        """The application behind what every request has to pass; changes: paths that take POST."""
        names = [self.host.lower(), *map(str.lower, self.names)]
        return Guard(app, names, self.token, changes)

    def address(self, listener: socket.socket, path: str, query: Mapping[str, str]) -> str:
        """What a browser is given, the token in it."""
        asked = urlencode({**query, **({"token": self.token} if self.token else {})})
        port, secure = listener.getsockname()[1], self.certificates is not None
        return page_address(self.host, port, path + "?" * bool(asked) + asked, secure=secure)


def page_access(arguments: argparse.Namespace) -> Access:
    """What the flags say; raises ConfigError for a missing file or a token that is too short."""
    certificates = _certificates(arguments)
    token = _token(arguments, certificates)
    return Access(arguments.host, arguments.port, tuple(arguments.name), certificates, token)


def _certificates(arguments: argparse.Namespace) -> Certificates | None:
    """The files for HTTPS, if any; raises ConfigError if one is missing."""
    certificate, key = arguments.https_certificate, arguments.https_key
    client_ca = arguments.https_client_ca
    if certificate is None and key is None and client_ca is None:
        return None
    if certificate is None or key is None:
        raise ConfigError("HTTPS takes both --https-certificate and --https-key")
    for path in filter(None, (certificate, key, client_ca)):
        if not path.is_file():
            raise ConfigError(f"{path} is not a file")
    return Certificates(certificate, key, client_ca)


def _token(arguments: argparse.Namespace, certificates: Certificates | None) -> str | None:
    """What browsers have to know: as given, or made where others could reach the server."""
    given: str | None = arguments.token or os.environ.get(TOKEN_VARIABLE) or None
    if given is not None and len(given) < _SHORTEST_TOKEN:
        raise ConfigError(f"a token has at least {_SHORTEST_TOKEN} characters")
    asks_clients = certificates is not None and certificates.client_ca is not None
    if given is not None or asks_clients or is_loopback(arguments.host):
        return given
    return secrets.token_urlsafe(18)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
