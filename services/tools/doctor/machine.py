"""Checks of this machine, none of which needs a run.

Invariants: what a check judges by is given to it where it can be, and read by `of_this_machine`
otherwise; a check that cannot tell says so, and is no failure.
"""

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from importlib.metadata import requires
from pathlib import Path

from mrcdrl.common.config import Config
from mrcdrl.common.errors import SharedMemoryError
from mrcdrl.common.runtime.process import ALLOCATOR, available_cores
from mrcdrl.common.runtime.versions import installed
from mrcdrl.common.transport.shared_memory import SharedBuffer
from mrcdrl.services.replay.client import table_bytes
from mrcdrl.services.tools.doctor.finding import Finding, failed, ok, warning

CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"  # of a checkout
_REQUIREMENT = re.compile(r"([\w.-]+)>=([\d.]+)")
_CGROUP = Path("/sys/fs/cgroup")
_INITIAL_PROCESSES = "pid:[4026531836]"  # the kernel's number of the first process namespace
_OPENER = "import os, sys; os.open(sys.argv[1], os.O_RDWR)"


def of_this_machine(config: Config, run_dir: Path, *, running: bool) -> Iterator[Finding]:
    """All checks.

    running: the run is up, its table taken already.
    """
    yield python_and_packages(requirements(), pins(CONSTRAINTS))
    yield clock()
    yield cores(config, available_cores(), cpu_quota(_CGROUP), os.environ)
    yield memory(0 if running else table_bytes(config), free_memory(_CGROUP))
    yield shared_memory()
    yield allocator(os.environ, learns=installed("torch") is not None)
    yield disk(config, run_dir)


def requirements() -> dict[str, str]:
    """Least version of each package that mrcdrl needs always."""
    lines = requires("mrcdrl") if installed("mrcdrl") else None
    return {m[1]: m[2] for line in lines or () if (m := _REQUIREMENT.fullmatch(line))}


def pins(constraints: Path) -> dict[str, str]:
    """The versions that mrcdrl is tested with; none outside a checkout."""
    if not constraints.is_file():
        return {}
    lines = constraints.read_text("utf-8").splitlines()
    return dict(line.split("==") for line in lines if "==" in line)


def python_and_packages(least: Mapping[str, str], tested: Mapping[str, str]) -> Finding:
    """least: version a package must have. tested: version it has in the tests."""
    check, there = "versions", {name: installed(name) for name in (*least, "torch")}
    missing = [name for name in least if there[name] is None]
    if missing:
        return failed(check, f"not installed: {', '.join(missing)}", "pip install --upgrade mrcdrl")
    old = [f"{n} {there[n]} < {v}" for n, v in least.items() if _numbers(there[n]) < _numbers(v)]
    if old:
        return failed(check, f"too old: {', '.join(old)}", "pip install --upgrade mrcdrl")
    other = [
        f"{name} {version} (tested: {tested[name]})"
        for name, version in there.items()
        if version is not None and name in tested and _numbers(version) != _numbers(tested[name])
    ]
    if other:
        mend = "pip install --constraint constraints.txt mrcdrl"
        return warning(check, f"not as tested: {', '.join(other)}", mend)
    torch = there["torch"] or "not installed: no actor, learner or evaluator here"
    python = ".".join(map(str, sys.version_info[:3]))
    return ok(check, f"Python {python}, zenoh {there.get('eclipse-zenoh')}, torch {torch}")


def _numbers(text: str | None) -> tuple[int, ...]:
    """By which versions are compared; a local part, such as +cpu, does not count."""
    return tuple(int(n) for n in re.findall(r"\d+", (text or "").split("+")[0]))


def clock(now_s: float | None = None) -> Finding:
    """Of the wall and monotonic. now_s: since 1970; by default now."""
    info = time.get_clock_info("monotonic")
    if not info.monotonic or info.resolution > 1e-3:
        said = f"the monotonic clock has steps of {info.resolution:g} s"
        return warning("clock", said, "choose another clock source of the kernel")
    year = time.gmtime(time.time() if now_s is None else now_s).tm_year
    if year < 2024:
        mend = "set the clock (NTP): starts of learners and actors are ordered by it"
        return failed("clock", f"it says that the year is {year}", mend)
    return ok("clock", f"the year is {year}; monotonic to {info.resolution:g} s")


def cpu_quota(cgroup: Path) -> float | None:
    """Cores' worth of time that this container may use; None for no limit."""
    try:
        quota, period = (cgroup / "cpu.max").read_text("ascii").split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else int(quota) / int(period)


def cores(config: Config, there: int, quota: float | None, environ: Mapping[str, str]) -> Finding:
    """Threads of one process against the cores it may use, and the share of their time."""
    may_use = there if quota is None else min(there, quota)
    said = f"{there}" if quota is None else f"{there}, of whose time {quota:g} may be used"
    asked = {
        "learner.threads": config.learner.threads,
        "actor.threads": config.actor.threads,
        "evaluator.threads": config.evaluator.threads,
        "OMP_NUM_THREADS": max(_numbers(environ.get("OMP_NUM_THREADS")), default=0),
    }
    many = [f"{name} is {count}" for name, count in asked.items() if count > may_use]
    if many:
        mend = "set it to what is there: threads wait for one another"
        return warning("cores", f"{said}; {', '.join(many)}", mend)
    if quota is not None and quota <= there / 2 and not config.learner.threads:
        mend = f"set learner.threads to {max(1, int(quota // 2))}: else half the cores are counted"
        return warning("cores", said, mend)
    if there < 2:
        return warning("cores", said, "actors and learner take turns; more cores are faster")
    return ok("cores", said)


def free_memory(cgroup: Path) -> int:
    """Bytes that this machine, and its container, have free."""
    meminfo = Path("/proc/meminfo").read_text("ascii")
    match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo)
    free = int(match[1]) * 1024 if match else 0
    try:
        limit = (cgroup / "memory.max").read_text("ascii").strip()
        used = int((cgroup / "memory.current").read_text("ascii"))
    except (OSError, ValueError):
        return free
    return free if limit == "max" else min(free, int(limit) - used)


def memory(needed: int, free: int) -> Finding:
    """needed: bytes of the table of one shard; 0 where it is there already."""
    said = f"{mib(free)} free"
    if needed:
        said += f", the table takes {mib(needed)}"
    if needed > free:
        mend = "lower replay.capacity or replay.capacity_bytes, or raise the memory limit"
        return failed("memory", said, mend)
    if needed > 0.8 * free or free < 512 << 20:
        return warning("memory", said, "the other processes take some 500 MiB each: leave room")
    return ok("memory", said)


def shared_memory() -> Finding:
    """Whether another process can open memory that this one lends."""
    check = "shared memory"
    mend = "large messages go over the network meanwhile; allow memfds of one user in /proc"
    try:
        buffer = SharedBuffer(1 << 20)
        _, process, descriptor, _ = buffer.address.split()
        path = f"/proc/{process}/fd/{descriptor}"
        command = [sys.executable, "-I", "-S", "-c", _OPENER, path]
        opened = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        if opened.returncode:
            lines = opened.stderr.strip().splitlines()
            raise SharedMemoryError(lines[-1] if lines else f"it ended with {opened.returncode}")
    except (OSError, SharedMemoryError, subprocess.TimeoutExpired) as error:
        return warning(check, f"no process can open what another lends: {error}", mend)
    said = "a process can open what another lends"
    if Path("/proc/self/ns/pid").readlink() != Path(_INITIAL_PROCESSES):
        said += "; in this container only, over the network to others"
    return ok(check, f"{said}; not needed: {_other_memory()}")


def _other_memory() -> str:
    """What other systems would need, and lent memory does not."""
    locked, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    memlock = "unlimited" if locked == resource.RLIM_INFINITY else mib(locked)
    shm = mib(shutil.disk_usage("/dev/shm").total) if Path("/dev/shm").is_dir() else "none"
    return f"/dev/shm ({shm}), memlock ({memlock})"


def allocator(environ: Mapping[str, str], *, learns: bool) -> Finding:
    """learns: this machine has torch."""
    check, missing = "allocator", [name for name in ALLOCATOR if name not in environ]
    if not learns:
        return ok(check, "nothing here learns")
    if not missing:
        return ok(check, "freed memory stays with the process")
    said = f"{', '.join(missing)} not set; `mrcdrl train` and the images set them"
    if len(missing) == len(ALLOCATOR):
        return ok(check, said)
    mend = "set all three, as in the Dockerfile: large tensors are mapped afresh at every step"
    return warning(check, said, mend)


def disk(config: Config, run_dir: Path) -> Finding:
    """Room for the log of the table and the checkpoints, where runs are kept."""
    check, folder = "disk", run_dir.resolve()
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        mend = f"give --run-dir another folder, or make {folder} writable"
        return failed(check, f"{folder} cannot be written: {error.strerror}", mend)
    free = shutil.disk_usage(folder).free
    needed = 256 << 20  # checkpoints, records, images
    if config.replay.fsync != "off":
        needed += config.replay.shards * table_bytes(config) + 2 * config.replay.segment_bytes
    said = f"{mib(free)} free in {folder}, a run takes up to {mib(needed)}"
    if free < needed:
        mend = "free some, give --run-dir another folder, or set replay.fsync to off (no log)"
        return failed(check, said, mend)
    return ok(check, said)


def mib(size: int) -> str:
    """Bytes, for a reader."""
    return f"{size / 2**30:.1f} GiB" if size >= 1 << 30 else f"{size / 2**20:.0f} MiB"
