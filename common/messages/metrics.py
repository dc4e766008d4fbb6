"""The metrics that each role publishes about itself: one schema for services, watchers and docs.

Invariants: a field's name is the metric's name on the wire and in a run's records; its annotation
says of what kind it is; a field that is None is not sent.

A new metric is a field here, an argument where the service makes the object, and a row in
docs/metrics.md, in the same order: ActorMetrics are made in services/actor/actor.py, ReplayMetrics
in services/replay/service.py, LearnerMetrics in services/learner/timing.py, DiagnosticMetrics in
services/learner/diagnostics.py, EvaluatorMetrics in services/evaluator/evaluator.py.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_type_hints

from mrcdrl.common.config.schema import MOST_ROBOTS

Kind = Literal["counter", "pace", "share", "gauge", "histogram"]
Counter = Annotated[float, "counter"]  # rises while the process lives
Pace = Annotated[float, "pace"]  # a counter whose rate is shown and recorded
Share = Annotated[float, "share"]  # of the time since the start, or a flag: watchers average it
Gauge = Annotated[float, "gauge"]  # as it is now
NUM_BINS = 10
Bins = Annotated[tuple[float, ...], "histogram"]  # share of each, sent as NAME_0 …; or ()
ByRobots = Annotated[Mapping[int, float] | None, "gauge"]  # by number of robots, sent as NAME_1 …


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorMetrics:
    """An actor, about itself."""

    env_steps: Pace  # over all arenas; one step moves all robots of an arena
    robot_steps: Pace  # transitions made
    episodes: Counter  # finished
    chunks: Counter  # acknowledged by replay
    inserts_acknowledged: Counter  # transitions in these chunks
    spool_chunks: Gauge  # chunks waiting to be sent
    weights_version: Gauge  # of the policy; -1 before the first
    weights_age_s: Gauge  # since they were adopted
    weights_refused: Counter  # messages that broke the schema or did not fit the network
    slot: Gauge  # of exploration, leased to it; -1 for none
    epsilon_min: Gauge  # over its arenas
    epsilon_max: Gauge  # over its arenas
    inference_share: Share  # choosing actions
    arena_share: Share  # physics, rewards and records
    draw_share: Share  # rendering images of records, and starting episodes
    chunk_share: Share  # cutting chunks and summing returns
    wait_share: Share  # waiting for room in the spool
    success_by_robots: ByRobots = None  # of its latest episodes, where numbers differ
    share_by_robots: ByRobots = None  # of the transitions that it is to make with each number


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayMetrics:
    """A replay shard, about itself; transitions unless said otherwise."""

    size: Gauge  # in the table
    capacity: Gauge  # of the table
    min_size: Gauge  # inserted before the first sample is given
    inserts: Pace  # accepted since the run began
    samples: Pace  # handed out since the run began
    samples_per_insert: Gauge  # counted from min_size on
    bytes: Gauge  # memory of the table
    chunks: Counter  # stored
    duplicates: Counter  # chunks that were acknowledged without being stored again
    gaps: Counter  # chunks whose sequence number skipped some
    refused: Counter  # requests, and chunks of the log, that broke the schema or did not fit
    log_errors: Counter  # inserts throttled because the log could not be written
    priority_updates: Counter  # transitions whose priority a learner has set
    priorities_ignored: Counter  # transitions evicted before their new priority came
    insert_held: Share  # flag: the rate limiter throttles an insert
    sample_held: Share  # flag: the rate limiter, or a table not yet filled, throttles a sample


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticMetrics:
    """What the learner's last batch shows; rewards are scaled."""

    loss: Gauge  # of the last step
    mean_q: Gauge  # mean over the batch of the greatest action value
    td_error_mean: Gauge  # of absolute TD errors, as the percentiles below
    gradient_norm: Gauge  # before clipping
    loss_finite: Gauge  # flag: the loss is a number
    q_min: Gauge  # over all actions of at most 64 states, as the two below
    q_p50: Gauge
    q_max: Gauge
    td_error_p50: Gauge
    td_error_p90: Gauge
    td_error_p99: Gauge
    dead_share: Gauge  # of hidden units that are 0 for all these states
    target_drift: Gauge  # distance of the online from the target parameters, relative
    q_bin: Bins = ()  # of action values; sent now and then
    td_error_bin: Bins = ()  # of absolute TD errors; sent with q_bin


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnerMetrics:
    """The learner, about itself."""

    learner_steps: Pace  # of the run, over restarts
    weights_version: Gauge  # last published
    weights_epoch: Gauge  # of the weights; rounded, as a float64
    batches_ready: Gauge  # decoded, waiting for the step
    batches_refused: Counter  # from replay, that broke the schema
    priorities_dropped: Counter  # batches whose new priorities replay did not get
    decode_share: Share  # rendering and stacking batches, in a thread beside the others
    data_wait_share: Share  # without a batch
    step_share: Share  # target, loss, gradient and optimizer
    publish_share: Share  # serialising and publishing weights
    checkpoint_share: Share  # writing checkpoints
    diagnostics: DiagnosticMetrics | None = None  # None before the first step


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluatorMetrics:
    """An evaluator, about itself."""

    evaluations: Counter  # finished since the process started
    weights_version: Gauge  # being evaluated, or evaluated last; -1 before the first
    weights_refused: Counter  # messages that broke the schema or did not fit the network
    busy: Gauge  # flag: evaluating now


Metrics = ActorMetrics | ReplayMetrics | LearnerMetrics | EvaluatorMetrics
SCHEMAS: dict[str, type[Metrics]] = {
    "actor": ActorMetrics,
    "learner": LearnerMetrics,
    "replay": ReplayMetrics,
    "evaluator": EvaluatorMetrics,
}
M = TypeVar("M", bound=Metrics | DiagnosticMetrics)


def kinds(schema: type) -> dict[str, Kind]:
    """The kind of every metric of a schema, by name, in the order in which they are sent."""
    found: dict[str, Kind] = {}
    for name, hint in get_type_hints(schema, include_extras=True).items():
        nested = next(filter(is_dataclass, get_args(hint)), None)
        if isinstance(nested, type):
            found |= kinds(nested)
        elif hint == Bins:
            found |= {f"{name}_{i}": "histogram" for i in range(NUM_BINS)}
        elif hint == ByRobots:
            found |= {f"{name}_{number}": "gauge" for number in range(1, MOST_ROBOTS + 1)}
        else:
            found[name] = hint.__metadata__[0]
    return found


def of_kind(kind: Kind) -> dict[str, tuple[str, ...]]:
    """Names of the metrics of that kind, by role."""
    return {
        role: tuple(name for name, its in kinds(schema).items() if its == kind)
        for role, schema in SCHEMAS.items()
    }


def numbers(metrics: Metrics | DiagnosticMetrics) -> dict[str, float]:
    """The metrics by name, as they are sent."""
    found: dict[str, float] = {}
    for field in fields(metrics):
        value = getattr(metrics, field.name)
        if isinstance(value, DiagnosticMetrics):
            found |= numbers(value)
        elif isinstance(value, tuple):
            found |= {f"{field.name}_{i}": share for i, share in enumerate(value)}
        elif isinstance(value, Mapping):
            found |= {f"{field.name}_{number}": item for number, item in value.items()}
        elif value is not None:
            found[field.name] = float(value)
    return found


def read(schema: type[M], by_name: Mapping[str, float]) -> M:
    """Received metrics as a schema; 0 for each that is missing."""
    required = [field.name for field in fields(schema) if field.default is MISSING]
    values: dict[str, Any] = {name: by_name.get(name, 0.0) for name in required}
    return schema(**values)
