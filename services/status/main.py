"""`mrcdrl status`: the processes of a live run, its pace, and its bottleneck."""

import json
import math
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from typing import Any

from rich.console import Console

from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.versions import VERSIONED
from mrcdrl.common.sync.joining import Joining, fetch_config, joining_parser
from mrcdrl.common.transport import Session
from mrcdrl.services.monitor.bottleneck import bottleneck
from mrcdrl.services.monitor.display import Show, at_most_every, display
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.recorder import Recorder, flat_metrics
from mrcdrl.services.monitor.records import finite
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.screen import Screen
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule, stopped

_TICK_S = 0.25
_LISTEN_S = 3.0  # every service reports once a second, and two reports make a rate
_JSON_PERIOD_S = 1.0


def main(argv: Sequence[str]) -> int:
    """Show a run, or keep its records; the exit code."""
    arguments = parser().parse_args(argv)
    joining, stop = Joining.from_arguments(arguments), StopSignal().listen()
    with ExitStack() as owned:
        session = owned.enter_context(Session(joining.transport))
        config = fetch_config(session, joining, stop)
        recorder = None
        if arguments.record:
            run = owned.enter_context(RunDirectory.join(joining.run_dir, config))
            recorder = owned.enter_context(Recorder(run.path, config))
            session.announce(joining.keys.live("status", joining.worker))
        state, rule = RunState(config), StoppingRule(config.run)
        follower = Follower(session, joining.keys, state, recorder, rule)
        if not (arguments.watch or arguments.record):
            listen(follower, Heartbeat(None), stop, lambda: None, until_s=_LISTEN_S)
            print_once(state, follower.now, joining.run, arguments.json)
            return 0

        def print_line() -> None:
            print_once(state, follower.now, joining.run, as_json=True)

        showing = (
            nullcontext(at_most_every(_JSON_PERIOD_S, lambda: follower.now, print_line))
            if arguments.json
            else display(state, joining.run, lambda: follower.now)
        )
        # Only a recorder is a service: status run in its container must not beat for it.
        heartbeat = Heartbeat.from_environment() if arguments.record else Heartbeat(None)
        with showing as show:
            listen(follower, heartbeat, stop, show)
        if recorder is not None:
            recorder.write_summary(state, follower.now, stopped(stop.cause))
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = joining_parser("status", "Show what a live run does, and its bottleneck.")
    made.add_argument("--watch", action="store_true", help="keep showing it until stopped")
    made.add_argument("--json", action="store_true", help="as JSON, one object a line")
    made.add_argument(
        "--record",
        action="store_true",
        help="keep the records that `mrcdrl train` would, until stopped",
    )
    return made


def listen(
    follower: Follower,
    heartbeat: Heartbeat,
    stop: StopSignal,
    show: Show,
    until_s: float = math.inf,
) -> None:
    """Follow the run and show it until stopped, or for `until_s` seconds."""
    beat_s = 0.0
    while not stop.is_set() and follower.lived_s < until_s:
        if follower.listen(_TICK_S):
            heartbeat.worked()
        show()
        if follower.lived_s >= beat_s:
            beat_s = follower.lived_s + 1.0
            heartbeat.beat()


def print_once(state: RunState, now: float, run: str, as_json: bool) -> None:
    """Print the screen, or the JSON, of this moment."""
    console = Console()
    if as_json:
        console.out(json.dumps(status(state, now)), highlight=False)
    else:
        console.print(Screen(state, now, run), height=console.height - 1)


def status(state: RunState, now: float) -> dict[str, Any]:
    """The processes, the bottleneck, and all that metrics.jsonl records of a second."""
    last = state.last_evaluation
    figures = flat_metrics(state, now).items()
    values = {
        "limited_by": bottleneck(state).replace("\N{NO-BREAK SPACE}", " "),
        "services": [
            {
                "role": s.role,
                "id": s.id,
                "alive": s.alive,
                "silent_s": round(s.silent_s(now), 6),
                "slot": s.slot,
                "versions": {name: s.text[name] for name in VERSIONED if name in s.text},
            }
            for s in state.services
        ],
        "replay_size": state.replay_size,
        "replay_capacity": state.replay_capacity,
        "success_rate": last.evaluation.success_rate if last else None,
        "evaluated_version": last.evaluation.weights_version if last else None,
        **{name: None if value is None else round(value, 6) for name, value in figures},
    }
    return {name: finite(value) for name, value in values.items()}
