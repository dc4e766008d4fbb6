"""The segment log: accepted chunks, appended before they are acknowledged, read back at startup.

    <directory>/<first key, 15 digits>.segment
    record: length uint32, CRC-32 of the payload uint32 (little-endian), payload (a wire Chunk)

Invariants: a record is whole in the page cache when `append` returns, so an acknowledged chunk
survives kill -9, and with fsync a power cut too; a segment is deleted only after the table has
evicted all of it; a torn tail is cut off, a corrupt record skipped, and both are logged.
"""

import logging
import os
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from zlib_ng import zlib_ng  # ten times as fast as zlib

from mrcdrl.common.config import Config
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.runtime.files import lock_directory, reason, sync_directory

_LOG = logging.getLogger("replay")
_HEADER = struct.Struct("<II")
_SUFFIX = ".segment"
_PARTS = 1024  # in one call of writev at most


@dataclass(slots=True)
class _Segment:
    """A file, and the table's keys for the transitions in it."""

    path: Path
    first_key: int
    next_key: int


def segment_paths(directory: Path) -> list[Path]:
    """The segments in a directory, oldest first."""
    return sorted(directory.glob(f"*{_SUFFIX}"))


def read_segment(path: Path) -> Iterator[tuple[int, int, bytes | None]]:
    """Yield each record's begin, end and payload; the payload is None if it is corrupt.

    Ends at the first incomplete record. The rest of the file is a torn tail: bytes of a write
    that never finished or, after a power cut, never began.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        offset = 0
        while offset + _HEADER.size <= size:
            length, crc = _HEADER.unpack(file.read(_HEADER.size))
            end = offset + _HEADER.size + length
            if length == 0 or end > size:
                break
            payload = file.read(length)
            yield offset, end, payload if zlib_ng.crc32(payload) == crc else None
            offset = end


class SegmentLog:
    """Appends payloads to segments of about `segment_bytes`.

    Raises RunDirectoryError when the directory cannot be made.
    """

    def __init__(self, directory: Path, *, segment_bytes: int, fsync: bool) -> None:
        self._directory = directory
        self._segment_bytes = segment_bytes
        self._fsync = fsync
        self._descriptor: int | None = None
        self._lock: int | None = None
        self._size = 0
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunDirectoryError(f"cannot make {directory}: {reason(error)}") from error
        self._segments = deque(
            _Segment(path, int(path.stem), int(path.stem)) for path in segment_paths(directory)
        )
        self.corrupt = 0
        """Records skipped because their checksum did not match."""

    @property
    def directory(self) -> Path:
        """The directory of the segments."""
        return self._directory

    @property
    def first_key(self) -> int:
        """Key of the oldest transition in the log; 0 if it is empty."""
        return self._segments[0].first_key if self._segments else 0

    def lock(self) -> None:
        """Keep other processes out until `close`; raises RunDirectoryError if one is there."""
        try:
            self._lock = lock_directory(self._directory)
        except BlockingIOError as error:
            raise RunDirectoryError(
                f"{self._directory} is in use by another process: a shard of replay has one"
            ) from error
        except OSError as error:
            _LOG.warning("%s cannot be locked: %s", self._directory, reason(error))

    def recover(self, next_key: Callable[[], int]) -> Iterator[bytes]:
        """Yield all whole payloads, oldest first; exhaust it before the first append.

        next_key: key of the transition after those recovered so far.
        """
        for segment in self._segments:
            segment.first_key = next_key()
            self._size = 0
            for offset, end, payload in read_segment(segment.path):
                if payload is None:
                    self.corrupt += 1
                    _LOG.warning("%s: skipped a corrupt record at byte %d", segment.path, offset)
                else:
                    yield payload
                self._size = end
            lost = segment.path.stat().st_size - self._size
            if lost:
                _LOG.warning("%s: cut off a torn tail of %d bytes", segment.path, lost)
                os.truncate(segment.path, self._size)
            segment.next_key = next_key()
        if self._segments:
            self._open(self._segments[-1], self._size)

    def append(self, payloads: Sequence[Part], first_key: int, num_transitions: int) -> None:
        """Write one record per payload; raises OSError, after which none of them is in the log.

        first_key, num_transitions: of all payloads together.
        """
        if self._descriptor is None or self._size >= self._segment_bytes:
            self._rotate(first_key)
        heads = (_HEADER.pack(len(p), zlib_ng.crc32(p)) for p in payloads)
        parts = list(chain.from_iterable(zip(heads, payloads, strict=True)))
        try:
            self._write(parts)
        except OSError:
            if self._descriptor is not None:
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size += sum(map(len, parts))
        self._segments[-1].next_key = first_key + num_transitions

    def forget(self, first_key: int) -> None:
        """Delete segments all of whose transitions are older than `first_key`."""
        while len(self._segments) > 1 and self._segments[0].next_key <= first_key:
            self._segments.popleft().path.unlink(missing_ok=True)

    def close(self) -> None:
        """Sync the last segment to disk; the system writes out earlier ones in its own time."""
        self._end_segment(fsync=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _end_segment(self, *, fsync: bool) -> None:
        if self._descriptor is not None:
            if fsync:
                os.fsync(self._descriptor)
            os.close(self._descriptor)
            self._descriptor = None

    def _write(self, parts: Sequence[Part]) -> None:
        if self._descriptor is None:
            raise ValueError("the log is closed")
        for start in range(0, len(parts), _PARTS):
            self._write_some(self._descriptor, parts[start : start + _PARTS])
        if self._fsync:
            os.fsync(self._descriptor)

    @staticmethod
    def _write_some(descriptor: int, parts: Sequence[Part]) -> None:
        written = os.writev(descriptor, parts)
        if written < sum(
            map(len, parts)
        ):  # no space for all of it: the next write raises the reason
            remaining = memoryview(b"".join(parts))[written:]
            while remaining:
                remaining = remaining[os.write(descriptor, remaining) :]

    def _rotate(self, first_key: int) -> None:
        self._end_segment(fsync=self._fsync)
        after = int(self._segments[-1].path.stem) + 1 if self._segments else 0
        path = self._directory / f"{max(first_key, after):015d}{_SUFFIX}"
        segment = _Segment(path, first_key, first_key)
        self._open(segment, 0)
        self._segments.append(segment)
        if self._fsync:
            sync_directory(self._directory)

    def _open(self, segment: _Segment, size: int) -> None:
        self._descriptor = os.open(segment.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        self._size = size


def open_log(config: Config, directory: Path) -> SegmentLog | None:
    """The log a configuration asks for."""
    if config.replay.fsync == "off":
        return None
    return SegmentLog(
        directory,
        segment_bytes=config.replay.segment_bytes,
        fsync=config.replay.fsync == "always",
    )
