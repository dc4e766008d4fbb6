"""Records a run as it goes: lines of JSON, TensorBoard events, a summary at the end.

What TensorBoard shows goes to an experiment tracker as well, if the run has one.

Invariants: a line that a crash left unfinished is cut off by the next start; a record is handed to
the operating system by the next `record_metrics` at the latest; a resumed run appends. What cannot
be written once the files are open is said once and ends nothing.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import chain
from pathlib import Path

import numpy as np

from mrcdrl.common.config import Config, to_toml
from mrcdrl.common.config.returns import largest_return
from mrcdrl.common.config.settings import all_settings
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.checks import MAX_METRICS
from mrcdrl.common.messages.metrics import (
    NUM_BINS,
    Q_EDGES,
    SCHEMAS,
    TD_ERROR_EDGES,
    kinds,
)
from mrcdrl.common.messages.trajectory import EpisodeSummary
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.runtime.files import FILM, METRICS, MOVING_PICTURE, PICTURES, atomic_write
from mrcdrl.services.monitor.events import Events
from mrcdrl.services.monitor.records import (
    EPISODES,
    EVALUATIONS,
    EpisodeRecord,
    EvaluationRecord,
    cut_torn_line,
    read_episodes,
    read_evaluations,
    read_last_metrics,
    record_line,
    to_line,
)
from mrcdrl.services.monitor.state import COUNTERS, RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.monitor.summary import summary_bytes
from mrcdrl.services.monitor.tracker import Tracker
from mrcdrl.services.monitor.watching import Watching

SUMMARY = "summary.json"
TENSORBOARD = "tensorboard"
_TRACKER = "tracking"
_RECORDING = "recording"  # as a failure is said
_KNOWN = {role: kinds(schema) for role, schema in SCHEMAS.items()}
HISTOGRAMS = {"q": Q_EDGES, "td_error": TD_ERROR_EDGES}  # of the learner
RESULTS = ("result/best_success_rate", "result/last_success_rate")  # by which runs are compared
_LARGEST_EVENT = float(np.finfo(np.float32).max)  # TensorBoard keeps float32; NaN is not below
RATES = tuple(chain.from_iterable(COUNTERS.values()))
EVALUATION_FIELDS = (
    "success_rate",
    "collision_rate",
    "timeout_rate",
    "max_per_100",
    "mean_per_100",
    "variance_per_100",
    "mean_frames",
    "mean_score",
)


class Recorder(Closing):
    """Owns the open record files of one run directory; close it, or use it in `with`."""

    def __init__(self, run_dir: Path, config: Config) -> None:
        """Raises RunDirectoryError when the directory cannot be written."""
        self.run_dir = run_dir
        self._config = config
        self._watching = Watching()
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            for name in (EPISODES, EVALUATIONS, METRICS):
                cut_torn_line(run_dir / name)
            self._episodes = (run_dir / EPISODES).open("a", encoding="utf-8")
            self._evaluations = (run_dir / EVALUATIONS).open("a", encoding="utf-8")
            self._metrics = (run_dir / METRICS).open("a", encoding="utf-8")
            self._events = _open_events(run_dir / TENSORBOARD)
        except OSError as error:
            raise RunDirectoryError(f"{run_dir} cannot be written: {error}") from error
        self._tracker: Tracker | None = None
        with self._watching(_TRACKER):
            self._tracker = Tracker.of_run(run_dir, config)
        self._largest_return = largest_return(config)
        self._histograms: dict[str, tuple[float, ...]] = {}  # as written last
        if self._events is not None:
            with self._watching(TENSORBOARD):
                code = "".join(f"    {line}\n" for line in to_toml(config).splitlines())
                self._events.add_text("configuration", code)
                self._events.add_hyperparameters(hyperparameters(config), RESULTS)

    def __repr__(self) -> str:
        return f"Recorder({str(self.run_dir)!r}, closed={self._metrics.closed})"

    def restore(self, state: RunState, rule: StoppingRule) -> float:
        """Fold earlier records into the state and the rule; see `restore`."""
        return restore(self.run_dir, state, rule)

    def record_episode(self, episode: EpisodeSummary, state: RunState, now: float) -> None:
        """Write an episode that `state` has observed."""
        record = EpisodeRecord(now, state.learner_steps, episode)
        with self._watching(_RECORDING):
            self._episodes.write(record_line(record))
        self._event("training/score", episode.score, state.episodes)
        self._event("training/mean_q", episode.mean_q, state.episodes)
        if state.successes_per_100 is not None:
            self._event("training/successes_per_100", state.successes_per_100, state.episodes)

    def record_evaluation(self, record: EvaluationRecord) -> None:
        """Write what `state.observe_evaluation` returned."""
        with self._watching(_RECORDING):
            self._evaluations.write(record_line(record))
            self._evaluations.flush()
        evaluation = record.evaluation
        mixed = self._config.arena.mixes_numbers
        which = f"{evaluation.num_robots}_robots/" if mixed else ""
        for name in EVALUATION_FIELDS:
            value = getattr(evaluation, name)
            self._event(f"evaluation/{which}{name}", value, evaluation.learner_step)

    def record_metrics(self, state: RunState, now: float) -> None:
        """Write the metrics of this second and flush all files; call it once a second."""
        with self._watching(_RECORDING):
            self._metrics.write(to_line(flat_metrics(state, now)))
        for name in RATES:
            self._event(f"rates/{name}_per_s", state.per_second(name, now), int(now))
        if (learner := state.learner) is not None:
            for name in learner.metrics.keys() & _KNOWN["learner"].keys():
                if _KNOWN["learner"][name] != "histogram":
                    self._event(f"learner/{name}", learner.metrics[name], state.learner_steps)
            self._record_histograms(learner.metrics, state.learner_steps)
        self.flush()
        if self._tracker is not None:
            with self._watching(_TRACKER):
                self._tracker.tell(now)

    def write_summary(self, state: RunState, now: float, stop_reason: str) -> None:
        """Write summary.json in one step."""
        with self._watching(f"writing {SUMMARY}"):
            content = summary_bytes(state, self._config, now, stop_reason)
            atomic_write(self.run_dir / SUMMARY, content)
        best, last = state.best_evaluation, state.last_evaluation
        if best is not None and last is not None:
            step = state.learner_steps
            self._event("result/best_success_rate", best.evaluation.success_rate, step)
            self._event("result/last_success_rate", last.evaluation.success_rate, step)

    def record_pictures(self) -> None:
        """Hand on the plots and films that the run has left."""
        self.flush()
        learner_steps = int(read_last_metrics(self.run_dir).get("learner_steps", 0))
        for name in (*PICTURES, MOVING_PICTURE):
            path = self.run_dir / name
            if self._events is not None and path.is_file():
                with self._watching(TENSORBOARD):
                    self._events.add_picture(f"run/{path.stem}", path.read_bytes(), learner_steps)
        if self._tracker is not None:
            files = [self.run_dir / name for name in (*PICTURES, FILM)]
            with self._watching(_TRACKER):
                self._tracker.tell_files([path for path in files if path.is_file()])

    def summarize(self, stop_reason: str) -> None:
        """Write summary.json from what is recorded; for a run whose state is lost."""
        self.flush()
        with self._watching(f"writing {SUMMARY}"):
            state = RunState(self._config)
            now = self.restore(state, StoppingRule(self._config.run))
            self.write_summary(state, now, stop_reason)

    def flush(self) -> None:
        """Hand buffered records to the operating system."""
        for file in (self._episodes, self._evaluations, self._metrics):
            with self._watching(_RECORDING):
                file.flush()
        if self._events is not None:
            with self._watching(TENSORBOARD):
                self._events.flush()

    def close(self) -> None:
        """Flush and close; a second call does nothing."""
        for file in (self._episodes, self._evaluations, self._metrics):
            with self._watching(_RECORDING):
                file.close()
        events, self._events = self._events, None
        if events is not None:
            with self._watching(TENSORBOARD):
                events.close()
        tracker, self._tracker = self._tracker, None
        if tracker is not None:
            with self._watching(_TRACKER):
                tracker.close()

    def _record_histograms(self, metrics: Mapping[str, float], step: int) -> None:
        """Write the learner's histograms, when it has sent new ones."""
        for name, edges in HISTOGRAMS.items():
            shares = tuple(metrics.get(f"{name}_bin_{i}", -1.0) for i in range(NUM_BINS))
            if min(shares) < 0 or max(shares) > 1 or self._histograms.get(name) == shares:
                continue
            self._histograms[name] = shares
            scaled = [edge * self._largest_return for edge in edges]
            low, high = (metrics.get(f"q_{end}", 0.0) for end in ("min", "max"))
            span = (low, high) if name == "q" else (0.0, scaled[-1])
            if self._events is not None and all(abs(end) <= _LARGEST_EVENT for end in span):
                with self._watching(TENSORBOARD):
                    self._events.add_histogram(f"learner/{name}", scaled, shares, span, step)

    def _event(self, tag: str, value: float, step: int) -> None:
        if self._tracker is not None and abs(value) <= _LARGEST_EVENT:
            self._tracker.add(tag, value)
        if self._events is not None and abs(value) <= _LARGEST_EVENT:
            with self._watching(TENSORBOARD):
                self._events.add(tag, value, step)


def restore(run_dir: Path, state: RunState, rule: StoppingRule) -> float:
    """Fold the records of a run into the state and the rule; return the seconds the run lasted.

    Raises RunDirectoryError when a file was written by another version.
    """
    metrics = read_last_metrics(run_dir)
    time_s = float(metrics.get("time_s", 0.0))
    for episode in read_episodes(run_dir):
        state.observe_episode(episode.episode)
        rule.observe_episode(episode.episode)
        time_s = max(time_s, episode.time_s)
    for evaluation in read_evaluations(run_dir):
        state.restore_evaluation(evaluation)
        rule.observe_evaluation(evaluation.evaluation)
        time_s = max(time_s, evaluation.time_s)
    state.restore_metrics(metrics)
    return time_s


def hyperparameters(config: Config) -> dict[str, float | str]:
    """Every setting that a run is made with, as section.name; lists as text."""
    found: dict[str, float | str] = {}
    for setting in all_settings():
        value = getattr(getattr(config, setting.section), setting.name)
        if setting.section != "transport":
            found[setting.key] = value if isinstance(value, bool | float | int) else str(value)
    return found


def _open_events(directory: Path) -> Events | None:
    """None if the optional tensorboardX is not installed."""
    try:
        return Events(directory)
    except ImportError:
        return None


def flat_metrics(state: RunState, now: float) -> dict[str, float | int | None]:
    """The state as one flat object, with each service's own metrics as role/id/name."""
    successes = state.successes_per_100
    flat: dict[str, float | int | None] = {
        "time_s": round(now, 3),
        "env_steps": state.env_steps,
        "robot_steps": state.robot_steps,
        "learner_steps": state.learner_steps,
        "inserts": state.inserts,
        "samples": state.samples,
        "weights_version": state.weights_version,
        "episodes": state.episodes,
        "successes_per_100": successes,
        "staleness_versions": state.max_staleness[0],
        "staleness_s": state.max_staleness[1],
    }
    flat.update({f"{name}_per_s": round(state.per_second(name, now), 3) for name in RATES})
    flat.update(_service_metrics(state))
    return flat


def _service_metrics(state: RunState) -> Iterator[tuple[str, float]]:
    """Each service's metrics; of those in no schema a limited number, so that lines stay short."""
    others = 0
    for service in state.services:
        if service.alive:
            known = _KNOWN.get(service.role, {})
            for name, value in service.metrics.items():
                others += name not in known
                if name in known or others <= MAX_METRICS:
                    yield f"{service.role}/{service.id}/{name}", value
    spreads = state.staleness_spreads
    for actor in state.alive("actor"):
        for unit, spread in spreads.get(actor.id, {}).items():
            for name, value in asdict(spread).items():
                yield f"actor/{actor.id}/staleness_{unit}_{name}", round(value, 3)
