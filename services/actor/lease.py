"""An actor's exploration slot: leased from replay, renewed while the actor works.

Invariants: a slot counts as held for somewhat less than its lease, by this process's own clock,
starting before the request was sent. An actor that was suspended, or cannot reach replay, has
therefore lost its slot before another actor can get it. An actor without a slot carries on and
spreads its arenas over all epsilons, as if it were the only actor. Nothing here waits, except for
the return of the slot at the end, which has a deadline.
"""

import logging
import math
import time

from mrcdrl.common.errors import TransportError, WireError
from mrcdrl.common.messages.trajectory import NO_SLOT, LeaseReply, LeaseRequest
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.transport import PendingReply, Priority, Session
from mrcdrl.common.transport.keys import Keys

_LOG = logging.getLogger("actor")
_SURE = 0.9  # fraction of a lease that has not expired by any clock: clocks run at different rates
_RENEWALS = 3  # per lease
_ANSWER_S = 2.0
ExplorationRank = tuple[int, int]  # rank on the epsilon schedule, and number of ranks
ALONE: ExplorationRank = (0, 1)


class Lease:
    """What an actor knows of its lease; pure, the caller supplies the time."""

    def __init__(self, actor: str, incarnation: int) -> None:
        self._actor = actor
        self._incarnation = incarnation
        self._slot = NO_SLOT
        self._rank = ALONE
        self._until_s = -math.inf

    def request(self, now: float, answer_s: float, *, ends: bool = False) -> LeaseRequest:
        """The request to send at `now`, if the answer may take `answer_s`."""
        holds = self.slot(now + answer_s) != NO_SLOT
        return LeaseRequest(self._actor, self._incarnation, self._slot, holds, ends)

    def take(self, reply: LeaseReply, asked_s: float) -> None:
        """Accept the answer to the request sent at `asked_s`."""
        if reply.slot == NO_SLOT:
            self._until_s = -math.inf
            return
        self._slot, self._rank = reply.slot, (reply.rank, reply.num_places)
        self._until_s = asked_s + _SURE * reply.lease_s

    def slot(self, now: float) -> int:
        """The slot held; NO_SLOT if none."""
        return self._slot if now < self._until_s else NO_SLOT

    def rank(self, now: float) -> ExplorationRank:
        """The actor's exploration rank; ALONE without a slot."""
        return self._rank if now < self._until_s else ALONE


class LeaseClient:
    """Requests and renews an actor's lease, from the actor's main loop.

    lease_s: length of the run's leases; each answer repeats it.
    """

    def __init__(self, session: Session, keys: Keys, actor: str, lease_s: float) -> None:
        self._answer_s = min(_ANSWER_S, lease_s / (2 * _RENEWALS))
        self._client = session.client(keys.leases, "replay", self._answer_s, priority=Priority.HIGH)
        self._lease = Lease(actor, time.time_ns())
        self._period_s = lease_s / _RENEWALS
        self._pending: PendingReply | None = None
        self._asked_s = -math.inf
        self._logged = NO_SLOT
        self.rank = ALONE
        """The exploration rank at the last `follow`."""

    @property
    def slot(self) -> int:
        """The slot held now; NO_SLOT if none."""
        return self._lease.slot(time.monotonic())

    def follow(self) -> None:
        """Send a request if one is due, read the answer if it is here, update the rank."""
        now = time.monotonic()
        if self._pending is not None and self._pending.wait(0.0):
            self._hear(self._pending)
            self._pending = None
        if self._pending is None and now >= self._asked_s + self._period_s:
            self._ask(now)
        self.rank = self._lease.rank(now)
        self._log(self._lease.slot(now))

    def give_back(self) -> None:
        """Return the slot at an orderly end; if replay does not hear of it, the lease expires."""
        now = time.monotonic()
        request = self._lease.request(now, self._answer_s, ends=True)
        try:
            self._client.ask(encode(request)).result()
        except TransportError as error:
            _LOG.info("exploration slot not returned: %s", error)

    def _ask(self, now: float) -> None:
        self._asked_s = now
        try:
            self._pending = self._client.ask(encode(self._lease.request(now, self._answer_s)))
        except TransportError as error:
            _LOG.info("exploration slot not requested: %s", error)

    def _hear(self, pending: PendingReply) -> None:
        try:
            self._lease.take(decode(LeaseReply, pending.result()), self._asked_s)
        except (TransportError, WireError):
            return  # the next request is sent when it is due

    def _log(self, slot: int) -> None:
        if slot == self._logged:
            return
        if slot == NO_SLOT:
            _LOG.info("exploration slot %d lost; exploring with all epsilons for now", self._logged)
        else:
            _LOG.info("exploration slot %d", slot)
        self._logged = slot
