"""`mrcdrl train`: one command from the first frame to a judged policy, all on this machine."""

import logging
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

from mrcdrl.common.arena import test_starts
from mrcdrl.common.config import Config, TransportConfig, load_config
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides
from mrcdrl.common.errors import EndpointError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.runtime.process import COMMAND, StopSignal, available_cores
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.display import display
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_directory import RunDirectory, default_name
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule
from mrcdrl.services.train.fleet import Fleet

_LOG = logging.getLogger("train")
_DEFAULT = "quick"
_TICK_S = 0.25
_IMAGES_S = 300.0
_JOIN_S = 60.0
_ENOUGH_CORES = 4
_SHORT = {
    "arena.num_robots": "--robots",
    "run.minutes": "--minutes",
    "run.learner_steps": "--learner-steps",
    "run.actors": "--actors",
}


def main(argv: Sequence[str]) -> int:
    """Train; the exit code."""
    with open_run(argv) as run:
        stop = StopSignal().listen()
        taken_up = " taken up again" if run.resumed else ""
        _LOG.info("run %s%s: %s", run.path, taken_up, expectation(run.config))
        endpoint = (run.config.transport.listen or (free_endpoint(),))[0]
        fleet = Fleet(run.logs)
        try:
            with Recorder(run.path, run.config) as recorder:
                reason = supervise(run, fleet, recorder, endpoint, stop)
        finally:
            fleet.stop()
        _LOG.info("%s: drawing what the run leaves", reason)
        draw(run.path)
    _LOG.info("the run is in %s: summary.json, training.png, evaluation.mp4", run.path)
    return 0


def open_run(argv: Sequence[str]) -> RunDirectory:
    """The run that the command line asks for, its folder made or taken up again."""
    parser = Parser(prog="mrcdrl train", description="Train on this machine, all processes.")
    parser.add_argument("--config", help=f"a preset or a TOML file; by default {_DEFAULT}")
    parser.add_argument("--run-dir", type=Path, default=Path("runs"), help="where runs are kept")
    parser.add_argument("--name", help="the run's name; by default from preset, robots and time")
    parser.add_argument("--resume", metavar="RUN", help="go on with this run where it was")
    add_config_flags(parser, _SHORT)
    arguments = parser.parse_args(argv)
    given = overrides(arguments)
    if arguments.resume:
        if arguments.name or arguments.config:
            parser.error("--resume keeps the run's name and configuration: no --name or --config")
        resumed = Path(arguments.resume)
        folder = resumed.parent if len(resumed.parts) > 1 else arguments.run_dir
        return RunDirectory.resume(folder / check_name(resumed.name, "run name"), given)
    preset = arguments.config or _DEFAULT
    config = load_config(preset, given)
    check_possible(config)
    name = arguments.name or default_name(preset, config.arena.num_robots)
    return RunDirectory.create(arguments.run_dir / check_name(name, "run name"), config)


def check_possible(config: Config) -> None:
    """Refuse, before anything is written, what no service could do.

    Raises ConfigError where the robots do not fit, EndpointError where a port is in use.
    """
    test_starts(config.arena, 1, config.evaluator.seed)
    if config.transport.listen:
        Session(config.transport.model_copy(update={"connect": ()})).close()


def supervise(
    run: RunDirectory, fleet: Fleet, recorder: Recorder, endpoint: str, stop: StopSignal
) -> str:
    """Run all services until stopped or the rule says so; the reason."""
    config, keys = run.config, Keys(run.path.name)
    state, rule = RunState(config), StoppingRule(config.run)
    start_replay(run, fleet, endpoint)
    with join(fleet, transport(config, endpoint)) as session:
        run.note_endpoint(endpoint)
        follower = Follower(session, keys, state, recorder, rule)
        for role, count in {
            "learner": 1,
            "actor": num_actors(config),
            "evaluator": config.run.evaluators,
        }.items():
            for index in range(count):
                worker = f"{role}-{index}"
                fleet.start(role, worker, join_arguments(run, endpoint, worker))
        with display(state, config, run.path.name, lambda: follower.now) as show:
            reason = None
            while reason is None:
                follower.listen(_TICK_S)
                for line in fleet.warnings():
                    state.observe_log(line)
                show()
                reason = fleet.watch() or follower.stop_reason()
                if stop.is_set():
                    reason = "stopped by hand"
        _LOG.info("stopping: %s", reason)
        fleet.stop()
        follower.listen(_TICK_S)
    recorder.write_summary(state, follower.now, reason)
    return reason


def transport(config: Config, endpoint: str) -> TransportConfig:
    """The configured transport, connecting to the replay service of this machine."""
    return config.transport.model_copy(update={"listen": (), "connect": (endpoint,)})


def join(fleet: Fleet, transport: TransportConfig) -> Session:
    """A session with the replay service, or the reason that one ended for."""
    deadline = time.monotonic() + _JOIN_S
    while True:
        try:
            return Session(transport, open_timeout_s=0.0)
        except EndpointError:
            fleet.watch()
            if time.monotonic() > deadline:
                raise


def start_replay(run: RunDirectory, fleet: Fleet, endpoint: str) -> None:
    """One replay process that listens itself, or several shards that a router joins."""
    num_shards = run.config.replay.shards
    if num_shards > 1:
        fleet.start("router", "router-0", ["--listen", endpoint])
    for shard in range(num_shards):
        fleet.start("replay", f"replay-{shard}", replay_arguments(run, endpoint, shard))


def replay_arguments(run: RunDirectory, endpoint: str, shard: int) -> list[str]:
    end = "--listen" if run.config.replay.shards == 1 else "--connect"
    return [
        *("--run", run.path.name, "--run-dir", str(run.path.parent)),
        *("--config", str(run.path / RUN_CONFIG), "--shard", str(shard), end, endpoint),
    ]


def join_arguments(run: RunDirectory, endpoint: str, worker: str) -> list[str]:
    run_dir = str(run.path.parent)
    name = run.path.name
    arguments = ["--run", name, "--connect", endpoint, "--run-dir", run_dir, "--id", worker]
    for field, value in run.config.transport.model_dump(exclude={"listen", "connect"}).items():
        arguments += [f"--transport.{field}", str(value).lower()]
    return arguments


def expectation(config: Config) -> str:
    """What this machine means for the run, in words."""
    cores, actors = available_cores(), num_actors(config)
    pace = "" if cores >= _ENOUGH_CORES else ", slower than on the 4 that the docs speak of"
    return f"{cores} cores, {actors} actor{'s' if actors > 1 else ''}{pace}"


def num_actors(config: Config) -> int:
    """As configured, or half the cores, at least 1: the other half is the learner's.

    Of a run that takes turns it is 1.
    """
    return config.run.actors or (1 if config.run.turn_size else max(1, available_cores() // 2))


def draw(run_dir: Path) -> None:
    """The images and the film of a run, in a process of its own; the run is whole without."""
    command = [*COMMAND, "report", str(run_dir)]
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=_IMAGES_S, check=False
        )
    except subprocess.TimeoutExpired:
        _LOG.warning("drawing took over %g s and was given up", _IMAGES_S)
        return
    if result.returncode:
        _LOG.warning("not all was drawn: %s", (result.stderr.splitlines() or ["no reason"])[-1])
