"""Time how long a replay service takes to read its log back after a kill, with a full table.

Writes a log of random chunks once (4 robots, `--codec` scene or frames), with a snapshot of all
priorities beside it, then builds table, log and service `--repeats` times, as a start does. Prints
one line of JSON: wall-clock and processor seconds (median, min, max).
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.machine import emit, spread
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.log import open_log
from tests.services.replay.harness import start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--codec", choices=("scene", "frames"), default="scene")
    parser.add_argument("--sampler", choices=("uniform", "prioritized"), default="prioritized")
    parser.add_argument("--transitions", type=int, default=400_000)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    config = load_config(
        "apex",
        {
            "arena.num_robots": "4",
            "arena.codec": arguments.codec,
            "actor.chunk_length": "50",
            "replay.capacity": str(arguments.transitions),
            "replay.min_size": "1000",
            "replay.sampler": arguments.sampler,
        },
        environ={},
    )
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        fill(config, directory)
        figures = [recover(config, directory) for _ in range(arguments.repeats)]
        size = sum(path.stat().st_size for path in directory.iterdir())
    emit(
        {
            "bench": "replay_recover",
            "codec": arguments.codec,
            "sampler": arguments.sampler,
            "transitions": arguments.transitions,
            "bytes": size,
            "wall_s": spread([wall for wall, _ in figures], 2),
            "processor_s": spread([processor for _, processor in figures], 2),
        }
    )


def fill(config: Config, directory: Path) -> None:
    """Write the log of a full table, and a snapshot."""
    log = open_log(config, directory)
    assert log is not None
    rng, length = np.random.default_rng(0), config.actor.chunk_length
    rows = config.arena.stack - 1 + length + config.agent.n_step
    for number in range(config.replay.capacity // length):
        chunk = Chunk(
            actor=f"actor-{number % 8}",
            incarnation=1,
            sequence=number // 8,
            weights_version=number,
            records=rng.integers(0, 256, (rows, config.arena.record_bytes), np.uint8),
            actions=rng.integers(0, 3, length, np.uint8),
            rewards=rng.random(length, np.float32),
            discounts=np.full(length, 0.97, np.float32),
            bootstrap_offsets=np.full(length, config.agent.n_step, np.uint8),
            priorities=rng.random(length, np.float32) if config.replay.prioritized else NONE,
        )
        log.append([encode(chunk)], number * length, length)
    log.close()
    (directory / "snapshot").write_bytes(start(directory, config).snapshot().to_bytes())


def recover(config: Config, directory: Path) -> tuple[float, float]:
    """Wall-clock and processor seconds until the table is back."""
    wall, processor = time.perf_counter(), time.process_time()
    service = start(directory, config)
    taken = time.perf_counter() - wall, time.process_time() - processor
    assert service.metrics().size > 0.9 * config.replay.capacity  # tails take rows, too
    return taken


NONE = np.empty(0, np.float32)

if __name__ == "__main__":
    main()
