"""Launches a run's processes on this machine, follows the run and stops it.

Invariants: what no service could do is refused before anything is written; the run is complete
without its plots.
"""

import argparse
import contextlib
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mrcdrl.common.arena import looked_up, test_starts
from mrcdrl.common.config import DEFAULT_PRESET, Config, TransportConfig, load_config
from mrcdrl.common.config.arguments import overrides
from mrcdrl.common.errors import ConfigError, EndpointError
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.common.runtime.extras import require
from mrcdrl.common.runtime.files import FILM, MOVING_PICTURE
from mrcdrl.common.runtime.process import COMMAND, DIE_WITH_PARENT, StopSignal
from mrcdrl.common.runtime.runs import find_run, new_run_path
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.display import display
from mrcdrl.services.monitor.follower import Follower
from mrcdrl.services.monitor.prometheus import serve_run
from mrcdrl.services.monitor.recorder import Recorder
from mrcdrl.services.monitor.run_directory import RunDirectory, default_name
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule, stopped
from mrcdrl.services.monitor.watching import Watching
from mrcdrl.services.train.flags import parser
from mrcdrl.services.train.fleet import Fleet
from mrcdrl.services.train.page import Page
from mrcdrl.services.train.resuming import check_unfinished

_LOG = logging.getLogger("train")
_TICK_S = 0.25
_PLOTS_S = 300.0
_JOIN_S = 60.0
_TRY_S = 1.0
_ENOUGH_CORES = 4
_KEYS = "Ctrl-C ends the run"
_OWN_METRICS = ("--metrics-port", "0")  # of services: the launcher serves those of the whole run


@dataclass(frozen=True, slots=True)
class Plan:
    """The run that a command line asks for; nothing is written yet, and it is possible."""

    path: Path
    config: Config
    base: str  # the preset, file or run that its settings come from
    before: Config  # the settings of that
    open: Callable[[], RunDirectory]  # creates or resumes the run
    dry_run: bool
    json: bool  # print the summary at the end
    plots: bool  # write plots and video at the end
    page: bool  # start a page to watch it by


def open_run(argv: Sequence[str]) -> RunDirectory:
    """Create or resume the run that the command line asks for."""
    return plan_run(argv).open()


def plan_run(argv: Sequence[str]) -> Plan:
    """Read the command line, and refuse a run that is not possible; write nothing."""
    made = parser()
    arguments = made.parse_args(argv)
    given = overrides(arguments)
    if arguments.json and arguments.dry_run:
        made.error("--json prints what a run reached: not with --dry-run")
    if arguments.resume:
        if arguments.name or arguments.config:
            made.error("--resume keeps the run's name and configuration: no --name or --config")
        path = find_run(arguments.resume, arguments.run_dir)
        return _resumption(path, given, arguments)
    preset = arguments.config or DEFAULT_PRESET
    config = looked_up(load_config(preset, given))
    check_possible(config)
    name = arguments.name or default_name(preset, config.arena.num_robots)
    path = new_run_path(name, arguments.run_dir)
    create = RunDirectory.create if arguments.name else RunDirectory.create_free
    before = load_config(preset, environ={})
    return Plan(
        path,
        config,
        base=preset,
        before=before,
        open=partial(create, path, config),
        dry_run=arguments.dry_run,
        json=arguments.json,
        plots=arguments.plots,
        page=arguments.page,
    )


def _resumption(path: Path, given: dict[str, str], flags: argparse.Namespace) -> Plan:
    def check(before: Config, now: Config) -> None:
        check_possible(looked_up(now), resumed=True)
        check_unfinished(path, before, now, given)

    before, config = RunDirectory.resumed_config(path, given)
    resume = partial(RunDirectory.resume, path, given, check)
    if flags.dry_run:
        check(before, config)
    return Plan(
        path, config, path.name, before, resume, flags.dry_run, flags.json, flags.plots, flags.page
    )


def check_possible(config: Config, *, resumed: bool = False) -> None:
    """Refuse a run that no service could serve.

    resumed: the run needs its initial weights no more. Raises ConfigError if the robots do not fit,
    or a package or the initial weights are missing; EndpointError if a port is in use.
    """
    require("torch", "safetensors")
    if config.run.tracker != "none":
        require(config.run.tracker)
    for one in config.each_number():
        test_starts(one.arena, 1, config.evaluator.seed)
    initial_weights = "" if resumed else config.learner.initial_weights
    if initial_weights and not Path(initial_weights).exists():
        raise ConfigError(f"learner.initial_weights {initial_weights}: no such file or directory")
    if config.transport.connect:
        raise ConfigError(
            f"transport.connect {', '.join(config.transport.connect)}: mrcdrl train connects to "
            "the replay that it starts; leave the setting out, or give it as []"
        )
    if config.transport.listen:
        Session(config.transport).close()


def supervise(
    run: RunDirectory,
    fleet: Fleet,
    recorder: Recorder,
    stop: StopSignal,
    hurry: StopSignal,
    page: Page,
) -> str:
    """Run all processes until a signal or the stopping rule ends the run; the reason.

    hurry: listens from then on. page: its address is shown.
    """
    config = run.config
    state, rule = RunState(config), StoppingRule(config.run, config.arena.numbers)
    watching = Watching()
    endpoints = config.transport.listen or (free_endpoint(),)
    endpoint = endpoints[0]
    start_replay(run, fleet, endpoints)
    with join(fleet, config.transport, endpoint) as session:
        run.note_endpoint(endpoint)
        follower = Follower(session, Keys(run.path.name), state, recorder, rule)
        if run.resumed:
            rule.go_on()
        start_workers(run, fleet, endpoint)
        # Progress goes to stderr: what is printed on stdout is the result.
        keys = f"{page.address}  {_KEYS}".lstrip()
        serving = serve_run(config.transport, follower, state, run.path, "train")
        shown = display(state, run.path, keys, lambda: follower.now, watching, stream=sys.stderr)
        with serving, shown as show:
            reason = None
            while reason is None:
                follower.listen(_TICK_S)
                for line in fleet.warnings(watching):
                    state.observe_log(line)
                show()
                page.check()
                ended = fleet.watch()
                if ended:
                    follower.listen(_TICK_S)  # to the learner's last words
                reason = follower.stop_reason(learner_ended=ended is not None) or ended
                if stop.is_set():
                    reason = stopped(stop.cause)
            hurry.listen()
            state.ending = reason
            if stop.is_set():
                _LOG.info("stopping (%s) …", stop.cause)
            else:
                _LOG.info("%s; stopping …", reason)
            fleet.stop(show)
        follower.listen(_TICK_S)
    recorder.record_metrics(state, follower.now)
    recorder.write_summary(state, follower.now, reason)
    return reason


def join(fleet: Fleet, transport: TransportConfig, endpoint: str) -> Session:
    """A session with the replay service; raises the reason if that fails to start."""
    connected = transport.model_copy(update={"listen": (), "connect": (endpoint,)})
    deadline = time.monotonic() + _JOIN_S
    while True:
        try:
            return Session(connected, open_timeout_s=_TRY_S)
        except EndpointError:
            fleet.watch()
            if time.monotonic() > deadline:
                raise


def start_replay(run: RunDirectory, fleet: Fleet, endpoints: Sequence[str]) -> None:
    """Start one replay process that listens itself, or several shards behind a router."""
    ends = [word for endpoint in endpoints for word in ("--listen", endpoint)]
    num_shards = run.config.replay.shards
    if num_shards > 1:
        fleet.start(
            "router", "router-0", ["--transport", str(run.config_file), *_OWN_METRICS, *ends]
        )
        ends = ["--connect", endpoints[0]]
    for shard in range(num_shards):
        flags = ["--config", str(run.config_file), "--shard", str(shard), *ends]
        fleet.start("replay", f"replay-{shard}", [*run_flags(run), *flags])


def start_workers(run: RunDirectory, fleet: Fleet, endpoint: str) -> None:
    """Start the learner, the actors and the evaluators."""
    evaluators = run.config.run.evaluators
    for role, count in (
        ("learner", 1),
        ("actor", num_actors(run.config)),
        ("evaluator", evaluators),
    ):
        for index in range(count):
            worker = f"{role}-{index}"
            flags = ["--transport", str(run.config_file), "--connect", endpoint, "--id", worker]
            if run.config.arena.is_custom and role != "learner":
                flags += ["--env", run.config.arena.env]
            fleet.start(role, worker, [*run_flags(run), *flags])


def run_flags(run: RunDirectory) -> list[str]:
    """Flags that name the run; its settings are in its file, but for the port of its metrics."""
    return ["--run", run.path.name, "--run-dir", str(run.path.parent), *_OWN_METRICS]


def expectation(config: Config) -> str:
    """The cores and actors of this machine, and the pace to expect."""
    cores, actors = available_cores(), num_actors(config)
    pace = "" if cores >= _ENOUGH_CORES else f", slower than the {_ENOUGH_CORES} cores in the docs"
    return f"{cores} cores, {actors} actor{'s' if actors > 1 else ''}{pace}"


def num_actors(config: Config) -> int:
    """The configured number, else 1 in lockstep, else half the cores; the rest is the learner's."""
    return config.run.actors or (1 if config.run.turn_size else max(1, available_cores() // 2))


def write_plots(run_dir: Path, hurry: StopSignal) -> None:
    """Write the plots and the video of a run, in a separate process, unless a signal skips them.

    Log its progress, or why they are missing.
    """
    films = [run_dir / name for name in (MOVING_PICTURE, FILM)]  # as they are written, at the end
    before = [_written_ns(film) for film in films]
    report = subprocess.Popen(
        [*COMMAND, "report", str(run_dir)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, DIE_WITH_PARENT: str(os.getpid())},
        start_new_session=True,
    )
    last_line, deadline = "no reason given", time.monotonic() + _PLOTS_S
    for line in _lines_until(report, lambda: hurry.is_set() or time.monotonic() > deadline):
        last_line = line
        if not line.startswith("mrcdrl: "):
            _LOG.info("%s", line)
    if report.poll() is None:
        report.kill()
        report.wait()
        now = [_written_ns(film) for film in films]
        changed = [f for f, was, at in zip(films, before, now, strict=True) if at not in (was, 0)]
        for film in changed[-1:]:
            film.unlink()  # it was cut off
        why = f"skipped ({hurry.cause})" if hurry.is_set() else f"given up after {_PLOTS_S:g} s"
        _LOG.warning("plots and video %s; `mrcdrl report %s` writes them", why, run_dir)
    elif report.returncode:
        _LOG.warning("plots or video are missing: %s", last_line)


def _written_ns(path: Path) -> int:
    """When the file was last written; 0 if there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


def _lines_until(process: "subprocess.Popen[bytes]", enough: Callable[[], bool]) -> Iterator[str]:
    """Yield the lines that a process writes to its stderr, until it ends or `enough` says so."""
    if process.stderr is None:
        raise ValueError("the process writes elsewhere")
    with process.stderr as pipe:
        os.set_blocking(pipe.fileno(), False)
        waiting, ended = b"", False
        while not (ended or enough()):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_TICK_S)
                ended = True
            *whole, waiting = (waiting + (pipe.read() or b"")).split(b"\n")
            yield from (line.decode("utf-8", "replace") for line in whole)
