"""Folds what a run has recorded into a state, for who did not follow it from its beginning.

Invariant: nothing is written.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.runtime.files import METRICS
from mrcdrl.common.sync.joining import ENDPOINT_FILE
from mrcdrl.services.monitor.recorder import restore
from mrcdrl.services.monitor.records import (
    by_service,
    read_evaluations,
    read_last_episodes,
    read_last_metrics,
    read_latest_metrics,
)
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule

_LATEST = 20  # lines of metrics, from which rates and histograms are known
FRESH_S = 10.0  # records are of a run that is up if they are no older; one comes every second


def is_recorded_now(run_dir: Path) -> bool:
    """Whether the run's records are being written."""
    try:
        return time.time() - (run_dir / METRICS).stat().st_mtime < FRESH_S
    except OSError:
        return False


def recall(run_dir: Path, state: RunState, rule: StoppingRule) -> float:
    """Fold in what the run has recorded on this machine; the seconds it has lasted.

    Where nothing is being recorded, the state says from when on it counts.
    """
    try:
        if is_recorded_now(run_dir):
            lasted_s = restore(run_dir, state, rule)
            state.resumed_at_s = _resumed_at_s(run_dir, lasted_s)
            return lasted_s
    except (OSError, RunDirectoryError):
        pass
    state.since, state.resumed_at_s = "since status started", None
    return 0.0


def recall_recent(run_dir: Path, state: RunState) -> float:
    """Fold in the run's counters, evaluations and latest episodes; the seconds it has lasted.

    Unlike `recall` it costs the same however long the run has lasted, and the state has no success
    curve. Raises RunDirectoryError when a file was written by another version.
    """
    metrics = read_last_metrics(run_dir)
    lasted_s = _recall_scores(run_dir, state, metrics)
    state.restore_metrics(metrics)
    state.resumed_at_s = _resumed_at_s(run_dir, lasted_s)
    return lasted_s


def recall_ending(run_dir: Path, state: RunState) -> float:
    """Fold in the same, and the services of the run's last seconds as if they had just reported."""
    latest = read_latest_metrics(run_dir, _LATEST)
    lasted_s = _recall_scores(run_dir, state, latest[-1] if latest else {})
    state.restore_metrics(latest[0] if latest else {})
    for metrics in latest:
        for (role, worker), own in by_service(metrics).items():
            state.observe_stats(Stats(role, worker, own), float(metrics.get("time_s") or 0.0))
    return lasted_s


def _recall_scores(run_dir: Path, state: RunState, metrics: Mapping[str, Any]) -> float:
    time_s = float(metrics.get("time_s") or 0.0)
    for episode in read_last_episodes(run_dir):
        state.observe_episode(episode.episode)
        time_s = max(time_s, episode.time_s)
    state.episodes = max(state.episodes, int(metrics.get("episodes") or 0))
    for evaluation in read_evaluations(run_dir):
        state.restore_evaluation(evaluation)
        time_s = max(time_s, evaluation.time_s)
    return time_s


def _resumed_at_s(run_dir: Path, lasted_s: float) -> float | None:
    """Seconds that the run had lasted when it was started last; None where nobody noted it."""
    endpoint = run_dir / ENDPOINT_FILE  # written when `mrcdrl train` starts the run
    try:
        return max(0.0, lasted_s - (time.time() - endpoint.stat().st_mtime))
    except OSError:
        return None
