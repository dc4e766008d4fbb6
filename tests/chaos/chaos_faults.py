"""Faults, each for as long as a `with` block lasts.

What Linux lets one do to a process, a host's network and a file system; `tc netem` is in few
kernels, so that packets are dropped by iptables and links slowed by a token bucket. A wall clock
is the machine's and cannot be another for one process: `CLOCK_SHIFT` moves what Python reads of it.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.chaos.chaos_hosts import Host, hosts, owned_name, owners_are_gone, run

_CLOCK = Path(__file__).with_name("clock")  # its sitecustomize.py is what Python imports first
CLOCK_SHIFT = "CHAOS_CLOCK_SHIFT_S"


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    """SIGSTOP, then SIGCONT: up, but silent."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@contextmanager
def cut_off(host: Host) -> Iterator[None]:
    """Cut all links of a host: packets are lost, connections are not told."""
    host.plug("down")
    try:
        yield
    finally:
        host.plug("up")


@contextmanager
def lossy(host: Host, share: float) -> Iterator[None]:
    """Lose this fraction of a host's packets, in each direction."""
    rule = ("-m", "statistic", "--mode", "random", "--probability", str(share), "-j", "DROP")
    for way in ("INPUT", "OUTPUT"):
        host.run("iptables", "--append", way, *rule)
    try:
        yield
    finally:
        for way in ("INPUT", "OUTPUT"):
            host.run("iptables", "--flush", way)


@contextmanager
def slow(host: Host, kilobits_per_s: int) -> Iterator[None]:
    """Limit what a host's links carry, in each direction."""
    ends = [(host.namespace, port) for port in host.ports]
    ends += [(network.namespace, host.name) for network in host.networks]
    for namespace, port in ends:
        bucket = ("tbf", "rate", f"{kilobits_per_s}kbit", "burst", "16kb", "latency", "1s")
        run("tc", "-n", namespace, "qdisc", "add", "dev", port, "root", *bucket)
    try:
        yield
    finally:
        for namespace, port in ends:
            run("tc", "-n", namespace, "qdisc", "delete", "dev", port, "root")


def why_no_hosts() -> str | None:
    """Say what is missing for hosts and the faults of their networks; None if nothing."""
    if os.geteuid() != 0:
        return "they take root"
    try:
        with hosts() as made:
            host = made.host("probe", made.network("probes"))
            with cut_off(host), lossy(host, 0.5), slow(host, 1000):
                return None
    except OSError as error:
        return f"they take iproute2 and iptables, and a kernel that has what these do: {error}"


@contextmanager
def disk(folder: Path, num_bytes: int) -> Iterator[None]:
    """Mount a file system of a given size in bytes on a folder, for `full` to fill."""
    mounted = [line.split()[:2] for line in Path("/proc/mounts").read_text("utf-8").splitlines()]
    left = owners_are_gone(source for source, _ in mounted)
    for place in (place for source, place in mounted if source in left):
        run("umount", "--lazy", place)
    name = owned_name(folder.name)
    run("mount", "-t", "tmpfs", "-o", f"size={num_bytes}", name, str(folder))
    try:
        yield
    finally:
        run("umount", "--lazy", str(folder))


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Leave no room on a `disk`: shrink it to what it holds."""
    before = os.statvfs(folder)
    _shrink(folder)
    try:
        yield
    finally:
        run("mount", "-o", f"remount,size={before.f_blocks * before.f_frsize}", str(folder))


def _shrink(folder: Path, attempts: int = 20) -> None:
    """Shrink it; if a process writes meanwhile, it may already hold more than the new size."""
    now = os.statvfs(folder)
    used = max(now.f_blocks - now.f_bfree, 1) * now.f_frsize
    try:
        run("mount", "-o", f"remount,size={used}", str(folder))
    except OSError:
        if attempts == 1:
            raise
        _shrink(folder, attempts - 1)


def shifted_clock(seconds: float) -> dict[str, str]:
    """Environment of a process whose wall clock is ahead by this much."""
    path = os.pathsep.join(filter(None, (str(_CLOCK), os.environ.get("PYTHONPATH"))))
    return {"PYTHONPATH": path, CLOCK_SHIFT: str(seconds)}
