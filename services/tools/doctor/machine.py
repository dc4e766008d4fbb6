"""Checks of this machine, none of which needs a run.

Invariants: `of_this_machine` reads the inputs of the checks where possible, so that checks can be
tested; a check that cannot tell says so and does not fail.
"""

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import requires
from pathlib import Path

from mrcdrl.common.config import Config
from mrcdrl.common.errors import SharedMemoryError
from mrcdrl.common.runtime.cores import allowed_cores, cpu_quota
from mrcdrl.common.runtime.extras import PACKAGES, TRAINING, missing_extras
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.common.runtime.versions import installed
from mrcdrl.common.transport.shared_memory import SharedBuffer
from mrcdrl.services.replay.client import table_bytes
from mrcdrl.services.tools.doctor.finding import Finding, failed, ok, warning

CONSTRAINTS = Path(__file__).resolve().parents[3] / "constraints.txt"  # in a checkout
_REQUIREMENT = re.compile(r"([\w.-]+)>=([\d.]+)")
_CGROUP = Path("/sys/fs/cgroup")
_INITIAL_PROCESSES = "pid:[4026531836]"  # the kernel's number of the first process namespace
_OPENER = "import os, sys; os.open(sys.argv[1], os.O_RDWR)"


def of_this_machine(config: Config, run_dir: Path, *, running: bool) -> Iterator[Finding]:
    """Run all checks.

    running: the run is up, so that its table is already allocated.
    """
    yield python_and_packages(requirements(), pins(CONSTRAINTS))
    yield extras(missing_extras())
    yield clock()
    yield cores(config, allowed_cores(), cpu_quota(), os.environ)
    yield memory(0 if running else table_bytes(config), free_memory(_CGROUP))
    yield shared_memory()
    yield allocator(os.environ, learns=installed("torch") is not None)
    yield disk(config, run_dir)


def requirements() -> dict[str, str]:
    """Minimum version of each package that mrcdrl always needs."""
    lines = requires("mrcdrl") if installed("mrcdrl") else None
    return {m[1]: m[2] for line in lines or () if (m := _REQUIREMENT.fullmatch(line))}


def pins(constraints: Path) -> dict[str, str]:
    """Versions that mrcdrl is tested with; empty outside a checkout."""
    if not constraints.is_file():
        return {}
    lines = constraints.read_text("utf-8").splitlines()
    return dict(line.split("==") for line in lines if "==" in line)


def python_and_packages(least: Mapping[str, str], tested: Mapping[str, str]) -> Finding:
    """Check the installed versions.

    least: minimum version by package. tested: version used in the tests.
    """
    check, have = "versions", {name: installed(name) for name in (*least, "torch")}
    missing = [name for name in least if have[name] is None]
    if missing:
        return failed(check, f"not installed: {', '.join(missing)}", "pip install --upgrade mrcdrl")
    old = [f"{n} {have[n]} < {v}" for n, v in least.items() if _numbers(have[n]) < _numbers(v)]
    if old:
        return failed(check, f"too old: {', '.join(old)}", "pip install --upgrade mrcdrl")
    other = [
        f"{name} {version} (tested: {tested[name]})"
        for name, version in have.items()
        if version is not None and name in tested and _numbers(version) != _numbers(tested[name])
    ]
    if other:
        fix = "pip install --constraint constraints.txt mrcdrl"
        return warning(check, f"other versions than tested: {', '.join(other)}", fix)
    torch = have["torch"] or "not installed: no actor, learner or evaluator can run here"
    python = ".".join(map(str, sys.version_info[:3]))
    return ok(check, f"Python {python}, zenoh {have.get('eclipse-zenoh')}, torch {torch}")


def extras(missing: Mapping[str, Sequence[str]]) -> Finding:
    """Say what is not installed; a machine that only serves replay or routes needs none of it.

    missing: packages by extra.
    """
    if not missing:
        return ok("extras", f"all installed: {', '.join(PACKAGES)}")
    named = "; ".join(f"{extra} (lacks {', '.join(lacks)})" for extra, lacks in missing.items())
    said = f"not installed: {named}"
    if set(missing) & set(TRAINING):
        said += "; to train here: pip install 'mrcdrl[all]'"
    return ok("extras", said)


def _numbers(text: str | None) -> tuple[int, ...]:
    """The numbers that order versions; a local part, such as +cpu, does not count."""
    return tuple(int(n) for n in re.findall(r"\d+", (text or "").split("+")[0]))


def clock(now_s: float | None = None) -> Finding:
    """Check the monotonic clock and the wall clock. now_s: since 1970; default: now."""
    info = time.get_clock_info("monotonic")
    if not info.monotonic or info.resolution > 1e-3:
        said = f"the monotonic clock has steps of {info.resolution:g} s"
        return warning("clock", said, "choose another kernel clock source")
    year = time.gmtime(time.time() if now_s is None else now_s).tm_year
    if year < 2024:
        fix = "set the clock (NTP): it orders the starts of learners and actors"
        return failed("clock", f"it shows the year {year}", fix)
    return ok("clock", f"the year is {year}; monotonic to {info.resolution:g} s")


def cores(config: Config, num: int, quota: float | None, environ: Mapping[str, str]) -> Finding:
    """Compare the threads of each process with the cores and the CPU quota."""
    may_use = num if quota is None else min(num, quota)
    said = f"{num}" if quota is None else f"{num}, with a CPU quota of {quota:g}"
    asked = {
        "learner.threads": config.learner.threads,
        "actor.threads": config.actor.threads,
        "evaluator.threads": config.evaluator.threads,
        "OMP_NUM_THREADS": max(_numbers(environ.get("OMP_NUM_THREADS")), default=0),
    }
    many = [f"{name} is {count}" for name, count in asked.items() if count > may_use]
    if many:
        fix = "lower it to the number of cores: threads wait for one another"
        return warning("cores", f"{said}; {', '.join(many)}", fix)
    if may_use < 2:
        return warning("cores", said, "actors and learner share one core; more cores are faster")
    return ok("cores", said)


def free_memory(cgroup: Path) -> int:
    """Free memory of this machine and its container, in bytes."""
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
    """Check the free memory. needed: bytes of one shard's table; 0 if it is allocated already."""
    said = f"{mib(free)} free"
    if needed:
        said += f", the table takes {mib(needed)}"
    if needed > free:
        fix = "lower replay.capacity or replay.capacity_bytes, or raise the memory limit"
        return failed("memory", said, fix)
    if needed > 0.8 * free or free < 512 << 20:
        return warning("memory", said, "leave room: every other process takes some 500 MiB")
    return ok("memory", said)


def shared_memory() -> Finding:
    """Check that another process can open memory that this one shares."""
    check = "shared memory"
    fix = "allow a user's memfds in /proc; until then large messages go over the network"
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
        return warning(check, f"processes cannot open each other's memory: {error}", fix)
    said = "processes can open each other's memory"
    if Path("/proc/self/ns/pid").readlink() != Path(_INITIAL_PROCESSES):
        said += "; within this container, others are reached over the network"
    return ok(check, f"{said}; not needed: {_other_memory()}")


def _other_memory() -> str:
    """Limits that other systems depend on, and shared buffers do not."""
    locked, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    memlock = "unlimited" if locked == resource.RLIM_INFINITY else mib(locked)
    shm = mib(shutil.disk_usage("/dev/shm").total) if Path("/dev/shm").is_dir() else "none"
    return f"/dev/shm ({shm}), memlock ({memlock})"


def allocator(environ: Mapping[str, str], *, learns: bool) -> Finding:
    """Check the allocator's variables. learns: this machine has torch."""
    check, missing = "allocator", [name for name in ALLOCATOR if name not in environ]
    if not learns:
        return ok(check, "not needed without torch")
    if not missing:
        return ok(check, "freed memory stays with the process")
    said = f"{', '.join(missing)} not set; `mrcdrl train` and the images set them"
    if len(missing) == len(ALLOCATOR):
        return ok(check, said)
    fix = "set all three, as in the Dockerfile: else large tensors are mapped again at every step"
    return warning(check, said, fix)


def disk(config: Config, run_dir: Path) -> Finding:
    """Check for room for replay's log and the checkpoints in the directory of runs."""
    check, folder = "disk", run_dir.resolve()
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fix = f"give --run-dir another directory, or make {folder} writable"
        return failed(check, f"{folder} cannot be written: {error.strerror}", fix)
    free = shutil.disk_usage(folder).free
    needed = 256 << 20  # checkpoints, records, images
    if config.replay.fsync != "off":
        needed += config.replay.shards * table_bytes(config) + 2 * config.replay.segment_bytes
    said = f"{mib(free)} free in {folder}, a run takes up to {mib(needed)}"
    if free < needed:
        fix = (
            "free some space, give --run-dir another directory, or set replay.fsync to off (no log)"
        )
        return failed(check, said, fix)
    return ok(check, said)


def mib(size: int) -> str:
    """Format a number of bytes."""
    return f"{size / 2**30:.1f} GiB" if size >= 1 << 30 else f"{size / 2**20:.0f} MiB"
