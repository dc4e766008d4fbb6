"""What the page shows of a run, as JSON: the state of its processes, and its settings.

Invariants: pure; derived from the same RunState as the terminal's screen, and what both say is
made by the same functions. Lists are bounded, whatever peers claim.
"""

import base64
from statistics import fmean
from typing import Any

import numpy as np

from mrcdrl.common.config import ArenaConfig, Config, differences, load_config, nearest_preset
from mrcdrl.common.config.returns import largest_return
from mrcdrl.common.config.settings import all_settings
from mrcdrl.common.config.toml import toml_value
from mrcdrl.common.messages.metrics import NUM_BINS
from mrcdrl.common.messages.trajectory import ArenaFrame, Float32Array
from mrcdrl.common.runtime.names import MAX_TEXT, printable
from mrcdrl.services.monitor.bottleneck import reason
from mrcdrl.services.monitor.phase import progress
from mrcdrl.services.monitor.recorder import flat_metrics
from mrcdrl.services.monitor.records import finite, flat
from mrcdrl.services.monitor.service_table import QUIET_S, figures, heard
from mrcdrl.services.monitor.state import ROLES, RunState, Service
from mrcdrl.services.monitor.status import status
from mrcdrl.services.web.history import curves_of

MAX_SERVICES = 100  # in the table: actors, and others
MAX_EVALUATIONS = 50
MAX_LOG = 50
_OF_STATUS = (
    "phase",
    "limited_by",
    "time_since",
    "evaluating_version",
    "replay_size",
    "replay_capacity",
    "success_by_robots",
)
WATCHED = ("evaluator", "actor")  # roles whose arenas can be watched


def live_view(state: RunState, now: float) -> dict[str, Any]:
    """The state of a run that is up, or as it was in its last second."""
    doing, last, best = progress(state), state.last_evaluation, state.best_evaluation
    services = state.services
    actors = [s for s in services if s.role == "actor"]
    listed = [*actors[:MAX_SERVICES], *services[len(actors) :][:MAX_SERVICES]]
    told = status(state, now)
    values = {name: told[name] for name in _OF_STATUS} | {
        "point": curves_of(flat_metrics(state, now)),
        "doing": str(doing),
        "waiting": bool(doing.waiting_for),
        "why": reason(state),
        "time_left_s": state.time_left_s(now),
        "weights_version": state.weights_version,
        "recent_successes": state.recent_successes,
        "recent_score": fmean(state.recent_scores) if state.recent_scores else None,
        "last": None if last is None else flat(last),
        "best": None if best is None else flat(best),
        "evaluations": [flat(record) for record in state.weakest[-MAX_EVALUATIONS:]],
        "up": {role: len(state.alive(role)) for role in ROLES},
        "services": [_service(state, service, now) for service in listed],
        "more_services": len(services) - len(listed),
        "histograms": _histograms(state),
        "log": list(state.log)[-MAX_LOG:],
    }
    return {name: finite(value) for name, value in values.items()}


def frame_view(frame: ArenaFrame) -> dict[str, Any]:
    """A frame of an arena; positions in px, to a hundredth."""
    values: dict[str, Any] = {
        "role": frame.role,
        "worker": frame.worker,
        "arena": frame.arena,
        "episode": frame.episode,
        "frame": frame.frame,
        "weights_version": frame.weights_version,
        "epsilon": frame.epsilon,
        "robots": _rounded(frame.robots, 2),
        "targets": _rounded(frame.targets, 2),
        "obstacles": _rounded(frame.obstacles, 2),
        "q_values": _rounded(frame.q_values, 5),
        "actions": frame.actions.tolist(),
        "collided": frame.collided.tolist(),
        "outcome": frame.outcome,
        "view_px": frame.view_px,
        "images": base64.b64encode(frame.images).decode("ascii"),
    }
    return {name: finite(value) for name, value in values.items()}


def _rounded(array: Float32Array, digits: int) -> list[list[float]]:
    rows: list[list[float]] = array.astype(np.float64).round(digits).tolist()
    return rows


def settings_view(config: Config) -> dict[str, Any]:
    """The resolved configuration, and what differs from the nearest preset."""
    preset, _ = nearest_preset(config)
    changed = differences(load_config(preset, environ={}), config)
    values = config.model_dump()
    return {
        "preset": preset,
        "largest_return": largest_return(config),
        "arena": arena_view(config.arena),
        "settings": [
            {
                "key": setting.key,
                "value": toml_value(values[setting.section][setting.name]),
                "there": toml_value(changed[setting.key][0]) if setting.key in changed else None,
                "meaning": setting.meaning,
            }
            for setting in all_settings()
        ],
    }


def arena_view(arena: ArenaConfig) -> dict[str, Any]:
    """What it takes to draw the arena; lengths in px."""
    return {
        "size": arena.size_px,
        "robot_radius": arena.robot_radius_px,
        "target_size": arena.target_size_px,
        "wall_offset": arena.wall_offset_px,
        "wall_thickness": arena.wall_thickness_px,
        "inner_walls": arena.inner_walls_px,
        "view_px": arena.view_px,
        "stack": arena.stack,
        "crop": arena.crop_px,
        "kind": arena.kind,
        "actions": _action_names(arena),
    }


def _action_names(arena: ArenaConfig) -> list[str]:
    if arena.is_custom:
        return [f"action {number}" for number in range(arena.num_actions)]
    return ["left", "straight", "right"]


def _service(state: RunState, service: Service, now: float) -> dict[str, Any]:
    silent_s = service.silent_s(now)
    versions, seconds = state.staleness(service) or (None, None)
    return {
        "role": printable(service.role),
        "id": printable(service.id),
        "presence": heard(service, now).plain,
        "well": service.alive and (silent_s <= QUIET_S or service.heard_s is None),
        "since_ns": service.text.get("incarnation"),
        "figures": figures(state, service, now)[:MAX_TEXT],
        "stale_versions": versions if service.role == "actor" else None,
        "stale_s": seconds if service.role == "actor" else None,
        "watchable": service.alive and service.role in WATCHED,
    }


def _histograms(state: RunState) -> dict[str, list[float]]:
    """The learner's histograms as last sent; none before it has sent any."""
    known = [s.histograms for s in state.services if s.role == "learner" and s.histograms]
    return {
        name: [known[0].get(f"{name}_{i}", 0.0) for i in range(NUM_BINS)]
        for name in ("q_bin", "td_error_bin")
        if known
    }
