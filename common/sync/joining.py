"""How a process joins a run: by its name, an endpoint, and the configuration that replay serves."""

import argparse
import os
import re
import socket
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mrcdrl.common.config import Config, TransportConfig, apply_overrides, load_transport
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides
from mrcdrl.common.errors import DeadlineError, EndpointError
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys

ENDPOINT_FILE = "endpoint"


@dataclass(frozen=True, slots=True)
class Joining:
    """How a service finds its run."""

    run: str
    worker: str
    run_dir: Path  # of this run
    transport: TransportConfig
    overrides: dict[str, str]

    @property
    def keys(self) -> Keys:
        return Keys(self.run)


def joining_arguments(role: str, argv: Sequence[str]) -> Joining:
    """A service's command line.

    Raises EndpointError where neither --connect nor the run's folder names an endpoint.
    """
    parser = joining_parser(role, f"Start the {role} of a run that is up.")
    return joining_of(parser.parse_args(argv))


def joining_parser(command: str, description: str) -> Parser:
    """The flags of a command that joins a run."""
    parser = Parser(prog=f"mrcdrl {command}", description=description)
    parser.add_argument("--run", required=True, help="the run's name")
    parser.add_argument("--connect", action="append", help="endpoint, such as tcp/HOST:7447")
    parser.add_argument("--id", help="this worker's name; by default from the host and process")
    parser.add_argument("--run-dir", type=Path, default=Path("runs"), help="where runs are kept")
    add_config_flags(parser)
    return parser


def joining_of(arguments: argparse.Namespace) -> Joining:
    """What those flags say.

    Raises EndpointError where neither --connect nor the run's folder names an endpoint.
    """
    run_dir = arguments.run_dir / check_name(arguments.run, "run name")
    worker = arguments.id or re.sub(r"[^A-Za-z0-9-]", "-", f"{socket.gethostname()}-{os.getpid()}")
    given = overrides(arguments)
    transport = load_transport(given)
    endpoints = tuple(
        arguments.connect or transport.connect or [noted_endpoint(run_dir, "--connect")]
    )
    transport = transport.model_copy(update={"connect": endpoints, "listen": ()})
    return Joining(arguments.run, check_name(worker, "--id"), run_dir, transport, given)


def noted_endpoint(run_dir: Path, flag: str) -> str:
    """Where the run on this machine listens, as `mrcdrl train` wrote it down.

    Raises EndpointError, naming the flag to give, where none is up.
    """
    try:
        return (run_dir / ENDPOINT_FILE).read_text("utf-8").strip()
    except OSError as error:
        raise EndpointError(
            f"no run is up in {run_dir}; give {flag}, such as tcp/127.0.0.1:7447"
        ) from error


def fetch_config(
    session: Session, joining: Joining, stop: StopSignal, timeout_s: float = 30.0
) -> Config:
    """The run's configuration, from its replay service, under this process's own settings.

    Raises DeadlineError where nobody serves that run within the time.
    """
    whom = f"the replay service of run {joining.run!r}"
    client = session.client(joining.keys.config, whom, timeout_s=2.0)
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            text = bytes(client.ask(b"").result()).decode()
        except DeadlineError as error:
            if time.monotonic() > deadline or stop.wait(0.2):
                raise DeadlineError(f"{error}; is that the run's name?") from error
            continue
        table = {**tomllib.loads(text), "transport": joining.transport.model_dump()}
        return apply_overrides(table, joining.overrides)
