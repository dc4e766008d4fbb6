"""Run a replay service at full load: does its memory grow, and how long do requests take?

Starts `mrcdrl replay` and two processes that insert, and sample with priorities, as fast as they
can. Once the table has been filled twice, its memory is recorded every few seconds. Prints one line
of JSON: memory at the beginning, the end and the maximum (proportional, MiB), request latencies
(milliseconds: median, p99, maximum), and throughput.
"""

import argparse
import multiprocessing
import multiprocessing.process
import multiprocessing.queues
import multiprocessing.synchronize
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import emit
from mrcdrl.common.config import Config, load_config, to_toml
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.trajectory import Chunk, Priorities, Stats
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.runtime.process import COMMAND, StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader, ReplayWriter

RUN = "soak"
LENGTH = 50
PERIOD_S = 5.0
CHUNKS_PER_REQUEST = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--capacity", type=int, default=400_000)
    parser.add_argument("--codec", choices=["scene", "frames"], default="scene")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--log-dir", help="directory for the log; default: the system's")
    arguments = parser.parse_args()
    config = load_config(
        "quick",
        {
            "arena.num_robots": "4",
            "arena.codec": arguments.codec,
            "replay.capacity": str(arguments.capacity),
            "replay.sampler": "prioritized",
            "replay.samples_per_insert": "0",
            "learner.batch_size": str(arguments.batch_size),
        },
        environ={},
    )
    with tempfile.TemporaryDirectory(prefix="soak-", dir=arguments.log_dir) as folder:
        emit({"bench": "replay_soak", **vars(arguments), **soak(config, arguments, Path(folder))})


def soak(config: Config, arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run the load and return all figures."""
    endpoint = free_endpoint()
    (folder / "config.toml").write_text(to_toml(config), "utf-8")
    command = [*COMMAND, "replay", "--run", RUN, "--listen", endpoint]
    command += ["--config", str(folder / "config.toml"), "--run-dir", str(folder)]
    spawn = multiprocessing.get_context("spawn")
    stop, results = spawn.Event(), spawn.Queue()
    workers = [
        spawn.Process(target=work, args=(name, config, endpoint, stop, results)) for name in WORK
    ]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as service:
        try:
            for worker in workers:
                worker.start()
            memory = watch(service.pid, config, endpoint, arguments.minutes, workers)
            stop.set()
            return {"memory_mib": memory, **dict(results.get(timeout=60) for _ in workers)}
        finally:
            stop.set()
            service.terminate()
            for worker in workers:
                worker.join(60)


def work(
    name: str,
    config: Config,
    endpoint: str,
    stop: multiprocessing.synchronize.Event,
    results: "multiprocessing.queues.Queue[tuple[str, dict[str, float]]]",
) -> None:
    """Run one of WORK until stopped, then send its figures."""
    results.put((name, WORK[name](config, endpoint, stop)))


def watch(
    process: int,
    config: Config,
    endpoint: str,
    minutes: float,
    workers: Sequence[multiprocessing.process.BaseProcess],
) -> dict[str, float]:
    """Memory of the service under load, from when its table has been filled twice."""
    transport = config.transport.model_copy(update={"connect": (endpoint,)})
    found: list[float] = []
    with Session(transport) as session:
        stats = session.queue_subscriber(Keys(RUN).every_stats)
        inserts, due_s = 0.0, time.monotonic()
        while len(found) < max(2, 60 * minutes / PERIOD_S):
            if not all(worker.is_alive() for worker in workers):
                raise MrcdrlError("a worker has ended; its error is above")
            item = stats.take(1.0)
            if item is not None:
                inserts = decode(Stats, item[1]).metrics["inserts"]
            if inserts > 2 * config.replay.capacity and time.monotonic() >= due_s:
                due_s = time.monotonic() + PERIOD_S
                found.append(memory_mib(process))
    tenth = max(1, len(found) // 10)
    first, last = np.median(found[:tenth]), np.median(found[-tenth:])
    return {
        "begin": round(float(first), 1),
        "end": round(float(last), 1),
        "max": round(max(found), 1),
        "growth": round(float(last / first - 1), 4),
        "inserts": inserts,
    }


def memory_mib(process: int) -> float:
    """Proportional memory: a buffer shared with a client counts half.

    Leaves out mapped files: a library's part depends on how many processes have it open.
    """
    rollup = Path(f"/proc/{process}/smaps_rollup").read_text("ascii")
    fields = dict(line.split()[:2] for line in rollup.splitlines()[1:])
    return (int(fields["Pss_Anon:"]) + int(fields["Pss_Shmem:"])) / 1024


def insert(
    config: Config, endpoint: str, stop: multiprocessing.synchronize.Event
) -> dict[str, float]:
    """Insert chunks until stopped."""
    rng = np.random.default_rng(0)
    arena = config.arena
    shape = (arena.stack - 1 + LENGTH + config.agent.n_step, arena.record_bytes)
    records = [rng.integers(0, 255, shape).astype(np.uint8) for _ in range(64)]
    seconds: list[float] = []
    with Session(config.transport.model_copy(update={"connect": (endpoint,)})) as session:
        writer = ReplayWriter(session, Keys(RUN), 10.0, StopSignal())
        while not stop.is_set():
            first = CHUNKS_PER_REQUEST * len(seconds)
            chunks = [
                Chunk(
                    actor="soak",
                    incarnation=1,
                    sequence=number,
                    weights_version=number,
                    records=records[number % len(records)],
                    actions=rng.integers(0, 3, LENGTH).astype(np.uint8),
                    rewards=rng.random(LENGTH).astype(np.float32),
                    discounts=np.ones(LENGTH, np.float32),
                    bootstrap_offsets=np.ones(LENGTH, np.uint8),
                    priorities=rng.random(LENGTH).astype(np.float32),
                )
                for number in range(first, first + CHUNKS_PER_REQUEST)
            ]
            began = time.perf_counter()
            writer.insert(chunks)
            seconds.append(time.perf_counter() - began)
    return latencies(seconds) | {"transitions": len(seconds) * CHUNKS_PER_REQUEST * LENGTH}


def sample(
    config: Config, endpoint: str, stop: multiprocessing.synchronize.Event
) -> dict[str, float]:
    """Sample mini-batches one at a time and set their priorities, until stopped."""
    rng = np.random.default_rng(1)
    size = config.learner.batch_size
    seconds: list[float] = []
    with Session(config.transport.model_copy(update={"connect": (endpoint,)})) as session:
        ended = StopSignal()
        reader = ReplayReader(session, Keys(RUN), size, 1, 1, 10.0, ended)
        writer = PriorityWriter(session, Keys(RUN), ended)
        while not stop.is_set():
            began = time.perf_counter()
            samples = reader.sample()
            if samples is None:
                raise MrcdrlError("no mini-batch came")
            seconds.append(time.perf_counter() - began)
            writer.update(Priorities(samples.keys, rng.random(size).astype(np.float32)))
    return latencies(seconds) | {"transitions": len(seconds) * size}


def latencies(seconds: list[float]) -> dict[str, float]:
    """Milliseconds, without the first hundred requests, which set things up."""
    median, p99, longest = np.quantile(np.array(seconds[100:]) * 1000, [0.5, 0.99, 1.0])
    return {
        "p50_ms": round(float(median), 3),
        "p99_ms": round(float(p99), 3),
        "max_ms": round(float(longest), 1),
    }


WORK = {"insert": insert, "sample": sample}

if __name__ == "__main__":
    main()
