"""The cost of a load, and the bottleneck that keeps it from being larger.

Invariants: pure, except for readings from /proc; these are None on systems without /proc.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrcdrl.common.messages.trajectory import Float64Array

_FULL = 0.9  # of a core, above which a process fills it
_BUSY = 0.95  # of all cores
_THROTTLED = 0.2  # of replay's reports
_LATE_MS = 5_000.0
_ACCEPTED = 0.95  # of what was due
_NANO = 1e-9


@dataclass(frozen=True, slots=True)
class Totals:
    """Resources that a process has used since it started."""

    cpu_s: float
    waited_s: float  # ready to run, waiting for a core
    memory_mib: float  # proportional set size
    threads: int

    @classmethod
    def of(cls, pid: int) -> "Totals | None":
        """Read /proc; None if the process has ended or the system does not provide it."""
        folder = Path(f"/proc/{pid}")
        try:
            threads = [
                [int(word) for word in (task / "schedstat").read_text("ascii").split()]
                for task in (folder / "task").iterdir()
            ]
            rollup = (folder / "smaps_rollup").read_text("ascii")
        except OSError:
            return None
        shared = next(line for line in rollup.splitlines() if line.startswith("Pss:"))
        return cls(
            sum(thread[0] for thread in threads) * _NANO,
            sum(thread[1] for thread in threads) * _NANO,
            int(shared.split()[1]) / 1024,
            len(threads),
        )


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources that a process used over a period."""

    cores: float
    waited_cores: float
    memory_mib: float
    threads: int

    @classmethod
    def between(cls, first: Totals, last: Totals, seconds: float) -> "Usage":
        return cls(
            round((last.cpu_s - first.cpu_s) / seconds, 3),
            round((last.waited_s - first.waited_s) / seconds, 3),
            round(last.memory_mib, 1),
            last.threads,
        )


def busy_cores() -> float | None:
    """Busy seconds, for any process, of the cores this process may use, since boot."""
    try:
        lines = Path("/proc/stat").read_text("ascii").splitlines()
        ours = {f"cpu{core}" for core in os.sched_getaffinity(0)}
        tick_s = 1 / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return None
    counted = [line.split() for line in lines if line.split()[0] in ours]
    idle = (4, 5)  # idle and waiting for a disk; guests' 9 and 10 are included in 1 and 2
    return tick_s * sum(
        int(ticks)
        for words in counted
        for column, ticks in enumerate(words[:9])
        if column and column not in idle
    )


def latency(seconds: Float64Array) -> dict[str, float | None]:
    """Median, 99th percentile and maximum in milliseconds; None without values."""
    if not len(seconds):
        return {"p50": None, "p99": None, "max": None}
    figures = np.quantile(seconds * 1000, [0.5, 0.99, 1.0])
    return {
        name: round(float(f), 2) for name, f in zip(("p50", "p99", "max"), figures, strict=True)
    }


@dataclass(frozen=True, slots=True)
class Load:
    """The figures that show the bottleneck."""

    due: float  # transitions per second; infinite if actors make as many as are accepted
    accepted: float
    throttled: float  # fraction of replay's reports in which its limiter throttled an insert
    insert_ms: float | None  # median
    cores: int
    busy: float | None  # of these cores, for any process
    usage: dict[str, Usage]  # by process
    weights_ms: float | None = None  # from their publication to an actor, 99th percentile
    simulating: frozenset[str] = frozenset()  # processes that a real run would have elsewhere


def bottleneck(load: Load) -> str:
    """Name the bottleneck, with the figures that show it."""
    if math.isfinite(load.due) and load.accepted >= _ACCEPTED * load.due:
        if load.weights_ms is None or load.weights_ms <= _LATE_MS:
            return "none: all transitions due were accepted"
        late = f"weights: actors have them {load.weights_ms / 1000:.1f} s after they are published"
        return "; ".join(filter(None, (late, _full(load))))
    if load.throttled > _THROTTLED:
        return "the rate limiter: the learner does not sample enough to admit more"
    if (full := _full(load)) is not None:
        return full
    if load.insert_ms is None:
        return "replay did not acknowledge anything"
    return f"the round trip to replay: an acknowledgement takes {load.insert_ms:.1f} ms"


def _full(load: Load) -> str | None:
    """The cores that are full, if any are, and who fills them."""
    largest = max(load.usage, key=lambda name: load.usage[name].cores, default=None)
    if load.busy is not None and load.busy >= _BUSY * load.cores:
        used = ", ".join(f"{name} {usage.cores:.2f}" for name, usage in load.usage.items())
        ours = sum(usage.cores for usage in load.usage.values())
        others = max(load.busy - ours, 0.0)
        simulating = sum(load.usage[name].cores for name in load.simulating & load.usage.keys())
        return (
            f"the machine's {load.cores} cores: {used}, all others {others:.2f}; "
            f"the simulation itself took {simulating:.2f}"
        )
    if largest is not None and load.usage[largest].cores >= _FULL:
        cores = load.usage[largest].cores
        if largest.startswith("actors"):
            return f"the simulation: {largest} fills its core ({cores:.2f}); raise --processes"
        return f"{largest}: it fills a core ({cores:.2f})"
    return None
