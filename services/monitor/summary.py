"""The summary of a run: what it reached, at what cost, on which machine.

Invariants: figures that were never reached or measured are null; torch is named, never imported.
"""

import json
import math
import os
import platform
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import fmean, pvariance
from typing import Any

from mrcdrl.common.config import Config
from mrcdrl.services.monitor.records import EvaluationRecord
from mrcdrl.services.monitor.state import RunState

REACHED = (0.5, 0.8, 0.9, 0.94)
PACKAGES = {"mrcdrl": "mrcdrl", "zenoh": "eclipse-zenoh", "numpy": "numpy", "torch": "torch"}


def summary_bytes(state: RunState, config: Config, now: float, stop_reason: str) -> bytes:
    """The summary as JSON, indented for a reader."""
    values = summary(state, config, now, stop_reason)
    return (json.dumps(_finite(values), indent=2) + "\n").encode()


def summary(state: RunState, config: Config, now: float, stop_reason: str) -> dict[str, Any]:
    """Everything a comparison of runs asks for; `now` is the seconds the run lasted."""
    return {
        "stop_reason": stop_reason,
        "wall_s": round(now, 3),
        "num_robots": config.arena.num_robots,
        "agent": config.agent.kind,
        "episodes": state.episodes,
        "env_steps": state.env_steps,
        "robot_steps": state.robot_steps,
        "learner_steps": state.learner_steps,
        "inserts": state.inserts,
        "samples": state.samples,
        "weights_version": state.weights_version,
        "staleness": {
            actor: {unit: asdict(spread) for unit, spread in spreads.items()}
            for actor, spreads in state.staleness_spreads.items()
        },
        "training_success_per_100": training_table(state),
        "evaluation": {
            "count": len(state.evaluations),
            "last": _evaluation(state.last_evaluation),
            "best": _evaluation(state.best_evaluation),
        },
        "reached": {f"{rate:g}": _reached(state, rate) for rate in REACHED},
        "versions": versions(),
        "machine": machine(),
    }


def training_table(state: RunState) -> dict[str, float | int | None]:
    """Table 1: maximum, average and variance over each 100 episodes; `last`: the latest 100."""
    hundreds = state.hundreds
    return {
        "last": state.successes_per_100,
        "max": max(hundreds, default=None),
        "average": fmean(hundreds) if hundreds else None,
        "variance": pvariance(hundreds) if hundreds else None,
        "hundreds": len(hundreds),
    }


def _evaluation(record: EvaluationRecord | None) -> dict[str, Any] | None:
    if record is None:
        return None
    head = {
        "time_s": record.time_s,
        "env_steps": record.env_steps,
        "robot_steps": record.robot_steps,
    }
    return {**head, **asdict(record.evaluation)}


def _reached(state: RunState, rate: float) -> dict[str, float | int] | None:
    """Cost of the first evaluation with that success rate; its weights' learner step."""
    for record in state.evaluations:
        if record.evaluation.success_rate >= rate:
            return {
                "seconds": record.time_s,
                "learner_steps": record.evaluation.learner_step,
                "robot_steps": record.robot_steps,
            }
    return None


def versions() -> dict[str, str | None]:
    """Of Python and of what decides a run's figures; null: not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name, package in PACKAGES.items():
        try:
            found[name] = version(package)
        except PackageNotFoundError:
            found[name] = None
    return found


def machine() -> dict[str, Any]:
    """The host the summary is written on; load is that of now, over 1, 5 and 15 minutes."""
    memory = _field(Path("/proc/meminfo"), "MemTotal")
    return {
        "cpu": _field(Path("/proc/cpuinfo"), "model name") or platform.processor() or None,
        "cores": os.cpu_count(),
        "memory_bytes": int(memory.split()[0]) * 1024 if memory else None,
        "load": [round(load, 2) for load in os.getloadavg()],
    }


def _field(path: Path, name: str) -> str | None:
    """Value of the first `name : value` line of a file of /proc; None where there is none."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError:
        return None
    pairs = (line.partition(":") for line in lines)
    return next((value.strip() for key, _, value in pairs if key.strip() == name), None)


def _finite(value: Any) -> Any:
    """Numbers JSON has no word for as null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return value
