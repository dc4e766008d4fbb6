"""Joining a run: its name, its endpoint, and the configuration that its replay service serves."""

import argparse
import os
import re
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from mrcdrl.common.config import (
    Config,
    TransportConfig,
    apply_overrides,
    from_toml,
    load_transport,
    validate_config,
    variable,
)
from mrcdrl.common.config.arguments import (
    SEEDS,
    Parser,
    add_config_flags,
    add_transport_flag,
    overrides,
)
from mrcdrl.common.errors import (
    ConfigError,
    DeadlineError,
    RefusedError,
    UnreachableError,
    WireError,
)
from mrcdrl.common.runtime.names import check_name, printable
from mrcdrl.common.runtime.pauses import random_pauses
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import add_run, is_run, run_path, unknown_run
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys

ENDPOINT_FILE = "endpoint"
_SHOWN = {  # in the short help of a service
    "actor": ("actor.num_arenas", "actor.threads", "actor.device", "actor.spool_chunks"),
    "learner": (
        "learner.device",
        "learner.threads",
        "learner.precision",
        "learner.publish_period",
        "learner.checkpoint_period_s",
    ),
    "evaluator": (
        "evaluator.episodes",
        "evaluator.epsilon",
        "evaluator.period_s",
        "evaluator.max_share",
        "evaluator.threads",
    ),
}


@dataclass(frozen=True, slots=True)
class Joining:
    """What a process needs to join its run."""

    run: str
    worker: str
    run_dir: Path  # of this run
    transport: TransportConfig
    overrides: dict[str, str]

    @classmethod
    def from_argv(cls, role: str, argv: Sequence[str]) -> Self:
        """Parse a service's command line; raises UnreachableError as `from_arguments`."""
        return cls.from_arguments(service_parser(role).parse_args(argv))

    @classmethod
    def from_arguments(cls, arguments: argparse.Namespace) -> Self:
        """Read the flags of `joining_parser`.

        Raises ConfigError without a run, UnreachableError if neither --connect nor the run
        directory names an endpoint.
        """
        run_dir = run_path(arguments.run, arguments.run_dir)
        host_and_process = f"{socket.gethostname()}-{os.getpid()}"
        worker = arguments.id or re.sub(r"[^A-Za-z0-9-]", "-", host_and_process)
        given = overrides(arguments)
        transport = load_transport(given, source=arguments.transport)
        endpoints = arguments.connect or transport.connect
        endpoints = tuple(endpoints or [recorded_endpoint(run_dir, "--connect")])
        transport = transport.model_copy(update={"connect": endpoints, "listen": ()})
        return cls(run_dir.name, check_name(worker, "--id"), run_dir, transport, given)

    @property
    def keys(self) -> Keys:
        return Keys(self.run)


def actor_parser() -> Parser:
    """The flags of `mrcdrl actor`."""
    return service_parser("actor")


def learner_parser() -> Parser:
    """The flags of `mrcdrl learner`."""
    return service_parser("learner")


def evaluator_parser() -> Parser:
    """The flags of `mrcdrl evaluator`."""
    return service_parser("evaluator")


def service_parser(role: str) -> Parser:
    """The flags of an actor, learner or evaluator."""
    seeds = ("evaluator.seed",) if role == "evaluator" else SEEDS
    parser = joining_parser(role, f"Start the {role} of a run that is up.")
    add_config_flags(parser, _SHOWN[role], seeds=seeds)
    return parser


def joining_parser(command: str, description: str) -> Parser:
    """The flags of a command that joins a run, without those of settings."""
    parser = Parser(prog=f"mrcdrl {command}", description=description)
    add_run(parser)
    parser.add_argument("--connect", action="append", help="endpoint, such as tcp/HOST:7447")
    parser.add_argument("--id", help="this worker's name; default: from the host and process")
    add_transport_flag(parser)
    return parser


def recorded_endpoint(run_dir: Path, flag: str) -> str:
    """The endpoint of a run on this machine, as `mrcdrl train` recorded it.

    Raises UnreachableError, naming the flag to give, if no run is up there.
    """
    try:
        return (run_dir / ENDPOINT_FILE).read_text("utf-8").strip()
    except OSError as error:
        why = f"no run is up in {run_dir}" if is_run(run_dir) else unknown_run(run_dir)
        raise UnreachableError(f"{why}; give {flag}, such as tcp/127.0.0.1:7447") from error


def fetch_config(
    session: Session,
    joining: Joining,
    stop: StopSignal,
    timeout_s: float = 30.0,
    *,
    plays: bool = False,
) -> Config:
    """Ask replay for the run's configuration, and put this process's own settings over it.

    plays: this process makes the run's arenas. It imports a custom world only if it was itself told
    to: what is served over the network does not decide which code runs here. Else ConfigError.

    Raises, once the time is over, DeadlineError if nobody serves that run, WireError or
    RefusedError if the answer is not a configuration: another process may have answered.
    """
    whom = f"the replay service of run {joining.run!r}"
    client = session.client(joining.keys.config, whom, timeout_s=2.0)
    deadline, pauses = time.monotonic() + timeout_s, random_pauses()
    while True:
        try:
            served = _served(bytes(client.ask(b"").result()), whom)
        except (DeadlineError, RefusedError, WireError) as error:
            left_s = deadline - time.monotonic()
            if left_s < 0 or stop.wait(min(next(pauses), left_s)):
                if isinstance(error, DeadlineError):
                    raise DeadlineError(f"{error}; is that the run's name?") from error
                raise
            continue
        if plays:
            _check_world(served.get("arena", {}).get("env", ""), joining)
        table = {**served, "transport": joining.transport.model_dump()}
        return apply_overrides(table, joining.overrides)


def _check_world(served: str, joining: Joining) -> None:
    """Raise ConfigError unless this process was told to play in the run's world."""
    name = variable("arena", "env")
    own = joining.overrides.get("arena.env", os.environ.get(name, ""))
    if own != served:
        told = f"this process was told {own}" if own else "this process was not told to import it"
        world = served or "the paper's arena"
        raise ConfigError(
            f"run {joining.run} plays in {world}, and {told}: give "
            f"{f'--env {served}' if served else 'no --env'}, or set {name}"
        )


def _served(answer: bytes, whom: str) -> dict[str, Any]:
    """The table of a served configuration; raises WireError if the answer is none."""
    try:
        served = from_toml(answer.decode())
        validate_config(served)
    except (UnicodeDecodeError, ConfigError) as error:
        raise WireError(f"{whom} serves no configuration: {printable(str(error))}") from error
    return served
