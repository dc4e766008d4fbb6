"""What the log of a run holds, read from its files alone, without changing anything.

Invariants: chunks are taken, numbered and left out as a starting service would; the table is the
one it would have, with hashes in place of records. A log may be read while it is being written.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from pathlib import Path

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.errors import RunDirectoryError, WireError
from mrcdrl.common.messages.trajectory import Chunk, Float32Array, UInt8Array
from mrcdrl.common.messages.wire import decode
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import read_segment, segment_paths
from mrcdrl.services.replay.sampler import priorities_of
from mrcdrl.services.replay.sequence import Arrival, SequenceBook
from mrcdrl.services.replay.snapshot import Snapshot, read_snapshot
from mrcdrl.services.replay.table import Table

_HASH_BYTES = 8


@dataclass(slots=True)
class Files:
    """The segments, and the parts of them that are not chunks of the run."""

    segments: int = 0
    bytes: int = 0
    torn_bytes: int = 0  # after the last whole record; in a live run, of a write in progress
    corrupt_records: int = 0
    left_out_chunks: int = 0  # of an unknown schema, or of another arena or agent
    duplicate_chunks: int = 0
    oldest_s: float = 0.0  # since the oldest segment was last written
    newest_s: float = 0.0  # since the newest segment was last written


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """The table that a service would have after a start, except its records."""

    table: Table
    limiter: RateLimiter
    snapshot: Snapshot | None  # None if there is none that fits
    exponent: float

    @property
    def priorities(self) -> Float32Array:
        """Absolute TD errors of its transitions [size]; [0] where sampling is uniform."""
        scaled = self.table.sampler.scaled_priorities(self.table.keys)
        return priorities_of(scaled, self.exponent)


@dataclass(slots=True)
class Contents:
    """All chunks of a log, oldest first, and the key of each chunk's first transition."""

    files: Files = field(default_factory=Files)
    keys: list[int] = field(default_factory=list)
    chunks: list[Chunk] = field(default_factory=list)
    rebuilt: Rebuilt | None = None  # None without a configuration

    @property
    def num_transitions(self) -> int:
        return sum(map(len, self.chunks))


def log_directory(run: Path, shard: int) -> Path:
    """The directory of a run's log; raises RunDirectoryError if there is no run or no log."""
    if not run.is_dir():
        raise RunDirectoryError(f"{run} is not a directory")
    directory = run / "replay" / str(shard)
    if not directory.is_dir():
        others = sorted(path.name for path in directory.parent.glob("*") if path.is_dir())
        hint = f"; its shards are {', '.join(others)}" if others else ""
        raise RunDirectoryError(f"{run} has no replay log: {directory} is missing{hint}")
    return directory


def read_contents(directory: Path, config: Config | None, *, records: bool = False) -> Contents:
    """Read the chunks of a log.

    config: the run's; None: all chunks are assumed to be the run's, and there is no table.
    records: keep the observation records; otherwise they have no columns.
    """
    contents, book = Contents(), SequenceBook()
    table = None if config is None else Table.from_config(config, record_bytes=_HASH_BYTES)
    next_key = _first_key(directory)
    if table is not None:
        table.number_from(next_key)
    for payload in _payloads(directory, contents.files):
        try:
            chunk = decode(Chunk, payload)
            if book.classify(chunk.actor, chunk.incarnation, chunk.sequence) is Arrival.REPEATED:
                contents.files.duplicate_chunks += 1
                continue
            if table is not None and config is not None:
                _check_record(chunk, config)
                table.insert(replace(chunk, records=_record_hashes(chunk.records)))
        except WireError:
            contents.files.left_out_chunks += 1
            continue
        book.record(chunk.actor, chunk.incarnation, chunk.sequence)
        contents.keys.append(next_key)
        if not records:
            chunk = replace(chunk, records=np.empty((len(chunk.records), 0), np.uint8))
        contents.chunks.append(chunk)
        next_key += len(chunk)
    if config is not None and table is not None:
        contents.rebuilt = _rebuilt(directory, config, table)
    return contents


def _rebuilt(directory: Path, config: Config, table: Table) -> Rebuilt:
    limiter = RateLimiter.from_config(config)
    limiter.resume(len(table))
    snapshot = read_snapshot(directory)
    if snapshot is not None and not snapshot.restore(config, table, limiter):
        snapshot = None
    return Rebuilt(table, limiter, snapshot, config.replay.priority_exponent)


def _check_record(chunk: Chunk, config: Config) -> None:
    if chunk.records.shape[1] != config.arena.record_bytes:
        raise WireError("records of another arena")


def _record_hashes(records: UInt8Array) -> UInt8Array:
    """Hash records, uint8 [N, R] to [N, _HASH_BYTES], so that the table recognizes equal ones."""
    hashes = (blake2b(record, digest_size=_HASH_BYTES).digest() for record in records)
    return np.frombuffer(b"".join(hashes), np.uint8).reshape(-1, _HASH_BYTES)


def _first_key(directory: Path) -> int:
    return next((int(path.stem) for path in segment_paths(directory)), 0)


def _payloads(directory: Path, files: Files) -> Iterator[bytes]:
    """Yield the payloads of all whole records, oldest first; count the rest in `files`."""
    now = time.time()
    for path in segment_paths(directory):
        whole = 0
        try:
            for _, end, payload in read_segment(path):
                whole = end
                if payload is None:
                    files.corrupt_records += 1
                else:
                    yield payload
            status = path.stat()
        except FileNotFoundError:  # the service has evicted all of it meanwhile
            continue
        files.newest_s = max(now - status.st_mtime, 0.0)
        files.oldest_s = files.oldest_s if files.segments else files.newest_s
        files.segments += 1
        files.bytes += status.st_size
        files.torn_bytes += max(status.st_size - whole, 0)
