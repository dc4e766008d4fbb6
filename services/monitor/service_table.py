"""The table of a run's services: one row each, with its key figures.

Invariants: pure; keeps to the number of rows asked for by merging actors into one row.
"""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from mrcdrl.common.messages.metrics import (
    ActorMetrics,
    DiagnosticMetrics,
    EvaluatorMetrics,
    LearnerMetrics,
    ReplayMetrics,
)
from mrcdrl.services.monitor.phase import counted, thousands
from mrcdrl.services.monitor.state import WITHOUT_METRICS, RunState, Service

QUIET_S = 5.0  # a service that reports nothing for this long is shown as silent
ROLE_STYLES = {"actor": "cyan", "replay": "blue", "learner": "magenta", "evaluator": "green"}


def services(state: RunState, now: float, num_rows: int) -> Table:
    """One row a service; actors that do not fit share one."""
    table = Table(box=None, expand=True, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, ratio=1, overflow="ellipsis")
    table.add_column(no_wrap=True, justify="right")
    known = state.services
    actors = [service for service in known if service.role == "actor"]
    shown = len(actors) - max(0, len(known) - num_rows)
    if shown < len(actors):
        shown = max(0, shown - 1)
    for actor in actors[:shown]:
        table.add_row(*_service_row(state, actor, now))
    if shown < len(actors):
        table.add_row(*_actors_row(state, actors[shown:], "more " if shown else "", now))
    for service in known[len(actors) :]:
        table.add_row(*_service_row(state, service, now))
    if not known:
        table.add_row(Text("none yet", style="grey62"), "", "")
    return table


def _service_row(state: RunState, service: Service, now: float) -> tuple[Text, str, Text]:
    named = service.id.startswith(service.role)
    name = service.id if named else f"{service.role} {service.id}"
    style = ROLE_STYLES.get(service.role, "")
    return Text(name, style=style), figures(state, service, now), heard(service, now)


def _actors_row(
    state: RunState, actors: Sequence[Service], more: str, now: float
) -> tuple[Text, str, Text]:
    up = [actor for actor in actors if actor.alive]
    name = Text(f"{len(up)} {more}actors", style=ROLE_STYLES["actor"])
    rate = sum(actor.per_second("robot_steps", now) for actor in up)
    versions, seconds = state.max_staleness
    weights = f"weights: ≤ {versions} behind, ≤ {seconds:.0f} s old"
    lost = len(actors) - len(up)
    presence = Text(f"{lost} lost", style="bold red") if lost else Text("up", "green")
    return name, f"{thousands(rate)} robot steps/s · {weights}", presence


def heard(service: Service, now: float) -> Text:
    """Whether a service is up, and how long it has been silent."""
    silent = service.silent_s(now)
    if not service.alive:
        return Text("lost", style="bold red")
    if service.role in WITHOUT_METRICS:
        return Text("up", "green")
    if service.compiling:
        return Text("compiling", style="yellow")
    if silent == float("inf"):
        return Text("starting", style="yellow")
    return Text(f"silent {silent:.0f} s", "yellow") if silent > QUIET_S else Text("up", "green")


def figures(state: RunState, service: Service, now: float) -> str:
    """A service's key figures in one line; empty before it has any."""
    if service.heard_s is None or (service.compiling and not service.metrics):
        return ""
    match service.role:
        case "actor":
            actor = service.read(ActorMetrics)
            slot = "no slot" if service.slot is None else f"slot {service.slot}"
            rate = thousands(service.per_second("robot_steps", now))
            busy = _percent(
                inference=actor.inference_share,
                arena=actor.arena_share,
                render=actor.draw_share,
                wait=actor.wait_share,
            )
            refused = _refused(actor.weights_refused)
            return f"{slot} · {rate} steps/s{_age(state, service)}{refused} · {busy}"
        case "replay":
            replay = service.read(ReplayMetrics)
            lost = f"{replay.gaps:.0f} gaps, {replay.refused:.0f} refused"
            return f"{replay.bytes / 2**20:,.0f} MiB · {thousands(replay.chunks)} chunks · {lost}"
        case "learner":
            learner, last = service.read(LearnerMetrics), service.read(DiagnosticMetrics)
            busy = _percent(
                step=learner.step_share, wait=learner.data_wait_share, decode=learner.decode_share
            )
            return f"loss {last.loss:.4g} · Q {last.mean_q:.3g} · {busy}"
        case "evaluator":
            evaluator = service.read(EvaluatorMetrics)
            doing = "evaluating" if evaluator.busy else "waiting after"
            done = f"{counted(evaluator.evaluations, 'evaluation')} done"
            refused = _refused(evaluator.weights_refused)
            return f"{doing} v{evaluator.weights_version:.0f} · {done}{refused}"
    return ""


def _age(state: RunState, actor: Service) -> str:
    """Versions that an actor's weights are behind, and their age; empty before they are known."""
    staleness = state.staleness(actor)
    if staleness is None:
        return ""
    behind, seconds = staleness
    return f" · weights: {f'{behind} behind' if behind else 'current'}, {seconds:.0f} s old"


def _refused(weights: float) -> str:
    """How often a service has refused weights; empty for never."""
    return f" · {weights:.0f} weights refused" if weights else ""


def _percent(**shares: float) -> str:
    return " ".join(f"{name} {100 * share:.0f}%" for name, share in shares.items())
