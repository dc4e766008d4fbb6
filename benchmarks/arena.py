"""The arena on one core: robot steps per second of physics, of rendering, and of both.

Prints one line of JSON. Each figure is the median of interleaved repeats, so that other load on the
machine affects all alike; rates are per second of processor time. `drawing` is rendering, and
`literal_drawing` the paper's steps of it, the arena once for all of its robots. `collecting` gives
the shares of an actor's time.

With --pusht-python it also measures gym-pusht in its own environment, images of 60 x 60 per second:

    python3 -m venv pusht && pusht/bin/pip install gym-pusht
    python -m benchmarks.arena --pusht-python pusht/bin/python
"""

import argparse
import os
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.machine import emit, spread
from benchmarks.stages import make_collector
from mrcdrl.common.arena import ArenaBatch, Scene, literal_views, make_codec
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import UInt8Array

PUSHT = Path(__file__).with_name("pusht.py")
NUM_ACTIONS_DRAWN = 512  # steps after which the random actions repeat
WARM_UP_CALLS = 20

Measure = Callable[[float], float]  # takes the seconds to spend, returns the rate


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", type=int, default=[2, 3, 4])
    parser.add_argument("--arenas", type=int, default=16, help="stepped together")
    parser.add_argument("--seconds", type=float, default=1.0, help="per repeat")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--core", type=int, help="to run on; default: the first one allowed")
    parser.add_argument("--pusht-python", type=Path, help="a Python that has gym-pusht")
    arguments = parser.parse_args()
    core = min(os.sched_getaffinity(0)) if arguments.core is None else arguments.core
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    measures: dict[str, Measure] = {}
    for num_robots in arguments.robots:
        measures |= measures_of(num_robots, arguments.arenas)
    rates: dict[str, list[float]] = {}
    with ExitStack() as stack:
        if arguments.pusht_python is not None:
            rival = stack.enter_context(
                subprocess.Popen(
                    [arguments.pusht_python, PUSHT],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    bufsize=0,
                )
            )
            measures["pusht_pictures_per_s"] = lambda seconds: ask(rival, seconds)
        for _ in range(arguments.repeats):
            for name, measure in measures.items():
                rates.setdefault(name, []).append(measure(arguments.seconds))
    collecting = [collecting_shares(n, arguments.seconds) for n in arguments.robots]
    emit(
        {
            "bench": "arena",
            "arenas": arguments.arenas,
            "repeats": arguments.repeats,
            "seconds": arguments.seconds,
            "rates": {name: spread(values, 0) for name, values in rates.items()},
            "collecting": collecting,
        }
    )


def measures_of(num_robots: int, num_arenas: int) -> dict[str, Measure]:
    """Measures of arenas with this number of robots, by name."""
    config = make_config(num_robots)
    step = stepper(config, num_arenas)
    by_pymunk = make_config(num_robots, physics="pymunk")
    render = make_codec(config.arena).decode
    records = step()
    robots = num_arenas * num_robots

    def render_literally(records: UInt8Array) -> None:
        for scene in scenes_of(records, num_robots):
            literal_views(scene, config.arena)

    works: dict[str, Callable[[], object]] = {
        "physics": step,
        "pymunk_physics": stepper(by_pymunk, num_arenas),
        "drawing": lambda: render(records),
        "both": lambda: render(step()),
        "literal_drawing": lambda: render_literally(records),
        "literal_both": lambda: render_literally(step()),
    }
    return {
        f"{name}_{num_robots}_robot_steps_per_s": rate_of(work, robots)
        for name, work in works.items()
    }


def make_config(num_robots: int, physics: str = "array") -> Config:
    given = {"arena.num_robots": str(num_robots), "arena.physics": physics}
    return load_config("quick", given, environ={})


def scenes_of(records: UInt8Array, num_robots: int) -> list[Scene]:
    """Scenes from the records of each arena's first robot."""
    numbers = records.reshape(-1, num_robots, records.shape[-1])[:, 0].copy().view("<f4")
    robots, targets = np.split(numbers.astype(np.float64), [3 * num_robots], axis=1)
    pairs = zip(robots.reshape(-1, num_robots, 3), targets.reshape(-1, num_robots, 2), strict=True)
    return [Scene(*pair) for pair in pairs]


def stepper(config: Config, num_arenas: int) -> Callable[[], UInt8Array]:
    """A function that steps all arenas at random, with resets, and returns records [N, R]."""
    arenas = ArenaBatch(config.arena, [np.random.default_rng(i) for i in range(num_arenas)])
    shape = (NUM_ACTIONS_DRAWN, num_arenas, config.arena.num_robots)
    drawn = np.random.default_rng(0).integers(0, 3, shape, dtype=np.uint8)
    steps = 0
    for index in range(num_arenas):
        arenas.reset(index)

    def step() -> UInt8Array:
        nonlocal steps
        actions = drawn[steps % NUM_ACTIONS_DRAWN]
        steps += 1
        time_steps = arenas.step(actions)
        for index, outcome in enumerate(time_steps.outcomes):
            if outcome is not None:
                arenas.reset(index)
        records: UInt8Array = time_steps.records.reshape(-1, time_steps.records.shape[-1])
        return records

    return step


def rate_of(work: Callable[[], object], per_call: int) -> Measure:
    """Measures work per second of processor time; each call counts as per_call."""
    for _ in range(WARM_UP_CALLS):
        work()

    def measure(seconds: float) -> float:
        started, calls = time.process_time(), 0
        while time.process_time() - started < seconds:
            work()
            calls += 1
        return calls * per_call / (time.process_time() - started)

    return measure


def ask(rival: subprocess.Popen[bytes], seconds: float) -> float:
    """The rival's rate; raises RuntimeError with its exit code if it has ended."""
    if rival.stdin is None or rival.stdout is None:
        raise RuntimeError("the rival has no pipes")
    with suppress(BrokenPipeError):  # no answer will come
        rival.stdin.write(f"{seconds}\n".encode())
    answer = rival.stdout.readline()
    if not answer:
        raise RuntimeError(f"gym-pusht did not answer: exit code {rival.wait()}")
    return float(answer)


def collecting_shares(num_robots: int, seconds: float) -> dict[str, float]:
    """Shares of a collecting actor's time, by its own clock; the policy is untrained."""
    config = make_config(num_robots)
    collector = make_collector(config)
    epsilons = np.full(config.actor.num_arenas, 0.1, np.float32)
    for _ in range(WARM_UP_CALLS):
        collector.step(epsilons)
    before = asdict(collector.seconds)
    steps = collector.robot_steps
    started = time.process_time()
    while time.process_time() - started < seconds:
        collector.step(epsilons)
    spent = {stage: s - before[stage] for stage, s in asdict(collector.seconds).items()}
    total = sum(spent.values())
    shares = {f"{stage}_share": round(s / total, 4) for stage, s in spent.items()}
    rate = (collector.robot_steps - steps) / (time.process_time() - started)
    return {"robots": num_robots, "robot_steps_per_s": round(rate), **shares}


if __name__ == "__main__":
    main()
