"""What a figure was measured on; every benchmark prints it with its result."""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mrcdrl.common.runtime.versions import all_versions
from mrcdrl.services.monitor.summary import machine


def seconds_per_call(work: Callable[[], object], *, seconds: float, repeats: int) -> list[float]:
    """Mean seconds of one call, in `repeats` pieces of `seconds` each, after a warm-up."""
    work()
    figures = []
    for _ in range(repeats):
        started, calls = time.perf_counter(), 0
        while time.perf_counter() - started < seconds:
            work()
            calls += 1
        figures.append((time.perf_counter() - started) / calls)
    return figures


def spread(values: list[float], digits: int = 1) -> dict[str, float]:
    """Median, smallest and largest."""
    return {
        "median": round(statistics.median(values), digits),
        "min": round(min(values), digits),
        "max": round(max(values), digits),
    }


def emit(result: dict[str, Any]) -> None:
    """Print one line of JSON, with the machine, its load and the command."""
    line = {
        **result,
        "machine": machine(),
        "cores": sorted(os.sched_getaffinity(0)),
        "versions": all_versions(),
        "command": " ".join(["python -m", f"benchmarks.{Path(sys.argv[0]).stem}", *sys.argv[1:]]),
    }
    print(json.dumps(line), flush=True)
