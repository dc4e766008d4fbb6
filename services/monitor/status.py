"""The state of a run as one JSON object, for programs: `mrcdrl status --json`, and the page."""

from typing import Any

from mrcdrl.common.runtime.versions import VERSIONED
from mrcdrl.services.monitor.bottleneck import bottleneck
from mrcdrl.services.monitor.phase import progress
from mrcdrl.services.monitor.recorder import flat_metrics
from mrcdrl.services.monitor.records import finite
from mrcdrl.services.monitor.state import RunState


def status(state: RunState, now: float) -> dict[str, Any]:
    """The processes, the bottleneck, and all that metrics.jsonl records of a second."""
    last = state.last_evaluation
    figures = flat_metrics(state, now).items()
    doing = progress(state)
    values = {
        "time_since": state.since or "the run began",
        "phase": doing.phase,
        "evaluating_version": doing.evaluating,
        "limited_by": bottleneck(state).replace("\N{NO-BREAK SPACE}", " "),
        "services": [
            {
                "role": s.role,
                "id": s.id,
                "alive": s.alive,
                "silent_s": round(s.silent_s(now), 6),
                "slot": s.slot,
                "compiling": s.compiling,
                "versions": {name: s.text[name] for name in VERSIONED if name in s.text},
            }
            for s in state.services
        ],
        "replay_size": state.replay_size,
        "replay_capacity": state.replay_capacity,
        "success_rate": last.evaluation.success_rate if last else None,
        "success_by_robots": {
            str(number): record.evaluation.success_rate
            for number, record in sorted(state.last_by_robots.items())
        },
        "evaluated_version": last.evaluation.weights_version if last else None,
        **{name: None if value is None else round(value, 6) for name, value in figures},
    }
    return {name: finite(value) for name, value in values.items()}
