"""What a load cost, and what would have to be more for it to be larger, in words.

Invariants: pure, save for what is read in /proc; where the system has no /proc, figures are None.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrcdrl.common.messages.trajectory import Float64Array

_FULL = 0.9  # of a core, from which a process counts as filling it
_BUSY = 0.95  # of all cores
_HELD = 0.2  # of replay's reports
_TAKEN = 0.95  # of what was due
_NANO = 1e-9


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used since it started."""

    cpu_s: float
    waited_s: float  # ready to run, without a core
    memory_mib: float  # its proportional share of what it shares
    threads: int

    @classmethod
    def of(cls, pid: int) -> "Usage | None":
        """None where the process is gone, or the system does not say."""
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
class Share:
    """What a process used of the machine over some time."""

    cores: float
    waited_cores: float
    memory_mib: float
    threads: int

    @classmethod
    def between(cls, first: Usage, last: Usage, seconds: float) -> "Share":
        return cls(
            round((last.cpu_s - first.cpu_s) / seconds, 3),
            round((last.waited_s - first.waited_s) / seconds, 3),
            round(last.memory_mib, 1),
            last.threads,
        )


def busy_cores() -> float | None:
    """Seconds that the cores this process may use have worked, whoever for, since they started."""
    try:
        lines = Path("/proc/stat").read_text("ascii").splitlines()
        ours = {f"cpu{core}" for core in os.sched_getaffinity(0)}
        tick_s = 1 / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return None
    counted = [line.split() for line in lines if line.split()[0] in ours]
    idle = (4, 5)  # idle and waiting for a disk; 9 and 10, of guests, are in 1 and 2 already
    return tick_s * sum(
        int(ticks)
        for words in counted
        for place, ticks in enumerate(words[:9])
        if place and place not in idle
    )


def latency(seconds: Float64Array) -> dict[str, float | None]:
    """Milliseconds: median, 99th percentile, longest; null where there were none."""
    if not len(seconds):
        return {"p50": None, "p99": None, "max": None}
    figures = np.quantile(seconds * 1000, [0.5, 0.99, 1.0])
    return {
        name: round(float(f), 2) for name, f in zip(("p50", "p99", "max"), figures, strict=True)
    }


@dataclass(frozen=True, slots=True)
class Load:
    """The figures that a limit is told from."""

    due: float  # transitions per second; infinite where actors made as many as were taken
    taken: float
    held: float  # share of replay's reports in which its limiter held an insert
    insert_ms: float | None  # median
    cores: int
    busy: float | None  # of them, whoever for
    shares: dict[str, Share]  # by process; "actors-0" and so on are simulated ones


def first_limit(load: Load) -> str:
    """What kept more from being taken."""
    if math.isfinite(load.due) and load.taken >= _TAKEN * load.due:
        return "none: all that was due was taken"
    if load.held > _HELD:
        return "the rate limiter: the learner does not draw enough for more to be let in"
    largest = max(load.shares, key=lambda name: load.shares[name].cores, default=None)
    if load.busy is not None and load.busy >= _BUSY * load.cores:
        used = ", ".join(f"{name} {share.cores:.2f}" for name, share in load.shares.items())
        ours = sum(share.cores for share in load.shares.values())
        others = max(load.busy - ours, 0.0)
        return f"the machine's {load.cores} cores: {used}, all others {others:.2f}"
    if largest is not None and load.shares[largest].cores >= _FULL:
        share = load.shares[largest].cores
        if largest.startswith("actors"):
            return f"the simulation: {largest} fills its core ({share:.2f}); give --processes more"
        return f"{largest}: it fills a core ({share:.2f})"
    if load.insert_ms is None:
        return "replay did not acknowledge anything"
    return f"the way to replay and back: an acknowledgement takes {load.insert_ms:.1f} ms"
