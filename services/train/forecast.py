"""`mrcdrl train --dry-run`: what a run would be, and the time, memory and disk to expect.

Invariants: nothing is written; a figure is said to be a limit, computed, or an estimate, and an
estimate names its measurement.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

from mrcdrl.common.config import Config, differences
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.services.replay.capacity import bytes_per_transition, capacity_of, table_bytes
from mrcdrl.services.train.launcher import Plan, num_actors

# benchmarks/results/make-train: learner steps of 32 states a second, 41 896 in 853 s, on two busy
# cores, while everything of the run works.
_STATES_PER_S = 41_896 / 853 * 32
_ACTOR_STEPS_PER_S = 4300.0  # of an actor with a dedicated core: docs/profile.md
_WEIGHTS_BYTES = 4_442_638  # of the network at 60 x 60 pixels: docs/scaling.md
_CHECKPOINT = 4  # such in a checkpoint: weights, target, two moments of Adam
_PROCESS_BYTES = 500 << 20  # of every process but replay, as `mrcdrl doctor` counts them
_MAX_CHANGES = 20  # settings that are listed


def forecast(plan: Plan) -> str:
    """The forecast as text, a line for each thing to know."""
    lines = [
        ("run", str(plan.path)),
        *_settings(plan),
        ("processes", _processes(plan.config)),
        *_time(plan.config),
        *_memory(plan.config),
        *_disk(plan.config, plan.path),
    ]
    text = "".join(f"{name:<10} {said}\n" for name, said in lines)
    return f"{text}nothing was written: this was a dry run\n"


def _settings(plan: Plan) -> Iterator[tuple[str, str]]:
    changes = differences(plan.before, plan.config)
    count = f"{len(changes)} settings" if len(changes) != 1 else "1 setting"
    yield "settings", f"{plan.base}, with {count} changed" if changes else f"{plan.base}, unchanged"
    for name, (old, new) in list(changes.items())[:_MAX_CHANGES]:
        yield "", f"{name} = {new} (there: {old})"
    if len(changes) > _MAX_CHANGES:
        yield "", f"and {len(changes) - _MAX_CHANGES} more; `mrcdrl config` shows all"


def _processes(config: Config) -> str:
    roles = {
        "replay": config.replay.shards,
        "learner": 1,
        "actor": num_actors(config),
        "evaluator": config.run.evaluators,
        "router": int(config.replay.shards > 1),
    }
    named = ", ".join(f"{n} {role}{'s' * (n > 1)}" for role, n in roles.items() if n)
    return f"{named}; this machine has {available_cores()} cores for them"


def _time(config: Config) -> Iterator[tuple[str, str]]:
    run = config.run
    limits = [
        f"an evaluation with {run.target_success_rate:.1%} success" * bool(run.target_success_rate),
        f"{run.learner_steps} learner steps" * bool(run.learner_steps),
        f"{run.minutes:g} minutes" * bool(run.minutes),
        f"{run.patience_episodes} episodes without a new maximum" * bool(run.patience_episodes),
    ]
    named = [limit for limit in limits if limit]
    yield "ends after", ", or ".join(named) if named else "nothing: when it is stopped"
    rate = _STATES_PER_S / config.learner.batch_size
    pace = f"{rate:.0f} learner steps a second"
    if run.learner_steps:
        pace = f"{run.learner_steps / rate / 60:.0f} minutes to {run.learner_steps}, at {pace}"
    yield (
        "time",
        f"estimate: {pace}, as many states as on two busy cores without a GPU "
        "(benchmarks/results/make-train); more cores or a GPU are faster",
    )


def _memory(config: Config) -> Iterator[tuple[str, str]]:
    tables = config.replay.shards * table_bytes(config)
    others = 2 + num_actors(config) + config.run.evaluators
    yield (
        "memory",
        f"{_size(tables)} for {config.replay.shards * capacity_of(config)} transitions in replay "
        f"(computed), and {_size(others * _PROCESS_BYTES)} for {others} other processes "
        "(estimate: 500 MiB each)",
    )


def _disk(config: Config, path: Path) -> Iterator[tuple[str, str]]:
    if config.replay.fsync == "off":
        yield "disk", 'no replay log (replay.fsync is "off")'
    else:
        each = _log_bytes_each(config)
        growth = 3600 * _transitions_per_s(config) * each
        most = config.replay.shards * (capacity_of(config) * each + 2 * config.replay.segment_bytes)
        yield (
            "disk",
            f"replay's log grows by {each:.0f} bytes a transition (computed), so by "
            f"{_size(growth)} an hour at that pace (estimate), to {_size(most)} at most",
        )
    kept = (1 + config.learner.keep_checkpoints) * _CHECKPOINT * _WEIGHTS_BYTES
    folder = path.resolve()
    while not folder.exists():
        folder = folder.parent
    yield (
        "",
        f"checkpoints take {_size(kept)} (estimate: four times the weights' size each, as at 60 "
        f"pixels), records some MB an hour; {_size(shutil.disk_usage(folder).free)} are free",
    )


def _transitions_per_s(config: Config) -> float:
    """What the rate limiter lets in, or else what the actors collect."""
    ratio = config.replay.samples_per_insert
    return _STATES_PER_S / ratio if ratio else _ACTOR_STEPS_PER_S * num_actors(config)


def _log_bytes_each(config: Config) -> float:
    window = config.arena.stack + config.agent.n_step
    return bytes_per_transition(window, config.actor.chunk_length, config.arena.record_bytes)


def _size(num_bytes: float) -> str:
    """Bytes in the unit that fits."""
    return f"{num_bytes / 1e9:.1f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.0f} MB"
