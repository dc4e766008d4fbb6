"""What every service's shell shares: signals, logging, joining a run, and a clean exit.

Invariants: SIGTERM and SIGINT set one StopSignal; errors on purpose end the process with one
line and their exit code; bugs of ours crash with a traceback.
"""

import argparse
import ctypes
import logging
import os
import re
import signal
import socket
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from common.arguments import Parser, add_config_flags, overrides
from common.config import Config, TransportConfig, apply_overrides, load_transport
from common.errors import DeadlineError, EndpointError, MrcdrlError, TransportError
from common.heartbeat import Heartbeat
from common.keys import Keys, check_name
from common.trajectory import Stats
from common.transport import Publisher, Session
from common.versions import versions
from common.wire import encode

ENDPOINT_FILE = "endpoint"
DIE_WITH_PARENT = "MRCDRL_DIE_WITH_PARENT"  # its process id, set by who starts services
# Of the environment of processes that learn: freed memory stays with them. Else each large tensor
# is mapped afresh at every step.
ALLOCATOR = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(1 << 32),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
STOP_DEADLINE_S = 30  # of a service, from the signal to its end
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>
_LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class StopSignal:
    """Set once, by a signal or from within; many may wait for it."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._deadline_s = 0

    def listen(self, deadline_s: int = 0) -> "StopSignal":
        """Have SIGTERM and SIGINT set it; call from the main thread.

        deadline_s: if above 0, a process still there so long after the signal is ended by the
        kernel, whatever it waits for.
        """
        self._deadline_s = deadline_s
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        return self

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._event.set()
        signal.alarm(self._deadline_s)

    def set(self) -> None:
        self._event.set()

    def is_set(self) -> bool:
        return self._event.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Whether it is set within the time."""
        return self._event.wait(timeout_s)


def run_main(main: Callable[[], int | None]) -> int:
    """Run a command; the exit code. MrcdrlError becomes one line on stderr."""
    logging.basicConfig(level=logging.INFO, format=_LOG_FORMAT, stream=sys.stderr)
    parent = os.environ.get(DIE_WITH_PARENT)
    if parent and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):  # it was gone before it could be watched
            return 0
    try:
        return main() or 0
    except MrcdrlError as error:
        sys.stderr.write(f"mrcdrl: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("mrcdrl: interrupted\n")
        return 130


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


def available_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class StatsReporter:
    """Publishes a service's metrics once a second, from its own main loop, and beats with it."""

    def __init__(self, publisher: Publisher, role: str, worker: str) -> None:
        self._publisher = publisher
        self._role = role
        self._worker = worker
        self._text = {"incarnation": str(time.time_ns()), **versions()}
        self._heartbeat = Heartbeat.of_environment()
        self._due_s = 0.0

    def worked(self, at_s: float | None = None) -> None:
        """The service did something, or has nothing to do; `at_s`: then, by default now."""
        self._heartbeat.worked(at_s)

    def maybe(self, metrics: Callable[[], dict[str, float]]) -> None:
        """Publish if a second has passed since the last time."""
        if time.monotonic() >= self._due_s:
            self.now(metrics)

    def now(self, metrics: Callable[[], dict[str, float]]) -> None:
        """Publish, and again in a second."""
        self._due_s = time.monotonic() + 1.0
        try:
            numbers = {name: float(value) for name, value in metrics().items()}
            text = {**self._text, "clock_ns": str(time.time_ns())}
            self._publisher.put(encode(Stats(self._role, self._worker, numbers, text)))
        except TransportError as error:
            logging.getLogger(self._role).warning("stats not published: %s", error)
        self._heartbeat.beat()
