"""A run's records as lines of JSON: episodes, evaluations, the metrics of each second.

Invariants: one object a line; a number that is not finite is written as null and read as nan; a
torn last line is what a crash leaves, and not an error.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.trajectory import EpisodeSummary, Evaluation, Outcome
from mrcdrl.common.runtime.files import METRICS

Record = TypeVar("Record")

EPISODES = "episodes.jsonl"
EVALUATIONS = "evaluations.jsonl"
SUCCESS_WINDOW = 100  # episodes over which successes are counted (Table 1, Fig. 6b)
_TAIL_BYTES = 1 << 20
_LATEST_BYTES = 1 << 17


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """A finished training episode and when it was reported."""

    time_s: float  # since the run began, over all resumptions
    learner_steps: int
    episode: EpisodeSummary


@dataclass(frozen=True, slots=True)
class EvaluationRecord:
    """An evaluation, when it was reported, and the progress of collection by then."""

    time_s: float  # since the run began, over all resumptions
    env_steps: int
    robot_steps: int
    evaluation: Evaluation


def to_line(values: Mapping[str, Any]) -> str:
    """One line of strict JSON, newline included."""
    return json.dumps(finite(values)) + "\n"


def finite(value: Any) -> Any:
    """The value as strict JSON takes it: numbers that are not finite become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: finite(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(inner) for inner in value]
    return value


def flat(record: EpisodeRecord | EvaluationRecord) -> dict[str, Any]:
    """The record and its message as one flat object."""
    values = asdict(record)
    values |= values.pop("episode" if isinstance(record, EpisodeRecord) else "evaluation")
    return values


def record_line(record: EpisodeRecord | EvaluationRecord) -> str:
    """The record as one line of JSON."""
    return to_line(flat(record) | {"time_s": round(record.time_s, 3)})


def _pick(values: Mapping[str, Any], message: type) -> dict[str, Any]:
    """The fields of the message, null read as nan; raises KeyError for one that is missing."""
    names = [field.name for field in fields(message)]
    return {name: math.nan if values[name] is None else values[name] for name in names}


def _episode(values: Mapping[str, Any]) -> EpisodeRecord:
    # 0: from a run of a version that did not record it
    picked = _pick({"num_robots": 0} | dict(values), EpisodeSummary)
    picked["outcome"] = Outcome(picked["outcome"])
    return EpisodeRecord(values["time_s"], values["learner_steps"], EpisodeSummary(**picked))


def _evaluation(values: Mapping[str, Any]) -> EvaluationRecord:
    picked = _pick(values, Evaluation)
    low, high = picked["success_interval"]
    picked["success_interval"] = (low, high)
    evaluation = Evaluation(**picked)
    return EvaluationRecord(
        values["time_s"], values["env_steps"], values["robot_steps"], evaluation
    )


def json_objects(text: bytes, *, from_end: bool = False) -> Iterator[dict[str, Any]]:
    """The whole lines that are JSON objects; others (torn, zeroed by a crash) are skipped.

    from_end: the last one first.
    """
    lines = text.split(b"\n")[:-1]
    for line in reversed(lines) if from_end else lines:
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if isinstance(values, dict):
            yield values


def _read(path: Path, parse: Callable[[Mapping[str, Any]], Record]) -> list[Record]:
    return _parsed(path, path.read_bytes(), parse) if path.exists() else []


def _parsed(path: Path, text: bytes, parse: Callable[[Mapping[str, Any]], Record]) -> list[Record]:
    try:
        return [parse(values) for values in json_objects(text)]
    except (KeyError, TypeError, ValueError) as error:
        raise RunDirectoryError(f"{path} is not of this version of mrcdrl: {error!r}") from error


def read_episodes(run_dir: Path) -> list[EpisodeRecord]:
    """Every episode of a run, in the order reported; [] when there is no file.

    Raises RunDirectoryError when a whole line is not an episode.
    """
    return _read(run_dir / EPISODES, _episode)


def read_last_episodes(run_dir: Path) -> list[EpisodeRecord]:
    """The latest episodes, some hundreds; errors are those of `read_episodes`."""
    path = run_dir / EPISODES
    if not path.exists():
        return []
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _LATEST_BYTES))
        lines = file.read()
    whole = lines if len(lines) < _LATEST_BYTES else lines.partition(b"\n")[2]
    return _parsed(path, whole, _episode)


def read_evaluations(run_dir: Path) -> list[EvaluationRecord]:
    """Every evaluation of a run, in the order reported; [] when there is no file.

    Raises RunDirectoryError when a whole line is not an evaluation.
    """
    return _read(run_dir / EVALUATIONS, _evaluation)


def read_last_metrics(run_dir: Path) -> dict[str, Any]:
    """The last whole line of the metrics; {} when there is none."""
    return next(iter(read_latest_metrics(run_dir, 1)), {})


def read_latest_metrics(run_dir: Path, num: int) -> list[dict[str, Any]]:
    """The last whole lines of the metrics: at most `num`, and at least one where there is one."""
    path = run_dir / METRICS
    if not path.exists():
        return []
    size = path.stat().st_size
    tail, objects = _TAIL_BYTES, list[dict[str, Any]]()
    with path.open("rb") as file:
        while not objects:  # a run of a thousand actors has lines of a megabyte
            file.seek(max(0, size - tail))
            objects = list(islice(json_objects(file.read(), from_end=True), num))
            if tail >= size:
                break
            tail *= 4
    return objects[::-1]


def by_service(metrics: Mapping[str, Any]) -> dict[tuple[str, str], dict[str, float]]:
    """The numbers of each service in a line of metrics, named ROLE/WORKER/METRIC there."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for name, value in metrics.items():
        role, _, rest = name.partition("/")
        worker, _, metric = rest.partition("/")
        if metric and isinstance(value, int | float):
            found.setdefault((role, worker), {})[metric] = float(value)
    return found


def cut_torn_line(path: Path) -> None:
    """Cut the file after its last newline, so that the next append starts a line."""
    if not path.exists():
        return
    with path.open("r+b") as file:
        size = file.seek(0, 2)
        start = max(0, size - _TAIL_BYTES)
        file.seek(start)
        newline = file.read().rfind(b"\n")
        file.truncate(start + newline + 1 if newline >= 0 else start)
