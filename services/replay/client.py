"""What an actor and a learner use of replay."""

import dataclasses
import logging
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from common.errors import DeadlineError, HeldError, WireError
from common.framing import join_set
from common.keys import Keys
from common.process import StopSignal
from common.trajectory import Chunk, InsertReply, Priorities, PrioritiesReply, Samples
from common.transport import PendingReply, Session
from common.wire import SampleRequest, decode, encode, encode_parts

_LOG = logging.getLogger("replay-client")
_RETRY_S = 0.2
_LAST_ANSWER_S = 1.0  # for an answer under way when told to stop


class ReplayWriter:
    """Inserts chunks; returns when replay has acknowledged, however often it must ask.

    warn_s: without an acknowledgement for so long, a line of the log says so.
    """

    def __init__(self, session: Session, keys: Keys, warn_s: float, stop: StopSignal) -> None:
        self._client = session.client(keys.insert(), "replay", lends=True)
        self._patience = _Patience("replay has not acknowledged a chunk", warn_s)
        self._stop = stop

    def insert(self, chunks: Sequence[Chunk]) -> InsertReply | None:
        """The acknowledgement of all, at least one; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again would not help.
        """
        parts = join_set([encode_parts(chunk) for chunk in chunks])
        self._patience.renew()
        while True:
            try:
                pending = self._client.ask(parts)
                if not _answered(pending, self._stop, _LAST_ANSWER_S):
                    return None
                reply = decode(InsertReply, pending.result())
                pending.release()
                return reply
            except HeldError:
                self._patience.renew()
            except (DeadlineError, WireError):
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            if self._stop.is_set():
                return None


class ReplayReader:
    """Samples mini-batches, several requests ahead, several batches a request."""

    def __init__(
        self,
        session: Session,
        keys: Keys,
        batch_size: int,
        batches_per_request: int,
        requests_in_flight: int,
        warn_s: float,
        stop: StopSignal,
    ) -> None:
        self._client = session.client(keys.sample(), "replay", lends=True)
        self._batch_size = batch_size
        self._payload = encode(SampleRequest(batch_size * batches_per_request))
        self._in_flight = requests_in_flight
        self._pending: deque[PendingReply] = deque()
        self._reply: PendingReply | None = None  # whose batches are being given out
        self._reply_bytes = 0
        self._batches: Iterator[Samples] = iter(())
        self._patience = _Patience("replay has not answered with a mini-batch", warn_s)
        self._stop = stop

    def sample(self) -> Samples | None:
        """The next mini-batch, valid until the next call; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again would not help.
        """
        batch = next(self._batches, None)
        while batch is None and self._ask():
            batch = next(self._batches, None)
        return batch

    def _ask(self) -> bool:
        """Wait for the batches of the next reply; False when stopped before it came."""
        if self._reply is not None:
            self._reply.release()
            self._reply = None
        self._patience.renew()
        while not self._stop.is_set():
            while len(self._pending) < self._in_flight:
                asked = self._client.ask(self._payload, reply_bytes=self._reply_bytes)
                self._pending.append(asked)
            pending = self._pending.popleft()
            if not _answered(pending, self._stop):
                break
            try:
                payload = pending.result()
                samples = decode(Samples, payload)
            except HeldError:
                self._patience.renew()
            except DeadlineError:
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            else:
                self._reply, self._reply_bytes = pending, len(payload)
                self._batches = split_samples(samples, self._batch_size)
                return True
        return False


class PriorityWriter:
    """Sets priorities; each is tried once, since a lost one does no harm."""

    def __init__(self, session: Session, keys: Keys, stop: StopSignal) -> None:
        self._client = session.client(keys.priorities(), "replay")
        self._stop = stop

    def update(self, priorities: Priorities) -> PrioritiesReply | None:
        """The acknowledgement; None where replay is away or busy, or told to stop.

        Raises RefusedError, with replay's reason, when the message is wrong.
        """
        pending = self._client.ask(encode(priorities))
        if not _answered(pending, self._stop):
            return None
        try:
            return decode(PrioritiesReply, pending.result())
        except (HeldError, DeadlineError, WireError):
            return None


def split_samples(samples: Samples, batch_size: int) -> Iterator[Samples]:
    """Mini-batches of consecutive samples, views of theirs."""
    columns: dict[str, Any] = {
        field.name: column
        for field in dataclasses.fields(samples)
        if isinstance(column := getattr(samples, field.name), np.ndarray)
    }
    for start in range(0, len(samples), batch_size):
        stop = start + batch_size
        yield dataclasses.replace(samples, **{n: c[start:stop] for n, c in columns.items()})


def _answered(pending: PendingReply, stop: StopSignal, last_s: float = 0.0) -> bool:
    """Whether its result is there; False when stopped and it did not come within `last_s` more."""
    while not pending.wait(_RETRY_S):
        if stop.is_set():
            return pending.wait(last_s)
    return True


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
