"""An actor's slot of exploration: leased by replay, renewed while the actor works.

Invariants: a slot counts as held only until its lease is over by this process's own clock, counted
from before it was asked for, and somewhat less; so an actor that was stopped and wakes up, or that
cannot reach replay, has lost its slot before anyone else can get it. Without a slot an actor goes
on, its arenas spread over the whole ladder as if it were alone. Nothing here waits, but for the
giving back at the end, and that has a deadline.
"""

import logging
import math
import time

from mrcdrl.common.errors import TransportError, WireError
from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseReply, LeaseRequest
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.transport import PendingReply, Session
from mrcdrl.common.transport.keys import Keys

_LOG = logging.getLogger("actor")
_SURE = 0.9  # share of a lease that is over by no clock: two need not run alike
_RENEWALS = 3  # in the time of a lease
_ANSWER_S = 2.0
Place = tuple[int, int]  # rank, and of how many
WHOLE_LADDER: Place = (0, 1)


class HeldLease:
    """What is known of the lease; pure, the clock is the caller's."""

    def __init__(self, actor: str, incarnation: int) -> None:
        self._actor = actor
        self._incarnation = incarnation
        self._slot = NO_SLOT
        self._place = WHOLE_LADDER
        self._until_s = -math.inf

    def request(self, now: float, answer_s: float, *, ends: bool = False) -> LeaseRequest:
        """What to ask at `now`, where the answer may take `answer_s`."""
        holds = self.slot(now + answer_s) != NO_SLOT
        return LeaseRequest(self._actor, self._incarnation, self._slot, holds, ends)

    def take(self, reply: LeaseReply, asked_s: float) -> None:
        """The answer to what was asked at `asked_s`."""
        if reply.slot == NO_SLOT:
            self._until_s = -math.inf
            return
        self._slot, self._place = reply.slot, (reply.rank, reply.num_places)
        self._until_s = asked_s + _SURE * reply.lease_s

    def slot(self, now: float) -> int:
        """The slot that is held; NO_SLOT for none."""
        return self._slot if now < self._until_s else NO_SLOT

    def place(self, now: float) -> Place:
        """Rank among how many actors, on the ladder."""
        return self._place if now < self._until_s else WHOLE_LADDER


class LeaseKeeper:
    """Keeps an actor's lease, from its main loop.

    lease_s: of the run; answers say it again.
    """

    def __init__(self, session: Session, keys: Keys, actor: str, lease_s: float) -> None:
        self._answer_s = min(_ANSWER_S, lease_s / (2 * _RENEWALS))
        self._client = session.client(keys.leases, "replay", self._answer_s)
        self._lease = HeldLease(actor, time.time_ns())
        self._period_s = lease_s / _RENEWALS
        self._pending: PendingReply | None = None
        self._asked_s = -math.inf
        self._said = NO_SLOT
        self.place = WHOLE_LADDER
        """As of the last `follow`."""

    @property
    def slot(self) -> int:
        """The slot held now; NO_SLOT for none."""
        return self._lease.slot(time.monotonic())

    def follow(self) -> None:
        """Ask and hear what is due, and see whether the lease is over."""
        now = time.monotonic()
        if self._pending is not None and self._pending.wait(0.0):
            self._hear(self._pending)
            self._pending = None
        if self._pending is None and now >= self._asked_s + self._period_s:
            self._ask(now)
        self.place = self._lease.place(now)
        self._say(self._lease.slot(now))

    def give_back(self) -> None:
        """At an orderly end; a lease whose end replay does not hear of ends by itself."""
        now = time.monotonic()
        request = self._lease.request(now, self._answer_s, ends=True)
        try:
            self._client.ask(encode(request)).result()
        except TransportError as error:
            _LOG.info("the exploration slot was not given back: %s", error)

    def _ask(self, now: float) -> None:
        self._asked_s = now
        try:
            self._pending = self._client.ask(encode(self._lease.request(now, self._answer_s)))
        except TransportError as error:
            _LOG.info("not asked for an exploration slot: %s", error)

    def _hear(self, pending: PendingReply) -> None:
        try:
            self._lease.take(decode(LeaseReply, pending.result()), self._asked_s)
        except (TransportError, WireError):
            return  # asked again when it is due

    def _say(self, slot: int) -> None:
        if slot == self._said:
            return
        if slot == NO_SLOT:
            _LOG.info("exploration slot %d is lost; over the whole ladder meanwhile", self._said)
        else:
            _LOG.info("exploration slot %d", slot)
        self._said = slot
