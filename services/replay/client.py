"""What an actor and a learner use of replay."""

import logging
import time
from collections import deque

from common.errors import DeadlineError, HeldError, WireError
from common.keys import Keys
from common.process import StopSignal
from common.trajectory import Chunk, InsertReply, Priorities, PrioritiesReply, Samples
from common.transport import PendingReply, Session
from common.wire import SampleRequest, decode, encode

_LOG = logging.getLogger("replay-client")
_RETRY_S = 0.2


class ReplayWriter:
    """Inserts chunks; returns when replay has acknowledged, however often it must ask.

    warn_s: without an acknowledgement for so long, a line of the log says so.
    """

    def __init__(self, session: Session, keys: Keys, warn_s: float, stop: StopSignal) -> None:
        self._client = session.client(keys.insert(), "replay")
        self._patience = _Patience("replay has not acknowledged a chunk", warn_s)
        self._stop = stop

    def insert(self, chunk: Chunk) -> InsertReply | None:
        """The acknowledgement; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again would not help.
        """
        payload = encode(chunk)
        self._patience.renew()
        while True:
            try:
                return decode(InsertReply, self._client.ask(payload).result())
            except HeldError:
                self._patience.renew()
            except (DeadlineError, WireError):
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            if self._stop.is_set():
                return None


class ReplayReader:
    """Samples mini-batches, several requests ahead."""

    def __init__(
        self,
        session: Session,
        keys: Keys,
        batch_size: int,
        requests_in_flight: int,
        warn_s: float,
        stop: StopSignal,
    ) -> None:
        self._client = session.client(keys.sample(), "replay")
        self._payload = encode(SampleRequest(batch_size))
        self._in_flight = requests_in_flight
        self._pending: deque[PendingReply] = deque()
        self._patience = _Patience("replay has not answered with a mini-batch", warn_s)
        self._stop = stop

    def sample(self) -> Samples | None:
        """The next mini-batch; None when stopped before it came."""
        self._patience.renew()
        while not self._stop.is_set():
            while len(self._pending) < self._in_flight:
                self._pending.append(self._client.ask(self._payload))
            try:
                samples = decode(Samples, self._pending.popleft().result())
            except HeldError:
                self._patience.renew()
            except DeadlineError:
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            else:
                return samples
        return None


class PriorityWriter:
    """Sets priorities; each is tried once, since a lost one does no harm."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._client = session.client(keys.priorities(), "replay")

    def update(self, priorities: Priorities) -> PrioritiesReply | None:
        """The acknowledgement; None where replay is away or busy.

        Raises RefusedError, with replay's reason, when the message is wrong.
        """
        try:
            return decode(PrioritiesReply, self._client.ask(encode(priorities)).result())
        except (HeldError, DeadlineError, WireError):
            return None


class _Patience:
    """Says in the log, every `warn_s` without an answer, whom is waited for."""

    def __init__(self, what: str, warn_s: float) -> None:
        self._what = what
        self._warn_s = warn_s
        self._since = self._warned = time.monotonic()

    def renew(self) -> None:
        self._since = self._warned = time.monotonic()

    def spend(self) -> None:
        now = time.monotonic()
        if now - self._warned >= self._warn_s:
            self._warned = now
            _LOG.warning("%s for %.0f s; still waiting for it", self._what, now - self._since)
