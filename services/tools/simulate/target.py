"""The run that takes a simulated load: our own, or one that is up already.

Invariants: on leaving the block, the processes started here have ended and their directory is
removed.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from mrcdrl.common.config import Config, TransportConfig, load_transport, to_toml
from mrcdrl.common.errors import EndpointError, MrcdrlError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.process import StopSignal, end_service, last_line, start_service
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Session, free_endpoint

NAME = "simulate"  # prefix of the names of runs whose data may be made up
_START_S = 120.0
_TRY_S = 1.0
_END_S = 30.0


@dataclass(frozen=True, slots=True)
class Target:
    """The run that takes the load."""

    run: str
    config: Config
    transport: TransportConfig
    pids: dict[str, int]  # of its processes, if we started them


@contextmanager
def joined(
    run: str, endpoint: str, overrides: dict[str, str], stop: StopSignal
) -> Iterator[Target]:
    """A run that is up; raises EndpointError or DeadlineError if it is not."""
    transport = load_transport(overrides).model_copy(update={"connect": (endpoint,), "listen": ()})
    with Session(transport) as session:
        joining = Joining(run, NAME, Path(), transport, overrides)
        config = fetch_config(session, joining, stop)
    yield Target(run, config, transport, {})


@contextmanager
def own(config: Config, *, router: bool) -> Iterator[Target]:
    """Replay with the configured shards, behind a router if asked for or if there are several."""
    run, endpoint = f"{NAME}-{os.getpid()}", free_endpoint()
    transport = config.transport.model_copy(update={"connect": (endpoint,), "listen": ()})
    router = router or config.replay.shards > 1
    with tempfile.TemporaryDirectory(prefix=f"{NAME}-") as folder, ExitStack() as owned:
        settings, services = Path(folder, RUN_CONFIG), dict[str, _Service]()
        settings.write_text(to_toml(config), "utf-8")
        if router:
            flags = ["--transport", str(settings), "--listen", endpoint]
            services["router"] = owned.enter_context(_Service("router", flags, Path(folder, "log")))
            services["router"].await_endpoint(transport)
        end = "--connect" if router else "--listen"
        for shard in range(config.replay.shards):
            worker = f"replay-{shard}"
            flags = ["--run", run, "--run-dir", folder, "--config", str(settings)]
            flags += ["--shard", str(shard), end, endpoint]
            replay = _Service("replay", flags, Path(folder, f"{worker}.log"))
            services[worker] = owned.enter_context(replay)
            replay.await_endpoint(transport)
        with Session(transport) as session:
            fetch_config(session, Joining(run, NAME, Path(), transport, {}), StopSignal(), _START_S)
        yield Target(run, config, transport, {n: s.process.pid for n, s in services.items()})


class _Service:
    """The process of a service, which ends with the block."""

    def __init__(self, role: str, flags: Sequence[str], log: Path) -> None:
        self._role, self._log = role, log
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MRCDRL_")}
        self.process = start_service(role, flags, log, environment)

    def __enter__(self) -> "_Service":
        return self

    def __exit__(self, *_: object) -> None:
        end_service(self.process, _END_S)

    def await_endpoint(self, transport: TransportConfig) -> None:
        """Wait until it listens; raises MrcdrlError, with its last log line, if it ends first."""
        deadline = monotonic() + _START_S
        while True:
            try:
                Session(transport, open_timeout_s=_TRY_S).close()
                return
            except EndpointError:
                if self.process.poll() is not None:
                    raise MrcdrlError(f"{self._role} failed: {last_line(self._log)}") from None
                if monotonic() > deadline:
                    raise
