"""Hosts on this machine: network namespaces, joined by networks that touch nothing else.

A network is a bridge in a namespace, a host a namespace with a cable to each of its networks.
Packets are not forwarded between networks: what crosses them is relayed by routers of a run.

Invariants: every namespace bears this process's id in its name, and all of them are gone when the
block ends, or when the next begins after a process that was killed; nothing is made or changed
in the namespace of this process. Needs root, and `ip`.
"""

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.patience import PATIENCE_S

PORT = "eth"  # eth0 leads to a host's first network
TCP_RETRIES = 3  # as docs/compose.md asks of several hosts


def run(*command: str) -> str:
    """Output of the command; raises OSError with its messages if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def owned_name(name: str) -> str:
    """A name that says which process it belongs to."""
    return f"mrcdrl-{os.getpid()}-{name}"


def owners_are_gone(names: Iterator[str]) -> list[str]:
    """Names left by processes that were killed before they could clean up."""
    owners = {name: re.fullmatch(r"mrcdrl-(\d+)-.*", name) for name in names}
    return [n for n, owner in owners.items() if owner and not Path("/proc", owner[1]).exists()]


@dataclass(frozen=True, slots=True)
class Network:
    """One switch; `number` distinguishes its addresses from those of other networks."""

    name: str
    namespace: str
    number: int
    hosts: list["Host"] = field(default_factory=list, repr=False)


@dataclass(frozen=True, slots=True)
class Host:
    """One machine, as far as the network is concerned."""

    name: str
    namespace: str
    networks: tuple[Network, ...]

    @property
    def prefix(self) -> tuple[str, ...]:
        """Prefix of a command that runs there, in the very process that the prefix starts."""
        return ("ip", "netns", "exec", self.namespace)

    @property
    def ports(self) -> list[str]:
        return [f"{PORT}{index}" for index in range(len(self.networks))]

    def run(self, *command: str) -> None:
        run(*self.prefix, *command)

    def address(self, network: Network) -> str:
        """IPv4 address in one of its networks."""
        return f"10.77.{network.number}.{network.hosts.index(self) + 1}"

    def plug(self, state: str) -> None:
        """Set the links "up" or "down" at the switch; the host sees that it has no carrier."""
        for network in self.networks:
            run("ip", "-n", network.namespace, "link", "set", "dev", self.name, state)


class Hosts:
    """Makes networks and hosts that exist until the block of `hosts` ends."""

    def __init__(self, owned: ExitStack) -> None:
        self._owned = owned
        self._num_networks = 0

    def network(self, name: str) -> Network:
        namespace = self._namespace(name)
        run("ip", "-n", namespace, "link", "add", "switch", "type", "bridge")
        run("ip", "-n", namespace, "link", "set", "dev", "switch", "up")
        self._num_networks += 1
        return Network(name, namespace, self._num_networks)

    def host(self, name: str, *networks: Network) -> Host:
        """name: at most 15 characters, Linux's limit for an interface."""
        host = Host(name, self._namespace(name), networks)
        host.run("sh", "-c", f"echo {TCP_RETRIES} > /proc/sys/net/ipv4/tcp_retries2")
        run("ip", "-n", host.namespace, "link", "set", "dev", "lo", "up")
        for port, network in zip(host.ports, networks, strict=True):
            network.hosts.append(host)
            cable = ("link", "add", "name", name, "type", "veth", "peer", "name", port)
            run("ip", "-n", network.namespace, *cable, "netns", host.namespace)
            run("ip", "-n", network.namespace, "link", "set", "dev", name, "master", "switch", "up")
            address = f"{host.address(network)}/24"
            run("ip", "-n", host.namespace, "address", "add", address, "dev", port)
            run("ip", "-n", host.namespace, "link", "set", "dev", port, "up")
        return host

    def _namespace(self, name: str) -> str:
        namespace = owned_name(name)
        run("ip", "netns", "add", namespace)
        self._owned.callback(run, "ip", "netns", "delete", namespace)
        return namespace


@contextmanager
def hosts() -> Iterator[Hosts]:
    """Yield a maker of networks and hosts; raises OSError if this machine allows none."""
    listed = run("ip", "netns", "list").splitlines()
    for namespace in owners_are_gone(line.split()[0] for line in listed):
        run("ip", "netns", "delete", namespace)
    with ExitStack() as owned:
        yield Hosts(owned)
