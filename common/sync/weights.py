"""Live weights: the learner says that there are new ones, and readers get them when they are free.

A notice of some 300 bytes goes to all. On the learner's host a reader takes the weights from sealed
memory that the notice names; on any other, one process asks the learner and hands on to the rest
(`host_share.py`). Weights are published in full only while somebody subscribes to that, which no
process of ours does. Where averages are for evaluation alone, whoever tests asks for these instead.

Invariants: a reader's weights only ever get newer, by (epoch, version), and only what was adopted
makes others old; a message that is torn, altered or of another network is refused: counted and
dropped. Bytes in, bytes out: no torch here.
"""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from mrcdrl.common.errors import CheckpointError, SharedMemoryError, TransportError, WireError
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.messages.trajectory import Weights, WeightsNotice
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.sync.host_share import HostShare
from mrcdrl.common.transport import PendingReply, Priority, Server, Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.common.transport.shared_memory import SealedMemory, open_sealed

_LOG = logging.getLogger("weights")
_POLL_S = 0.2
_RETRY_S = 0.5
_SILENCE_S = 20.0
_AFTER_REFUSAL_S = 1.0
_HANDED_ON_S = 5.0  # from a notice until a reader no longer waits for another of its host
_LOOK_S = 0.05  # between looks for an answer
_KEPT = 3  # weights in memory: some may still be reading the older ones


class WeightsWriter:
    """Announces weights, and answers with the newest, in threads of its own.

    bytes_per_s: what the answers may take of the learner's link. The next weights are announced
    when those are spent that the weights before have taken; versions that have become old meanwhile
    are skipped, as while a subscriber hangs. 0: there is no limit.
    """

    def __init__(self, session: Session, keys: Keys, bytes_per_s: float = 0.0) -> None:
        self._bytes_per_s = bytes_per_s
        self.publications = 0
        """Announced so far; those that were skipped do not count."""
        self._notices = session.publisher(keys.weights_notice, Priority.HIGH)
        self._whole = session.watched_publisher(keys.weights, Priority.LOW)
        self._share = session.shares_memory
        self._memories: deque[SealedMemory] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._newest: tuple[Weights, Weights] | None = None  # and their average
        self._published: tuple[Weights, Weights] | None = None
        self._answers: dict[str, bytes] = {}  # the newest by key, once announced
        self._answered = 0  # bytes of weights since the last notice
        self._stopping = False
        served = (keys.weights, keys.weights_notice, keys.weights_average)
        servers = [(key, session.server(key)) for key in served]
        self._threads = [threading.Thread(target=self._publish, name="weights-publish")] + [
            threading.Thread(target=self._serve, args=each, name="weights-serve")
            for each in servers
        ]
        self._keys = keys
        for thread in self._threads:
            thread.start()

    def publish(self, weights: Weights, average: Weights | None = None) -> None:
        """Take the newest weights to be announced; returns at once.

        average: what is tested in their place, of the same version; None: they are.
        """
        with self._changed:
            self._newest = weights, average or weights
            self._changed.notify_all()

    def close(self) -> None:
        """Announce the newest weights if they are not yet, then end all threads."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _publish(self) -> None:
        began_s = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._newest is not self._published or self._stopping
                )
                self._await_link(began_s)
                newest = self._newest
                if newest is None or newest is self._published:
                    return
                self._published = newest
            began_s = time.monotonic()
            weights, average = newest
            notice, whole = encode(self._notice_of(weights)), encode(weights)
            answers = {
                self._keys.weights: whole,
                self._keys.weights_notice: notice,
                self._keys.weights_average: whole if average is weights else encode(average),
            }
            with self._changed:
                self._answers, self._answered = answers, 0
            try:
                self._notices.put(notice)
                if self._whole.watched:
                    self._whole.put(whole)
                self.publications += 1
            except TransportError as error:
                _LOG.warning("weights not published: %s", error)

    def _notice_of(self, weights: Weights) -> WeightsNotice:
        """The notice of weights, which are put into sealed memory if there is some."""
        address = ""
        if self._share:
            try:
                memory = SealedMemory(weights.payload)
            except OSError as error:
                self._share = False
                _LOG.info("weights go over the network: no memory to share: %s", error.strerror)
            else:
                self._memories.append(memory)
                address = memory.address
        return WeightsNotice(
            *weights.order, weights.learner_step, weights.digest, len(weights.payload), address
        )

    def _await_link(self, began_s: float) -> None:
        """Wait until what the weights of then have taken of the link is spent, or for `close`.

        Called with the lock, which is released meanwhile.
        """
        while self._bytes_per_s and not self._stopping:
            left_s = began_s + self._answered / self._bytes_per_s - time.monotonic()
            if left_s <= 0:
                return
            self._changed.wait(left_s)

    def _serve(self, key: str, server: Server) -> None:
        while not self._stopping:
            request = server.take(_POLL_S)
            if request is None:
                continue
            answer = self._answers.get(key)
            if answer is None:
                request.throttle("no weights yet")
                continue
            if key != self._keys.weights_notice:
                with self._changed:
                    self._answered += len(answer)
            request.reply(answer)


class WeightsReader:
    """Follows the newest weights of a run.

    adopt: puts weights into use, or raises CheckpointError if they are another network's; by
    default, all are taken. silence_s: after this long without newer weights the reader asks the
    learner, because a link that was lost may come back without its subscriptions. It asks sooner
    after a message that it refused, which may have taken the place of a good one.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        adopt: Callable[[Weights], None] = lambda _weights: None,
        *,
        averages: bool = False,
        silence_s: float = _SILENCE_S,
    ) -> None:
        """averages: ask for these; they are neither in memory nor handed on."""
        whom, low = "the learner", Priority.LOW
        self._shares_memory = session.shares_memory and not averages
        self._subscriber = session.latest_subscriber(keys.weights_notice, self._opened)
        self._notices = session.client(keys.weights_notice, whom, timeout_s=2.0, priority=low)
        wholes = keys.weights_average if averages else keys.weights
        self._wholes = session.client(wholes, whom, priority=low)
        self._host = HostShare(keys.run, enabled=self._shares_memory)
        self._adopt = adopt
        self._silence_s = silence_s
        self._ask_at_s = time.monotonic() + silence_s
        self._asked: PendingReply | None = None  # for a notice
        self._noticed: _Noticed | None = None  # of weights to be had
        self._noticed_s = 0.0  # when there were newer weights first
        self._fetch_at_s = 0.0  # not before
        self._fetched: PendingReply | None = None  # for weights
        self._order = (-1, -1)
        self._refused = 0
        self.fetched_bytes = 0
        """Bytes of weights that came from the learner, not from the memory of this host."""

    @property
    def refused(self) -> int:
        """Messages that were torn, altered, too large or of another network."""
        return self._refused + self._subscriber.oversized

    def latest(self, timeout_s: float = 0.0) -> Weights | None:
        """Newer weights, which are adopted now; None if none came within the time."""
        deadline = time.monotonic() + timeout_s
        while True:
            left_s = max(deadline - time.monotonic(), 0.0)
            waits = self._noticed is not None or self._asked is not None
            self._note(self._subscriber.take(min(left_s, _LOOK_S) if waits else left_s))
            weights = self._adopted(self._newer())
            if weights is not None or time.monotonic() >= deadline:
                return weights

    def wait(
        self,
        stop: StopSignal,
        timeout_s: float = math.inf,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Weights | None:
        """Ask and listen for the first weights, adopted then; None when stopped or out of time.

        meanwhile: called several times a second at best, every few seconds at worst.
        """
        logged, deadline = False, time.monotonic() + timeout_s
        while not stop.is_set() and time.monotonic() < deadline:
            with contextlib.suppress(TransportError):  # no learner yet; asked again
                self._note(self._opened(self._notices.ask(b"").result()))
            weights = self.latest(_RETRY_S)
            if weights is not None:
                return weights
            if not logged:
                _LOG.info("waiting for the learner's first weights")
                logged = True
            meanwhile()
        return None

    def _opened(self, payload: Part) -> "_Noticed | WireError":
        """A notice with the memory that it names; an unreadable one is returned as its error.

        Called by Zenoh's thread, too.
        """
        try:
            notice = decode(WeightsNotice, payload)
        except WireError as error:
            return error
        memory = None
        if notice.address and self._shares_memory:
            with contextlib.suppress(SharedMemoryError):
                memory = open_sealed(notice.address, notice.num_bytes)
        return _Noticed(notice, memory)

    def _note(self, noticed: "_Noticed | WireError | None") -> None:
        """Keep a notice if its weights are newer than all that are known of."""
        if noticed is None:
            return
        if isinstance(noticed, WireError):
            self._refuse(noticed)
            return
        if self._noticed is None:
            self._noticed_s = time.monotonic()
        known = self._order if self._noticed is None else self._noticed.notice.order
        if noticed.notice.order > known:
            self._noticed, self._fetch_at_s = noticed, 0.0

    def _newer(self) -> Weights | None:
        """The weights of the last notice, or newer ones, if they can be had now."""
        self._ask_after_silence()
        if self._noticed is None:
            return None
        weights = self._from_host(self._noticed) or self._from_learner()
        if weights is not None:
            self._noticed = None
        return weights

    def _from_host(self, noticed: "_Noticed") -> Weights | None:
        """The weights from the memory of this host, if they are there."""
        notice, memory = noticed.notice, noticed.memory
        if memory is not None:
            payload: bytes | None = bytes(memory)
        else:
            payload = self._host.take(notice.digest, notice.num_bytes)
        if payload is None:
            return None
        return Weights(*notice.order, notice.learner_step, payload, notice.digest)

    def _from_learner(self) -> Weights | None:
        """The newest weights, if the answer has come; asks if it is this process's turn."""
        if self._fetched is None:
            now_s = time.monotonic()
            alone = now_s > self._noticed_s + _HANDED_ON_S  # who is to hand them on may hang
            if now_s >= self._fetch_at_s and (self._host.lead() or alone):
                self._fetch_at_s = now_s + _RETRY_S
                try:
                    self._fetched = self._wholes.ask(b"")
                except TransportError:
                    self._host.release()
            return None
        if not self._fetched.wait(0.0):
            return None
        fetched, self._fetched = self._fetched, None
        try:
            answer = fetched.result()
            self.fetched_bytes += len(answer)
            weights = decode(Weights, answer)
            self._host.offer(weights)
        except TransportError:
            return None  # asked again
        except WireError as error:
            self._refuse(error)
            return None
        finally:
            self._host.release()
        return weights

    def _ask_after_silence(self) -> None:
        """Ask for a notice when that is due, and note the answer if it has come."""
        if self._asked is None:
            if time.monotonic() >= self._ask_at_s:
                self._ask_at_s = time.monotonic() + self._silence_s
                with contextlib.suppress(TransportError):  # asked again when due
                    self._asked = self._notices.ask(b"")
            return
        if self._asked.wait(0.0):
            asked, self._asked = self._asked, None
            with contextlib.suppress(TransportError):
                self._note(self._opened(asked.result()))

    def _adopted(self, weights: Weights | None) -> Weights | None:
        """The weights once they are adopted; None if they are not newer, or refused."""
        if weights is None or weights.order <= self._order:
            return None
        try:
            self._adopt(weights)
        except CheckpointError as error:
            self._refuse(error)
            return None
        self._order, self._ask_at_s = weights.order, time.monotonic() + self._silence_s
        return weights

    def _refuse(self, error: Exception) -> None:
        """Count a message; log the 1st, 2nd, 4th, 8th …, as a peer may send many."""
        self._refused += 1
        self._ask_at_s = min(self._ask_at_s, time.monotonic() + _AFTER_REFUSAL_S)
        if is_logged(self._refused):
            _LOG.warning("weights refused, %d so far: %s", self._refused, error)


@dataclass(frozen=True, slots=True)
class _Noticed:
    """A notice, and the memory that it names, which stays when the learner ends."""

    notice: WeightsNotice
    memory: memoryview | None  # None: on another host
