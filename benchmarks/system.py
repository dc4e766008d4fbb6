"""The learner's speed while the whole system runs, compared with stable-baselines3.

    python -m benchmarks.system --cores 0,1 --rounds 2 --sb3

Each round starts replay, learner, actors and evaluator as `mrcdrl train` does, fills the table and
alternates phases: the learner with actors and evaluator, with actors at the rate limiter's ratio,
and alone, on the transitions collected meanwhile (`replay.tolerance` lets it fall that far behind).
The others are stopped and restarted; the learner keeps running. Then stable-baselines3's DQN runs
alone with as many samples per step. Prints one line of JSON per round, then medians on stderr.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.machine import emit
from benchmarks.replay_peers import run
from mrcdrl.common.config import Config, TransportConfig
from mrcdrl.common.messages.trajectory import Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.train.launcher import num_actors
from tests.patience import eventually
from tests.system.system_processes import Command, end_all, run_name

PHASES = ("actors and evaluator", "actors", "alone")
_TUNED = "one thread, allocator tuned"  # like our learner on two cores
SB3: dict[str, tuple[Sequence[str], dict[str, str]]] = {
    "sb3, the paper's network": (("--network=paper",), {}),
    f"sb3, the paper's network, {_TUNED}": (("--network=paper", "--threads=1"), ALLOCATOR),
    "sb3, its network": (("--network=sb3",), {}),
    f"sb3, its network, {_TUNED}": (("--network=sb3", "--threads=1"), ALLOCATOR),
}
_SETTLE_S = 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="quick")
    parser.add_argument("--cores", default=",".join(map(str, sorted(os.sched_getaffinity(0)))))
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--turns", type=int, default=2, help="phases of each kind in a round")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a phase")
    parser.add_argument("--samples-per-step", type=int, default=8)
    parser.add_argument("--threads", type=int, default=0, help="learner.threads")
    parser.add_argument("--actors", type=int, default=0)
    parser.add_argument("--tolerance", type=float, default=3.0, help="replay.tolerance")
    parser.add_argument("--sb3", action="store_true")
    parser.add_argument(
        "--setting", nargs="*", default=[], help="more settings, such as --agent.kind=dqn"
    )
    arguments = parser.parse_args()
    os.sched_setaffinity(0, map(int, arguments.cores.split(",")))
    found: dict[str, list[float]] = {}
    for number in range(arguments.rounds):
        rates = system(arguments)
        if arguments.sb3:
            rates |= {name: [rival(arguments, name)] for name in SB3}
        emit({"bench": "system", "round": number, "updates_per_s": rates, **vars(arguments)})
        for name, figures in rates.items():
            found.setdefault(name, []).extend(figures)
    for name, figures in found.items():
        share = median(figures) / median(found["alone"])
        sys.stderr.write(f"{name:55} {median(figures):7.1f} updates/s, {share:6.1%} of alone\n")


def rival(arguments: argparse.Namespace, name: str) -> float:
    """Updates per second of stable-baselines3."""
    flags, environment = SB3[name]
    timing = ["--seconds", str(arguments.seconds)]
    ratio = ["--samples-per-step", str(arguments.samples_per_step)]
    command = [sys.executable, "-m", "benchmarks.sb3_dqn", *flags, *timing, *ratio]
    result: dict[str, Any] = run(command, **environment)
    return float(result["updates_per_s"])


def system(arguments: argparse.Namespace) -> dict[str, list[float]]:
    """Updates per second in each phase of one run."""
    with tempfile.TemporaryDirectory() as folder:
        name = run_name("system")
        try:
            return Run(arguments, Path(folder), name).phases()
        finally:
            end_all(name)


class Run:
    """The processes of one run, measured by their statistics."""

    def __init__(self, arguments: argparse.Namespace, folder: Path, name: str) -> None:
        self._arguments = arguments
        self._folder = folder
        self._name = name
        self._endpoint = free_endpoint()

    def phases(self) -> dict[str, list[float]]:
        arguments = self._arguments
        actors = [f"actor-{i}" for i in range(arguments.actors or num_actors(Config()))]
        serving = ["--config", arguments.config, "--listen", self._endpoint]
        serving += [
            f"--replay.samples_per_insert={arguments.samples_per_step}",
            f"--replay.tolerance={arguments.tolerance}",
            f"--learner.threads={arguments.threads}",
            *("--evaluator.period_s=0", *arguments.setting),
        ]
        found: dict[str, list[float]] = {phase: [] for phase in PHASES}
        with (
            self._command("replay", serving),
            Session(TransportConfig(connect=(self._endpoint,)), open_timeout_s=60) as session,
            self._joined(["learner-0"]),
        ):
            stats = _Statistics(session, Keys(self._name))
            for _ in range(arguments.turns):
                with self._joined(actors):
                    with self._joined(["evaluator-0"]):
                        stats.wait("evaluator", "busy", 1)
                        stats.wait("replay", "insert_held", 1)
                        found[PHASES[0]].append(stats.rate(arguments.seconds))
                    stats.wait("replay", "insert_held", 1)
                    found[PHASES[1]].append(stats.rate(arguments.seconds))
                found[PHASES[2]].append(stats.rate(arguments.seconds))
                stats.wait("replay", "sample_held", 0)
        return {phase: [round(rate, 1) for rate in rates] for phase, rates in found.items()}

    def _command(self, role: str, arguments: Sequence[str]) -> Command:
        where = ("--run", self._name, "--run-dir", str(self._folder))
        return Command([role, *where, *arguments], self._folder, **ALLOCATOR)

    @contextmanager
    def _joined(self, workers: Sequence[str]) -> Iterator[None]:
        with ExitStack() as running:
            for worker in workers:
                joining = ("--connect", self._endpoint, "--id", worker)
                running.enter_context(self._command(worker.partition("-")[0], joining))
            yield


class _Statistics:
    """The newest statistics of each role."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._stats = session.queue_subscriber(keys.every_stats)
        self._newest: dict[str, dict[str, float]] = {}

    def wait(self, role: str, metric: str, value: float) -> None:
        """Wait until the metric has this value in statistics that arrive from now on."""
        self._listen()
        self._newest.clear()
        eventually(
            lambda: self._listen() and self._newest.get(role, {}).get(metric) == value,
            f"{metric} of the {role} is {value:g}",
        )

    def rate(self, seconds: float) -> float:
        """The learner's updates per second, between two of its statistics messages."""
        time.sleep(_SETTLE_S)
        self._listen()
        began_s, began = self._step()
        ended_s, ended = self._step()
        while ended_s - began_s < seconds:
            ended_s, ended = self._step()
        return (ended - began) / (ended_s - began_s)

    def _step(self) -> tuple[float, float]:
        self._newest.pop("learner", None)
        eventually(
            lambda: self._listen() and "learner" in self._newest,
            "the learner publishes statistics",
            pause_s=0,
        )
        return time.perf_counter(), self._newest["learner"]["learner_steps"]

    def _listen(self) -> bool:
        item = self._stats.take(0.05)
        while item is not None:
            stats = decode(Stats, item[1])
            self._newest[stats.role] = stats.metrics
            item = self._stats.take(0.0)
        return True


if __name__ == "__main__":
    main()
