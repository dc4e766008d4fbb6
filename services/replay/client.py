"""What other processes use of replay: actors, the learner, and their watchers."""

import dataclasses
import logging
import math
import time
from collections.abc import Iterator, Sequence
from typing import Any, Self

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.errors import DeadlineError, RefusedError, ThrottledError, WireError
from mrcdrl.common.messages.framing import join_set
from mrcdrl.common.messages.trajectory import (
    Chunk,
    Float64Array,
    InsertReply,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
)
from mrcdrl.common.messages.wire import decode, encode, encode_parts
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.transport import Client, PendingReply, Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.capacity import table_bytes
from mrcdrl.services.replay.shards import ShardStream, shard_of, shard_probabilities

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
_LAST_ANSWER_S = 1.0  # wait for a pending answer after a stop
_REFUSALS_S = 3.0  # a refusal repeated for so long is replay's, and no other process's in its place


class ReplayWriter:
    """Inserts chunks; returns when replay has acknowledged them, however often it must ask.

    warn_s: after so long without an acknowledgement, logs a warning. shard: of num_shards, the
    one that takes this actor's chunks.
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
        self._name = _names(num_shards)[shard]
        self._client = session.client(keys.insert(shard), self._name, shared_memory=True)
        self._patience = _Patience("replay has not acknowledged a chunk", warn_s)
        self._stop = stop
        self.throttled = 0
        """Answers that said "not now"."""
        self.unanswered = 0
        """Requests that timed out or brought an unreadable reply."""
        self.uncounted = 0
        """Acknowledgements of transitions that replay's own count does not have."""
        self._inserts: int | None = None  # replay's count in its last acknowledgement

    @classmethod
    def from_config(
        cls, session: Session, keys: Keys, config: Config, actor: str, stop: StopSignal
    ) -> Self:
        """The writer of an actor, to the shard that takes its chunks."""
        num_shards = config.replay.shards
        shard = shard_of(actor, num_shards)
        return cls(session, keys, config.actor.warn_s, stop, shard=shard, num_shards=num_shards)

    @property
    def heard_s(self) -> float:
        """When replay last answered, on the monotonic clock; before that, when first asked."""
        return self._patience.since

    def insert(self, chunks: Sequence[Chunk]) -> InsertReply | None:
        """Insert one chunk or more; the acknowledgement of all, or None when stopped before.

        Raises RefusedError, with replay's reason, when asking again did not help.
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
                self._check_count(chunks[-1], reply)
                return reply
            except ThrottledError:
                self.throttled += 1
                self._patience.renew()
                if time.monotonic() - asked_s < _RETRY_S:  # too many requests are waiting
                    self._stop.wait(retry_s)
                    retry_s = min(2 * retry_s, _LONGEST_RETRY_S)
            except RefusedError as error:
                self._patience.refused(error)
                self._stop.wait(_RETRY_S)
            except (DeadlineError, WireError):
                self.unanswered += 1
                self._patience.spend()
                self._stop.wait(_RETRY_S)
            if self._stop.is_set():
                return None

    def _check_count(self, last: Chunk, reply: InsertReply) -> None:
        """Compare what was acknowledged with replay's count, which only rises, by as much.

        Log the 1st, 2nd, 4th, 8th … that is missing.
        """
        before, self._inserts = self._inserts, reply.inserts
        stored = 0 if reply.duplicate else len(last)
        if before is None or reply.inserts >= before + stored:
            return
        self.uncounted += 1
        if is_logged(self.uncounted):
            _LOG.warning(
                "%s acknowledged %d transitions, but counts %d where it had %d: it has lost its "
                "log, or another process answers in its place and stores nothing",
                self._name,
                stored,
                reply.inserts,
                before,
            )


class ReplayReader:
    """Samples mini-batches from all shards, several requests ahead, several batches a request.

    A reply comes from one shard. They take turns in proportion to their total priorities, not at
    random: a shard that chance leaves out for a while would hold its actors. The probabilities,
    table size and keys of its samples refer to all shards as one table. A shard that is unreachable
    or throttles for `late_s` is left out until it answers.
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
        late_s: float = _RETRY_S,
        learner_step: int | None = None,
    ) -> None:
        """learner_step: in lockstep, the steps made so far; requests then go out one at a time,
        each for the steps that follow. None: not in lockstep.
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
        self._owed = np.zeros(num_shards)  # requests that each shard is behind its share
        self._late_s = late_s
        self._stop = stop

    @classmethod
    def from_config(
        cls, session: Session, keys: Keys, config: Config, stop: StopSignal, learner_step: int = 0
    ) -> Self:
        """The learner's reader. learner_step: steps made so far, which matter in lockstep."""
        learner = config.learner
        return cls(
            session,
            keys,
            learner.batch_size,
            learner.sample_size // learner.batch_size,
            learner.requests_in_flight,
            learner.warn_s,
            stop,
            num_shards=config.replay.shards,
            learner_step=learner_step if config.run.turn_size else None,
        )

    def _request(self) -> bytes:
        size = self._batch_size * self._batches_per_request
        return encode(SampleRequest(size, self._learner_step))

    @property
    def heard_s(self) -> float:
        """When replay last answered, on the monotonic clock; before that, when first asked."""
        return self._patience.since

    def sample(self) -> Samples | None:
        """The next mini-batch, valid until the next call; None when stopped before it came.

        Raises RefusedError, with replay's reason, when asking again did not help; WireError for
        an answer that cannot be read, after which the next call asks again.
        """
        batch = next(self._batches, None)
        self._patience.renew()
        while batch is None and not self._stop.is_set():
            self._batches = self._next_batches()
            batch = next(self._batches, None)
        return batch

    def _next_batches(self) -> Iterator[Samples]:
        """The mini-batches of the next reply; none if no shard replied in time."""
        eligible = [s for s in self._shards if s.ready() or not s.late] or self._shards
        probabilities = shard_probabilities([shard.total_priority for shard in eligible])
        index = self._next_turn(eligible, probabilities)
        chosen = eligible[index]
        if not chosen.ready(self._late_s):
            chosen.late = True
            return iter(())
        try:
            samples = chosen.take()
        except ThrottledError:
            self._patience.renew()
            return iter(())
        except RefusedError as error:
            self._patience.refused(error)
            self._stop.wait(_RETRY_S)
            return iter(())
        except DeadlineError:
            self._patience.spend()
            self._stop.wait(_RETRY_S)
            return iter(())
        if self._learner_step >= 0:
            self._learner_step += self._batches_per_request
        if len(self._shards) > 1:
            shard = self._shards.index(chosen)
            samples = self._as_one_table(samples, shard, float(probabilities[index]))
        return split_samples(samples, self._batch_size)

    def _next_turn(self, eligible: Sequence[ShardStream], probabilities: Float64Array) -> int:
        """The index of the eligible shard that is the furthest behind its share."""
        shards = [self._shards.index(shard) for shard in eligible]
        self._owed[shards] += probabilities
        index = int(self._owed[shards].argmax())
        self._owed[shards[index]] -= 1
        return index

    def _as_one_table(self, samples: Samples, shard: int, probability: float) -> Samples:
        """A shard's samples as samples of the table that all shards form together."""
        return dataclasses.replace(
            samples,
            keys=samples.keys * len(self._shards) + shard,
            probabilities=samples.probabilities * probability,
            table_size=sum(stream.table_size for stream in self._shards),
            total_priority=sum(stream.total_priority or 0.0 for stream in self._shards),
        )


class PriorityWriter:
    """Sets priorities; tries each message once, since a lost one does no harm."""

    def __init__(
        self, session: Session, keys: Keys, stop: StopSignal, *, num_shards: int = 1
    ) -> None:
        self._clients = [
            session.client(keys.priorities(shard), name)
            for shard, name in enumerate(_names(num_shards))
        ]
        self._patience = _Patience("replay has not taken priorities", math.inf)
        self._stop = stop

    @classmethod
    def from_config(cls, session: Session, keys: Keys, config: Config, stop: StopSignal) -> Self:
        return cls(session, keys, stop, num_shards=config.replay.shards)

    def update(self, priorities: Priorities) -> PrioritiesReply | None:
        """The acknowledgement; None if a shard is unreachable or busy, or when stopped.

        Raises RefusedError, with replay's reason, when messages are refused again and again.
        """
        pending = [client.ask(encode(part)) for client, part in self._parts(priorities)]
        replies = [self._reply(asked) for asked in pending]
        received = [reply for reply in replies if reply is not None]
        if len(received) < len(replies):
            return None
        return PrioritiesReply(sum(r.updated for r in received), sum(r.ignored for r in received))

    def _parts(self, priorities: Priorities) -> Iterator[tuple[Client, Priorities]]:
        """Each shard's client, and the priorities of its transitions."""
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
            reply = decode(PrioritiesReply, pending.result())
        except (ThrottledError, DeadlineError, WireError):
            return None
        except RefusedError as error:
            self._patience.refused(error)
            return None
        self._patience.renew()
        return reply


def _names(num_shards: int) -> list[str]:
    """The shards' names, for errors and the log."""
    return [f"replay shard {i}" for i in range(num_shards)] if num_shards > 1 else ["replay"]


def split_samples(samples: Samples, batch_size: int) -> Iterator[Samples]:
    """Mini-batches of consecutive samples, as views."""
    columns: dict[str, Any] = {
        field.name: column
        for field in dataclasses.fields(samples)
        if isinstance(column := getattr(samples, field.name), np.ndarray)
    }
    for start in range(0, len(samples), batch_size):
        stop = start + batch_size
        yield dataclasses.replace(samples, **{n: c[start:stop] for n, c in columns.items()})


def _answered(pending: PendingReply, stop: StopSignal, last_s: float = 0.0) -> bool:
    """Wait for the result; return False if it does not come within `last_s` after a stop."""
    while not pending.wait(_RETRY_S):
        if stop.is_set():
            return pending.wait(last_s)
    return True


class _Patience:
    """Logs a warning for every `warn_s` without an answer, and bears a passing refusal.

    Another process that answers in replay's place may refuse anything, so a refusal counts once
    it has been repeated for a while.
    """

    def __init__(self, what: str, warn_s: float) -> None:
        self._what = what
        self._warn_s = warn_s
        self.since = self._warned = time.monotonic()
        self._refused_s: float | None = None  # since when all is refused

    def refused(self, error: RefusedError) -> None:
        """Raise the refusal if there have been only refusals for _REFUSALS_S."""
        now = time.monotonic()
        if self._refused_s is None:
            self._refused_s = now
            _LOG.warning("%s; asking again", error)
        elif now - self._refused_s >= _REFUSALS_S:
            raise error

    def renew(self) -> None:
        self.since = self._warned = time.monotonic()
        self._refused_s = None

    def spend(self) -> None:
        now = time.monotonic()
        if now - self._warned >= self._warn_s:
            self._warned = now
            _LOG.warning("%s for %.0f s; still waiting", self._what, now - self.since)
