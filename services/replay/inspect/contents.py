"""What the log of a run holds, read from its files alone: nothing is changed, nobody is asked.

Invariants: chunks are taken, numbered and left out as a service that starts would; the table is
the one it would have, with digests in place of records. A log that is being written may be read
meanwhile.
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
from mrcdrl.services.replay.build import build
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import read_segment, segment_paths
from mrcdrl.services.replay.sampler import priorities_of
from mrcdrl.services.replay.sequence import Arrival, SequenceBook
from mrcdrl.services.replay.snapshot import Snapshot, read_snapshot
from mrcdrl.services.replay.table import Table

_DIGEST_BYTES = 8


@dataclass(slots=True)
class Files:
    """The segments, and what of them is no chunk of the run."""

    segments: int = 0
    bytes: int = 0
    torn_bytes: int = 0  # after the last whole record; in a run that is up, of a write under way
    corrupt_records: int = 0
    left_out_chunks: int = 0  # of no known form, or of another arena or agent
    duplicate_chunks: int = 0
    oldest_s: float = 0.0  # since the oldest segment was last written
    newest_s: float = 0.0  # since the newest segment was last written


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """The table that a service would have after a start, but for its records."""

    table: Table
    limiter: RateLimiter
    snapshot: Snapshot | None  # None where there is none that fits
    exponent: float

    @property
    def priorities(self) -> Float32Array:
        """Of its transitions, absolute TD errors [size]; [0] where sampling is uniform."""
        return priorities_of(self.table.sampler.shares(self.table.keys), self.exponent)


@dataclass(slots=True)
class Contents:
    """All chunks of a log, oldest first, and the key of each one's first transition."""

    files: Files = field(default_factory=Files)
    keys: list[int] = field(default_factory=list)
    chunks: list[Chunk] = field(default_factory=list)
    rebuilt: Rebuilt | None = None  # None without a configuration

    @property
    def num_transitions(self) -> int:
        return sum(map(len, self.chunks))


def log_directory(run: Path, shard: int) -> Path:
    """Where a run's log lies; RunDirectoryError where there is no run or no log."""
    if not run.is_dir():
        raise RunDirectoryError(f"{run} is no run's folder")
    directory = run / "replay" / str(shard)
    if not directory.is_dir():
        others = sorted(path.name for path in directory.parent.glob("*") if path.is_dir())
        hint = f"; there are the shards {', '.join(others)}" if others else ""
        raise RunDirectoryError(f"{run} has no replay log: {directory} is missing{hint}")
    return directory


def read_contents(directory: Path, config: Config | None, *, records: bool = False) -> Contents:
    """The chunks of a log.

    config: the run's; None: all chunks are taken for the run's, and there is no table. records:
    keep the observation records; otherwise each chunk's have no columns.
    """
    contents, book = Contents(), SequenceBook()
    table, limiter = (None, None) if config is None else build(config, record_bytes=_DIGEST_BYTES)
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
                table.insert(replace(chunk, records=_digests(chunk.records)))
        except WireError:
            contents.files.left_out_chunks += 1
            continue
        book.record(chunk.actor, chunk.incarnation, chunk.sequence)
        contents.keys.append(next_key)
        if not records:
            chunk = replace(chunk, records=np.empty((len(chunk.records), 0), np.uint8))
        contents.chunks.append(chunk)
        next_key += len(chunk)
    if config is not None and table is not None and limiter is not None:
        contents.rebuilt = _rebuilt(directory, config, table, limiter)
    return contents


def _rebuilt(directory: Path, config: Config, table: Table, limiter: RateLimiter) -> Rebuilt:
    limiter.resume(len(table))
    snapshot = read_snapshot(directory)
    if snapshot is not None and not snapshot.restore(config, table, limiter):
        snapshot = None
    return Rebuilt(table, limiter, snapshot, config.replay.priority_exponent)


def _check_record(chunk: Chunk, config: Config) -> None:
    if chunk.records.shape[1] != config.arena.record_bytes:
        raise WireError("records of another arena")


def _digests(records: UInt8Array) -> UInt8Array:
    """By which the table knows equal records, uint8 [N, D] of [N, R]."""
    digests = (blake2b(record, digest_size=_DIGEST_BYTES).digest() for record in records)
    return np.frombuffer(b"".join(digests), np.uint8).reshape(-1, _DIGEST_BYTES)


def _first_key(directory: Path) -> int:
    return next((int(path.stem) for path in segment_paths(directory)), 0)


def _payloads(directory: Path, files: Files) -> Iterator[bytes]:
    """The payloads of all whole records, oldest first; counts what is none."""
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
        except FileNotFoundError:  # all in it has left the table meanwhile
            continue
        files.newest_s = max(now - status.st_mtime, 0.0)
        files.oldest_s = files.oldest_s if files.segments else files.newest_s
        files.segments += 1
        files.bytes += status.st_size
        files.torn_bytes += max(status.st_size - whole, 0)
