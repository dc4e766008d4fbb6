"""What others use of replay: actors, the learner, and who looks after them."""

import dataclasses
import logging
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mrcdrl.common.errors import DeadlineError, ThrottledError, WireError
from mrcdrl.common.messages.framing import join_set
from mrcdrl.common.messages.trajectory import (
    Chunk,
    InsertReply,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
)
from mrcdrl.common.messages.wire import decode, encode, encode_parts
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Client, PendingReply, Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.build import table_bytes
from mrcdrl.services.replay.shards import ShardStream, shard_of, shares

__all__ = [
    "PriorityWriter",
    "ReplayReader",
    "ReplayWriter",
    "shard_of",
    "split_samples",
    "table_bytes",
]

_LOG = logging.getLogger("replay-client")
_RETRY_S = 0.2
_LONGEST_RETRY_S = 3.2
_LAST_ANSWER_S = 1.0  # for an answer under way when told to stop


class ReplayWriter:
    """Inserts chunks; returns when replay has acknowledged, however often it must ask.

    warn_s: without an acknowledgement for so long, a line of the log says so. shard: of
    num_shards, the one that takes this actor's chunks.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        warn_s: float,
        stop: StopSignal,
        *,
        shard: int = 0,
        num_shards: int = 1,
    ) -> None:
        name = _names(num_shards)[shard]
        self._client = session.client(keys.insert(shard), name, shared_memory=True)
        self._patience = _Patience("replay has not acknowledged a chunk", warn_s)
        self._stop = stop
        self.throttled = 0
        """Answers that said: not now."""
        self.unanswered = 0
        """Requests whose time was over, or that brought no reply one could read."""

    @property
    def heard_s(self) -> float:
        """When replay last answered, on the monotonic clock; at first, when it was first asked."""
        return self._patience.since

    def insert(self, chunks: Sequence[Chunk]) -> InsertReply | None:
        """The acknowledgement of all, at least one; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again would not help.
        """
        parts = join_set([encode_parts(chunk) for chunk in chunks])
        self._patience.renew()
        retry_s = _RETRY_S
        while True:
            asked_s = time.monotonic()
            try:
                pending = self._client.ask(parts)
                if not _answered(pending, self._stop, _LAST_ANSWER_S):
                    return None
                reply = decode(InsertReply, pending.result())
                pending.release()
                return reply
            except ThrottledError:
                self.throttled += 1
                self._patience.renew()
                if time.monotonic() - asked_s < _RETRY_S:  # too many wait there already
                    self._stop.wait(retry_s)
                    retry_s = min(2 * retry_s, _LONGEST_RETRY_S)
            except (DeadlineError, WireError):
                self.unanswered += 1
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            if self._stop.is_set():
                return None


class ReplayReader:
    """Samples mini-batches from all shards, several requests ahead, several batches a request.

    A reply is of one shard, drawn in proportion to the shards' total priorities; the
    probabilities, the table size and the keys of its samples speak of all shards together. One
    that is away or holds back, for which a sample has waited `late_s` in vain, is left out until
    it answers.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        batch_size: int,
        batches_per_request: int,
        requests_in_flight: int,
        warn_s: float,
        stop: StopSignal,
        *,
        num_shards: int = 1,
        seed: int = 0,
        late_s: float = _RETRY_S,
        learner_step: int | None = None,
    ) -> None:
        """learner_step: of a run that takes turns, the steps made so far; then one request after
        the other is for the steps that follow.
        """
        self._batches_per_request = batches_per_request
        self._learner_step = -1 if learner_step is None else learner_step
        in_lockstep = learner_step is not None
        self._shards = [
            ShardStream(
                session.client(keys.sample(shard), name, shared_memory=True),
                name,
                self._request,
                1 if in_lockstep else requests_in_flight,
            )
            for shard, name in enumerate(_names(num_shards))
        ]
        self._batch_size = batch_size
        self._batches: Iterator[Samples] = iter(())
        self._patience = _Patience("replay has not answered with a mini-batch", warn_s)
        self._rng = np.random.default_rng(seed)
        self._late_s = late_s
        self._stop = stop

    def _request(self) -> bytes:
        size = self._batch_size * self._batches_per_request
        return encode(SampleRequest(size, self._learner_step))

    @property
    def heard_s(self) -> float:
        """When replay last answered, on the monotonic clock; at first, when it was first asked."""
        return self._patience.since

    def sample(self) -> Samples | None:
        """The next mini-batch, valid until the next call; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again would not help.
        """
        batch = next(self._batches, None)
        self._patience.renew()
        while batch is None and not self._stop.is_set():
            self._batches = self._next_batches()
            batch = next(self._batches, None)
        return batch

    def _next_batches(self) -> Iterator[Samples]:
        """Those of the next reply; none where no shard had one in time."""
        there = [s for s in self._shards if s.ready() or not s.late] or self._shards
        share = shares([shard.total_priority for shard in there])
        index = int(self._rng.choice(len(there), p=share)) if len(there) > 1 else 0
        drawn = there[index]
        if not drawn.ready(self._late_s):
            drawn.late = True
            return iter(())
        try:
            samples = drawn.take()
        except ThrottledError:
            self._patience.renew()
            return iter(())
        except DeadlineError:
            self._patience.spend()
            self._stop.wait(_RETRY_S)
            return iter(())
        if self._learner_step >= 0:
            self._learner_step += self._batches_per_request
        if len(self._shards) > 1:
            samples = self._of_all(samples, self._shards.index(drawn), float(share[index]))
        return split_samples(samples, self._batch_size)

    def _of_all(self, samples: Samples, shard: int, share: float) -> Samples:
        """A shard's samples as those of the table that all shards are together."""
        return dataclasses.replace(
            samples,
            keys=samples.keys * len(self._shards) + shard,
            probabilities=samples.probabilities * share,
            table_size=sum(stream.table_size for stream in self._shards),
            total_priority=sum(stream.total_priority or 0.0 for stream in self._shards),
        )


class PriorityWriter:
    """Sets priorities; each is tried once, since a lost one does no harm."""

    def __init__(
        self, session: Session, keys: Keys, stop: StopSignal, *, num_shards: int = 1
    ) -> None:
        self._clients = [
            session.client(keys.priorities(shard), name)
            for shard, name in enumerate(_names(num_shards))
        ]
        self._stop = stop

    def update(self, priorities: Priorities) -> PrioritiesReply | None:
        """The acknowledgement; None where a shard is away or busy, or told to stop.

        Raises RefusedError, with replay's reason, when the message is wrong.
        """
        pending = [client.ask(encode(part)) for client, part in self._parts(priorities)]
        replies = [self._reply(asked) for asked in pending]
        there = [reply for reply in replies if reply is not None]
        if len(there) < len(replies):
            return None
        return PrioritiesReply(sum(r.updated for r in there), sum(r.ignored for r in there))

    def _parts(self, priorities: Priorities) -> Iterator[tuple[Client, Priorities]]:
        """Whom to tell what."""
        num_shards = len(self._clients)
        for shard, client in enumerate(self._clients):
            here = priorities.keys % num_shards == shard
            if here.any():
                keys = priorities.keys[here] // num_shards
                yield client, Priorities(keys, priorities.priorities[here])

    def _reply(self, pending: PendingReply) -> PrioritiesReply | None:
        if not _answered(pending, self._stop):
            return None
        try:
            return decode(PrioritiesReply, pending.result())
        except (ThrottledError, DeadlineError, WireError):
            return None


def _names(num_shards: int) -> list[str]:
    """The shards' names, for errors and the log."""
    return [f"replay shard {i}" for i in range(num_shards)] if num_shards > 1 else ["replay"]


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
        self.since = self._warned = time.monotonic()

    def renew(self) -> None:
        self.since = self._warned = time.monotonic()

    def spend(self) -> None:
        now = time.monotonic()
        if now - self._warned >= self._warn_s:
            self._warned = now
            _LOG.warning("%s for %.0f s; still waiting for it", self._what, now - self.since)
