"""Kill a replay service at random moments under load, and check that it loses nothing.

`python -m benchmarks.replay_kills --kills 50` runs a replay process, two that insert counting
chunks and one that samples and sets priorities. It kills the first again and again (kill -9), every
fifth time while it is still reading its log, and restarts it. At the end it looks for every
acknowledged chunk in the log. Prints one line of JSON; exits with 1 if a chunk was lost, doubled or
moved.

A restart lasts from the start of the process until its log says that it serves. On a busy machine
most of that may be waiting for a core: `with_a_core_s` leaves this out, as Linux counts it
(schedstat), and `processor_s` is the processor time. Peers find the service a little later, when
Zenoh tries again: `answered_s` lasts until this process gets its first answer.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import emit, spread
from benchmarks.replay_load import MAX_COUNT, counting_chunk
from mrcdrl.common.config import Config, TransportConfig, load_config, to_toml
from mrcdrl.common.errors import DeadlineError
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.inspect.contents import Contents, log_directory, read_contents
from tests.patience import eventually
from tests.system.system_processes import (
    REPOSITORY,
    Command,
    end_all,
    environment,
    run_name,
)

WRITERS = ("actor-0", "actor-1")
DURING_RECOVERY = 5  # one kill in so many comes before the service is up
CONFIG = {
    "arena.num_robots": "4",
    "arena.success_reward": str(MAX_COUNT),  # rewards count transitions
    "actor.chunk_length": "50",
    "replay.sampler": "prioritized",
    "replay.min_size": "1000",
    "replay.samples_per_insert": "0",
    "replay.snapshot_period_s": "1",
    "replay.segment_bytes": "4000000",
    "learner.batch_size": "64",
    "transport.timeout_s": "6",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--capacity", type=int, default=400_000)
    parser.add_argument("--longest", type=float, default=4.0, help="most seconds before a kill")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = ordeal(
            Path(folder), arguments.kills, arguments.seed, arguments.capacity, arguments.longest
        )
    emit({"bench": "replay_kills", **result})
    return 1 if result["lost"] or result["doubled"] or result["moved"] else 0


def ordeal(folder: Path, kills: int, seed: int, capacity: int, longest_s: float) -> dict[str, Any]:
    """Kill and restart, then count what the log holds."""
    config = load_config("smoke", {**CONFIG, "replay.capacity": str(capacity)}, environ={})
    (folder / "kills.toml").write_text(to_toml(config), "utf-8")
    name, rng = run_name("kills"), random.Random(seed)
    service = ReplayProcess(folder, name)
    began_s = time.monotonic()
    try:
        service.begin()
        with Session(TransportConfig(connect=(service.endpoint,))) as session:
            service.wait(session)
            with load(folder, name, service.endpoint):
                for number in range(kills):
                    time.sleep(rng.uniform(0.2, longest_s))
                    service.kill()
                    if number % DURING_RECOVERY == DURING_RECOVERY - 1:
                        service.begin()
                        time.sleep(rng.uniform(0.2, 1.5))
                        service.kill()
                    service.start(session)
                time.sleep(longest_s)
            seconds = time.monotonic() - began_s
            service.end()
    finally:
        end_all(name)
    contents = read_contents(log_directory(folder / name, 0), config, records=True)
    return {
        "kills": service.kills,
        "seed": seed,
        "seconds": round(seconds, 1),
        **compare(config, contents, folder),
        "restart_s": spread(service.restarts, 2),
        "answered_s": spread(service.answers, 2),
        "with_a_core_s": spread(service.with_a_core, 2),
        "processor_s": spread(service.processor, 2),
        "over_5_s": sum(s > 5 for s in service.restarts),
        "with_a_core_over_5_s": sum(s > 5 for s in service.with_a_core),
        "torn_tails": service.logged("torn tail"),
        "snapshots_ignored": service.logged("ignoring"),
        "tracebacks": service.logged("Traceback"),
    }


@dataclass
class ReplayProcess:
    """The replay process and its successors."""

    folder: Path
    run: str
    endpoint: str = field(default_factory=free_endpoint)
    kills: int = 0
    restarts: list[float] = field(default_factory=list)
    answers: list[float] = field(default_factory=list)
    with_a_core: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    command: Command | None = None

    def begin(self) -> None:
        arguments = ["replay", "--run", self.run, "--config", self.folder / "kills.toml"]
        self.command = Command(
            [*arguments, "--listen", self.endpoint, "--run-dir", self.folder], self.folder
        )

    def start(self, session: Session) -> None:
        """Begin, wait, and measure the restart."""
        began_s = time.monotonic()
        self.begin()
        command = self.command
        assert command is not None
        eventually(lambda: " serving " in command.err or command.process.poll() is not None, "up")
        self.restarts.append(time.monotonic() - began_s)
        self.with_a_core.append(self.restarts[-1] - _waited_s(command.process.pid))
        self.processor.append(_processor_s(command.process.pid))
        self.wait(session)
        self.answers.append(time.monotonic() - began_s)

    def wait(self, session: Session) -> None:
        """Wait until it answers."""
        assert self.command is not None
        client = session.client(Keys(self.run).config, "replay", timeout_s=120.0)
        while True:
            if self.command.process.poll() is not None:
                raise AssertionError(self.command.err)
            try:
                client.ask(b"").result()
            except DeadlineError:  # at once, if no server is declared
                time.sleep(0.02)
            else:
                return

    def kill(self) -> None:
        assert self.command is not None
        self.command.signal(signal.SIGKILL)
        self.command.wait()
        self.kills += 1

    def end(self) -> None:
        """Stop it in order."""
        assert self.command is not None
        if self.command.end() != 0:
            raise AssertionError(self.command.err)

    def logged(self, word: str) -> int:
        """Lines of all processes' logs that hold the word."""
        texts = (path.read_text("utf-8") for path in self.folder.glob("replay-*.err"))
        return sum(word in line for text in texts for line in text.splitlines())


def _processor_s(pid: int) -> float:
    """Processor seconds of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _waited_s(pid: int) -> float:
    """Seconds for which the main thread could have run but no core was free."""
    return int(Path(f"/proc/{pid}/schedstat").read_text("utf-8").split()[1]) / 1e9


@contextmanager
def load(folder: Path, run: str, endpoint: str) -> Iterator[None]:
    """Run writers and a sampler during the block; check that they end well."""
    common = ["--run", run, "--connect", endpoint, "--config", str(folder / "kills.toml")]
    roles = [["writer", "--actor", w, "--out", str(folder / f"{w}.acknowledged")] for w in WRITERS]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.replay_load", *role, *common],
            cwd=REPOSITORY,
            env=environment(),
        )
        for role in (*roles, ["sampler"])
    ]
    try:
        yield
        for process in processes:
            if process.poll() is not None:
                raise AssertionError(f"{process.args} ended with {process.returncode}")
            process.terminate()
        for process in processes:
            if process.wait(60):
                raise AssertionError(f"{process.args} ended with {process.returncode}")
    finally:
        for process in processes:
            process.kill()
            process.wait()


def compare(config: Config, contents: Contents, folder: Path) -> dict[str, Any]:
    """Compare what was acknowledged with what the log holds.

    lost: acknowledged, not yet evicted from the table, and missing. moved: under another key than
    acknowledged, or not as sent. doubled: present twice. placed: acknowledged with a key.
    """
    assert contents.rebuilt is not None
    oldest = contents.rebuilt.table.first_key
    by_sequence = {
        (chunk.actor, chunk.sequence): (key, chunk)
        for key, chunk in zip(contents.keys, contents.chunks, strict=True)
    }
    lost, moved, acknowledged, placed, unasked = [], [], 0, 0, 0
    for actor in WRITERS:
        *lines, last = (folder / f"{actor}.acknowledged").read_text("utf-8").splitlines()
        assert last == "done"
        not_before = 0  # keys of one actor increase
        for line in lines:
            sequence, key = (int(word) for word in line.split())
            acknowledged, placed = acknowledged + 1, placed + (key >= 0)
            not_before = max(not_before, key)
            found = by_sequence.get((actor, sequence))
            if found is None:
                lost += [f"{actor} {sequence}"] * (not_before >= oldest)
            elif key not in (-1, found[0]) or not _as_sent(config, found[1]):
                moved.append(f"{actor} {sequence}")
        newest = max(s for a, s in by_sequence if a == actor)
        unasked += newest - (len(lines) - 1)
    files = contents.files
    return {
        "acknowledged": acknowledged,
        "transitions": acknowledged * config.actor.chunk_length,
        "placed": placed,
        "lost": lost[:20],
        "doubled": files.duplicate_chunks + len(contents.chunks) - len(by_sequence),
        "moved": moved[:20],
        "stored_unacknowledged": unasked,  # at most one request per writer
        "in_the_log": len(contents.chunks),
        "table_size": len(contents.rebuilt.table),
        "corrupt_records": files.corrupt_records,
        "left_out_chunks": files.left_out_chunks,
        "segments": files.segments,
    }


def _as_sent(config: Config, chunk: Any) -> bool:
    sent = counting_chunk(config, chunk.actor, chunk.incarnation, chunk.sequence)
    return all(
        np.array_equal(getattr(chunk, name), getattr(sent, name))
        for name in ("records", "actions", "rewards", "discounts", "bootstrap_offsets")
    )


if __name__ == "__main__":
    sys.exit(main())
