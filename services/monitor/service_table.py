"""The table of who is there: a row a service, with its key figures.

Invariants: pure; never more rows than asked for while actors can share one.
"""

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from mrcdrl.services.monitor.bottleneck import thousands
from mrcdrl.services.monitor.state import WITHOUT_FIGURES, RunState, Service

QUIET_S = 5.0  # after so long without a word a service is shown as silent
ROLE_STYLES = {"actor": "cyan", "replay": "blue", "learner": "magenta", "evaluator": "green"}


def services(state: RunState, now: float, num_rows: int) -> Table:
    """A row a service; actors that do not fit are one row together."""
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
        table.add_row(Text("nobody yet", style="grey62"), "", "")
    return table


def _service_row(state: RunState, service: Service, now: float) -> tuple[Text, str, Text]:
    named = service.id.startswith(service.role)
    name = service.id if named else f"{service.role} {service.id}"
    style = ROLE_STYLES.get(service.role, "")
    return Text(name, style=style), figures(state, service, now), heard(service, now)


def _actors_row(
    state: RunState, actors: Sequence[Service], more: str, now: float
) -> tuple[Text, str, Text]:
    here = [actor for actor in actors if actor.alive]
    name = Text(f"{len(here)} {more}actors", style=ROLE_STYLES["actor"])
    rate = sum(actor.per_second("robot_steps", now) for actor in here)
    versions, seconds = state.max_staleness
    text = f"{thousands(rate)} robot steps/s · ≤ {versions} versions, {seconds:.0f} s behind"
    gone = len(actors) - len(here)
    return name, text, Text(f"{gone} gone", style="bold red") if gone else Text("here", "green")


def heard(service: Service, now: float) -> Text:
    """Whether a service is there."""
    silent = service.silent_s(now)
    if not service.alive:
        return Text("gone", style="bold red")
    if service.role in WITHOUT_FIGURES:
        return Text("here", "green")
    if silent == float("inf"):
        return Text("starting", style="yellow")
    return Text(f"silent {silent:.0f} s", "yellow") if silent > QUIET_S else Text("here", "green")


def figures(state: RunState, service: Service, now: float) -> str:
    """A service's key figures in one line."""
    m = service.metrics
    if service.heard_s is None:
        return ""
    match service.role:
        case "actor":
            behind = state.staleness(service)
            stale = f" · {behind[0]} behind, {behind[1]:.0f} s old" if behind else ""
            busy = _percent(service, ("inference", "arena", "draw", "wait"))
            slot = "no slot" if service.slot is None else f"slot {service.slot}"
            rate = thousands(service.per_second("robot_steps", now))
            return f"{slot} · {rate} steps/s{stale} · {busy}"
        case "replay":
            refused = int(m.get("refused", 0))
            lost = f"{int(m.get('gaps', 0))} gaps, {refused} refused"
            mib = m.get("bytes", 0) / 2**20
            return f"{mib:,.0f} MiB · {thousands(m.get('chunks', 0))} chunks · {lost}"
        case "learner":
            busy = _percent(service, ("step", "data_wait", "decode"))
            return f"loss {m.get('loss', 0):.4g} · Q {m.get('mean_q', 0):.3g} · {busy}"
        case "evaluator":
            doing = "judging" if m.get("busy") else "waiting after"
            done = int(m.get("evaluations", 0))
            return f"{doing} v{int(m.get('weights_version', 0))} · {done} evaluations done"
    return ""


def _percent(service: Service, names: Sequence[str]) -> str:
    shares = ((name.replace("_", " "), service.share(f"{name}_share")) for name in names)
    return " ".join(f"{name} {100 * share:.0f}%" for name, share in shares)
