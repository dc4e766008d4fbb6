"""A router that is killed while many simulated actors insert through it, and started again.

    python -m benchmarks.router_kills --actors 1000 --away 3

Starts a router, replay and `mrcdrl simulate` as processes of their own, kills the router by SIGKILL
a while after all have joined, and starts it again after --away seconds. Prints a line of JSON: how
long after the start all actors' liveliness tokens were back, and what the simulation said, above
all whether all that was made was acknowledged.
"""

import argparse
import json
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from benchmarks.machine import emit
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import eventually
from tests.system.system_processes import Command, end_all

_PATIENCE_S = 600.0
_BEFORE_S = 15.0  # of inserts, before the kill


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--actors", type=int, default=1000)
    parser.add_argument("--away", type=float, default=3.0, help="seconds without a router")
    parser.add_argument("--minutes", type=float, default=1.5, help="of inserts")
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    for number in range(arguments.rounds):
        figures = killed_and_back(arguments.actors, arguments.away, arguments.minutes)
        emit({"bench": "router_kills", "round": number, "away_s": arguments.away, **figures})


def killed_and_back(actors: int, away_s: float, minutes: float) -> dict[str, object]:
    """One kill; seconds until all were back, and the simulation's own figures."""
    run, endpoint = f"simulate-kills-{time.time_ns()}", free_endpoint()
    keys = Keys(run)
    with tempfile.TemporaryDirectory() as name, ExitStack() as owned:
        folder = Path(name)
        owned.callback(end_all, run)
        joins = ["--connect", endpoint]
        router = ["router", "--listen", endpoint]
        replay = ["replay", "--run", run, "--run-dir", folder, "--config", "quick", *joins]
        replay += ["--replay.samples_per_insert", "0"]  # there is no learner
        load = ["simulate", "--run", run, *joins, "--actors", str(actors), "--rate", "5"]
        load += ["--minutes", str(minutes)]
        first = owned.enter_context(Command(router, folder))
        owned.enter_context(Command(replay, folder))
        config = TransportConfig(connect=(endpoint,))
        watcher = owned.enter_context(Session(config, open_timeout_s=_PATIENCE_S))
        presence = watcher.presence(keys.everyone("actor"))
        simulation = owned.enter_context(Command(load, folder))
        eventually(
            lambda: len(presence.alive()) == actors or simulation.process.poll() is not None,
            "all have joined",
            _PATIENCE_S,
        )
        if simulation.process.poll() is not None:
            sys.exit(f"the simulation has ended: {simulation.err}")
        time.sleep(_BEFORE_S)
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: not presence.alive(), "all are lost", _PATIENCE_S)
        time.sleep(away_s)
        owned.enter_context(Command(router, folder))
        started_s = time.monotonic()
        eventually(lambda: len(presence.alive()) == actors, "all are back", _PATIENCE_S)
        back_s = time.monotonic() - started_s
        simulation.wait()
        told = json.loads(simulation.out)
    said = ("made", "acknowledged", "unanswered", "insert_ms", "busy_cores")
    return {
        "actors": actors,
        "back_s": round(back_s, 2),
        "simulation": {key: told[key] for key in said},
    }


if __name__ == "__main__":
    main()
