"""Time until workers that join a run late have its newest weights.

`python -m benchmarks.late_joiners --joiners 50 --seconds 60` runs replay, an actor and a learner;
then workers join at random moments within the time and stay. Each opens its own session, requests
configuration and weights and builds its policy (`LivePolicy`), as evaluators and actors do. Each
process holds several joiners, to spare a small machine fifty imports of PyTorch. A joiner's weights
are compared with the newest that this process had received when the joiner began. Prints one line
of JSON; exit code 1 if a joiner had older weights.
"""

import argparse
import bisect
import json
import random
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.learner_kills import Follower
from benchmarks.machine import emit, spread
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.common.sync.live_policy import LivePolicy
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import eventually
from tests.system.system_processes import (
    REPOSITORY,
    Command,
    end_all,
    environment,
    run_name,
)

_SOON_S = 1.0
_PATIENCE_S = 120.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--joiners", type=int, default=50)
    parser.add_argument("--processes", type=int, default=5, help="processes that hold the joiners")
    parser.add_argument("--seconds", type=float, default=60.0, help="time within which they join")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--config", default="quick")
    parser.add_argument("--join", nargs=2, metavar=("RUN", "ENDPOINT"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.join:
        run, endpoint = arguments.join
        join(run, endpoint, arguments.joiners, arguments.seconds, arguments.seed)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        found = joined(Path(folder), arguments)
    emit({"bench": "late_joiners", **found})
    return 1 if found["had_older"] or found["joiners"] < arguments.joiners else 0


def joined(folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Compare what the joiners report with what had been published by then."""
    name, endpoint = run_name("joiners"), free_endpoint()
    here = ["--run", name, "--run-dir", str(folder)]
    joining = [*here, "--connect", endpoint, "--id"]
    serving = ["--config", arguments.config, "--listen", endpoint]
    each = arguments.joiners // arguments.processes
    command = [sys.executable, "-m", "benchmarks.late_joiners", "--join", name, endpoint]
    command += [f"--joiners={each}", f"--seconds={arguments.seconds}"]
    heard_s: list[float] = []
    try:
        with (
            Command(["replay", *here, *serving], folder, **ALLOCATOR),
            Session(TransportConfig(connect=(endpoint,)), open_timeout_s=120) as session,
            Command(["learner", *joining, "learner-0"], folder, **ALLOCATOR),
            Command(["actor", *joining, "actor-0"], folder, **ALLOCATOR),
            ExitStack() as running,
        ):
            follower = Follower(session, Keys(name))
            eventually(lambda: follower.reaches(1), "the learner learns")
            processes = []
            for number in range(arguments.processes):
                process = subprocess.Popen(
                    [*command, f"--seed={arguments.seed + number}"],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                    cwd=REPOSITORY, env=environment(),
                )  # fmt: skip
                running.callback(process.wait)
                running.callback(process.kill)
                processes.append(process)
            replies = [json.loads(_line(process)) for process in processes]
            assert replies == ["ready"] * len(processes)
            before = len(follower.published)
            for process in processes:
                _begin(process)
            while any(process.poll() is None for process in processes):
                follower.listen()
                heard_s += [time.monotonic()] * (len(follower.published) - before - len(heard_s))
    finally:
        end_all(name)
    published = follower.published[before - 1 :]
    joiners = [line for process in processes for line in map(json.loads, _rest(process))]
    had_older = []
    for joiner in joiners:
        newest = published[bisect.bisect_left(heard_s, joiner["began_s"])]
        if (joiner["epoch"], joiner["version"]) < newest.order:
            had_older.append({**joiner, "newest": newest.version})
    times = [joiner["weights_s"] for joiner in joiners]
    return {
        "joiners": len(joiners),
        "processes": len(processes),
        "seconds": arguments.seconds,
        "published_meanwhile": len(heard_s),
        "weights_after_s": spread(times, 3),
        "later_than_a_second": sum(s > _SOON_S for s in times),
        "had_older": had_older,
        "each": sorted(round(s, 3) for s in times),
    }


def _line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def _rest(process: "subprocess.Popen[str]") -> list[str]:
    assert process.stdout is not None
    return process.stdout.read().splitlines()


def _begin(process: "subprocess.Popen[str]") -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def join(run: str, endpoint: str, count: int, seconds: float, seed: int) -> None:
    """Join this many times and stay until all have joined; then print a line for each."""
    rng = random.Random(seed)
    moments = [rng.uniform(0.0, seconds) for _ in range(count)]
    joiners: list[dict[str, float]] = []
    all_joined = threading.Barrier(count)

    def one(moment_s: float) -> None:
        time.sleep(moment_s)
        began_s = time.monotonic()
        with LivePolicy(run, endpoint) as policy:
            weights_s = time.monotonic() - began_s
            epoch = policy._policy.weights_epoch
            joiners.append(
                {
                    "began_s": began_s,
                    "weights_s": weights_s,
                    "epoch": epoch,
                    "version": policy.version,
                }
            )
            all_joined.wait(seconds + _PATIENCE_S)

    threads = [threading.Thread(target=one, args=(moment,)) for moment in moments]
    print(json.dumps("ready"), flush=True)
    sys.stdin.readline()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for joiner in joiners:
        print(json.dumps(joiner), flush=True)


if __name__ == "__main__":
    sys.exit(main())
