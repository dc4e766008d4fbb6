"""The summary of a run: what it reached, at what cost, on which machine.

Invariants: figures that were never reached or measured are null; torch is never imported.
"""

import json
import os
import platform
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, pvariance
from typing import Any

from mrcdrl.common.config import Config
from mrcdrl.common.runtime.versions import all_versions
from mrcdrl.services.monitor.records import EvaluationRecord, finite, flat
from mrcdrl.services.monitor.state import RunState

REACHED = (0.5, 0.8, 0.9, 0.94)


def summary_bytes(state: RunState, config: Config, now: float, stop_reason: str) -> bytes:
    """The summary as JSON, indented for a reader."""
    values = summary(state, config, now, stop_reason)
    return (json.dumps(finite(values), indent=2) + "\n").encode()


def summary(state: RunState, config: Config, now: float, stop_reason: str) -> dict[str, Any]:
    """Everything that runs are compared by; `now`: seconds the run lasted."""
    return {
        "stop_reason": stop_reason,
        "wall_s": round(now, 3),
        "num_robots": config.arena.num_robots,
        "robots": list(config.arena.numbers),
        "agent": config.agent.kind,
        "initial_weights": config.learner.initial_weights or None,
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
            **_by_robots(state, config),
        },
        "reached": {f"{rate:g}": _reached(state, rate) for rate in REACHED},
        "versions": all_versions(),
        "machine": machine(),
    }


def training_table(state: RunState) -> dict[str, float | int | None]:
    """Table 1: maximum, average and variance over blocks of 100 episodes; last: the latest 100."""
    hundreds = state.hundreds
    return {
        "last": state.successes_per_100,
        "max": max(hundreds, default=None),
        "average": fmean(hundreds) if hundreds else None,
        "variance": pvariance(hundreds) if hundreds else None,
        "hundreds": len(hundreds),
    }


def _by_robots(state: RunState, config: Config) -> dict[str, Any]:
    """The last evaluation with each number of robots, where there are several numbers."""
    numbers, last = config.arena.numbers, state.last_by_robots
    if len(numbers) == 1:
        return {}
    return {"last_by_robots": {str(number): _evaluation(last.get(number)) for number in numbers}}


def _evaluation(record: EvaluationRecord | None) -> dict[str, Any] | None:
    return None if record is None else flat(record)


def _reached(state: RunState, rate: float) -> dict[str, float | int] | None:
    """Cost of the first evaluation with that success rate; the step is that of its weights.

    Every number of robots has to reach it.
    """
    for record in state.weakest:
        if record.evaluation.success_rate >= rate:
            return {
                "seconds": record.time_s,
                "learner_steps": record.evaluation.learner_step,
                "robot_steps": record.robot_steps,
            }
    return None


def machine() -> dict[str, Any]:
    """This host; load: averages over the last 1, 5 and 15 minutes."""
    memory = _field(Path("/proc/meminfo"), "MemTotal")
    return {
        "cpu": _field(Path("/proc/cpuinfo"), "model name") or platform.processor() or None,
        "cores": os.cpu_count(),
        "memory_bytes": int(memory.split()[0]) * 1024 if memory else None,
        "load": [round(load, 2) for load in os.getloadavg()],
    }


def _field(path: Path, name: str) -> str | None:
    """Value of the first `name : value` line of a file in /proc; None if there is none."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError:
        return None
    pairs = (line.partition(":") for line in lines)
    return next((value.strip() for key, _, value in pairs if key.strip() == name), None)
