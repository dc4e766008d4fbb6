"""Curves of a run, from its record files: a few hundred points of any stretch of it.

Invariants: pure but for reading; every point has the run's time and the learner's steps, either of
which may be the axis; a number that is missing or not finite is None.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.common.runtime.files import METRICS
from mrcdrl.services.monitor.recorder import RATES
from mrcdrl.services.monitor.records import EPISODES, by_service, finite, flat, read_evaluations
from mrcdrl.services.monitor.run_info import config_of
from mrcdrl.services.monitor.sampling import sample_blocks, sample_lines
from mrcdrl.services.monitor.state import RunState

MAX_POINTS = 2000
Column = list[float | None]
_OWN = (
    "time_s",
    "env_steps",
    "robot_steps",
    "learner_steps",
    "episodes",
    "successes_per_100",
    "staleness_versions",
    "staleness_s",
    *(f"{name}_per_s" for name in RATES),
)
_LEARNER = (
    "loss",
    "mean_q",
    "gradient_norm",
    "td_error_mean",
    "td_error_p50",
    "td_error_p90",
    "td_error_p99",
    "q_min",
    "q_p50",
    "q_max",
    "dead_share",
    "target_drift",
)
# Of several services of a role, by the role, the metric, and what is made of theirs.
_JOINED: dict[str, tuple[str, str, Callable[[Iterable[float]], float]]] = {
    "replay_size": ("replay", "size", sum),
    "replay_capacity": ("replay", "capacity", sum),
    "samples_per_insert": ("replay", "samples_per_insert", fmean),
    "epsilon_min": ("actor", "epsilon_min", min),
    "epsilon_max": ("actor", "epsilon_max", max),
}
CURVES = (*_OWN, *_LEARNER, *_JOINED)


def history(run_dir: Path, num: int, begin_s: float, end_s: float) -> dict[str, Column]:
    """The metrics at some seconds of a stretch of the run, by column; raises OSError."""
    points = [curves_of(line) for line in sample_lines(run_dir / METRICS, num, begin_s, end_s)]
    return {name: [point[name] for point in points] for name in CURVES}


def curves_of(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """One line of the metrics as a point of each curve."""
    by_role: dict[tuple[str, str], list[float]] = {}
    for (role, _), own in by_service(metrics).items():
        for metric, value in own.items():
            if math.isfinite(value):
                by_role.setdefault((role, metric), []).append(value)
    point = {name: _number(metrics.get(name)) for name in _OWN}
    point |= {name: next(iter(by_role.get(("learner", name), ())), None) for name in _LEARNER}
    for name, (role, metric, join) in _JOINED.items():
        values = by_role.get((role, metric))
        point[name] = join(values) if values else None
    return point


def episodes(run_dir: Path, num: int, begin_s: float, end_s: float) -> dict[str, Column]:
    """Means over neighbouring training episodes, by column; raises OSError."""
    blocks = sample_blocks(run_dir / EPISODES, num, begin_s, end_s)
    columns = ("time_s", "learner_steps", "score", "mean_q", "frames", "collisions")
    found: dict[str, Column] = {name: [_mean(b, name) for b in blocks] for name in columns}
    found["success"] = [fmean(r.get("outcome") == Outcome.SUCCESS for r in b) for b in blocks]
    return found


def evaluations(run_dir: Path, num: int) -> list[dict[str, Any]]:
    """The latest evaluations, oldest first; raises OSError and RunDirectoryError.

    Where there are several numbers of robots, those of the number that succeeds least.
    """
    records, config = read_evaluations(run_dir), config_of(run_dir)
    if config is not None:
        state = RunState(config)
        for record in records:
            state.restore_evaluation(record)
        records = state.weakest
    return [finite(flat(record)) for record in records[-num:]]


def _mean(records: Iterable[Mapping[str, Any]], name: str) -> float | None:
    values = [float(r[name]) for r in records if _is_finite(r.get(name))]
    return fmean(values) if values else None


def _number(value: Any) -> float | None:
    return float(value) if _is_finite(value) else None


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
