"""Recognize repeated inserts by (actor, incarnation, sequence), so that they do no harm.

Invariant: memory is bounded by `max_streams`; the streams heard from least recently go first.
"""

from collections import OrderedDict
from enum import Enum, auto


class Arrival(Enum):
    """What a sequence number says about its chunk."""

    NEXT = auto()
    REPEATED = auto()
    GAP = auto()


class SequenceBook:
    """Keeps the last sequence number of every (actor, incarnation)."""

    def __init__(self, max_streams: int = 4096) -> None:
        self._last: OrderedDict[tuple[str, int], int] = OrderedDict()
        self._max_streams = max_streams

    def classify(self, actor: str, incarnation: int, sequence: int) -> Arrival:
        """Tell whether the chunk is the next one, came before, or skips some."""
        last = self._last.get((actor, incarnation), -1)
        if sequence <= last:
            return Arrival.REPEATED
        return Arrival.NEXT if sequence == last + 1 else Arrival.GAP

    def record(self, actor: str, incarnation: int, sequence: int) -> int | None:
        """Remember that the chunk is stored; return its stream's last sequence number before."""
        before = self._last.get((actor, incarnation))
        self._last[actor, incarnation] = sequence
        self._last.move_to_end((actor, incarnation))
        while len(self._last) > self._max_streams:
            self._last.popitem(last=False)
        return before

    def take_back(self, actor: str, incarnation: int, before: int | None) -> None:
        """Undo the stream's last `record`, which returned `before`: the chunk is not stored."""
        if before is None:
            self._last.pop((actor, incarnation), None)
        else:
            self._last[actor, incarnation] = before
