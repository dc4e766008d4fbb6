"""The shell around the table: threads that insert, sample and set priorities, under one lock.

Inserts are stored in the order in which their actors first asked (`turns.py`).

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
from mrcdrl.services.replay.turns import Request, Turns, Waiting

_LOG = logging.getLogger("replay")
_TAKE_S = 0.2  # how soon a thread notices a stop
_GROUP = 16  # insert requests stored under one lock at most
_TAKEN = 256  # insert requests put in the line at once at most
_HELD = 4  # largest messages that may wait in the line
_TOO_FEW_SAMPLES = "the learner has not sampled enough of what is there yet"
_COUNTS = (
    *("chunks", "duplicates", "gaps", "refused", "log_errors"),
    *("priority_updates", "priorities_ignored"),
)


@dataclass(frozen=True, slots=True)
class _Accepted:
    """A chunk to log and store."""

    message: Part
    chunk: Chunk
    arrival: Arrival
    before: int | None  # last sequence number of its stream, before this one


class _Server(Protocol):
    refused: int  # requests too large to take

    def take(self, timeout_s: float) -> Request | None: ...


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
        self._turns = Turns(config.replay.hold_s)
        self._most_held_bytes = _HELD * config.transport.max_message_bytes
        self._accepted: list[_Accepted] = []  # neither logged nor stored yet
        self._owed: list[tuple[Waiting, InsertReply]] = []  # replies due once they are stored
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

    def _serve(self, server: _Server, answer: Callable[[Request], None]) -> None:
        while not self._stopping.is_set():
            request = server.take(_TAKE_S)
            if request is not None:
                self._answer(request, answer)

    def _serve_inserts(self, server: _Server) -> None:
        """Take in what has arrived, then store what the rate limiter admits, in turn."""
        while not self._stopping.is_set():
            self._take_in(server)
            held = self._store_in_turn()
            if held is not None:
                self._await_samples(held)
                now_s = time.monotonic()
                for waiting in self._turns.overdue(now_s):
                    self._turns.ask_again(waiting, _TOO_FEW_SAMPLES, now_s)
        for waiting in self._turns.all():
            self._turns.ask_again(waiting, "replay is stopping", time.monotonic())

    def _take_in(self, server: _Server) -> None:
        """Put the requests that have arrived in the line; wait for one if it is empty."""
        timeout_s = 0.0 if self._turns else _TAKE_S
        for _ in range(_TAKEN):
            if self._turns.held_bytes > self._most_held_bytes:
                return
            request = server.take(timeout_s)
            if request is None:
                return
            self._answer(request, self._join)
            timeout_s = 0.0

    def _join(self, request: Request) -> None:
        messages = split_set(request.payload)
        self._turns.join(Waiting(request, messages, decode(Chunk, messages[0])))

    def _store_in_turn(self) -> Waiting | None:
        """Store and acknowledge some requests; return the one that the limiter holds, if any.

        A write to the log costs one wait for the interpreter lock, storing one wait for a whole
        sample.
        """
        for _ in range(_GROUP):
            waiting = self._turns.first()
            if waiting is None:
                break
            try:
                admitted = self._insert(waiting)
            except WireError as error:
                self._turns.leave(waiting)
                self._refuse(waiting.request, error)
                continue
            if not admitted:
                why_not = self._commit()
                if why_not:
                    self._turns.ask_again(waiting, why_not, time.monotonic())
                return None if why_not else waiting
            self._turns.leave(waiting)
        self._commit()
        return None

    def _answer(self, request: Request, answer: Callable[[Request], None]) -> None:
        try:
            answer(request)
        except WireError as error:
            self._refuse(request, error)

    def _refuse(self, request: Request, error: WireError) -> None:
        with self._changed:
            self._counts["refused"] += 1
        request.refuse(str(error))

    def _insert(self, waiting: Waiting) -> bool:
        """Accept the chunks that the rate limiter admits; whether these are all of them.

        `_commit` stores and acknowledges them. Only one thread inserts, so what it found stays
        true while it does not hold the lock, and sampling only allows more.
        """
        if not waiting.chunks:
            others = (decode(Chunk, message) for message in waiting.messages[1:])
            waiting.chunks = [self._checked(chunk) for chunk in (waiting.first, *others)]
        for index in range(waiting.taken, len(waiting.chunks)):
            chunk = waiting.chunks[index]
            arrival = self._classify(chunk)
            if arrival is Arrival.REPEATED:
                self._counts["duplicates"] += 1
            elif not self._limiter.can_insert(self._num_accepted + len(chunk)):
                return False
            else:
                self._throttled["insert_held"] = False
                before = self._book.record(chunk.actor, chunk.incarnation, chunk.sequence)
                message = waiting.messages[index]
                self._accepted.append(_Accepted(message, chunk, arrival, before))
            waiting.taken = index + 1
        total = self._table.next_key + self._num_accepted
        reply = InsertReply(chunk.sequence, arrival is Arrival.REPEATED, total)
        self._owed.append((waiting, reply))
        return True

    def _await_samples(self, held: Waiting) -> None:
        """Wait until the limiter admits the request's next chunk, or one must be answered."""
        length = len(held.chunks[held.taken])
        due_s = self._turns.next_answer_s()
        left_s = _TAKE_S if due_s is None else min(due_s - time.monotonic(), _TAKE_S)
        with self._changed:
            self._throttled["insert_held"] = True
            self._changed.wait_for(
                lambda: self._stopping.is_set() or self._limiter.can_insert(length),
                max(left_s, 0.0),
            )
            self._throttled["insert_held"] = not self._limiter.can_insert(length)

    def _commit(self) -> str:
        """Log and store the accepted chunks, and answer; return why all are throttled, or ""."""
        accepted, owed = self._accepted, self._owed
        self._accepted, self._owed = [], []
        why_not = self._append(accepted)
        if why_not:
            for each in reversed(accepted):
                self._book.take_back(each.chunk.actor, each.chunk.incarnation, each.before)
            for waiting, _ in owed:
                self._turns.ask_again(waiting, why_not, time.monotonic())
            return why_not
        if accepted:
            with self._changed:
                for each in accepted:
                    self._store(each.chunk, each.arrival)
                self._changed.notify_all()
            self._forget()
        for waiting, reply in owed:
            waiting.request.reply(encode(reply))
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

    def _checked(self, chunk: Chunk) -> Chunk:
        self._table.check(chunk)
        if len(chunk) > self._limiter.largest_insert:
            raise WireError(
                f"{len(chunk)} transitions where the run's actor.chunk_length is "
                f"{self._limiter.largest_insert}: the rate limiter might never admit them"
            )
        return chunk

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

    def _sample(self, request: Request) -> None:
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

    def _prioritize(self, request: Request) -> None:
        message = decode(Priorities, request.payload)
        with self._changed:
            updated = self._table.update_priorities(message.keys, message.priorities)
            ignored = len(message.keys) - updated
            self._counts["priority_updates"] += updated
            self._counts["priorities_ignored"] += ignored
        request.reply(encode(PrioritiesReply(updated, ignored)))

    def _wait(self, flag: str, request: Request, ready: Callable[[], bool]) -> bool:
        """Release the lock and wait until ready; return False if that took too long."""
        if ready():
            self._throttled[flag] = False
            return True
        self._throttled[flag] = True
        left = request.arrived_s + self._config.replay.hold_s - time.monotonic()
        self._changed.wait_for(lambda: self._stopping.is_set() or ready(), max(left, 0.0))
        self._throttled[flag] = not ready()
        return ready() and not self._stopping.is_set()
