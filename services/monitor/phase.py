"""The phase of a run: what its processes are doing together, and what it waits for.

Invariants: pure; told alike by the screen, the plain lines and `mrcdrl status`.
"""

from dataclasses import dataclass
from enum import StrEnum

from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.messages.metrics import EvaluatorMetrics
from mrcdrl.services.monitor.state import RunState

NEEDED = {"replay": "replay", "actor": "an actor", "learner": "the learner"}
_MOSTLY_RANDOM = 0.5  # epsilon from which a run explores rather than learns


class Phase(StrEnum):
    """The phases, in their order."""

    STARTING = "starting"
    COMPILING = "compiling"
    FILLING = "filling"
    EXPLORING = "exploring"
    LEARNING = "learning"
    ENDING = "ending"


@dataclass(frozen=True, slots=True)
class Progress:
    """The phase of a run now."""

    phase: Phase
    waiting_for: str = ""  # what has to happen before the ring turns; empty if it turns
    detail: str = ""
    evaluating: int | None = None  # the version of weights that an evaluator tests meanwhile

    def __str__(self) -> str:
        words = self.waiting_for or self.detail
        said = f"{self.phase}{', ' if words else ''}{words}"
        return said if self.evaluating is None else f"{said} · evaluating v{self.evaluating}"


def thousands(number: float) -> str:
    """5000 as "5 000", with no-break spaces."""
    return f"{number:,.0f}".replace(",", "\N{NO-BREAK SPACE}")


def counted(number: float, noun: str) -> str:
    """1 as "1 actor", 2 as "2 actors"."""
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"


def progress(state: RunState) -> Progress:
    """The phase, derived from who is up, how full replay is, and epsilon."""
    if state.ending:
        return Progress(Phase.ENDING, detail=state.ending)
    seen = {service.role for service in state.services}
    if {"actor", "learner"} <= seen and not state.alive("actor") and not state.alive("learner"):
        return Progress(Phase.ENDING, "its actors and its learner have left")
    if role := next((role for role in NEEDED if not state.alive(role)), None):
        came = "to return" if role in seen else "to start"
        return Progress(Phase.STARTING, f"waiting for {NEEDED[role]} {came}")
    if compiling := _compiling(state):
        return Progress(Phase.COMPILING, f"waiting for {compiling} to compile functions, once")
    size, needed = state.replay_size, state.config.replay.min_size
    if size < needed:
        numbers = f"{thousands(size)} of {thousands(needed)}"
        return Progress(Phase.FILLING, f"waiting for replay to fill ({numbers})")
    return _turning(state)


def _compiling(state: RunState) -> str:
    """The services that compile, if the ring waits for them; else empty."""
    for role in NEEDED:
        services = state.alive(role)
        if all(service.compiling for service in services):
            others = len(services) - 1
            return services[0].id + (f" and {others} more" if others else "")
    return ""


def _turning(state: RunState) -> Progress:
    """The phase while actors collect and the learner learns."""
    schedule = state.config.exploration.schedule
    epsilons = state.epsilons
    epsilon = epsilons[0] if epsilons else value_at(schedule, state.learner_steps)
    busy = [s.read(EvaluatorMetrics) for s in state.alive("evaluator")]
    version = max((int(each.weights_version) for each in busy if each.busy), default=None)
    if epsilon < _MOSTLY_RANDOM:
        return Progress(Phase.LEARNING, evaluating=version)
    detail = f"{epsilon:.0%} of the actions are random"
    return Progress(Phase.EXPLORING, detail=detail, evaluating=version)
