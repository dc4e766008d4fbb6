"""The segment log: accepted chunks, appended before they are acknowledged, read back at a start.

    <directory>/<first key, 15 digits>.segment
    record: length uint32, CRC-32 of the payload uint32 (little-endian), payload (a wire Chunk)

Invariants: a record is whole on the disk's cache when `append` returns, so an acknowledged chunk
survives kill -9 (with fsync also a power cut); a segment is deleted only when the table has
evicted all of it; a torn tail is cut off, a corrupt record skipped, and both are reported.
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

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.runtime.files import reason, sync_directory

_LOG = logging.getLogger("replay")
_HEADER = struct.Struct("<II")
_SUFFIX = ".segment"
_PARTS = 1024  # of one call, at most


@dataclass(slots=True)
class _Segment:
    """A file, and the table's keys of the transitions in it."""

    path: Path
    first_key: int
    next_key: int


def segment_paths(directory: Path) -> list[Path]:
    """The segments in a directory, oldest first."""
    return sorted(directory.glob(f"*{_SUFFIX}"))


def read_segment(path: Path) -> Iterator[tuple[int, int, bytes | None]]:
    """Of each record where it begins, where it ends, and its payload, None where that is corrupt.

    Ends at the first record that is not whole: what is left of the file is a torn tail, bytes
    of a write that never ended or, after a power cut, of one that never began.
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

    Raises RunDirectoryError where the directory cannot be written.
    """

    def __init__(self, directory: Path, *, segment_bytes: int, fsync: bool) -> None:
        self._directory = directory
        self._segment_bytes = segment_bytes
        self._fsync = fsync
        self._descriptor: int | None = None
        self._size = 0
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunDirectoryError(f"cannot make {directory}: {reason(error)}") from error
        self._segments = deque(
            _Segment(path, int(path.stem), int(path.stem)) for path in segment_paths(directory)
        )
        self.corrupt = 0
        """Records skipped because their bytes were not what was written."""

    @property
    def directory(self) -> Path:
        """Where the segments lie."""
        return self._directory

    @property
    def first_key(self) -> int:
        """Key of the oldest transition kept; 0 in an empty log."""
        return self._segments[0].first_key if self._segments else 0

    def recover(self, next_key: Callable[[], int]) -> Iterator[bytes]:
        """All whole payloads, oldest first; to be exhausted before the first append.

        next_key: key of the transition after those recovered so far.
        """
        for segment in self._segments:
            segment.first_key = next_key()
            self._size = 0
            for offset, end, payload in read_segment(segment.path):
                if payload is None:
                    self.corrupt += 1
                    _LOG.warning("%s: record at byte %d is corrupt, skipped", segment.path, offset)
                else:
                    yield payload
                self._size = end
            lost = segment.path.stat().st_size - self._size
            if lost:
                _LOG.warning("%s: torn tail of %d bytes cut off", segment.path, lost)
                os.truncate(segment.path, self._size)
            segment.next_key = next_key()
        if self._segments:
            self._open(self._segments[-1], self._size)

    def append(self, payloads: Sequence[Part], first_key: int, num_transitions: int) -> None:
        """Write a record each; raises OSError, and then none of them is in the log.

        first_key, num_transitions: of all of them.
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
        """Delete segments whose transitions are all older than `first_key`."""
        while len(self._segments) > 1 and self._segments[0].next_key <= first_key:
            self._segments.popleft().path.unlink(missing_ok=True)

    def close(self) -> None:
        """Bring the last segment to the disk; those before it the system has, in its own time."""
        self._end_segment(fsync=True)

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
        if written < sum(map(len, parts)):  # no space for all of it: the next write says why
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
