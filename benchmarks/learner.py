"""Updates a second of our full learner step, and of a CleanRL-style one beside it, in turns.

    python -m benchmarks.learner --peers DIR --cores 0,1

DIR is the folder of the harness with `bench_learner.py`; without it, or with --rounds 0, only we
are measured, in this process. A step is three forward passes, one backward, the optimiser, and
reading back the absolute TD errors that prioritized replay wants. Each system prints its line of
JSON, round after round; then a table of medians goes to stderr.
"""

import argparse
import itertools
import json
import sys
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from benchmarks.machine import emit, seconds_per_call, spread
from benchmarks.replay_peers import run
from common.config import AgentConfig, LearnerConfig
from common.network import Precision
from services.learner.batch import Batch
from services.learner.learner import Learner
from services.train.fleet import ALLOCATOR

_BATCHES = 8  # in turns, as the harness does
CLEANRL = ("--impl", "cleanrl")
TUNED = (*CLEANRL, "--channels-last", "--fused")
OURS: dict[str, Precision] = {"ours, float32": "float32", "ours, auto": "auto"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batches", type=int, nargs="+", default=[32, 512])
    parser.add_argument("--precision", default="auto", choices=["auto", "float32", "bfloat16"])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--reps", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.peers is None or not arguments.rounds:
        emit(ours(arguments))
        return
    found = in_turns(arguments)
    for name, results in found.items():
        cells = (
            f"b{size} {median(figure(r, size) for r in results):8.1f}" for size in arguments.batches
        )
        sys.stderr.write(f"{name:24}" + "   ".join(cells) + "\n")


def in_turns(arguments: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Results by system, a round after the other; each is printed as it comes."""
    timing = [f"--{name}={getattr(arguments, name)}" for name in ("threads", "seconds", "reps")]
    script = [sys.executable, str(arguments.peers / "bench_learner.py"), *timing]
    script += ["--batches", ",".join(map(str, arguments.batches))]
    module = [sys.executable, "-m", "benchmarks.learner", *timing, "--batches"]
    module += map(str, arguments.batches)
    systems: dict[str, tuple[list[str], dict[str, str]]] = {
        "CleanRL, plain": ([*script, *CLEANRL], {}),
        "CleanRL, tuned": ([*script, *TUNED], ALLOCATOR),
        **{name: ([*module, "--precision", p], ALLOCATOR) for name, p in OURS.items()},
    }
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in systems}
    for turn in range(arguments.rounds):
        for name, (command, environment) in systems.items():
            result = run(["taskset", "-c", arguments.cores, *command], **environment)
            print(json.dumps({"system": name, "round": turn, **result}), flush=True)
            found[name].append(result)
    return found


def figure(result: dict[str, Any], size: int) -> float:
    """Median updates a second; not a number where the system gave none."""
    value = result.get(f"b{size}_updates_per_s", np.nan)
    return float(value["median"] if isinstance(value, dict) else value)


def ours(arguments: argparse.Namespace) -> dict[str, object]:
    """Updates a second of our learner for each size of batch."""
    torch.set_num_threads(arguments.threads)
    settings = LearnerConfig(precision=arguments.precision, device="cpu")
    learner = Learner(AgentConfig(), settings, stack=4, view_px=60)
    figures: dict[str, object] = {
        "bench": "learner",
        "threads": arguments.threads,
        "dtype": str(learner.online.compute_dtype),
    }
    for size in arguments.batches:
        batches = itertools.cycle([random_batch(size, seed) for seed in range(_BATCHES)])
        seconds = seconds_per_call(
            lambda batches=batches: learner.step(next(batches)).td_errors.abs().numpy(),
            seconds=arguments.seconds,
            repeats=arguments.reps,
        )
        figures[f"b{size}_updates_per_s"] = spread([1 / s for s in seconds])
    return figures


def random_batch(size: int, seed: int) -> Batch:
    """As large as real ones; what the pixels are makes no difference to the time."""
    generator = torch.Generator().manual_seed(seed)
    pictures = torch.randint(0, 256, (2, size, 4, 60, 60), dtype=torch.uint8, generator=generator)
    return Batch(
        observation=pictures[0],
        action=torch.randint(0, 3, (size,), generator=generator),
        reward=torch.rand(size, generator=generator),
        discount=torch.full((size,), 0.99),
        next_observation=pictures[1],
        importance_weights=torch.ones(size),
        keys=np.arange(size),
    )


if __name__ == "__main__":
    main()
