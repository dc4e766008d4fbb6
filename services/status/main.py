"""`mrcdrl status`: the processes of a live run, its pace, and its bottleneck."""

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from mrcdrl.common.config import Config
from mrcdrl.common.config.arguments import Parser, add_config_flags
from mrcdrl.common.errors import DeadlineError, UnreachableError
from mrcdrl.common.runtime.files import METRICS
from mrcdrl.common.runtime.heartbeat import Heartbeat
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import LATEST, is_run, run_path
from mrcdrl.common.sync.joining import Joining, fetch_config, joining_parser
from mrcdrl.common.transport import Session
from mrcdrl.services.monitor.display import Show, at_most_every, display
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.prometheus import serve_run
from mrcdrl.services.monitor.recall import recall
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.records import read_last_metrics
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.monitor.screen import Screen, clock
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.status import status
from mrcdrl.services.monitor.stopping import StoppingRule, stopped
from mrcdrl.services.monitor.watching import Watching

_TICK_S = 0.25
_LISTEN_S = 3.0  # every service reports once a second, and two reports make a rate
_JSON_PERIOD_S = 1.0
_WAIT_S = 30.0  # of a watcher or recorder, for the run to come up
_RETRY_S = 0.2
_KEYS = "Ctrl-C ends this view; the run goes on"


def main(argv: Sequence[str]) -> int:
    """Show a run, or keep its records; the exit code."""
    arguments = parser().parse_args(argv)
    stop = StopSignal().listen()
    with ExitStack() as owned:
        joining, session, config = join(arguments, stop, owned)
        state, rule = RunState(config), StoppingRule(config.run, config.arena.numbers)
        recorder, lasted_s = None, 0.0
        if arguments.record:
            run = owned.enter_context(RunDirectory.join(joining.run_dir, config))
            recorder = owned.enter_context(Recorder(run.path, config))
            session.announce(joining.keys.live("status", joining.worker))
        else:
            lasted_s = recall(joining.run_dir, state, rule)
        follower = Follower(session, joining.keys, state, recorder, rule, lasted_s)
        if arguments.watch or arguments.record:
            owned.enter_context(
                serve_run(joining.transport, follower, state, joining.run_dir, "status")
            )
        if not (arguments.watch or arguments.record):
            listen(follower, Heartbeat(None), stop, lambda: None, until_s=_LISTEN_S)
            print_once(state, follower.now, joining.run_dir, arguments.json)
            return 0

        def print_line() -> None:
            print_once(state, follower.now, joining.run_dir, as_json=True)

        lines = at_most_every(_JSON_PERIOD_S, lambda: follower.now, print_line)
        # Who only shows has nothing left to do once nobody reads it; a recorder goes on.
        watching = Watching(passes=() if recorder else (OSError,))
        showing = display(
            state,
            joining.run_dir,
            _KEYS,
            lambda: follower.now,
            watching,
            lines if arguments.json else None,
        )
        # Only a recorder is a service: status run in its container must not beat for it.
        heartbeat = Heartbeat.from_environment() if arguments.record else Heartbeat(None)
        with showing as show:
            listen(follower, heartbeat, stop, show)
        if recorder is not None:
            recorder.write_summary(state, follower.now, stopped(stop.cause))
    return 0


def join(
    arguments: argparse.Namespace, stop: StopSignal, owned: ExitStack
) -> tuple[Joining, Session, Config]:
    """Join the run; who watches or records waits for it to come up, and says so at once.

    Raises UnreachableError, with what the run directory knows, if the run is not up.
    """
    if not (arguments.run or arguments.connect or arguments.record):
        arguments.run = LATEST
    wait_s = _WAIT_S if arguments.watch or arguments.record else 0.0
    deadline, told = time.monotonic() + wait_s, False
    while True:
        try:
            return _join_now(arguments, stop, owned)
        except UnreachableError as error:
            if time.monotonic() >= deadline or stop.wait(_RETRY_S):
                raise
            if not told:
                sys.stderr.write(f"mrcdrl: {error}; waiting up to {wait_s:.0f} s for it\n")
                told = True


def _join_now(
    arguments: argparse.Namespace, stop: StopSignal, owned: ExitStack
) -> tuple[Joining, Session, Config]:
    with ExitStack() as opened:
        try:
            joining = Joining.from_arguments(arguments)
            session = opened.enter_context(Session(joining.transport, open_timeout_s=0.0))
            config = fetch_config(session, joining, stop, 0.0)
        except (UnreachableError, DeadlineError) as error:
            run_dir = run_path(arguments.run, arguments.run_dir)
            if not (is_run(run_dir) or arguments.connect):
                raise
            why = str(error).partition(";")[0]
            raise UnreachableError(
                f"run {run_dir.name} is not up: {why}; {last_seen(run_dir)}"
            ) from error
        owned.push(opened.pop_all())
        return joining, session, config


def last_seen(run_dir: Path) -> str:
    """When the run last recorded something, as far as this machine knows."""
    try:
        at_s = (run_dir / METRICS).stat().st_mtime
        lasted_s = float(read_last_metrics(run_dir)["time_s"])
    except (OSError, KeyError):
        return f"{run_dir} has no records of it; give --connect if it runs elsewhere"
    at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at_s))
    return f"last seen {at}, {clock(lasted_s)} after it began"


def parser() -> Parser:
    """The command's flags."""
    made = joining_parser(
        "status", "Show what a live run does, and its bottleneck; without RUN, the latest."
    )
    made.add_argument("--watch", action="store_true", help="keep showing it until stopped")
    made.add_argument("--json", action="store_true", help="print JSON, one object a line")
    made.add_argument(
        "--record",
        action="store_true",
        help="keep the records that `mrcdrl train` would, until stopped",
    )
    add_config_flags(made)
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


def print_once(state: RunState, now: float, run_dir: Path, as_json: bool) -> None:
    """Print the screen, or the JSON, of this moment."""
    if as_json:
        sys.stdout.write(f"{json.dumps(status(state, now))}\n")
        sys.stdout.flush()
    else:
        console = Console()
        console.print(Screen(state, now, run_dir), height=console.height - 1)
