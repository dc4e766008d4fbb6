"""The phase of a run, as tables of what its processes report."""

import json
from collections.abc import Callable

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.messages.trajectory import COMPILING, DOING, Stats
from mrcdrl.services.monitor.phase import Phase, progress
from mrcdrl.services.monitor.screen import plain_line
from mrcdrl.services.monitor.service_table import figures, heard
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.status import status

CONFIG = load_config("quick", {"replay.min_size": "5000"}, {})
BUSY = {DOING: COMPILING}
Change = Callable[[RunState], None]


def says(role: str, name: str, text: dict[str, str] | None = None, **metrics: float) -> Change:
    return lambda state: state.observe_stats(Stats(role, name, metrics, text or {}), 1.0)


def leaves(role: str, name: str) -> Change:
    return lambda state: state.observe_presence(role, name, alive=False)


EMPTY, FULL = says("replay", "r", size=0.0), says("replay", "r", size=5_000.0)
ACTOR, LEARNER = says("actor", "a"), says("learner", "l")
UP = (FULL, ACTOR, LEARNER)
RANDOM = says("actor", "a", epsilon_min=0.63, epsilon_max=0.63)
SKILLED = says("actor", "a", epsilon_min=0.02, epsilon_max=0.31)


@pytest.mark.parametrize(
    ("changes", "phase", "words"),
    [
        ((), Phase.STARTING, "starting, waiting for replay to start"),
        ((EMPTY, LEARNER), Phase.STARTING, "starting, waiting for an actor to start"),
        (
            (EMPTY, LEARNER, says("actor", "a", BUSY)),
            Phase.COMPILING,
            "compiling, waiting for a to compile functions, once",
        ),
        (
            (EMPTY, LEARNER, says("actor", "a", BUSY), says("actor", "b", BUSY)),
            Phase.COMPILING,
            "compiling, waiting for a and 1 more to compile functions, once",
        ),
        (
            (EMPTY, LEARNER, says("actor", "a", BUSY), says("actor", "b")),
            Phase.FILLING,
            "filling, waiting for replay to fill (0 of 5 000)",
        ),
        (
            (EMPTY, LEARNER, says("actor", "a", BUSY), ACTOR),
            Phase.FILLING,
            "filling, waiting for replay to fill (0 of 5 000)",
        ),
        (
            (FULL, ACTOR, says("learner", "l", BUSY)),
            Phase.COMPILING,
            "compiling, waiting for l to compile functions, once",
        ),
        ((*UP, says("evaluator", "e", BUSY), RANDOM), Phase.EXPLORING, None),
        ((*UP, RANDOM), Phase.EXPLORING, "exploring, 63% of the actions are random"),
        ((*UP, SKILLED), Phase.LEARNING, "learning"),
        (
            (*UP, SKILLED, says("evaluator", "e", busy=1.0, weights_version=12.0)),
            Phase.LEARNING,
            "learning · evaluating v12",
        ),
        (
            (*UP, SKILLED, says("evaluator", "e", busy=0.0, weights_version=12.0)),
            Phase.LEARNING,
            "learning",
        ),
        (
            (*UP, SKILLED, leaves("learner", "l")),
            Phase.STARTING,
            "starting, waiting for the learner to return",
        ),
        (
            (*UP, SKILLED, leaves("actor", "a"), leaves("learner", "l")),
            Phase.ENDING,
            "ending, its actors and its learner have left",
        ),
    ],
)
def test_the_phase_is_told(changes: tuple[Change, ...], phase: Phase, words: str | None) -> None:
    state = RunState(CONFIG)
    for change in changes:
        change(state)
    now = progress(state)
    said = str(now).replace("\N{NO-BREAK SPACE}", " ")
    assert now.phase is phase
    assert words is None or said == words
    assert f"  {said}  " in plain_line(state, 1.0)
    told = json.loads(json.dumps(status(state, 1.0)))
    assert told["phase"] == phase.value
    assert told["evaluating_version"] == now.evaluating


def test_a_run_that_ends_says_why() -> None:
    state = RunState(CONFIG)
    for change in (*UP, SKILLED):
        change(state)
    state.ending = "stopped (Ctrl-C)"
    assert str(progress(state)) == "ending, stopped (Ctrl-C)"


def test_a_service_that_compiles_is_not_called_silent() -> None:
    state = RunState(CONFIG)
    says("actor", "a", BUSY)(state)
    (actor,) = state.services
    assert str(heard(actor, 60.0)) == "compiling"
    assert figures(state, actor, 60.0) == ""
    assert status(state, 60.0)["services"][0]["compiling"]
    says("actor", "a")(state)
    assert str(heard(actor, 2.0)) == "up"
