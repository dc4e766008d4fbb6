"""kill -9 of a run's learner at random moments: versions never go back, and learning goes on.

`python -m benchmarks.learner_kills --kills 20` runs replay, an actor, an evaluator and robots that
act by a `LivePolicy`, kills the learner again and again, every fifth time during its start-up, and
restarts it. The parameters acted by are compared bit for bit with those published; afterwards the
last weights before each kill and the first ones after it are evaluated on the same starts. Prints
one line of JSON; exit code 1 if a version went back or parameters were mixed.
"""

import argparse
import hashlib
import math
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.machine import emit
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.messages.trajectory import Evaluation, Stats, Weights
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.common.sync.live_policy import LivePolicy
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.evaluator.evaluator import WeightsEvaluator
from tests.patience import PATIENCE_S, eventually
from tests.system.system_processes import Command, end_all, run_name

SMALL_RUN = (
    "--arena.num_robots=1",
    "--arena.view_px=40",
    "--arena.max_frames=300",
    "--exploration.schedule=[[0, 1.0], [4000, 0.1]]",
    "--replay.min_size=2000",
    "--evaluator.episodes=50",
)
OFTEN = (
    "--learner.publish_period=25",
    "--learner.checkpoint_period_s=5",
    "--evaluator.period_s=5",
    "--learner.average_for=all",  # robots act by what is published
    "--run.learner_steps=0",
)
DURING_START = 5  # every fifth kill is followed by one during the learner's start-up
_ROBOTS = 2  # each acts by a LivePolicy with its own session

Order = tuple[int, int]  # (epoch, version)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=300, help="learner steps between kills")
    parser.add_argument(
        "--longest", type=float, default=5.0, help="seconds added at random, at most"
    )
    parser.add_argument("--trained", type=Path, help="start from a copy of this run's checkpoints")
    arguments = parser.parse_args()
    small = ["--config", "quick", *SMALL_RUN]
    trained = ["--config", f"{arguments.trained}/{RUN_CONFIG}"]
    with tempfile.TemporaryDirectory() as folder:
        found = ordeal(
            Path(folder),
            [*(trained if arguments.trained else small), *OFTEN],
            checkpoints=arguments.trained and arguments.trained / "checkpoints",
            kills=arguments.kills,
            seed=arguments.seed,
            steps=arguments.steps,
            longest_s=arguments.longest,
        )
    emit({"bench": "learner_kills", **found})
    return 1 if found["went_back"] or found["mixed"] else 0


def ordeal(
    folder: Path,
    configured: Sequence[str],
    *,
    kills: int,
    seed: int,
    steps: int,
    longest_s: float,
    checkpoints: Path | None = None,
) -> dict[str, Any]:
    """Kill the learner this many times and report what came of it.

    configured: replay's flags, with the configuration. steps: minimum learner steps between two
    kills, after which up to longest_s seconds pass. checkpoints: to start from.
    """
    rng = random.Random(seed)
    name, endpoint, began_s = run_name("kills"), free_endpoint(), time.monotonic()
    here = ["--run", name, "--run-dir", str(folder)]
    joining = [*here, "--connect", endpoint, "--id"]
    if checkpoints is not None:
        shutil.copytree(checkpoints, folder / name / "checkpoints")

    def process(role: str) -> Command:
        return Command([role, *joining, f"{role}-0"], folder, **ALLOCATOR)

    last_words = ""
    resumed: list[tuple[Weights, Weights]] = []
    try:
        with (
            Command(["replay", *here, "--listen", endpoint, *configured], folder),
            Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as session,
            ExitStack() as running,
        ):
            running.enter_context(process("actor"))
            running.enter_context(process("evaluator"))
            follower, robots = Follower(session, Keys(name)), list[Robot]()
            for number in range(kills + 1):
                before, due = follower.newest, follower.learner_step + steps
                with process("learner") as learner:
                    eventually(lambda: follower.is_newer_than(before), "weights after the kill")  # noqa: B023
                    if before is not None:
                        resumed.append((before, follower.first_after(before)))
                    if not robots:
                        robots += [
                            running.enter_context(acting(name, endpoint)) for _ in range(_ROBOTS)
                        ]
                    due = max(due, follower.learner_step + steps)
                    eventually(lambda: follower.reaches(due), f"learner step {due}")  # noqa: B023
                    if number == kills:
                        newest = follower.taken[-1].version
                        eventually(lambda: follower.has_evaluated(newest), f"{newest} is evaluated")  # noqa: B023
                        learner.signal(signal.SIGTERM)
                        code = learner.wait()
                        last_words = learner.err
                        break
                    follower.listen_for(rng.uniform(0.0, longest_s))
                    kill(learner)
                if number % DURING_START == DURING_START - 1:
                    with process("learner") as starting:
                        follower.listen_for(rng.uniform(0.5, 4.0))
                        kill(starting)
                follower.listen_for(1.0)  # messages in flight
            follower.listen_for(1.0)
            config = robots[0].config
            seconds = time.monotonic() - began_s
    finally:
        end_all(name)
    torch.set_num_threads(config.evaluator.threads)
    evaluator = WeightsEvaluator(config, "evaluator")
    return {
        "kills": kills + kills // DURING_START,
        "seed": seed,
        "seconds": round(seconds, 1),
        "ended": (code, "continuing from" in last_words),
        "learner_steps": follower.learner_step,
        "published": len(follower.published),
        "epochs": len({weights.epoch for weights in follower.published}),
        "went_back": follower.went_back()
        + [line for r in robots for line in backwards("acted by", [o for o, _ in r.acted])],
        "mixed": [line for robot in robots for line in mixed(robot.acted, follower.digests())],
        "acted_by": [len(robot.acted) for robot in robots],
        "evaluations": [
            (e.learner_step, e.weights_version, e.success_rate) for e in follower.evaluated
        ],
        **scores([(evaluator.evaluate(a, _on), evaluator.evaluate(b, _on)) for a, b in resumed]),
    }


def _on() -> bool:
    return True


def kill(learner: Command) -> None:
    learner.signal(signal.SIGKILL)
    if learner.wait() != -signal.SIGKILL:
        raise AssertionError(f"the learner ended before it was killed: {learner.err}")


def scores(evaluated: Sequence[tuple[Evaluation | None, Evaluation | None]]) -> dict[str, Any]:
    """Compare success rates before and after each kill.

    Each pair was evaluated on the same starts; `beyond_noise` counts the pairs whose difference is
    significant at 5 % (two proportions).
    """
    pairs = [(a, b) for a, b in evaluated if a is not None and b is not None]
    deviations = []
    for before, after in pairs:
        rate = (before.success_rate + after.success_rate) / 2
        error = math.sqrt(2 * rate * (1 - rate) / before.episodes)
        difference = after.success_rate - before.success_rate
        deviations.append(difference / error if error else 0.0)
    differences = [b.success_rate - a.success_rate for a, b in pairs]
    return {
        "resumed": [
            (a.learner_step, b.learner_step, a.success_rate, b.success_rate) for a, b in pairs
        ],
        "mean_difference": round(float(np.mean(differences)), 4) if differences else 0.0,
        "beyond_noise": sum(abs(d) > 1.96 for d in deviations),
    }


class Follower:
    """Records all published weights, evaluations and statistics, and follows the weights itself."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._reader = WeightsReader(session, keys)
        self._published = session.queue_subscriber(keys.weights)
        self._evaluations = session.queue_subscriber(keys.every_evaluation)
        self._stats = session.queue_subscriber(keys.every_stats)
        self.taken: list[Weights] = []
        self.published: list[Weights] = []
        self.evaluated: list[Evaluation] = []
        self.versions: dict[str, list[int]] = {"actor": [], "evaluator": [], "learner": []}

    @property
    def newest(self) -> Weights | None:
        return self.published[-1] if self.published else None

    @property
    def learner_step(self) -> int:
        return self.published[-1].learner_step if self.published else 0

    def listen(self) -> None:
        """Listen until the reader has newer weights, half a second at most."""
        newer = self._reader.latest(0.5)
        self.taken += [newer] if newer else []
        self.published += [decode(Weights, payload) for _, payload in self._published.drain()]
        self.evaluated += [decode(Evaluation, payload) for _, payload in self._evaluations.drain()]
        for _, payload in self._stats.drain():
            stats = decode(Stats, payload)
            if stats.role in self.versions:
                self.versions[stats.role].append(int(stats.metrics["weights_version"]))

    def listen_for(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self.listen()

    def is_newer_than(self, before: Weights | None) -> bool:
        self.listen()
        return self.newest is not before and bool(self.taken)

    def first_after(self, before: Weights) -> Weights:
        """The weights published right after `before`."""
        return self.published[self.published.index(before) + 1]

    def reaches(self, learner_step: int) -> bool:
        self.listen()
        return bool(self.taken) and self.taken[-1].learner_step >= learner_step

    def has_evaluated(self, version: int) -> bool:
        self.listen()
        return bool(self.evaluated) and self.evaluated[-1].weights_version >= version

    def digests(self) -> dict[Order, str]:
        return {weights.order: weights.digest for weights in self.published}

    def went_back(self) -> list[str]:
        """A line for each version that followed a newer one: on the wire, taken or evaluated."""
        evaluated = [(e.weights_epoch, e.weights_version) for e in self.evaluated]
        lines = backwards("published", [weights.order for weights in self.published])
        lines += backwards("taken", [weights.order for weights in self.taken])
        lines += backwards("evaluated", evaluated, again=True)
        for role, versions in self.versions.items():
            lines += backwards(role, [(0, version) for version in versions], again=True)
        if self._reader.refused:
            lines.append(f"{self._reader.refused} messages refused")
        return lines


def backwards(what: str, orders: Sequence[Order], *, again: bool = False) -> list[str]:
    """A line for each that is not above its predecessor; again: equal ones are allowed."""
    return [
        f"{what}: {after} after {before}"
        for before, after in pairwise(orders)
        if after < before or (after == before and not again)
    ]


def mixed(acted: Sequence[tuple[Order, str]], digests: dict[Order, str]) -> list[str]:
    """A line for each version that was acted by with other parameters than those published."""
    return [
        f"acted by {order}, with other parameters than published"
        for order, digest in acted
        if digests.get(order, digest) != digest
    ]


class Robot:
    """Acts by a LivePolicy in its own thread, and records by which parameters."""

    def __init__(self, run: str, endpoint: str) -> None:
        self._policy = LivePolicy(run, endpoint, timeout_s=120)
        self.config = self._policy.config
        self.acted: list[tuple[Order, str]] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._act)
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._policy.close()

    def _act(self) -> None:
        side = self.config.arena.view_px
        policy = self._policy._policy
        while not self._stopping.wait(0.02):
            self._policy.act(np.zeros((1, side, side), np.uint8))
            order = (policy.weights_epoch, policy.weights_version)
            if not self.acted or self.acted[-1][0] != order:
                payload = weights_to_bytes(policy.network)
                self.acted.append((order, hashlib.sha256(payload).hexdigest()))


@contextmanager
def acting(run: str, endpoint: str) -> Iterator[Robot]:
    robot = Robot(run, endpoint)
    try:
        yield robot
    finally:
        robot.close()


if __name__ == "__main__":
    sys.exit(main())
