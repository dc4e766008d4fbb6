"""Load a replay service with a process that inserts counting chunks, or one that samples them.

`python -m benchmarks.replay_load writer|sampler --run NAME --connect ENDPOINT --config FILE` runs
until it is asked to stop, whatever happens to the service. A counting chunk is a pure function of
its actor and sequence, so that a reader knows what it should hold. A writer sends up to six at a
time, as an actor's spool does, and writes a line to `--out` for each acknowledged chunk: its
sequence, and the key of its first transition, or -1 if unknown (the acknowledgement tells only the
key of a request's last chunk, unless it is a duplicate). The last line is `done`.
"""

import argparse
import random
import sys
import time
from pathlib import Path

import numpy as np

from mrcdrl.common.config import Config, TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Chunk, Priorities, Samples
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader, ReplayWriter

_WARN_S = 60.0
_MOST_CHUNKS = 6  # in one request
MAX_COUNT = 1_000_000  # rewards count so far, then from 0: the largest that settings allow


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("role", choices=("writer", "sampler"))
    parser.add_argument("--run", required=True)
    parser.add_argument("--connect", required=True)
    parser.add_argument("--config", required=True)
    parser.add_argument("--actor", default="actor-0")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    config, stop = load_config(arguments.config, environ={}), StopSignal().listen()
    transport = TransportConfig(connect=(arguments.connect,), timeout_s=config.transport.timeout_s)
    with Session(transport) as session:
        if arguments.role == "writer":
            write(config, session, Keys(arguments.run), arguments.actor, arguments.out, stop)
        else:
            sample(config, session, Keys(arguments.run), stop)
    return 0


def write(
    config: Config, session: Session, keys: Keys, actor: str, out: Path, stop: StopSignal
) -> None:
    """Insert chunk after chunk, some together, each until it is acknowledged."""
    writer, incarnation, sequence = ReplayWriter(session, keys, _WARN_S, stop), time.time_ns(), 0
    rng = random.Random(actor)
    with out.open("w", encoding="utf-8", buffering=1) as acknowledged:
        while not stop.is_set():
            numbers = range(sequence, sequence + rng.randint(1, _MOST_CHUNKS))
            chunks = [counting_chunk(config, actor, incarnation, n) for n in numbers]
            reply = writer.insert(chunks)
            if reply is None:
                break
            key = -1 if reply.duplicate else reply.inserts - config.actor.chunk_length
            acknowledged.writelines(f"{n} -1\n" for n in numbers[:-1])
            acknowledged.write(f"{numbers[-1]} {key}\n")
            sequence = numbers.stop
        acknowledged.write("done\n")


def sample(config: Config, session: Session, keys: Keys, stop: StopSignal) -> None:
    """Sample mini-batches, check that they are whole, and set new priorities."""
    reader = ReplayReader(session, keys, config.learner.batch_size, 2, 2, _WARN_S, stop)
    writer = PriorityWriter(session, keys, stop)
    rng = np.random.default_rng(0)
    while (samples := reader.sample()) is not None:
        check_samples(config, samples)
        errors = rng.lognormal(0, 1, len(samples)).astype(np.float32)
        writer.update(Priorities(samples.keys, errors))


def counting_chunk(config: Config, actor: str, incarnation: int, sequence: int) -> Chunk:
    """A chunk whose rewards count its actor's transitions and whose records repeat the count."""
    length, tail = config.actor.chunk_length, config.arena.stack - 1 + config.agent.n_step
    first = sequence * length
    rows = (first + np.arange(length + tail)).astype("<u4")
    counts = np.tile(rows[:, None], config.arena.record_bytes // 4)
    return Chunk(
        actor=actor,
        incarnation=incarnation,
        sequence=sequence,
        weights_version=sequence,
        records=counts.view(np.uint8),
        actions=((first + np.arange(length)) % 3).astype(np.uint8),
        rewards=((first + np.arange(length)) % MAX_COUNT).astype(np.float32),
        discounts=np.full(length, 0.97, np.float32),
        bootstrap_offsets=np.full(length, config.agent.n_step, np.uint8),
        priorities=np.ones(length, np.float32),
    )


def check_samples(config: Config, samples: Samples) -> None:
    """Raise AssertionError if records, rewards and versions of a transition do not match."""
    counts = samples.records.view("<u4")
    first = samples.weights_versions * config.actor.chunk_length
    window = counts[:, :1, :1] + np.arange(counts.shape[1])[:, None]
    now = counts[:, 0, 0].astype(np.int64)
    if not (
        (counts == window).all()
        and (samples.rewards == now % MAX_COUNT).all()
        and (samples.actions == now % 3).all()
        and ((now >= first) & (now < first + config.actor.chunk_length)).all()
    ):
        raise AssertionError("a sampled transition is torn or misplaced")


if __name__ == "__main__":
    sys.exit(main())
