"""The line of inserts: the actor that has waited longest is first, however often it had to ask.

Invariants: a request leaves the line when it is answered; an actor that is told to ask again keeps
its place for `_AWAY_S`. Pure, and used by one thread.
"""

import heapq
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Protocol

from mrcdrl.common.messages.framing import Part
from mrcdrl.common.messages.trajectory import Chunk

Stream = tuple[str, int]  # an actor's name and incarnation

_AWAY_S = 30.0  # how long a place is kept for an actor that does not ask again
_FEW = 64  # answered requests that may stay in the heap
_MAX_PLACES = 4096  # kept for actors that are to ask again


class Request(Protocol):
    """What replay needs from a transport's request."""

    @property
    def payload(self) -> Part: ...
    @property
    def arrived_s(self) -> float: ...

    def room(self, size: int) -> memoryview | None: ...
    def reply(self, payload: Part | Sequence[Part]) -> None: ...
    def refuse(self, reason: str) -> None: ...
    def throttle(self, reason: str) -> None: ...


@dataclass(slots=True, eq=False)
class Waiting:
    """A request in the line."""

    request: Request
    messages: list[memoryview]
    first: Chunk  # of the first message
    since_s: float = 0.0  # when its actor first asked
    chunks: list[Chunk] = field(default_factory=list)  # of all messages, once they were checked
    taken: int = 0  # chunks accepted so far
    answered: bool = False

    @property
    def stream(self) -> Stream:
        return self.first.actor, self.first.incarnation

    @property
    def held_bytes(self) -> int:
        """Memory that the request takes here, and not in a buffer of its client's."""
        return len(self.request.payload) if isinstance(self.request.payload, bytes) else 0


class Turns:
    """The line of requests, the one of the actor that has waited longest first."""

    def __init__(self, hold_s: float) -> None:
        """hold_s: how long after its arrival a request is answered, if only to ask again."""
        self._hold_s = hold_s
        self._line: list[tuple[float, int, Waiting]] = []  # heap; answered ones leave it late
        self._arrived: deque[Waiting] = deque()  # the same requests, in the order of arrival
        self._places: OrderedDict[Stream, tuple[float, float]] = OrderedDict()
        """Actors that are to ask again: since when they wait, and when they were told so."""
        self._numbers = count()
        self._num_waiting = 0
        self.held_bytes = 0

    def __bool__(self) -> bool:
        return self.first() is not None

    def join(self, waiting: Waiting) -> None:
        """Put a request in the place of its actor, or at the end."""
        arrived_s = waiting.request.arrived_s
        waiting.since_s, _ = self._places.get(waiting.stream, (arrived_s, 0.0))
        heapq.heappush(self._line, (waiting.since_s, next(self._numbers), waiting))
        self._arrived.append(waiting)
        self.held_bytes += waiting.held_bytes
        self._num_waiting += 1

    def first(self) -> Waiting | None:
        """The request whose turn it is."""
        while self._line and self._line[0][2].answered:
            heapq.heappop(self._line)
        return self._line[0][2] if self._line else None

    def leave(self, waiting: Waiting) -> None:
        """The request has been, or will be, answered for good: its actor waits no longer."""
        self._answered(waiting)
        self._places.pop(waiting.stream, None)

    def ask_again(self, waiting: Waiting, reason: str, now_s: float) -> None:
        """Tell the actor to ask again, and keep its place."""
        self._answered(waiting)
        self._places[waiting.stream] = (waiting.since_s, now_s)
        self._places.move_to_end(waiting.stream)
        oldest = next(iter(self._places.values()))
        while oldest[1] < now_s - _AWAY_S or len(self._places) > _MAX_PLACES:
            self._places.popitem(last=False)
            oldest = next(iter(self._places.values()))
        waiting.request.throttle(reason)

    def next_answer_s(self) -> float | None:
        """When the next request must be answered; None if none waits."""
        self._drop_answered()
        return self._arrived[0].request.arrived_s + self._hold_s if self._arrived else None

    def overdue(self, now_s: float) -> Iterator[Waiting]:
        """Requests that must be answered now."""
        while (due_s := self.next_answer_s()) is not None and due_s <= now_s:
            yield self._arrived.popleft()

    def all(self) -> list[Waiting]:
        """All that wait."""
        return [waiting for waiting in self._arrived if not waiting.answered]

    def _answered(self, waiting: Waiting) -> None:
        if not waiting.answered:
            waiting.answered = True
            self.held_bytes -= waiting.held_bytes
            self._num_waiting -= 1
        self._drop_answered()
        if len(self._line) > 2 * self._num_waiting + _FEW:
            self._line = [each for each in self._line if not each[2].answered]
            heapq.heapify(self._line)

    def _drop_answered(self) -> None:
        while self._arrived and self._arrived[0].answered:
            self._arrived.popleft()
