"""What is known of a run from its files alone, whether or not it is up; nothing is written."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from mrcdrl.common.config import Config, load_config, nearest_preset
from mrcdrl.common.errors import ConfigError, RunDirectoryError
from mrcdrl.common.runtime.files import BEST_WEIGHTS, RUN_CONFIG
from mrcdrl.common.runtime.runs import active_s
from mrcdrl.services.monitor.recorder import SUMMARY
from mrcdrl.services.monitor.records import read_evaluations, read_last_metrics
from mrcdrl.services.monitor.run_directory import is_held
from mrcdrl.services.monitor.stopping import has_failed, was_stopped


class State(StrEnum):
    """State of a run."""

    RUNNING = "running"
    ENDED = "ended"  # by its own rule
    STOPPED = "stopped"  # by a signal
    FAILED = "failed"  # with an error
    KILLED = "killed"  # without a word


@dataclass(frozen=True, slots=True)
class RunInfo:
    """A run as its files tell; what they do not tell is None."""

    name: str
    path: str
    state: State
    stop_reason: str | None
    robots: int | None
    kind: str | None  # of the agent
    preset: str | None  # the nearest
    changed: int | None  # settings that differ from it
    best_success: float | None
    learner_steps: int | None
    minutes: float | None
    disk_bytes: int
    active_s: float  # when it was active last, since the epoch


def run_info(path: Path, *, held: bool | None = None) -> RunInfo:
    """Read what is known of the run; held: whether a process holds it, if that is known."""
    metrics, summary = read_last_metrics(path), _json(path / SUMMARY)
    lasted_s = metrics.get("time_s", summary.get("wall_s"))
    config = config_of(path)
    preset, changed = (None, None) if config is None else nearest_preset(config)
    held = is_held(path) if held is None else held
    state, reason = (State.RUNNING, None) if held else _ending(summary, lasted_s or 0.0)
    best = best_evaluation(path)
    return RunInfo(
        name=path.resolve().name,
        path=str(path),
        state=state,
        stop_reason=reason,
        robots=None if config is None else config.arena.num_robots,
        kind=None if config is None else config.agent.kind,
        preset=preset,
        changed=changed,
        best_success=None if best is None else best["success_rate"],
        learner_steps=(metrics or summary).get("learner_steps"),
        minutes=None if lasted_s is None else lasted_s / 60,
        disk_bytes=disk_bytes(path),
        active_s=active_s(path),
    )


def config_of(path: Path) -> Config | None:
    """The run's configuration; None if it has none, or one of another version."""
    if not (path / RUN_CONFIG).is_file():
        return None
    try:
        return load_config(str(path / RUN_CONFIG), environ={})
    except ConfigError:
        return None


def best_evaluation(path: Path) -> Mapping[str, Any] | None:
    """The evaluation of the weights that are kept as best, or else the best one; None without any.

    Its fields are those of mrcdrl.common.messages.trajectory.Evaluation.
    """
    manifest = _json(path / BEST_WEIGHTS.with_suffix(".json"))
    if "success_rate" in manifest:
        return manifest
    try:
        records = read_evaluations(path)
    except RunDirectoryError:  # of another version
        return None
    best = max(records, key=lambda r: r.evaluation.success_rate, default=None)
    return None if best is None else asdict(best.evaluation)


def disk_bytes(path: Path) -> int:
    """Bytes that the run's files take on the disk."""
    return sum(_blocks_bytes(file) for file in path.rglob("*"))


def _ending(summary: Mapping[str, Any], lasted_s: float) -> tuple[State, str | None]:
    """How the run ended, and the reason; a summary counts if it is of the last start."""
    reason = summary.get("stop_reason")
    if reason is None or summary.get("wall_s", 0.0) < lasted_s:
        return State.KILLED, None
    if was_stopped(reason):
        return State.STOPPED, reason
    return State.FAILED if has_failed(reason) else State.ENDED, reason


def _json(path: Path) -> dict[str, Any]:
    """The object in a file; {} if there is none that can be read."""
    try:
        values = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def _blocks_bytes(file: Path) -> int:
    try:
        return 512 * file.lstat().st_blocks
    except OSError:  # it is gone
        return 0
