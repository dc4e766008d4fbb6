"""The state of a run: its messages folded into counters, rates, scores and the services' presence.

Invariants: no clock, lock or transport inside; `now` is the number of seconds the run has lasted,
over all resumptions, and never falls. Everything kept is bounded, except one byte an episode and
one record an evaluation.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from mrcdrl.common.config import Config
from mrcdrl.common.messages.metrics import M, of_kind, read
from mrcdrl.common.messages.trajectory import (
    COMPILING,
    DOING,
    NO_SLOT,
    EpisodeSummary,
    Evaluation,
    Outcome,
    Stats,
)
from mrcdrl.common.runtime.names import printable
from mrcdrl.services.monitor.rates import Rate, Share, Spread, SpreadWindow
from mrcdrl.services.monitor.records import SUCCESS_WINDOW, EvaluationRecord
from mrcdrl.services.monitor.weakest import Weakest

ROLES = ("actor", "replay", "learner", "evaluator", "status")
WITHOUT_METRICS = ("status",)  # roles that announce themselves and publish nothing
COUNTERS = of_kind("pace")  # an actor's start at 0 with it; the others' are kept with the run
SHARES = of_kind("share")
HISTOGRAMS = of_kind("histogram")
STALENESS = ("versions", "s")
INCARNATION = "incarnation"  # a text in Stats
HISTORY_PERIOD = 10  # episodes between two points of the success curve
LOG_LINES = 100
MAX_FORMER = 16  # starts of a service before the present one that are remembered
MAX_SERVICES = 4096  # a peer may claim any number of names


@dataclass(slots=True)
class Service:
    """One process of the run, as last heard from."""

    role: str
    id: str
    alive: bool = True
    heard_s: float | None = None  # when its last stats arrived
    metrics: dict[str, float] = field(default_factory=dict)
    text: dict[str, str] = field(default_factory=dict)
    rates: dict[str, Rate] = field(default_factory=dict)
    shares: dict[str, Share] = field(default_factory=dict)
    staleness: dict[str, SpreadWindow] = field(default_factory=dict)  # of its weights, by unit
    histograms: dict[str, float] = field(default_factory=dict)  # the latest; not in every report
    former: deque[str] = field(default_factory=lambda: deque(maxlen=MAX_FORMER))
    """Incarnations before the present one."""
    namesakes: int = 0
    """Reports of those, which came after the present one had begun."""

    def read(self, schema: type[M]) -> M:
        """Its metrics as last reported, shares averaged over the window."""
        means = {name: share.mean for name, share in self.shares.items()}
        return read(schema, self.metrics | means)

    def per_second(self, name: str, now: float) -> float:
        """Rate of one of its counters; 0 for a counter that it does not have."""
        rate = self.rates.get(name)
        return rate.per_second(now) if rate else 0.0

    def share(self, name: str) -> float:
        """Mean of one of its shares (0 ... 1) over the window."""
        share = self.shares.get(name)
        return share.mean if share else 0.0

    @property
    def slot(self) -> int | None:
        """The exploration slot leased to it; None if it has none or is lost."""
        slot = int(self.metrics.get("slot", NO_SLOT))
        return slot if self.alive and slot != NO_SLOT else None

    @property
    def compiling(self) -> bool:
        """Whether it compiles its functions, which keeps it from its work."""
        return self.alive and self.text.get(DOING) == COMPILING

    def silent_s(self, now: float) -> float:
        """Seconds since its last stats; infinite before the first."""
        return math.inf if self.heard_s is None else max(0.0, now - self.heard_s)


class RunState:
    """The run as seen from outside; `observe_*` folds in a message, everything else reads."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.resumed_at_s: float | None = 0.0  # seconds the run had lasted when it was resumed
        self.since = ""  # such as "since status started", where `now` does not count from its start
        self.ending = ""  # why the run ends, once it does
        self.log: deque[str] = deque(maxlen=LOG_LINES)
        self.evaluations: list[EvaluationRecord] = []  # with each number of robots
        self.weakest: list[EvaluationRecord] = []  # of each version, those with the least success
        self.last_by_robots: dict[int, EvaluationRecord] = {}  # the latest of each number
        self._weakest = Weakest(config.arena.numbers)
        self.episodes = 0
        self.max_successes = 0  # of 100 consecutive episodes
        self.success_history: list[int] = []  # successes_per_100, every HISTORY_PERIOD episodes
        self.recent_scores: deque[float] = deque(maxlen=SUCCESS_WINDOW)
        self.recent_q: deque[float] = deque(maxlen=SUCCESS_WINDOW)
        self._outcomes = bytearray()
        self._services: dict[tuple[str, str], Service] = {}
        self._collected = {"env_steps": 0.0, "robot_steps": 0.0}
        self._counted: dict[tuple[str, str], float] = {}  # by an earlier recorder
        self._before: Mapping[str, float] = {}  # counters, until their services report again

    def __repr__(self) -> str:
        return (
            f"RunState(services={len(self._services)}, episodes={self.episodes}, "
            f"successes={self.successes_per_100}, robot_steps={self.robot_steps}, "
            f"learner_steps={self.learner_steps})"
        )

    # -- observations ------------------------------------------------------------------

    def observe_stats(self, stats: Stats, now: float) -> None:
        """Take a service's metrics; a fallen counter or a new `incarnation` means a restart.

        After a restart, what still comes from an earlier incarnation is another process of that
        name: it is left out, which is said once.
        """
        service = self._service(stats.role, stats.id)
        before = service.text.get(INCARNATION)
        present = stats.text.get(INCARNATION, before)
        if present in service.former:
            self._observe_namesake(service)
            return
        if not stats.metrics:
            self._observe_start(service, stats, now)
            return
        restarted = before is not None and before != present
        if before is not None and restarted:
            service.former.append(before)
        service.alive, service.heard_s = True, now
        service.metrics, service.text = dict(stats.metrics), dict(stats.text)
        binned = {n: stats.metrics[n] for n in HISTOGRAMS.get(stats.role, ()) if n in stats.metrics}
        service.histograms = binned or service.histograms
        for name in COUNTERS.get(stats.role, ()):
            if name in stats.metrics:
                earlier = self._counted.get((stats.id, name), 0.0)  # of actors only
                rate = service.rates.setdefault(name, Rate(stats.role != "actor", earlier))
                counted = rate.observe(stats.metrics[name], now, restarted)
                if name in self._collected:
                    self._collected[name] += counted
        for name in SHARES.get(stats.role, ()):
            if name in stats.metrics:
                service.shares.setdefault(name, Share()).observe(stats.metrics[name], now)
        stale = self.staleness(service) if stats.role == "actor" else None
        for unit, value in zip(STALENESS, stale or (), strict=False):
            service.staleness.setdefault(unit, SpreadWindow()).observe(value, now)

    def _observe_start(self, service: Service, stats: Stats, now: float) -> None:
        """Take what a service tells before it has metrics; a restart is taken with the first."""
        service.alive, service.heard_s = True, now
        before = service.text.get(INCARNATION)
        service.text = dict(stats.text) | ({INCARNATION: before} if before else {})

    def _observe_namesake(self, service: Service) -> None:
        service.namesakes += 1
        if service.namesakes == 2:  # one may have been on its way when its process ended
            self.observe_log(
                f"two processes of the role {service.role} are named {service.id}: only the newer "
                "one is counted; give each its own --id"
            )

    def observe_episode(self, episode: EpisodeSummary) -> None:
        self.episodes += 1
        self._outcomes.append(episode.outcome is Outcome.SUCCESS)
        self.recent_scores.append(episode.score)
        self.recent_q.append(episode.mean_q)
        successes = self.successes_per_100
        if successes is not None:
            self.max_successes = max(self.max_successes, successes)
            if self.episodes % HISTORY_PERIOD == 0:
                self.success_history.append(successes)

    def observe_evaluation(self, evaluation: Evaluation, now: float) -> EvaluationRecord:
        """Take an evaluation; return it with the progress of collection."""
        record = EvaluationRecord(now, self.env_steps, self.robot_steps, evaluation)
        self.restore_evaluation(record)
        return record

    def restore_evaluation(self, record: EvaluationRecord) -> None:
        """Take an evaluation of earlier records."""
        self.evaluations.append(record)
        self.last_by_robots[record.evaluation.num_robots] = record
        weakest = self._weakest.add(record.evaluation)
        if weakest is not None:
            self.weakest.append(replace(record, evaluation=weakest))

    def observe_presence(self, role: str, service_id: str, alive: bool) -> None:
        """Note that a service's liveliness token appeared or vanished."""
        self._service(role, service_id).alive = alive

    def observe_log(self, line: str) -> None:
        """Keep a warning for the screen, fit to be shown."""
        self.log.append(printable(line))

    def restore_counted(
        self,
        counted: Mapping[str, float],
        by_actor: Mapping[tuple[str, str], float] = MappingProxyType({}),
    ) -> None:
        """Add what the run's actors collected before; other services continue their counters.

        counted: the run's counters, as metrics. by_actor: the part counted by actors that may
        still be up, by actor and counter.
        """
        self._counted.update(by_actor)
        for name in self._collected:
            self._collected[name] += counted.get(name, 0)
        self._before = counted

    def restore_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Add what the run had counted, by the last line of its metrics."""
        names = [name.split("/") for name in metrics if name.startswith("actor/")]
        by_actor = {
            (actor, name): float(metrics[f"actor/{actor}/{name}"])
            for _, actor, name in names
            if name in COUNTERS["actor"]
        }
        self.restore_counted(metrics, by_actor)

    def _service(self, role: str, service_id: str) -> Service:
        """The service of that name; one that is kept nowhere if there are too many."""
        key, new = (role, service_id), Service(role, service_id)
        if len(self._services) >= MAX_SERVICES:
            return self._services.get(key, new)
        return self._services.setdefault(key, new)

    # -- services -----------------------------------------------------------------------

    def knows(self, role: str, service_id: str) -> bool:
        """Whether a service of that name is, or was, up."""
        return (role, service_id) in self._services

    @property
    def by_arrival(self) -> list[Service]:
        """Every service ever seen, in the order in which they came."""
        return list(self._services.values())

    @property
    def services(self) -> list[Service]:
        """Every service ever seen, along the ring, then by id."""
        order = {role: index for index, role in enumerate(ROLES)}
        return sorted(
            self._services.values(), key=lambda s: (order.get(s.role, len(order)), s.role, s.id)
        )

    @property
    def learner(self) -> Service | None:
        """The run's learner: of those that are up the one that came first; None without one."""
        services = self._services.values()
        return next((s for s in services if s.role == "learner" and s.alive), None)

    def alive(self, role: str) -> list[Service]:
        """The services of a role that are up, by id."""
        return [s for s in self.services if s.role == role and s.alive]

    def gauges(self, role: str, name: str) -> list[float]:
        """A metric of every service of a role that is up and reports it."""
        return [s.metrics[name] for s in self.alive(role) if name in s.metrics]

    def _known(self, role: str, name: str) -> float:
        """Sum of a metric over a role's services that are up, else the value last reported.

        A run has one learner, so that of others does not count.
        """
        heard = [s for s in self._services.values() if s.role == role and name in s.metrics]
        up = [s for s in heard if s.alive]
        known = up[:1] if role == "learner" else up
        latest = sorted(heard, key=lambda s: s.heard_s or 0.0)[-1:]
        return sum(s.metrics[name] for s in known or latest)

    # -- counters and rates ---------------------------------------------------------------

    @property
    def env_steps(self) -> int:
        return int(self._collected["env_steps"])

    @property
    def robot_steps(self) -> int:
        return int(self._collected["robot_steps"])

    @property
    def learner_steps(self) -> int:
        return self._continued("learner", "learner_steps")

    @property
    def weights_version(self) -> int:
        return self._continued("learner", "weights_version")

    @property
    def published(self) -> tuple[float, int]:
        """Epoch and version of the last published weights; the epoch rounded, as a metric is."""
        return self._known("learner", "weights_epoch"), self.weights_version

    @property
    def inserts(self) -> int:
        return self._continued("replay", "inserts")

    @property
    def samples(self) -> int:
        return self._continued("replay", "samples")

    def _continued(self, role: str, name: str) -> int:
        """A counter that a service continues; before it reports, as it was in the records."""
        return int(self._known(role, name) or self._before.get(name, 0))

    def per_second(self, name: str, now: float) -> float:
        """Rate of one of COUNTERS over the last seconds, summed over all services."""
        return sum(service.per_second(name, now) for service in self._services.values())

    def mean_shares(self, role: str, schema: type[M]) -> M:
        """Shares (0 ... 1) averaged over the role's services that are up; 0 for other metrics."""
        services = self.alive(role)
        count = max(1, len(services))
        return read(schema, {n: sum(s.share(n) for s in services) / count for n in SHARES[role]})

    def staleness(self, actor: Service) -> tuple[int, float] | None:
        """Versions that an actor's weights are behind the learner's, and their age in seconds."""
        learner = self.learner
        published = {} if learner is None else learner.metrics
        if "weights_version" not in published or "weights_version" not in actor.metrics:
            return None
        behind = max(0, int(published["weights_version"] - actor.metrics["weights_version"]))
        return behind, actor.metrics.get("weights_age_s", 0.0)

    @property
    def max_staleness(self) -> tuple[int, float]:
        """Maximum over all actors, of versions and of seconds separately."""
        known = [s for s in map(self.staleness, self.alive("actor")) if s is not None]
        return max((b for b, _ in known), default=0), max((a for _, a in known), default=0.0)

    @property
    def staleness_spreads(self) -> dict[str, dict[str, Spread]]:
        """Staleness of each actor ever seen, by unit, over its reports of the last ten minutes."""
        return {
            s.id: {unit: spread for unit, each in s.staleness.items() if (spread := each.spread)}
            for s in self.services
            if s.staleness
        }

    # -- replay and exploration -----------------------------------------------------------

    @property
    def replay_size(self) -> int:
        return int(sum(self.gauges("replay", "size")))

    @property
    def replay_capacity(self) -> int:
        return int(sum(self.gauges("replay", "capacity"))) or self.config.replay.capacity

    @property
    def samples_per_insert(self) -> float | None:
        """Transitions sampled for each one inserted, as replay reports; None before it does."""
        reported = self.gauges("replay", "samples_per_insert")
        return sum(reported) / len(reported) if reported else None

    @property
    def epsilons(self) -> tuple[float, float] | None:
        """Smallest and largest epsilon of all actors."""
        low, high = self.gauges("actor", "epsilon_min"), self.gauges("actor", "epsilon_max")
        return (min(low), max(high)) if low and high else None

    # -- scores ---------------------------------------------------------------------------

    @property
    def successes_per_100(self) -> int | None:
        """Successes in the last 100 episodes; None before there are 100."""
        return self.recent_successes[0] if self.episodes >= SUCCESS_WINDOW else None

    @property
    def recent_successes(self) -> tuple[int, int]:
        """Successes and number of the last 100 episodes, or of all if there are fewer."""
        latest = self._outcomes[-SUCCESS_WINDOW:]
        return sum(latest), len(latest)

    @property
    def hundreds(self) -> list[int]:
        """Successes in the first, second, ... 100 episodes (Table 1, Fig. 6b)."""
        size, outcomes = SUCCESS_WINDOW, self._outcomes
        return [sum(outcomes[i - size : i]) for i in range(size, len(outcomes) + 1, size)]

    @property
    def last_evaluation(self) -> EvaluationRecord | None:
        """The latest evaluation, with the number of robots that succeeds least."""
        return self.weakest[-1] if self.weakest else None

    @property
    def best_evaluation(self) -> EvaluationRecord | None:
        """The evaluation with the highest success rate, the first of equal ones.

        Of each version, that with the number of robots that succeeds least.
        """
        return max(self.weakest, key=lambda r: r.evaluation.success_rate, default=None)

    def evaluations_with(self, number: int) -> list[EvaluationRecord]:
        """The evaluations with this number of robots."""
        return [r for r in self.evaluations if r.evaluation.num_robots == number]

    def time_left_s(self, now: float) -> float | None:
        """Time until run.minutes or, at the present rate, run.learner_steps; None if unlimited."""
        run, ends = self.config.run, []
        if run.minutes and self.resumed_at_s is not None:
            ends.append(max(0.0, 60 * run.minutes - (now - self.resumed_at_s)))
        rate = self.per_second("learner_steps", now)
        if run.learner_steps and rate > 0:
            ends.append(max(0.0, (run.learner_steps - self.learner_steps) / rate))
        return min(ends, default=None)
