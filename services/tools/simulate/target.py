"""The run that takes a simulated load: one of our own, or one that is up.

Invariants: what is started here has ended, and its folder is gone, when the block is left.
"""

import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from mrcdrl.common.config import Config, TransportConfig, load_transport, to_toml
from mrcdrl.common.errors import EndpointError, MrcdrlError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.process import COMMAND, DIE_WITH_PARENT, StopSignal
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.transport import Session, free_endpoint

NAME = "simulate"  # with which the names of runs begin whose data may be made up
_START_S = 120.0
_END_S = 30.0


@dataclass(frozen=True, slots=True)
class Target:
    """The run that takes the load."""

    run: str
    config: Config
    transport: TransportConfig
    pids: dict[str, int]  # of its processes, where they are ours


@contextmanager
def joined(
    run: str, endpoint: str, overrides: dict[str, str], stop: StopSignal
) -> Iterator[Target]:
    """A run that is up; raises EndpointError or DeadlineError where it is not."""
    transport = load_transport(overrides).model_copy(update={"connect": (endpoint,), "listen": ()})
    with Session(transport) as session:
        joining = Joining(run, NAME, Path(), transport, overrides)
        config = fetch_config(session, joining, stop)
    yield Target(run, config, transport, {})


@contextmanager
def own(config: Config, *, router: bool) -> Iterator[Target]:
    """Replay, as many shards as configured; a router before it if asked for, or if it needs one."""
    run, endpoint = f"{NAME}-{os.getpid()}", free_endpoint()
    transport = config.transport.model_copy(update={"connect": (endpoint,), "listen": ()})
    router = router or config.replay.shards > 1
    with tempfile.TemporaryDirectory(prefix=f"{NAME}-") as folder, ExitStack() as owned:
        settings, services = Path(folder, RUN_CONFIG), dict[str, _Service]()
        settings.write_text(to_toml(config), "utf-8")
        if router:
            flags = ["--listen", endpoint]
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
    """A service's process, ended with the block."""

    def __init__(self, role: str, flags: Sequence[str], log: Path) -> None:
        self._role, self._log = role, log
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MRCDRL_")}
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                [*COMMAND, role, *flags],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**environment, DIE_WITH_PARENT: str(os.getpid())},
                start_new_session=True,
            )

    def __enter__(self) -> "_Service":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def await_endpoint(self, transport: TransportConfig) -> None:
        """Wait for it to listen; raises MrcdrlError, with its last word, where it ends first."""
        deadline = monotonic() + _START_S
        while True:
            try:
                Session(transport, open_timeout_s=0.0).close()
                return
            except EndpointError:
                if self.process.poll() is not None:
                    said = self._log.read_text("utf-8", "replace").strip().splitlines()
                    reason = said[-1] if said else "it said nothing"
                    raise MrcdrlError(f"{self._role} failed: {reason}") from None
                if monotonic() > deadline:
                    raise
