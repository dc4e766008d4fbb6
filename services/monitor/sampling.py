"""Reads a few lines of a record file of any length, spread evenly over a stretch of the run.

Invariants: what is read is bounded, however long the file; nothing is kept; a torn line is left
out. Places are chosen by byte, and times found by bisection, as a record file's times rise.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mrcdrl.common.runtime.closing import Closing
from mrcdrl.services.monitor.records import json_objects

Record = dict[str, Any]
_ALL_BYTES = 1 << 21  # a stretch of no more is read whole
_MOST_BYTES = 1 << 24  # read of a longer one
_CLOSE_BYTES = 1 << 14  # how near bisection comes to a time
_BLOCK_BYTES = 1 << 13  # of short records, which are averaged


def sample_lines(path: Path, num: int, begin_s: float, end_s: float) -> list[Record]:
    """Records between two times of the run, in order, at most `num`; [] without a file.

    The first and the last of the stretch are among them. Raises OSError.
    """
    if not path.exists():
        return []
    with Stretch(path, begin_s, end_s) as stretch:
        if stretch.is_short:
            return thinned(stretch.records(), num)
        longest = max(len(line) for line in stretch.lines(2))
        num = max(2, min(num, _MOST_BYTES // max(1, longest)))
        return [r for line in dict.fromkeys(stretch.lines(num)) for r in json_objects(line)]


def sample_blocks(path: Path, num: int, begin_s: float, end_s: float) -> list[list[Record]]:
    """Blocks of neighbouring records between two times of the run, in order, at most `num`.

    Raises OSError.
    """
    if not path.exists():
        return []
    with Stretch(path, begin_s, end_s) as stretch:
        if stretch.is_short:
            records = stretch.records()
            size = max(1, math.ceil(len(records) / num))
            return [records[i : i + size] for i in range(0, len(records), size)]
        blocks = (list(json_objects(text)) for text in stretch.blocks(num))
        return [block for block in blocks if block]


def thinned(records: Sequence[Record], num: int) -> list[Record]:
    """The records or, if they are more, `num` of them, the first and the last among them."""
    if len(records) <= num:
        return list(records)
    return [records[round(i * (len(records) - 1) / (num - 1))] for i in range(num)]


class Stretch(Closing):
    """The bytes of a record file between two times; close it, or use it in `with`."""

    def __init__(self, path: Path, begin_s: float, end_s: float) -> None:
        """Raises OSError."""
        self._begin_s, self._end_s = begin_s, end_s
        self._file = path.open("rb")
        last, line = self._line_at(max(0, self._file.seek(0, 2) - 1))
        self._size = last + (len(line) if line.endswith(b"\n") else 0)  # without a torn line
        self._begin = self._around(begin_s)[0] if begin_s > 0 else 0
        self._end = self._around(end_s)[1] if end_s < math.inf else self._size

    @property
    def is_short(self) -> bool:
        """Whether `records` may be called."""
        return self._end - self._begin <= _ALL_BYTES

    def records(self) -> list[Record]:
        """All records of a short stretch."""
        begin, _ = self._line_at(self._begin)
        found = json_objects(self._read(begin, self._end))
        return [r for r in found if self._begin_s <= _time_s(r) <= self._end_s]

    def lines(self, num: int) -> Iterator[bytes]:
        """The lines at `num` places, the first and the last of the stretch among them."""
        return (self._line_at(place)[1] for place in self._places(num, self._end - 1))

    def blocks(self, num: int) -> Iterator[bytes]:
        """Whole lines at `num` places."""
        for place in self._places(num, self._end - _BLOCK_BYTES):
            yield self._read(place, place + _BLOCK_BYTES).partition(b"\n")[2]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _places(self, num: int, last: int) -> Iterator[int]:
        """Bytes spread evenly from the first of the stretch to `last`."""
        return (self._begin + (last - self._begin) * i // max(1, num - 1) for i in range(num))

    def _line_at(self, place: int) -> tuple[int, bytes]:
        """The line that this byte is in, newline included, and where it begins."""
        before, size = b"", _CLOSE_BYTES
        while size < 4 * place and b"\n" not in before:
            before = self._read(max(0, place - size), place)
            size *= 4
        begin = place - len(before) + before.rfind(b"\n") + 1
        self._file.seek(begin)
        return begin, self._file.readline()

    def _around(self, time_s: float) -> tuple[int, int]:
        """Two bytes close to each other, or in one line, between which this time is reached."""
        low, high = 0, self._size
        while high - low > _CLOSE_BYTES:
            middle, line = self._line_at((low + high) // 2)
            if middle <= low:
                break  # one line fills what is left
            record = next(json_objects(line), None)
            if record is not None and _time_s(record) > time_s:
                high = middle
            else:
                low = middle
        return low, high

    def _read(self, begin: int, end: int) -> bytes:
        self._file.seek(begin)
        return self._file.read(max(0, end - begin))


def _time_s(record: Record) -> float:
    time_s = record.get("time_s")
    return float(time_s) if isinstance(time_s, int | float) else 0.0
