"""Runs for Prometheus: what is followed of them, as one registry of metrics.

A page that follows runs serves them by `make_asgi_app(registry(followed))` of prometheus_client.

Invariants: the labels' values are bounded in number, whatever peers claim: services of known roles,
at most MAX_SERVICES of a run, those that came first; numbers of robots of the configuration.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import Evaluation
from mrcdrl.common.sync.exposition import ServiceFamilies, label_value
from mrcdrl.common.sync.metrics_server import serve_registry
from mrcdrl.common.sync.stats import Report
from mrcdrl.services.monitor.bottleneck import slowest_stage
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.phase import progress
from mrcdrl.services.monitor.state import ROLES, RunState, Service

MAX_SERVICES = 1024
_DISK_FREE, _DISK_SIZE = "disk_free_bytes", "disk_size_bytes"  # read off the disk, not the state
Sample = tuple[tuple[str, ...], float]  # values of the labels beside `run`, and the value


@dataclass(frozen=True, slots=True)
class FollowedRun:
    """A run that somebody follows.

    now: seconds the run has lasted. lock: held while the state changes. path: where its records
    are, for the room on that disk; None where they are not on this machine.
    """

    name: str
    state: RunState
    now: Callable[[], float]
    lock: AbstractContextManager[object]
    path: Path | None

    @classmethod
    def by(cls, follower: Follower, state: RunState, run_dir: Path) -> Self:
        """The run that a follower feeds this state from, in another thread."""
        return cls(run_dir.name, state, lambda: follower.now, follower.lock, run_dir)


@dataclass(frozen=True, slots=True)
class RunFamily:
    """A metric of a run as a whole; `samples` reads it off the state."""

    name: str
    help: str
    labels: tuple[str, ...]
    samples: Callable[[RunState, float], Iterable[Sample]]

    @property
    def exposed(self) -> str:
        return f"mrcdrl_{self.name}"


def registry(followed: Callable[[], Iterable[FollowedRun]]) -> CollectorRegistry:
    """A registry of the runs that are followed, asked for at each collection; from any thread."""
    made = CollectorRegistry()
    made.register(RunCollector(followed))
    return made


class RunCollector(Collector):
    """Collects all metrics of the followed runs and of their services."""

    def __init__(self, followed: Callable[[], Iterable[FollowedRun]]) -> None:
        self._followed = followed
        self._services = ServiceFamilies()

    def describe(self) -> Iterator[Metric]:
        """Nothing: who registers a collector need not collect."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """The families of this moment, a run at a time under its lock."""
        families = {
            family.name: GaugeMetricFamily(
                family.exposed, family.help, labels=("run", *family.labels)
            )
            for family in RUN_FAMILIES
        }
        reports: list[Report] = []
        for run in self._followed():
            name = label_value(run.name)
            with run.lock:
                now = run.now()
                for family in RUN_FAMILIES:
                    for labels, value in family.samples(run.state, now):
                        families[family.name].add_metric([name, *labels], value)
                reports += [
                    Report(run.name, s.role, s.id, s.metrics) for s in _shown(run.state) if s.alive
                ]
            if run.path is not None:  # without the lock: a disk may not answer
                with suppress(OSError):
                    usage = shutil.disk_usage(run.path)
                    families[_DISK_FREE].add_metric([name], usage.free)
                    families[_DISK_SIZE].add_metric([name], usage.total)
        yield from (family for family in families.values() if family.samples)
        yield from self._services.families(reports)


def _shown(state: RunState) -> list[Service]:
    """The services whose names become labels."""
    return [service for service in state.by_arrival if service.role in ROLES][:MAX_SERVICES]


def _each_service(
    read: Callable[[Service, float], float | None],
) -> Callable[[RunState, float], Iterator[Sample]]:
    def samples(state: RunState, now: float) -> Iterator[Sample]:
        seen = set()
        for service in _shown(state):
            labels, value = (service.role, label_value(service.id)), read(service, now)
            if value is not None and labels not in seen:
                seen.add(labels)
                yield labels, value

    return samples


def _each_number(
    read: Callable[[RunState, int, Evaluation], float],
) -> Callable[[RunState, float], Iterator[Sample]]:
    """Samples by number of robots, from the last evaluation of each."""

    def samples(state: RunState, _: float) -> Iterator[Sample]:
        for number in state.config.arena.numbers:
            record = state.last_by_robots.get(number)
            if record is not None:
                yield (str(number),), read(state, number, record.evaluation)

    return samples


def _whole(read: Callable[[RunState, float], float | None]) -> Callable[..., Iterator[Sample]]:
    def samples(state: RunState, now: float) -> Iterator[Sample]:
        value = read(state, now)
        if value is not None:
            yield (), value

    return samples


def _success(state: RunState, _: float) -> float | None:
    successes = state.successes_per_100
    return None if successes is None else successes / 100


def _best(state: RunState, number: int, _: Evaluation) -> float:
    return max(r.evaluation.success_rate for r in state.evaluations_with(number))


def _silent_s(service: Service, now: float) -> float | None:
    return service.silent_s(now) if service.alive and service.heard_s is not None else None


def _stage(state: RunState, _: float) -> Iterator[Sample]:
    if not progress(state).waiting_for:
        yield (slowest_stage(state).replace("\N{NO-BREAK SPACE}", " "),), 1.0


def _family(name: str, text: str, read: Callable[[RunState, float], float | None]) -> RunFamily:
    return RunFamily(name, text, (), _whole(read))


def _evaluated(
    name: str, text: str, read: Callable[[RunState, int, Evaluation], float]
) -> RunFamily:
    return RunFamily(f"evaluation_{name}", text, ("robots",), _each_number(read))


RUN_FAMILIES = (
    RunFamily(
        "run_info",
        "Always 1: which agent learns, and numbers of robots.",
        ("agent", "robots"),
        lambda s, _: [
            ((s.config.agent.kind, " ".join(map(str, s.config.arena.numbers))), 1.0),
        ],
    ),
    _family("run_duration_seconds", "Duration of the run, over all resumptions.", lambda _, n: n),
    RunFamily(
        "run_phase",
        "1 for what the run does: starting, compiling, filling, exploring, learning or ending.",
        ("phase",),
        lambda s, _: [((str(progress(s).phase),), 1.0)],
    ),
    RunFamily("run_bottleneck", "1 for the stage to speed up first.", ("stage",), _stage),
    _family("run_env_steps", "Steps of all arenas.", lambda s, _: s.env_steps),
    _family("run_robot_steps", "Transitions made by all actors.", lambda s, _: s.robot_steps),
    _family("run_learner_steps", "Steps of the learner.", lambda s, _: s.learner_steps),
    _family("run_inserted_transitions", "Transitions that replay took.", lambda s, _: s.inserts),
    _family("run_sampled_transitions", "Transitions that replay gave.", lambda s, _: s.samples),
    _family("run_episodes", "Training episodes finished.", lambda s, _: s.episodes),
    _family("run_success_ratio", "Success in the last 100 training episodes.", _success),
    _family("run_weights_version", "Version published last.", lambda s, _: s.weights_version),
    _family(
        "run_staleness_versions",
        "Versions that the stalest actor is behind.",
        lambda s, _: s.max_staleness[0],
    ),
    _family(
        "run_staleness_seconds",
        "Seconds since the stalest actor adopted its weights.",
        lambda s, _: s.max_staleness[1],
    ),
    _family("run_evaluations", "Evaluations finished.", lambda s, _: len(s.evaluations)),
    _evaluated(
        "success_ratio", "Success of the last evaluation.", lambda _s, _n, e: e.success_rate
    ),
    _evaluated(
        "success_low_ratio",
        "Lower end of its 95 % interval.",
        lambda _s, _n, e: e.success_interval[0],
    ),
    _evaluated(
        "success_high_ratio",
        "Upper end of its 95 % interval.",
        lambda _s, _n, e: e.success_interval[1],
    ),
    _evaluated("best_success_ratio", "Greatest success of any evaluation so far.", _best),
    _evaluated(
        "collision_ratio",
        "Episodes of the last evaluation that ended in a collision.",
        lambda _s, _n, e: e.collision_rate,
    ),
    _evaluated(
        "timeout_ratio",
        "Episodes of the last evaluation that ran out of time.",
        lambda _s, _n, e: e.timeout_rate,
    ),
    _evaluated("mean_score", "Mean score of the last evaluation.", lambda _s, _n, e: e.mean_score),
    _evaluated(
        "mean_frames", "Mean frames of its successful episodes.", lambda _s, _n, e: e.mean_frames
    ),
    _evaluated(
        "weights_version",
        "Version of the weights that were evaluated last.",
        lambda _s, _n, e: e.weights_version,
    ),
    RunFamily(
        "service_up",
        "1 while a process holds its liveliness token, 0 once it is lost.",
        ("role", "worker"),
        _each_service(lambda service, _: float(service.alive)),
    ),
    RunFamily(
        "service_silent_seconds",
        "Seconds since the last statistics of a process that is up.",
        ("role", "worker"),
        _each_service(_silent_s),
    ),
    _family(
        "services_omitted",
        "Processes that are not told apart here, as there are too many or their role is unknown.",
        lambda s, _: len(s.by_arrival) - len(_shown(s)),
    ),
    RunFamily(_DISK_FREE, "Room on the disk of the run's records.", (), lambda *_: ()),
    RunFamily(_DISK_SIZE, "Size of the disk of the run's records.", (), lambda *_: ()),
)


def serve_run(
    transport: TransportConfig, follower: Follower, state: RunState, run_dir: Path, role: str
) -> AbstractContextManager[None]:
    """Serve a followed run to Prometheus meanwhile, if transport.metrics_port says so.

    role: of the process that follows it, for its log.
    """
    run = FollowedRun.by(follower, state, run_dir)
    return serve_registry(transport, role, lambda: registry(lambda: [run]))
