"""The shell around the table: threads that insert, sample and set priorities, under one lock.

Invariants: a chunk is acknowledged only after it is in the log and the table; every request is
answered within `hold_s`: with the data, refused with the reason, or throttled, which tells the
peer to ask again.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from mrcdrl.common.config import Config
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.framing import Part, split_set
from mrcdrl.common.messages.metrics import ReplayMetrics
from mrcdrl.common.messages.trajectory import (
    Chunk,
    InsertReply,
    Priorities,
    PrioritiesReply,
    SampleRequest,
)
from mrcdrl.common.messages.wire import decode, encode, encode_parts
from mrcdrl.common.runtime.files import reason
from mrcdrl.services.replay.admission import make_admission
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import SegmentLog
from mrcdrl.services.replay.sequence import Arrival, SequenceBook
from mrcdrl.services.replay.snapshot import Snapshot, SnapshotWriter, read_snapshot
from mrcdrl.services.replay.table import Table

_LOG = logging.getLogger("replay")
_TAKE_S = 0.2  # how soon a thread notices a stop
_GROUP = 16  # insert requests stored under one lock at most
_COUNTS = (
    *("chunks", "duplicates", "gaps", "refused", "log_errors"),
    *("priority_updates", "priorities_ignored"),
)


class _Request(Protocol):
    """What the service needs from a transport's request."""

    @property
    def payload(self) -> Part: ...
    @property
    def arrived_s(self) -> float: ...

    def room(self, size: int) -> memoryview | None: ...
    def reply(self, payload: Part | Sequence[Part]) -> None: ...
    def refuse(self, reason: str) -> None: ...
    def throttle(self, reason: str) -> None: ...


@dataclass(frozen=True, slots=True)
class _Accepted:
    """A chunk to log and store."""

    message: Part
    chunk: Chunk
    arrival: Arrival
    before: int | None  # last sequence number of its stream, before this one


class _Server(Protocol):
    refused: int  # requests too large to take

    def take(self, timeout_s: float) -> _Request | None: ...


class ReplayService:
    """Serves inserts, samples and priorities until `stop`."""

    def __init__(
        self,
        config: Config,
        table: Table,
        limiter: RateLimiter,
        inserts: _Server,
        samples: _Server,
        priorities: _Server,
        log: SegmentLog | None = None,
    ) -> None:
        """log: keeps chunks beyond the process, beside a snapshot; None: nothing is kept."""
        self._config = config
        self._table = table
        self._limiter = limiter
        self._log = log
        period_s = config.replay.snapshot_period_s
        self._snapshots = (
            None if log is None else SnapshotWriter(log.directory, self.snapshot, period_s)
        )
        self._admission = make_admission(config, table, limiter)
        self._book = SequenceBook()
        self._accepted: list[_Accepted] = []  # neither logged nor stored yet
        self._owed: list[tuple[_Request, InsertReply]] = []  # replies due once they are stored
        self._earlier = {"inserts": 0, "samples": 0}  # not counted by the limiter
        self._changed = threading.Condition()
        self._log_fails = False
        self._stopping = threading.Event()
        self._counts = dict.fromkeys(_COUNTS, 0)
        self._throttled = {"insert_held": False, "sample_held": False}
        self._servers = (inserts, samples, priorities)
        self._threads = [
            threading.Thread(target=self._serve_inserts, args=(inserts,), name="insert"),
            threading.Thread(target=self._serve, args=(samples, self._sample), name="sample"),
            threading.Thread(
                target=self._serve, args=(priorities, self._prioritize), name="priorities"
            ),
        ]

    def recover(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Restore what earlier processes kept in the log and a snapshot; call before `start`.

        meanwhile: called after each chunk, as a long log takes minutes to read.
        """
        if self._log is None:
            return
        self._table.number_from(self._log.first_key)
        left_out = ""
        for payload in self._log.recover(lambda: self._table.next_key):
            try:
                chunk = decode(Chunk, payload)
                arrival = self._classify(chunk)
                if arrival is not Arrival.REPEATED:
                    self._book.record(chunk.actor, chunk.incarnation, chunk.sequence)
                    self._store(chunk, arrival)
            except WireError as error:
                self._counts["refused"] += 1
                left_out = str(error)
            meanwhile()
        if left_out:
            count = self._counts["refused"]
            _LOG.warning("%d chunks in the log were left out; the last: %s", count, left_out)
        self._forget()
        self._limiter.resume(len(self._table))
        evicted = self._table.next_key - len(self._table)
        self._earlier = {
            "inserts": evicted,
            "samples": round(evicted * self._limiter.samples_per_insert),
        }
        snapshot = read_snapshot(self._log.directory)
        if snapshot is not None and snapshot.restore(self._config, self._table, self._limiter):
            self._earlier = {
                "inserts": self._table.next_key - self._limiter.inserts,
                "samples": snapshot.all_samples - self._limiter.samples,
            }

    def snapshot(self) -> Snapshot:
        """A snapshot of the table as it is now."""
        with self._changed:
            return Snapshot.take(self._config, self._table, self._limiter, self._all_samples)

    @property
    def _all_samples(self) -> int:
        return self._earlier["samples"] + self._limiter.samples

    def start(self) -> None:
        for thread in self._threads:
            thread.start()
        if self._snapshots is not None:
            self._snapshots.start()

    def stop(self) -> None:
        """Answer the requests being served, then end all threads."""
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if self._snapshots is not None:
            self._snapshots.stop()

    @property
    def healthy(self) -> bool:
        """Whether all threads live; one that died from a bug ends the service."""
        snapshots = self._snapshots is None or self._snapshots.healthy
        return snapshots and all(thread.is_alive() for thread in self._threads)

    @property
    def accepting(self) -> bool:
        """Whether chunks can be stored; False while the log cannot be written."""
        return not self._log_fails

    def metrics(self) -> ReplayMetrics:
        with self._changed:
            refused = self._counts["refused"] + sum(s.refused for s in self._servers)
            counts = self._counts | {"refused": refused}
            return ReplayMetrics(
                size=len(self._table),
                capacity=self._table.capacity,
                min_size=self._limiter.min_size,
                inserts=self._earlier["inserts"] + self._limiter.inserts,
                samples=self._all_samples,
                samples_per_insert=self._limiter.ratio,
                bytes=self._table.nbytes,
                **counts,
                **self._throttled,
            )

    def _serve(self, server: _Server, answer: Callable[[_Request], None]) -> None:
        while not self._stopping.is_set():
            request = server.take(_TAKE_S)
            if request is not None:
                self._answer(request, answer)

    def _serve_inserts(self, server: _Server) -> None:
        """Write and store the requests that are already waiting together.

        A write costs one wait for the interpreter lock, storing one wait for a whole sample.
        """
        while not self._stopping.is_set():
            for count in range(_GROUP):
                request = server.take(0.0 if count else _TAKE_S)
                if request is None:
                    break
                self._answer(request, self._insert)
            self._commit()

    def _answer(self, request: _Request, answer: Callable[[_Request], None]) -> None:
        try:
            answer(request)
        except WireError as error:
            with self._changed:
                self._counts["refused"] += 1
            request.refuse(str(error))

    def _insert(self, request: _Request) -> None:
        """Accept the chunks of a request; `_commit` answers it unless it is throttled here.

        Only one thread inserts, so what it found stays true while it does not hold the lock.
        """
        messages = split_set(request.payload)
        chunks = [self._checked(message) for message in messages]
        for message, chunk in zip(messages, chunks, strict=True):
            arrival = self._classify(chunk)
            if arrival is Arrival.REPEATED:
                self._counts["duplicates"] += 1
                continue
            why_not = self._why_not_admitted(request, chunk)
            if why_not:
                request.throttle(why_not)
                return
            before = self._book.record(chunk.actor, chunk.incarnation, chunk.sequence)
            self._accepted.append(_Accepted(message, chunk, arrival, before))
        total = self._table.next_key + self._num_accepted
        reply = InsertReply(chunk.sequence, arrival is Arrival.REPEATED, total)
        self._owed.append((request, reply))

    def _commit(self) -> str:
        """Log and store the accepted chunks, and answer; return why all are throttled, or ""."""
        accepted, owed = self._accepted, self._owed
        self._accepted, self._owed = [], []
        why_not = self._append(accepted)
        if why_not:
            for each in reversed(accepted):
                self._book.take_back(each.chunk.actor, each.chunk.incarnation, each.before)
            for request, _ in owed:
                request.throttle(why_not)
            return why_not
        if accepted:
            with self._changed:
                for each in accepted:
                    self._store(each.chunk, each.arrival)
                self._changed.notify_all()
            self._forget()
        for request, reply in owed:
            request.reply(encode(reply))
        return ""

    def _append(self, accepted: Sequence[_Accepted]) -> str:
        """Write to the log, if any, while sampling continues; return why that failed, or ""."""
        if self._log is None or not accepted:
            return ""
        messages = [each.message for each in accepted]
        count = sum(len(each.chunk) for each in accepted)
        try:
            self._log.append(messages, self._table.next_key, count)
        except OSError as error:
            self._log_fails = True
            self._counts["log_errors"] += 1
            if self._counts["log_errors"] == 1:
                _LOG.warning("cannot write the log; inserts wait: %s", reason(error))
            return f"replay's log cannot be written: {reason(error)}"
        self._log_fails = False
        return ""

    def _checked(self, message: Part) -> Chunk:
        chunk = decode(Chunk, message)
        self._table.check(chunk)
        if len(chunk) > self._limiter.largest_insert:
            raise WireError(
                f"{len(chunk)} transitions where the run's actor.chunk_length is "
                f"{self._limiter.largest_insert}: the rate limiter might never admit them"
            )
        return chunk

    def _why_not_admitted(self, request: _Request, chunk: Chunk) -> str:
        """Why the rate limiter does not admit the chunk yet; "" if it does."""
        if self._limiter.can_insert(self._num_accepted + len(chunk)):  # sampling only allows more
            self._throttled["insert_held"] = False
            return ""
        why_not = self._commit()
        if why_not:
            return why_not
        with self._changed:
            if self._wait("insert_held", request, lambda: self._limiter.can_insert(len(chunk))):
                return ""
        return "the learner has not sampled enough of what is there yet"

    @property
    def _num_accepted(self) -> int:
        """Accepted transitions that are not in the table yet."""
        return sum(len(each.chunk) for each in self._accepted)

    def _classify(self, chunk: Chunk) -> Arrival:
        return self._book.classify(chunk.actor, chunk.incarnation, chunk.sequence)

    def _store(self, chunk: Chunk, arrival: Arrival) -> None:
        """Insert a chunk into the table and count it."""
        self._table.insert(chunk)
        self._limiter.inserts += len(chunk)
        self._counts["chunks"] += 1
        self._counts["gaps"] += arrival is Arrival.GAP

    def _forget(self) -> None:
        """Delete segments that the table has evicted; one that remains does no harm."""
        if self._log is None:
            return
        try:
            self._log.forget(self._table.first_key)
        except OSError as error:
            _LOG.warning("cannot delete an old segment of the log: %s", reason(error))

    def _sample(self, request: _Request) -> None:
        wanted = decode(SampleRequest, request.payload)
        size = wanted.batch_size
        if not 1 <= size <= self._limiter.largest_sample:
            raise WireError(f"batch_size {size} is outside 1 ... {self._limiter.largest_sample}")
        with self._changed:
            if not self._wait("sample_held", request, lambda: self._admission.can_sample(wanted)):
                request.throttle(self._admission.why_not(wanted))
                return
            self._admission.reseed(wanted)
            samples = self._table.sample(size, request.room(self._table.sample_bytes(size)))
            self._limiter.samples += size
            self._changed.notify_all()
        request.reply(encode_parts(samples))

    def _prioritize(self, request: _Request) -> None:
        message = decode(Priorities, request.payload)
        with self._changed:
            updated = self._table.update_priorities(message.keys, message.priorities)
            ignored = len(message.keys) - updated
            self._counts["priority_updates"] += updated
            self._counts["priorities_ignored"] += ignored
        request.reply(encode(PrioritiesReply(updated, ignored)))

    def _wait(self, flag: str, request: _Request, ready: Callable[[], bool]) -> bool:
        """Release the lock and wait until ready; return False if that took too long."""
        if ready():
            self._throttled[flag] = False
            return True
        self._throttled[flag] = True
        left = request.arrived_s + self._config.replay.hold_s - time.monotonic()
        self._changed.wait_for(lambda: self._stopping.is_set() or ready(), max(left, 0.0))
        self._throttled[flag] = not ready()
        return ready() and not self._stopping.is_set()
