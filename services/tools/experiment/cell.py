"""The files of a cell, its state as they tell it, and its result.

    OUT/cells/NAME/          the run directory
    OUT/cells/NAME.toml      its configuration: the cell has begun
    OUT/cells/NAME.log       what its processes wrote; locked while one of them runs
    OUT/cells/NAME.final     what `mrcdrl evaluate --json` prints for these weights; so NAME.best
    OUT/cells/NAME.failed    why it failed
    OUT/cells/NAME.done      its result, a line of JSON: the cell is done

Invariants: each file but the log is written in one step, and the result last; so a cell is whole
or goes on from where it was killed.
"""

import fcntl
import json
import shutil
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from statistics import fmean
from typing import IO, Any

from mrcdrl.common.config import to_toml
from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.common.runtime.files import BEST_WEIGHTS, RUN_CONFIG, atomic_write
from mrcdrl.services.monitor.recorder import SUMMARY
from mrcdrl.services.monitor.records import (
    SUCCESS_WINDOW,
    EpisodeRecord,
    EvaluationRecord,
    read_episodes,
    read_evaluations,
    read_last_metrics,
    to_line,
)
from mrcdrl.services.monitor.stopping import has_failed, was_stopped
from mrcdrl.services.tools.experiment.grid import BEST, FINAL, PROTOCOL, Cell

RATES = (0.5, 0.8, 0.9, 0.93, 0.94)
_LEAST_MINUTES = 0.01  # 0 would be no limit
_TRAINED = 0.95  # fraction of a cell that training makes; evaluations follow


class State(StrEnum):
    """State of a cell."""

    MISSING = "missing"  # it has not begun
    STOPPED = "stopped"  # it has begun, nothing works at it; it will be resumed
    RUNNING = "running"
    FAILED = "failed"  # it will be tried again
    DONE = "done"


class CellFiles:
    """The files of one cell below `out`."""

    def __init__(self, cell: Cell, out: Path) -> None:
        self.cell = cell
        self.run = out / "cells" / cell.name
        self.log = self._beside("log")
        self._toml, self._done, self._failed = map(self._beside, ("toml", "done", "failed"))

    def _beside(self, suffix: str) -> Path:
        return self.run.with_name(f"{self.run.name}.{suffix}")

    @property
    def state(self) -> State:
        if self.result() is not None:
            return State.DONE
        if self.log.exists():
            with self.log.open("rb") as log:
                if not lock(log):
                    return State.RUNNING
        if self._failed.exists():
            return State.FAILED
        return State.STOPPED if self._toml.exists() else State.MISSING

    def result(self) -> dict[str, Any] | None:
        """The result; None if the cell is not done, or the grid asks for other evaluations."""
        result = _read(self._done)
        asked = set(self.cell.trial.weights)
        whole = result is not None and all(
            name in result["evaluate"] and _is_of(result["evaluate"][name], name, self.cell)
            for name in asked
        )
        return result if whole else None

    @property
    def failure(self) -> str:
        """Why it failed, in one line."""
        return self._failed.read_text("utf-8").strip() if self._failed.exists() else ""

    def fail(self, reason: str) -> None:
        atomic_write(self._failed, f"{reason}\n".encode())

    def begin(self) -> None:
        """Write the configuration, and forget an earlier failure."""
        self._failed.unlink(missing_ok=True)
        if not self._toml.exists():
            atomic_write(self._toml, to_toml(self.cell.config).encode())
        if self.run.exists() and not (self.run / RUN_CONFIG).exists():
            shutil.rmtree(self.run)  # killed before it was a run

    def finish(self, command: str) -> None:
        """Write the result."""
        atomic_write(self._done, to_line(self._collect(command)).encode())

    # -- training --

    @property
    def summary(self) -> dict[str, Any]:
        """The summary of the run; {} until its training has ended or was stopped."""
        return _read(self.run / SUMMARY) or {}

    @property
    def trained(self) -> bool:
        """Whether the training came to its own end, and was not ended by a signal or an error."""
        reason = self.summary.get("stop_reason")
        return reason is not None and not (was_stopped(reason) or has_failed(reason))

    def train(self) -> list[str]:
        """Arguments of `mrcdrl train`, for a new run or to go on."""
        folder = ["--run-dir", str(self.run.parent), "--no-plots", "--no-web"]
        if not self.run.exists():
            named = ["--config", str(self._toml), "--name", self.run.name]
            return ["train", *named, *folder, "--no-web"]
        arguments = ["train", "--resume", self.run.name, *folder, "--no-web"]
        minutes = self.cell.config.run.minutes
        if minutes:  # train counts them from its start
            left = max(_LEAST_MINUTES, minutes - self.lasted_s / 60)
            arguments += ["--minutes", f"{left:.3f}"]
        return arguments

    @property
    def lasted_s(self) -> float:
        """Seconds of training so far, over all resumptions."""
        return float(read_last_metrics(self.run).get("time_s", 0.0))

    def fraction(self) -> float:
        """How much of the cell is over, by the limit that is nearer."""
        limits = self.cell.config.run
        steps = float(read_last_metrics(self.run).get("learner_steps") or 0.0)
        by_steps = steps / limits.learner_steps if limits.learner_steps else 0.0
        by_time = self.lasted_s / 60 / limits.minutes if limits.minutes else 0.0
        return min(_TRAINED, max(by_steps, by_time))

    # -- evaluation --

    def evaluations_due(self) -> Iterator[tuple[list[str], Path]]:
        """Arguments of each `mrcdrl evaluate` that is still due, and the file for its result."""
        trial = self.cell.trial
        for name in trial.weights:
            weights, target = self.weights(name), self._beside(name)
            if weights is None or (target.exists() and _is_of(_read(target), name, self.cell)):
                continue
            flags = ["--episodes", str(trial.episodes), "--seed", str(trial.seed), "--json"]
            if trial.values and name == FINAL:
                flags.append("--values")
            if self.cell.config.arena.mixes_numbers:
                flags += ["--robots", str(self.cell.robots)]
            yield ["evaluate", str(weights), *flags], target

    def weights(self, name: str) -> Path | None:
        """The file or checkpoint that holds the weights; None if the run left none."""
        if name == BEST:
            best = self.run / BEST_WEIGHTS
            return best if best.exists() else None
        return max(self.run.glob("checkpoints/step_*"), default=None)

    # -- result --

    def _collect(self, command: str) -> dict[str, Any]:
        summary, cell = self.summary, self.cell
        evaluations = read_evaluations(self.run)
        if cell.config.arena.mixes_numbers:  # it is judged by the greatest number
            evaluations = [r for r in evaluations if r.evaluation.num_robots == cell.robots]
        return {
            "cell": cell.name,
            "variant": cell.variant,
            "robots": cell.robots,
            "seed": cell.seed,
            "protocol": PROTOCOL,
            "configuration": cell.digest,
            "settings": dict(cell.settings),
            "stop_reason": summary["stop_reason"],
            "learner_steps": summary["learner_steps"],
            "wall_s": summary["wall_s"],
            "reached": {f"{rate:g}": _reached(evaluations, rate) for rate in RATES},
            "last": _success(evaluations[-1]) if evaluations else None,
            "best": _success(max(evaluations, key=_rate)) if evaluations else None,
            "training": hundreds(read_episodes(self.run), cell.config.agent.reward_scale),
            "evaluate": {name: _read(self._beside(name)) for name in cell.trial.weights},
            "machine": summary["machine"],
            "versions": summary["versions"],
            "command": command,
        }


def lock(log: IO[bytes]) -> bool:
    """Lock a log, for as long as it is open here or in a process that inherits it; whether nobody
    else holds it."""
    try:
        fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read(path: Path) -> Any:
    """The JSON in a file; None if there is no file."""
    return json.loads(path.read_bytes()) if path.exists() else None


def _is_of(evaluation: dict[str, Any] | None, name: str, cell: Cell) -> bool:
    """Whether the evaluation is what the grid asks for; None: there were no such weights."""
    if evaluation is None:
        return True
    values_due = cell.trial.values and name == FINAL and evaluation.get("values") is None
    trial = (cell.trial.episodes, cell.trial.seed)
    return not values_due and (evaluation["episodes"], evaluation["seed"]) == trial


def hundreds(episodes: Sequence[EpisodeRecord], reward_scale: float) -> dict[str, list[float]]:
    """Each whole hundred of training episodes: successes, means, and learner steps at its end."""
    blocks = [
        episodes[end - SUCCESS_WINDOW : end]
        for end in range(SUCCESS_WINDOW, len(episodes) + 1, SUCCESS_WINDOW)
    ]
    each = [[record.episode for record in block] for block in blocks]
    return {
        "successes": [sum(e.outcome is Outcome.SUCCESS for e in block) for block in each],
        "score": [round(fmean(e.score for e in block), 3) for block in each],
        "mean_q": [round(fmean(e.mean_q for e in block) / reward_scale, 3) for block in each],
        "learner_steps": [block[-1].learner_steps for block in blocks],
    }


def _rate(record: EvaluationRecord) -> float:
    return record.evaluation.success_rate


def _success(record: EvaluationRecord) -> dict[str, Any]:
    """The success of an evaluation, and when it was."""
    return {
        "success_rate": record.evaluation.success_rate,
        "success_interval": record.evaluation.success_interval,
        "episodes": record.evaluation.episodes,
        "learner_steps": record.evaluation.learner_step,
        "seconds": record.time_s,
    }


def _reached(evaluations: list[EvaluationRecord], rate: float) -> dict[str, float] | None:
    """Cost of the first evaluation with that success rate; None if there is none."""
    for record in evaluations:
        if _rate(record) >= rate:
            return {"learner_steps": record.evaluation.learner_step, "seconds": record.time_s}
    return None
