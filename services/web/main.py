"""`mrcdrl web`: a page to watch runs by, live while they are up."""

import argparse
import asyncio
import ipaddress
import logging
import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.config import load_transport
from mrcdrl.common.config.arguments import overrides
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal, yield_cores
from mrcdrl.common.runtime.runs import find_run, is_run, run_path, runs_folder
from mrcdrl.services.web.app import make_app
from mrcdrl.services.web.flags import DEFAULT_PORT, TOKEN_VARIABLE, page_address, parser
from mrcdrl.services.web.folder import RunFolder
from mrcdrl.services.web.following import Runs
from mrcdrl.services.web.guard import Guard
from mrcdrl.services.web.scraping import metrics_route
from mrcdrl.services.web.server import Certificates, listen, serve

_LOG = logging.getLogger("web")
_SHORTEST_TOKEN = 8  # characters
_NICE = 10  # a run goes first where cores are short


def main(argv: Sequence[str]) -> int:
    """Show runs until told to stop; return the exit code."""
    arguments = parser().parse_args(argv)
    certificates = _certificates(arguments)
    token = _token(arguments, certificates)
    transport = load_transport(overrides(arguments), source=arguments.transport)
    if arguments.connect:
        transport = transport.model_copy(update={"connect": tuple(arguments.connect)})
    folder, home = _shown(arguments, may_come=bool(transport.connect))
    stop = StopSignal().listen(STOP_DEADLINE_S)
    yield_cores(_NICE)
    listener = listen(arguments.host, arguments.port, DEFAULT_PORT)
    runs, heartbeat = Runs(transport), Heartbeat.from_environment()

    def each_second() -> None:
        runs.tend()
        heartbeat.worked()
        heartbeat.beat()

    found = RunFolder(folder)
    pages = make_app(found, runs, home=home, routes=[metrics_route(found, runs)])
    app = Guard(pages, [arguments.host.lower(), *map(str.lower, arguments.name)], token)
    query = "&".join([f"name={home}"] * bool(home) + [f"token={token}"] * bool(token))
    address = page_address(
        arguments.host,
        listener.getsockname()[1],
        f"{'run' if home else ''}{'?' * bool(query)}{query}",
        secure=certificates is not None,
    )
    _LOG.info("showing %s at %s", folder / home, address)
    asyncio.run(serve(app, listener, certificates, stop, each_second, runs.close))
    return 0


def _shown(arguments: argparse.Namespace, *, may_come: bool) -> tuple[Path, str]:
    """The folder of runs, and the name of the run that was asked for, or "".

    may_come: a run that has no directory yet may get one. Raises RunDirectoryError if there is
    neither a run nor a folder of that name.
    """
    word = arguments.shown
    if word is None:
        return runs_folder(arguments.run_dir), ""
    if Path(word).is_dir() and not is_run(Path(word)):
        return Path(word), ""
    find = run_path if may_come else find_run
    path = find(word, arguments.run_dir)
    return path.parent, path.name


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
