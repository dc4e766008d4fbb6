"""`mrcdrl simulate`: put the load of many actors on replay, without arenas and inference.

Invariant: a run that is joined has a name that marks its data as made up, unless --force allows
them to spoil it.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack

from mrcdrl.common.config import DEFAULT_PRESET, Config, load_config
from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flag,
    add_config_flags,
    overrides,
    whole_number,
)
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.common.runtime.open_files import allow_open_files
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.runs import add_run, run_path
from mrcdrl.common.runtime.versions import all_versions
from mrcdrl.common.sync.joining import recorded_endpoint
from mrcdrl.services.monitor.summary import machine
from mrcdrl.services.tools.simulate.simulation import Demand, simulation
from mrcdrl.services.tools.simulate.target import NAME, joined, own

ROBOT_STEPS_PER_S = 4300.0  # of an actor with a dedicated core: docs/profile.md
_FILES = 3  # open files per actor: a connection, shared memory, and a place for more
_PEERS = 10  # besides the actors
_SPARE_FILES = 200
_SHOWN = (  # in the short help
    "arena.num_robots",
    "replay.shards",
    "replay.samples_per_insert",
)


def main(argv: Sequence[str]) -> int:
    """Simulate; return the exit code. Figures go to stdout as JSON, progress to stderr."""
    arguments = _parse(argv)
    _check_open_files(arguments.actors)
    stop = StopSignal().listen()
    demand = Demand(arguments.actors, arguments.rate, arguments.processes, arguments.publications)
    given = overrides(arguments)
    preset = arguments.config or DEFAULT_PRESET
    with ExitStack() as owned:
        if arguments.run:
            target = owned.enter_context(joined(arguments.run, arguments.connect, given, stop))
        else:
            config = load_config(preset, given)
            _check_places(arguments.actors, config)
            target = owned.enter_context(own(config, router=arguments.router))
        simulated = owned.enter_context(simulation(demand, target, f"simulated-{os.getpid()}"))
        figures = simulated.run(60 * arguments.minutes, stop)
    result = {
        "command": " ".join(["mrcdrl simulate", *argv]),
        "actors": demand.actors,
        **figures,
        "machine": machine(),
        "versions": all_versions(),
    }
    sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
    return 0


def parser() -> Parser:
    """The command's flags."""
    made = Parser(
        prog="mrcdrl simulate", description="Put the load of many actors on replay, without arenas."
    )
    made.add_argument(
        "--actors", metavar="N", type=whole_number(1), default=200, help="to simulate; default: 200"
    )
    made.add_argument(
        "--minutes", metavar="MINUTES", type=_positive, default=1.0, help="to measure; default: 1"
    )
    made.add_argument(
        "--rate",
        metavar="X",
        type=lambda text: math.inf if text == "max" else _positive(text),
        default=ROBOT_STEPS_PER_S,
        help="robot steps per second of each actor, or max: as many as are acknowledged; "
        f"default: {ROBOT_STEPS_PER_S:g}, those of an actor with a dedicated core",
    )
    made.add_argument(
        "--processes", metavar="N", type=whole_number(1), help="of the actors; default: one a core"
    )
    made.add_argument(
        "--publications", metavar="X", type=_frequency, help="of weights a second; default: 1"
    )
    made.add_argument("--router", action="store_true", help="put a router in front of replay")
    add_config_flag(made)
    add_run(made, f"join this run, whose name begins with {NAME}")
    made.add_argument("--connect", metavar="ENDPOINT", help="the run's, such as tcp/127.0.0.1:7447")
    made.add_argument(
        "--force", action="store_true", help="join any run; its learner then trains on made-up data"
    )
    add_config_flags(made, _SHOWN)
    return made


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    made = parser()
    arguments = made.parse_args(argv)
    if arguments.connect and not arguments.run:
        made.error("--connect needs the run's name; without both replay is started here")
    if arguments.run:
        _check_joining(made, arguments)
    elif arguments.publications is None:
        arguments.publications = 1.0
    arguments.processes = min(arguments.processes or available_cores(), arguments.actors)
    return arguments


def _check_joining(parser: Parser, arguments: argparse.Namespace) -> None:
    """Find the run; refuse flags that it decides, and one that is not meant for made-up data."""
    run_dir = run_path(arguments.run, arguments.run_dir)
    arguments.run = run_dir.name
    arguments.connect = arguments.connect or recorded_endpoint(run_dir, "--connect")
    settled = [f"--{name}" for name in ("config", "router") if getattr(arguments, name)]
    settled += ["--publications"] * (arguments.publications is not None)
    settled += [f"--{n}" for n in overrides(arguments) if not n.startswith("transport.")]
    if settled:
        parser.error(f"{settled[0]} is set by the run that is joined")
    if not (arguments.run.startswith(NAME) or arguments.force):
        parser.error(
            f"run {arguments.run!r} would train on made-up data; give a run whose name begins "
            f"with {NAME!r}, or --force"
        )


def _positive(text: str) -> float:
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0")
    return number


def _frequency(text: str) -> float:
    return 0.0 if float(text) == 0 else _positive(text)


def _check_places(actors: int, config: Config) -> None:
    """Raise ConfigError if the run's replay or router would not let all actors in."""
    needed = actors + config.replay.shards + _PEERS
    if config.transport.max_peers < needed:
        raise ConfigError(
            f"transport.max_peers {config.transport.max_peers} is too few for {actors} actors: "
            f"give --transport.max_peers {needed} or more"
        )


def _check_open_files(actors: int) -> None:
    """Allow as many open files as all sessions need, for the processes started here too.

    Raises ConfigError if the system allows fewer.
    """
    needed = _FILES * actors + _SPARE_FILES
    allowed = allow_open_files(needed)
    if allowed < needed:
        raise ConfigError(
            f"{actors} actors need {needed} open files, but the system allows {allowed}: raise "
            "that (ulimit -Hn), or simulate fewer"
        )
