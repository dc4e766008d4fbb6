"""The metrics that each role publishes about itself: one schema for services, watchers and docs.

Invariants: a field's name is the metric's name on the wire and in a run's records; its annotation
says of what kind it is, its unit and meaning; a field that is None is not sent.

A new metric is a field here, and an argument where the service makes the object: ActorMetrics are
made in services/actor/actor.py, ReplayMetrics in services/replay/service.py, LearnerMetrics in
services/learner/timing.py, DiagnosticMetrics in services/learner/diagnostics.py, EvaluatorMetrics
in services/evaluator/evaluator.py. `python docs/generate.py` then writes its row of
docs/metrics.md.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args, get_type_hints

from mrcdrl.common.config.schema import MOST_ROBOTS

Kind = Literal["counter", "pace", "share", "gauge", "histogram"]


@dataclass(frozen=True, slots=True)
class Meaning:
    """The kind of a metric, its unit, and what it is of.

    kind: a `counter` rises while the process lives; a `pace` is a counter whose rate is shown and
    recorded; a `share` is of the time since the start, or a flag: watchers average it; a `gauge`
    is as it is now; a `histogram` is the share of a bin.
    exposed: its name for Prometheus, where that is not made of the field's.
    items: what each item of a field with several is, by the end of its name.
    """

    kind: Kind
    unit: str
    text: str
    exposed: str = ""
    label: str = ""  # what tells the items of a field apart
    items: tuple[tuple[str, str], ...] = ()


def counter(unit: str, text: str) -> Meaning:
    """A number that rises while the process lives."""
    return Meaning("counter", unit, text)


def pace(unit: str, text: str) -> Meaning:
    """A counter whose rate is shown and recorded."""
    return Meaning("pace", unit, text)


def share(text: str) -> Meaning:
    """A share of the time since the start."""
    return Meaning("share", "share", text)


def held(text: str) -> Meaning:
    """A flag that watchers average."""
    return Meaning("share", "0 or 1", text)


def gauge(unit: str, text: str, exposed: str = "") -> Meaning:
    """A number as it is now."""
    return Meaning("gauge", unit, text, exposed)


def flag(text: str) -> Meaning:
    """A gauge that is 0 or 1."""
    return gauge("0 or 1", text)


def part(text: str) -> Meaning:
    """A gauge between 0 and 1 that is a share of something else than time."""
    return gauge("share", text)


def bins(text: str, *ranges: str) -> Meaning:
    """A histogram; ranges: what each bin covers."""
    items = tuple((str(i), covered) for i, covered in enumerate(ranges))
    return Meaning("histogram", "share", text, label="bin", items=items)


def by_robots(unit: str, text: str, note: str = "") -> Meaning:
    """A gauge for each number of robots."""
    items = tuple(
        (str(n), f"{text} with {n} robot{'s' if n > 1 else ''}{note}")
        for n in range(1, MOST_ROBOTS + 1)
    )
    return Meaning("gauge", unit, f"{text} with this number of robots{note}", "", "robots", items)


NUM_BINS = 10
# Edges between bins, in units of R, the most that an episode can bring in scaled rewards.
Q_EDGES = tuple(i / 4 for i in range(-4, 5))
TD_ERROR_EDGES = tuple(10 ** (i / 2) for i in range(-8, 1))
Bins = tuple[float, ...]  # share of each, sent as NAME_0 …; or ()
ByRobots = Mapping[int, float] | None  # by number of robots, sent as NAME_1 …


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorMetrics:
    """An actor, about itself."""

    env_steps: Annotated[
        float, pace("steps", "over all arenas of this actor; one step moves all robots of an arena")
    ]
    robot_steps: Annotated[
        float, pace("transitions", "made, one for each robot that is there and each step")
    ]
    episodes: Annotated[float, counter("episodes", "finished")]
    chunks: Annotated[float, counter("chunks", "acknowledged by replay")]
    inserts_acknowledged: Annotated[
        float, counter("transitions", "in chunks that replay has acknowledged")
    ]
    spool_chunks: Annotated[
        float, gauge("chunks", "waiting to be sent, at most `actor.spool_chunks`")
    ]
    weights_version: Annotated[float, gauge("", "of the policy; −1 before the first")]
    weights_age_s: Annotated[float, gauge("s", "since they were adopted")]
    weights_refused: Annotated[
        float, counter("messages", "of weights that broke the schema or did not fit the network")
    ]
    slot: Annotated[
        float,
        gauge(
            "",
            "of exploration, leased to it; −1 for none: it then explores over the whole "
            "epsilon schedule",
        ),
    ]
    epsilon_min: Annotated[float, gauge("", "smallest epsilon of its arenas")]
    epsilon_max: Annotated[float, gauge("", "largest epsilon of its arenas")]
    inference_share: Annotated[float, share("choosing actions")]
    arena_share: Annotated[float, share("physics, rewards and records")]
    draw_share: Annotated[float, share("rendering images of records, and starting episodes")]
    chunk_share: Annotated[float, share("cutting chunks and summing returns")]
    wait_share: Annotated[
        float, share("waiting for room in the spool: replay or its rate limiter is behind")
    ]
    success_by_robots: Annotated[
        ByRobots, by_robots("0 … 1", "success of its latest training episodes")
    ] = None
    share_by_robots: Annotated[
        ByRobots,
        by_robots("share", "of the transitions that it is to make", ", by `[curriculum]`"),
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayMetrics:
    """A replay shard, about itself; transitions unless said otherwise."""

    size: Annotated[float, gauge("transitions", "in the table", exposed="transitions")]
    capacity: Annotated[float, gauge("transitions", "that the table can hold")]
    min_size: Annotated[float, gauge("transitions", "inserted before the first sample is given")]
    inserts: Annotated[
        float,
        pace("transitions", "accepted since the run began; without a log, since replay started"),
    ]
    samples: Annotated[
        float,
        pace(
            "transitions",
            "handed out since the run began; a kill loses those since the last snapshot "
            "(`replay.snapshot_period_s`) or, without a log, all before it",
        ),
    ]
    samples_per_insert: Annotated[
        float, gauge("", "samples for each insert, counted from `min_size` on")
    ]
    bytes: Annotated[float, gauge("bytes", "memory of the table", exposed="table_bytes")]
    chunks: Annotated[float, counter("chunks", "stored")]
    duplicates: Annotated[
        float, counter("chunks", "that were stored before and are only acknowledged")
    ]
    gaps: Annotated[
        float,
        counter(
            "chunks",
            "whose sequence number skipped earlier ones of the same actor, or that came "
            "first with a number above 0",
        ),
    ]
    refused: Annotated[
        float,
        counter(
            "requests",
            "that were too large, broke the schema or did not fit the table; chunks of the log too",
        ),
    ]
    log_errors: Annotated[
        float, counter("inserts", "throttled because the log could not be written")
    ]
    priority_updates: Annotated[float, counter("transitions", "whose priority a learner has set")]
    priorities_ignored: Annotated[
        float,
        counter(
            "transitions",
            "evicted before their new priority came; all with `replay.sampler` = `uniform`",
        ),
    ]
    insert_held: Annotated[float, held("the rate limiter throttles an insert now")]
    sample_held: Annotated[
        float, held("the rate limiter, or a table not yet filled, throttles a sample now")
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticMetrics:
    """What the learner's last batch shows; rewards are scaled."""

    loss: Annotated[float, gauge("", "of the last step; rewards scaled")]
    mean_q: Annotated[float, gauge("", "mean over the last batch of the greatest action value")]
    td_error_mean: Annotated[
        float, gauge("", "mean over the last batch of the absolute TD error; rewards scaled")
    ]
    gradient_norm: Annotated[float, gauge("", "of the last step, before clipping")]
    loss_finite: Annotated[
        float, flag("the last loss is a number; if not, the learner ends at the next publication")
    ]
    q_min: Annotated[
        float, gauge("", "smallest value of any action in the last batch, over at most 64 states")
    ]
    q_p50: Annotated[
        float,
        gauge("", "median of the values of all actions in the last batch, over at most 64 states"),
    ]
    q_max: Annotated[
        float,
        gauge(
            "",
            "largest value of any action in the last batch, over at most 64 states; a "
            "warning is logged if it exceeds twice what an episode can bring",
        ),
    ]
    td_error_p50: Annotated[
        float, gauge("", "median over the last batch of the absolute TD error; rewards scaled")
    ]
    td_error_p90: Annotated[
        float,
        gauge("", "90th percentile over the last batch of the absolute TD error; rewards scaled"),
    ]
    td_error_p99: Annotated[
        float,
        gauge("", "99th percentile over the last batch of the absolute TD error; rewards scaled"),
    ]
    dead_share: Annotated[
        float,
        part(
            "of hidden units (channels, in a convolution) that are 0 for all states of the "
            "batch that were looked at; a warning above 0.9"
        ),
    ]
    target_drift: Annotated[
        float,
        gauge(
            "",
            "distance of the online parameters from the target network's, relative to the "
            "target's norm",
        ),
    ]
    q_bin: Annotated[
        Bins,
        bins(
            "of the values of all actions, by range; sent every 15 s",
            "of these values below −R; R is the most that an episode can bring, in scaled rewards",
            "from −R to −3/4 R",
            "from −3/4 R to −1/2 R",
            "from −1/2 R to −1/4 R",
            "from −1/4 R to 0",
            "from 0 to 1/4 R",
            "from 1/4 R to 1/2 R",
            "from 1/2 R to 3/4 R",
            "from 3/4 R to R",
            "from R on",
        ),
    ] = ()
    td_error_bin: Annotated[
        Bins,
        bins(
            "of the absolute TD errors, by range; sent with `q_bin`",
            "of the absolute TD errors below R/10⁴",
            "from R/10⁴ to R/3162",
            "from R/3162 to R/1000",
            "from R/1000 to R/316",
            "from R/316 to R/100",
            "from R/100 to R/31.6",
            "from R/31.6 to R/10",
            "from R/10 to R/3.16",
            "from R/3.16 to R",
            "from R on",
        ),
    ] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnerMetrics:
    """The learner, about itself."""

    learner_steps: Annotated[float, pace("steps", "of this run, over restarts")]
    weights_version: Annotated[float, gauge("", "last published")]
    weights_epoch: Annotated[float, gauge("", "of the weights; rounded, as a float64")]
    batches_ready: Annotated[float, gauge("batches", "decoded, waiting for the step")]
    batches_refused: Annotated[float, counter("batches", "from replay that broke the schema")]
    priorities_dropped: Annotated[
        float,
        counter(
            "batches",
            "whose new priorities replay did not get: it was unreachable, or slower than "
            "the learner",
        ),
    ]
    decode_share: Annotated[
        float, share("rendering and stacking batches, in a thread beside the others")
    ]
    data_wait_share: Annotated[float, share("without a batch")]
    step_share: Annotated[
        float,
        share("target, loss, gradient and optimizer; on a GPU until the previous launch is done"),
    ]
    publish_share: Annotated[float, share("serialising and publishing weights")]
    checkpoint_share: Annotated[float, share("writing checkpoints")]
    diagnostics: DiagnosticMetrics | None = None  # None before the first step


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluatorMetrics:
    """An evaluator, about itself."""

    evaluations: Annotated[float, counter("", "finished since the process started")]
    weights_version: Annotated[
        float, gauge("", "being evaluated, or evaluated last; −1 before the first")
    ]
    weights_refused: Annotated[
        float, counter("messages", "of weights that broke the schema or did not fit the network")
    ]
    busy: Annotated[float, flag("evaluating now")]


Metrics = ActorMetrics | ReplayMetrics | LearnerMetrics | EvaluatorMetrics
SCHEMAS: dict[str, type[Metrics]] = {
    "actor": ActorMetrics,
    "learner": LearnerMetrics,
    "replay": ReplayMetrics,
    "evaluator": EvaluatorMetrics,
}
M = TypeVar("M", bound=Metrics | DiagnosticMetrics)


@dataclass(frozen=True, slots=True)
class Definition:
    """A metric of a schema, as it is sent.

    field: the name in the schema. item: which of the field's items it is; empty if it has none.
    """

    name: str
    field: str
    item: str
    text: str
    meaning: Meaning


def definitions(schema: type) -> Iterator[Definition]:
    """Every metric of a schema, in the order in which they are sent."""
    for name, hint in get_type_hints(schema, include_extras=True).items():
        nested = next(filter(is_dataclass, get_args(hint)), None)
        if isinstance(nested, type):
            yield from definitions(nested)
            continue
        (meaning,) = hint.__metadata__
        for item, text in meaning.items or (("", meaning.text),):
            yield Definition(f"{name}_{item}" if item else name, name, item, text, meaning)


def kinds(schema: type) -> dict[str, Kind]:
    """The kind of every metric of a schema, by name, in the order in which they are sent."""
    return {each.name: each.meaning.kind for each in definitions(schema)}


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
