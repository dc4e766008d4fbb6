"""Leases of exploration slots to actors, granted by replay, which every run has.

Invariants: the table is pure, with the caller's clock; a slot has one holder at a time, and is
free only after its last lease has ended; a holder is one start of an actor, (name, incarnation), so
a restarted actor is a new holder. While leases of an earlier table may still run, a slot is granted
only to an actor that claims to hold it.
"""

import bisect
import time
from dataclasses import dataclass
from itertools import chain, islice

from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseReply, LeaseRequest
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.transport import Server

MAX_SLOTS = 4096  # if the configuration sets no number
_ANSWERS = 1000  # in one call at most
Holder = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Lease:
    """A slot's holder, and when its lease ends."""

    holder: Holder
    until_s: float


class LeaseTable:
    """The exploration slots of a run.

    lease_s: how long a lease lasts. num_places: ranks of the epsilon schedule; 0: as many as slots
    are leased. now: seconds on the clock that `answer` is given.
    """

    def __init__(self, lease_s: float, num_places: int, now: float) -> None:
        self._lease_s = lease_s
        self._num_places = num_places
        self._open_s = now + lease_s  # until then, slots go only to actors that claim them
        self._leases: dict[int, Lease] = {}
        self._slots: list[int] = []  # leased ones, in order
        self._slot_of: dict[Holder, int] = {}
        self._names: dict[int, str] = {}  # each slot's last actor
        self._next_end_s = now  # no lease ends earlier

    def __len__(self) -> int:
        return len(self._slots)

    def __repr__(self) -> str:
        return f"LeaseTable({', '.join(f'{s}: {self._leases[s].holder}' for s in self._slots)})"

    def answer(self, request: LeaseRequest, now: float) -> LeaseReply:
        """Grant a slot, renew its lease, or end it."""
        self._end_leases(now)
        holder = (request.actor, request.incarnation)
        slot = self._slot_of.get(holder)
        if request.ends:
            if slot is not None:
                self._free(slot)
            slot = None
        elif slot is None:
            slot = self._choose(request, now)
        if slot is None:
            return LeaseReply(NO_SLOT, 0, 1, self._lease_s)
        self._lease(slot, holder, now + self._lease_s)
        return self._reply(slot)

    def check_invariants(self) -> None:
        """Raise AssertionError if the parts of the table contradict each other."""
        if self._slots != sorted(self._leases):
            raise AssertionError(f"slots {sorted(self._leases)} are leased, not {self._slots}")
        if self._slot_of != {lease.holder: slot for slot, lease in self._leases.items()}:
            raise AssertionError("a holder has two slots, or a slot two holders")
        if any(not 0 <= slot < self._limit for slot in self._slots):
            raise AssertionError(f"a slot is outside 0 ... {self._limit - 1}")

    @property
    def _limit(self) -> int:
        return self._num_places or MAX_SLOTS

    def _choose(self, request: LeaseRequest, now: float) -> int | None:
        """A free slot: the actor's last one, an earlier start's, or the lowest."""
        if now < self._open_s and not request.holds:
            return None
        if self._is_free(request.slot):
            return request.slot
        if now < self._open_s:
            return None
        earlier = (s for s, name in self._names.items() if name == request.actor)
        wanted = chain(sorted(earlier), range(self._limit))
        return next(filter(self._is_free, wanted), None)

    def _is_free(self, slot: int) -> bool:
        return 0 <= slot < self._limit and slot not in self._leases

    def _lease(self, slot: int, holder: Holder, until_s: float) -> None:
        if slot not in self._leases:
            bisect.insort(self._slots, slot)
        self._leases[slot] = Lease(holder, until_s)
        self._slot_of[holder] = slot
        self._names[slot] = holder[0]

    def _free(self, slot: int) -> None:
        self._slots.remove(slot)
        del self._slot_of[self._leases.pop(slot).holder]

    def _end_leases(self, now: float) -> None:
        if now < self._next_end_s:
            return
        for slot in [s for s, lease in self._leases.items() if lease.until_s <= now]:
            self._free(slot)
        ends = [lease.until_s for lease in self._leases.values()]
        self._next_end_s = min(ends, default=now)

    def _reply(self, slot: int) -> LeaseReply:
        """A slot's exploration rank: the slot itself, or the number of leased slots below it."""
        if self._num_places:
            return LeaseReply(slot, slot, self._num_places, self._lease_s)
        rank = bisect.bisect_left(self._slots, slot)
        return LeaseReply(slot, rank, len(self._slots), self._lease_s)


def answer_leases(server: Server, table: LeaseTable) -> None:
    """Answer the lease requests that are waiting, a limited number per call."""
    for request in islice(iter(lambda: server.take(0.0), None), _ANSWERS):
        try:
            wanted = decode(LeaseRequest, request.payload)
        except WireError as error:
            request.refuse(str(error))
            continue
        request.reply(encode(table.answer(wanted, time.monotonic())))
