"""Which actor holds which slot of exploration: leases, given by replay, which is always there.

Invariants: pure, the clock is the caller's; a slot has one holder at a time, and nobody gets it
before the lease of the one before is over; a holder is one start of an actor, (name, incarnation),
so that one started again is another. For as long as leases of a table before this one may last, a
slot is given only to who says that it holds it.
"""

import bisect
from dataclasses import dataclass
from itertools import chain

from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseReply, LeaseRequest

MAX_SLOTS = 4096  # where the configuration sets no number
Holder = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Lease:
    """Of one slot."""

    holder: Holder
    until_s: float


class LeaseTable:
    """The slots of a run.

    lease_s: how long a lease lasts. num_places: of the ladder; 0: as many as slots are leased.
    now: of the clock that `answer` is given, in seconds.
    """

    def __init__(self, lease_s: float, num_places: int, now: float) -> None:
        self._lease_s = lease_s
        self._num_places = num_places
        self._open_s = now + lease_s  # from then on slots are given to who holds none
        self._leases: dict[int, Lease] = {}
        self._slots: list[int] = []  # that are leased, in order
        self._slot_of: dict[Holder, int] = {}
        self._names: dict[int, str] = {}  # of who had a slot last
        self._next_end_s = now  # no lease ends before

    def __len__(self) -> int:
        return len(self._slots)

    def __repr__(self) -> str:
        return f"LeaseTable({', '.join(f'{s}: {self._leases[s].holder}' for s in self._slots)})"

    def answer(self, request: LeaseRequest, now: float) -> LeaseReply:
        """Give a slot, prolong its lease, or take it back."""
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
        """Raises AssertionError where the parts of the table contradict each other."""
        if self._slots != sorted(self._leases):
            raise AssertionError(f"leased are {sorted(self._leases)}, not {self._slots}")
        if self._slot_of != {lease.holder: slot for slot, lease in self._leases.items()}:
            raise AssertionError("a holder has two slots, or a slot two holders")
        if any(not 0 <= slot < self._limit for slot in self._slots):
            raise AssertionError(f"a slot is none of {self._limit}")

    @property
    def _limit(self) -> int:
        return self._num_places or MAX_SLOTS

    def _choose(self, request: LeaseRequest, now: float) -> int | None:
        """A free slot: the one it had, the one that an earlier start of it had, or the lowest."""
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
        """The place of a slot: the slot itself, or how many below it are leased."""
        if self._num_places:
            return LeaseReply(slot, slot, self._num_places, self._lease_s)
        rank = bisect.bisect_left(self._slots, slot)
        return LeaseReply(slot, rank, len(self._slots), self._lease_s)
