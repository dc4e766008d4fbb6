"""Updates a second of our full learner step, and of a CleanRL-style one beside it, in turns.

    python -m benchmarks.learner --peers DIR --cores 0,1
    python -m benchmarks.learner --device cuda --rounds 3
    python -m benchmarks.learner --profile

DIR is the folder of the harness with `bench_learner.py`; without it, or with --rounds 0, only we
are measured: on a GPU steps as learner.step = auto makes them beside eager ones. A step is three
forward passes, one backward, the optimiser, and reading back the absolute TD errors that
prioritized replay wants (on a GPU those of the launch before, so that none is waited for). Our
pictures are those of --robots playing at random in the default arena: what is black of them costs
a CPU nothing (`sparse_conv.py`). `--pictures noise` has no black in it. Each system prints
its line of JSON, round after round, with its share of what a large matrix product reaches with the
same threads; then a table of medians goes to stderr. `--run DIR` adds how many
transitions a second the learner of a recorded run consumed in its best minute, over Zenoh and
with all else running.
`--profile` prints the operations that take the longest instead.
"""

import argparse
import itertools
import json
import sys
from collections import deque
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.machine import emit, seconds_per_call, spread
from benchmarks.replay_peers import run
from mrcdrl.common.arena import ArenaBatch, make_codec
from mrcdrl.common.config import AgentConfig, ArenaConfig, LearnerConfig
from mrcdrl.common.messages.trajectory import NUM_ACTIONS
from mrcdrl.common.model.q_network import Precision
from mrcdrl.common.runtime.files import METRICS
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.learner import Learner

_BATCHES = 8  # in turns, as the harness does
_STACK, _VIEW_PX = 4, 60
_MATRIX = 1024  # side of the matrices whose product is taken for the peak
CLEANRL = ("--impl", "cleanrl")
TUNED = (*CLEANRL, "--channels-last", "--fused")
OURS: dict[str, Precision] = {"ours, float32": "float32", "ours, auto": "auto"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path)
    parser.add_argument("--cores", default="0,1")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--step", choices=["auto", "eager", "graph"])
    parser.add_argument("--batches", type=int, nargs="+", default=[32, 512])
    parser.add_argument("--precision", default="auto", choices=["auto", "float32", "bfloat16"])
    parser.add_argument("--pictures", choices=["arena", "noise"], default="arena")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--reps", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--profile", action="store_true")
    arguments = parser.parse_args()
    if arguments.run is not None:
        emit({"bench": "learner of a run", "samples_per_s": consumed(arguments.run)})
    if arguments.profile:
        profiled(arguments)
    elif arguments.step or not (arguments.rounds and (arguments.peers or on_gpu(arguments))):
        emit(ours(arguments))
    else:
        found = alternately(arguments)
        for name, results in found.items():
            cells = (
                f"b{size} {median(figure(r, size) for r in results):8.1f}"
                for size in arguments.batches
            )
            sys.stderr.write(f"{name:24}" + "   ".join(cells) + "\n")


def alternately(arguments: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Results by system, a round after the other; each is printed as it comes."""
    timing = [f"--{name}={getattr(arguments, name)}" for name in ("threads", "seconds", "reps")]
    module = [sys.executable, "-m", "benchmarks.learner", *timing, "--batches"]
    module += map(str, arguments.batches)
    module += [f"--pictures={arguments.pictures}", f"--robots={arguments.robots}"]
    systems: dict[str, tuple[list[str], dict[str, str]]] = {}
    if arguments.peers is not None:
        script = [sys.executable, str(arguments.peers / "bench_learner.py"), *timing]
        script += ["--batches", ",".join(map(str, arguments.batches))]
        systems["CleanRL, plain"] = ([*script, *CLEANRL], {})
        systems["CleanRL, tuned"] = ([*script, *TUNED], ALLOCATOR)
    if not on_gpu(arguments):
        for name, precision in OURS.items():
            command = [*module, "--step", "auto", "--precision", precision]
            systems[name] = (command, ALLOCATOR)
    else:
        given = ["--device", arguments.device, "--precision", arguments.precision]
        for step in ("eager", "auto"):
            systems[f"ours, {step}"] = ([*module, *given, "--step", step], ALLOCATOR)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in systems}
    for turn in range(arguments.rounds):
        for name, (command, environment) in systems.items():
            result = run(["taskset", "-c", arguments.cores, *command], **environment)
            print(json.dumps({"system": name, "round": turn, **result}), flush=True)
            found[name].append(result)
    return found


def on_gpu(arguments: argparse.Namespace) -> bool:
    """Whether we are measured there."""
    return bool(arguments.device != "cpu")


def figure(result: dict[str, Any], size: int) -> float:
    """Median updates a second; not a number where the system gave none."""
    value = result.get(f"b{size}_updates_per_s", np.nan)
    return float(value["median"] if isinstance(value, dict) else value)


def ours(arguments: argparse.Namespace) -> dict[str, object]:
    """Updates a second of our learner for each size of batch."""
    learner = make_learner(arguments)
    dtype, num = learner.online.compute_dtype, learner.updates_per_launch
    peak = {precision: flops_peak(precision, arguments) for precision in {torch.float32, dtype}}
    figures: dict[str, object] = {
        "bench": "learner",
        "threads": arguments.threads,
        "dtype": str(dtype),
        "learner": repr(learner),
        "pictures": arguments.pictures,
        "robots": arguments.robots,
        **{f"{_name(p)}_gflops_peak": round(f / 1e9, 1) for p, f in peak.items()},
    }
    for size in arguments.batches:
        learner = make_learner(arguments)
        launch = endless_steps(learner, size, arguments)
        for _ in range(10):  # the first ones record what the others replay
            launch()
        updates = [
            num / s
            for s in seconds_per_call(launch, seconds=arguments.seconds, repeats=arguments.reps)
        ]
        flops = flops_of_a_step(arguments, size)
        figures[f"b{size}_updates_per_s"] = spread(updates)
        figures[f"b{size}_gflop_per_update"] = round(flops / 1e9, 3)
        figures[f"b{size}_share_of_peak"] = round(median(updates) * flops / peak[dtype], 3)
        figures[f"b{size}_share_of_float32_peak"] = round(
            median(updates) * flops / peak[torch.float32], 3
        )
    return figures


def make_learner(arguments: argparse.Namespace, threads: int | None = None) -> Learner:
    """As `mrcdrl learner` makes it, of the default agent."""
    torch.set_num_threads(1)
    torch.backends.cudnn.benchmark = True
    settings = LearnerConfig(
        precision=arguments.precision, device=arguments.device, step=arguments.step or "auto"
    )
    return Learner(
        AgentConfig(),
        settings,
        stack=_STACK,
        view_px=_VIEW_PX,
        threads=threads or arguments.threads,
    )


def endless_steps(learner: Learner, size: int, arguments: argparse.Namespace) -> Any:
    """What makes one launch's steps at each call, and reads TD errors back."""
    batches = itertools.cycle(
        [
            random_batch(size, seed, arguments).map(lambda x: x.to(learner.device))
            for seed in range(_BATCHES)
        ]
    )
    waiting: deque[Any] = deque()
    late = learner.device.type == "cuda"

    def launch() -> None:
        updates = learner.steps(list(itertools.islice(batches, learner.updates_per_launch)))
        waiting.append(torch.cat([update.td_errors for update in updates]).abs())
        if len(waiting) > late:
            waiting.popleft().cpu().numpy()

    return launch


def flops_of_a_step(arguments: argparse.Namespace, size: int) -> int:
    """Of products and convolutions, a multiplication and an addition being two; as torch's own
    operations on a CPU do them, since kernels of ours are not counted.
    """
    plainly = {"step": "eager", "device": "cpu", "precision": "float32"}
    learner = make_learner(argparse.Namespace(**{**vars(arguments), **plainly}), threads=1)
    with FlopCounterMode(display=False) as counter:
        learner.step(random_batch(size, 0, argparse.Namespace(pictures="noise")))
    return int(counter.get_total_flops())


def flops_peak(dtype: torch.dtype, arguments: argparse.Namespace) -> float:
    """Operations a second of large matrix products with the same threads: the best of a few."""
    side = _MATRIX * (8 if on_gpu(arguments) else 1)
    one = torch.randn(side, side, device=arguments.device).to(dtype)
    into = torch.empty_like(one)

    def multiply() -> None:
        torch.mm(one, one, out=into)
        into[0, :1].cpu()

    torch.set_num_threads(arguments.threads)
    seconds = seconds_per_call(multiply, seconds=min(arguments.seconds, 0.3), repeats=3)
    torch.set_num_threads(1)
    return float(2 * side**3 / min(seconds))


def consumed(run_dir: Path) -> float:
    """Transitions a second that the learner of a run took in its best minute."""
    lines = [json.loads(line) for line in (run_dir / METRICS).read_text("utf-8").splitlines()]
    rates = [line["samples_per_s"] for line in lines]
    minutes = [rates[at : at + 60] for at in range(0, len(rates), 60)]
    return round(max(sum(minute) / len(minute) for minute in minutes), 1)


def profiled(arguments: argparse.Namespace) -> None:
    """Prints a table of operations for each size of batch, of one thread."""
    for size in arguments.batches:
        launch = endless_steps(make_learner(arguments, threads=1), size, arguments)
        for _ in range(10):
            launch()
        kinds = [ProfilerActivity.CPU, *[ProfilerActivity.CUDA] * on_gpu(arguments)]
        with profile(activities=kinds) as taken:
            for _ in range(10):
                launch()
        key = "self_device_time_total" if on_gpu(arguments) else "self_cpu_time_total"
        print(f"batch {size}, 10 launches")
        print(taken.key_averages().table(sort_by=key, row_limit=20, max_name_column_width=44))


def random_batch(size: int, seed: int, arguments: argparse.Namespace) -> Batch:
    """Of random transitions, with the pictures that the arguments want."""
    generator = torch.Generator().manual_seed(seed)
    if arguments.pictures == "noise":
        shape = (2, size, _STACK, _VIEW_PX, _VIEW_PX)
        pictures = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
    else:
        pictures = arena_states(2 * size, seed, arguments.robots).unflatten(0, (2, size))
    return Batch(
        observation=pictures[0],
        action=torch.randint(0, 3, (size,), generator=generator),
        reward=torch.rand(size, generator=generator),
        discount=torch.full((size,), 0.99),
        next_observation=pictures[1],
        importance_weights=torch.ones(size),
        keys=np.arange(size),
    )


def arena_states(count: int, seed: int, num_robots: int) -> torch.Tensor:
    """States uint8 [count, S, V, V] of robots that play at random, each state of another time."""
    config = ArenaConfig(num_robots=num_robots)
    codec, rng = make_codec(config), np.random.default_rng(seed)
    arenas = ArenaBatch(
        config, rng.spawn(-(-count // num_robots)), max_collisions=config.max_frames
    )
    for i in range(len(arenas)):
        arenas.reset(i)
    pictures = []
    for _ in range(_STACK):
        actions = rng.integers(NUM_ACTIONS, size=(len(arenas), num_robots), dtype=np.uint8)
        records = arenas.step(actions).records
        pictures.append(codec.decode(records.reshape(-1, records.shape[-1])))
    return torch.from_numpy(np.stack(pictures, axis=1)[:count])


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


if __name__ == "__main__":
    main()
