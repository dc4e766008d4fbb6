"""A run on hosts in two networks, with a router in each, and the routers linked.

    left: replay, learner, router-left      right: actors, evaluator, router-right

Every service has a host, with a folder for its run that no other host sees. Who watches sits on no
host: a socket in the file system leads to the left router, and no fault of a network touches it.

Invariants: a service that ends is started again, as `docker compose` would, and when is noted; all
end with this process, whatever happens to it.
"""

import os
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from mrcdrl.common.config import Config, to_toml
from mrcdrl.common.runtime.heartbeat import FILE_VARIABLE, Pulse
from mrcdrl.common.runtime.process import DIE_WITH_PARENT, STOP_DEADLINE_S
from tests.chaos.chaos_faults import disk
from tests.chaos.chaos_hosts import Host, Network, hosts
from tests.system.system_processes import Command, run_name

PORT = 7447
DISK_BYTES = 400 << 20
ON_DISKS = ("replay", "learner")  # whose folders can be filled


@dataclass
class Service:
    """A service on its host: one process after another."""

    name: str
    host: Host
    folder: Path  # of its host
    arguments: list[str]
    ends: list[int] = field(default_factory=list)  # exit codes of those that nobody killed
    command: Command | None = None
    away: bool = False  # killed, and not to be started again yet

    @property
    def role(self) -> str:
        return self.arguments[0]

    @property
    def process(self) -> Command:
        assert self.command is not None, f"{self.name} was never started"
        return self.command

    @property
    def pid(self) -> int:
        return self.process.process.pid

    def start(self, variables: Mapping[str, str] | None = None) -> None:
        settings = {
            FILE_VARIABLE: str(self.folder / "heartbeat"),
            DIE_WITH_PARENT: str(os.getpid()),
            **(variables or {}),
        }
        self.command = Command(self.arguments, self.folder, prefix=self.host.prefix, **settings)

    def tend(self) -> None:
        """Start it again if it has ended."""
        if not self.away and (code := self.process.process.poll()) is not None:
            self.ends.append(code)
            self.start()

    @contextmanager
    def killed(self, variables: Mapping[str, str] | None = None) -> Iterator[None]:
        """Kill with SIGKILL, and start no other process until the block ends."""
        self.away = True
        self.process.signal(signal.SIGKILL)
        self.process.wait()
        try:
            yield
        finally:
            self.start(variables)
            self.away = False

    def worked_since(self, moment_s: float) -> bool:
        """Whether it did work since then, as a container's health check asks."""
        with suppress(OSError, ValueError):
            return Pulse.read(self.folder / "heartbeat").worked_s > moment_s
        return False

    @property
    def log(self) -> str:
        """Output of all its processes."""
        files = sorted(self.folder.glob("*.err"), key=lambda path: path.stat().st_mtime)
        return "".join(path.read_text("utf-8", "replace") for path in files)


@dataclass(frozen=True, slots=True)
class Stack:
    """The services by name, in the order in which they are started."""

    run: str
    services: dict[str, Service]
    endpoint: str  # for who watches

    def tend(self) -> None:
        for service in self.services.values():
            service.tend()

    def end(self) -> dict[str, int]:
        """Ask all to end, first those that still have something to send; return the exit codes."""
        joined = [s for s in self.services.values() if s.role not in ("replay", "router")]
        for service in self.services.values():
            service.away = True
        for service in joined:
            service.process.signal(signal.SIGTERM)
        for service in joined:
            with suppress(subprocess.TimeoutExpired):
                service.process.wait(2 * STOP_DEADLINE_S)
        return {name: self.services[name].process.end() for name in reversed(self.services)}

    def logs(self) -> str:
        """The end of each service's output."""
        return "\n".join(
            f"--- {name}, ended by itself: {service.ends}\n{service.log[-2000:]}"
            for name, service in self.services.items()
        )


@contextmanager
def stack(config: Config, folder: Path, num_actors: int) -> Iterator[Stack]:
    """Start all services; end them and remove their hosts when the block is left.

    Raises OSError where this machine does not let us have hosts.
    """
    with ExitStack() as owned:
        made = owned.enter_context(hosts())
        left, right, between = map(made.network, ("left", "right", "between"))
        run, socket_path = run_name("chaos"), folder / "router.socket"
        config_path = folder / "chaos.toml"
        config_path.write_text(to_toml(config), "utf-8")
        services: dict[str, Service] = {}

        def add(name: str, networks: tuple[Network, ...], *arguments: str) -> Host:
            host, place = made.host(name, *networks), folder / name
            place.mkdir()
            if name in ON_DISKS:
                owned.enter_context(disk(place, DISK_BYTES))
            services[name] = Service(name, host, place, list(arguments))
            return host

        def join(name: str, network: Network, router: Host, role: str, *more: str) -> None:
            endpoint = f"tcp/{router.address(network)}:{PORT}"
            joining = ("--run", run, "--run-dir", str(folder / name), "--connect", endpoint)
            # These hosts share a kernel: without this they would lend each other memory.
            apart = ("--id", name, "--transport.shared_memory=false")
            add(name, (network,), role, *joining, *apart, *more)

        listen = f"tcp/0.0.0.0:{PORT}"
        watched = f"unixsock-stream/{socket_path}"
        first = add(
            *("router-left", (left, between), "router", "--listen", listen, "--listen", watched)
        )
        link = f"tcp/{first.address(between)}:{PORT}"
        second = add(
            *("router-right", (right, between), "router", "--listen", listen, "--connect", link)
        )
        join("replay", left, first, "replay", "--config", str(config_path))
        join("learner", left, first, "learner")
        join("evaluator", right, second, "evaluator")
        for number in range(num_actors):
            join(f"actor-{number}", right, second, "actor")
        started = Stack(run, services, watched)
        try:
            for service in services.values():
                service.start()
            yield started
        finally:
            for service in services.values():
                if service.command is not None:
                    service.command.process.kill()
                    service.command.wait()
