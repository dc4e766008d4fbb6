"""Live weights: the learner publishes, late joiners ask once, every reader keeps the newest.

Invariants: a reader's weights only ever get newer, by (epoch, version), and only what was adopted
makes others old; a message that is torn, altered or of another network is refused: counted and
dropped. Bytes in, bytes out: no torch here.
"""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable

from mrcdrl.common.errors import CheckpointError, TransportError, WireError
from mrcdrl.common.messages.framing import Part
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.transport import PendingReply, Priority, Session
from mrcdrl.common.transport.keys import Keys

_LOG = logging.getLogger("weights")
_POLL_S = 0.2
_RETRY_S = 0.5
_SILENCE_S = 20.0
_AFTER_REFUSAL_S = 1.0
_COUNT_S = 5.0  # for which a count of the readers holds
_READERS = ("actor", "evaluator")  # roles


class WeightsWriter:
    """Publishes weights and answers late joiners with the newest, in two threads of its own.

    A subscriber that hangs blocks the publishing thread only, which then skips versions that have
    become old. So it does while bytes_per_s, of all actors and evaluators together, are spent by
    the publication before; 0: there is no limit.
    """

    def __init__(self, session: Session, keys: Keys, bytes_per_s: float = 0.0) -> None:
        self._session, self._keys, self._bytes_per_s = session, keys, bytes_per_s
        self._readers, self._count_at_s = 0, 0.0
        self.publications = 0
        """Published so far; those that were skipped do not count."""
        self._publisher = session.publisher(keys.weights, Priority.LOW)
        self._server = session.server(keys.weights)
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        self._published: bytes | None = None
        self._stopping = False
        self._threads = [
            threading.Thread(target=self._publish, name="weights-publish"),
            threading.Thread(target=self._serve, name="weights-serve"),
        ]
        for thread in self._threads:
            thread.start()

    def publish(self, weights: Weights) -> None:
        """Take the newest weights to be published; returns at once."""
        payload = encode(weights)
        with self._changed:
            self._newest = payload
            self._changed.notify_all()

    def close(self) -> None:
        """Publish the newest weights if they are not yet, then end both threads."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _publish(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._newest is not self._published or self._stopping
                )
                payload = self._newest
                if payload is None or payload is self._published:
                    return
                self._published = payload
            began_s = time.monotonic()
            try:
                self._publisher.put(payload)
                self.publications += 1
            except TransportError as error:
                _LOG.warning("weights not published: %s", error)
            self._rest(began_s, len(payload))

    def _rest(self, began_s: float, size: int) -> None:
        """Wait until the bytes of a publication are spent, or for `close`."""
        if not self._bytes_per_s:
            return
        end_s = began_s + self._num_readers() * size / self._bytes_per_s
        with self._changed:
            self._changed.wait_for(lambda: self._stopping, max(end_s - time.monotonic(), 0.0))

    def _num_readers(self) -> int:
        """How many actors and evaluators there are, or were when that could be found out."""
        now_s = time.monotonic()
        if now_s >= self._count_at_s:
            self._count_at_s = now_s + _COUNT_S
            with contextlib.suppress(TransportError):
                self._readers = sum(
                    len(self._session.tokens(self._keys.claim(role, "*", "*"))) for role in _READERS
                )
        return self._readers

    def _serve(self) -> None:
        while not self._stopping:
            request = self._server.take(_POLL_S)
            if request is None:
                continue
            if self._newest is None:
                request.throttle("no weights yet")
            else:
                request.reply(self._newest)


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
        silence_s: float = _SILENCE_S,
    ) -> None:
        self._subscriber = session.latest_subscriber(keys.weights)
        self._client = session.client(
            keys.weights, "the learner", timeout_s=2.0, priority=Priority.LOW
        )
        self._adopt = adopt
        self._silence_s = silence_s
        self._ask_at_s = time.monotonic() + silence_s
        self._asked: PendingReply | None = None
        self._order = (-1, -1)
        self._refused = 0

    @property
    def refused(self) -> int:
        """Messages that were torn, altered, too large or of another network."""
        return self._refused + self._subscriber.oversized

    def latest(self, timeout_s: float = 0.0) -> Weights | None:
        """Newer weights, which are adopted now; None if none came within the time."""
        weights = self._adopted(self._subscriber.take(timeout_s))
        return weights or self._adopted(self._answer_after_silence())

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
            weights = self._adopted(self._ask()) or self.latest(_RETRY_S)
            if weights is not None:
                return weights
            if not logged:
                _LOG.info("waiting for the learner's first weights")
                logged = True
            meanwhile()
        return None

    def _answer_after_silence(self) -> Part | None:
        """The answer to a question asked after a long silence, if it has come; asks when due."""
        if self._asked is None:
            if time.monotonic() >= self._ask_at_s:
                self._ask_at_s = time.monotonic() + self._silence_s
                with contextlib.suppress(TransportError):  # asked again when due
                    self._asked = self._client.ask(b"")
            return None
        if not self._asked.wait(0.0):
            return None
        asked, self._asked = self._asked, None
        try:
            return asked.result()
        except TransportError:
            return None

    def _ask(self) -> Part | None:
        try:
            return self._client.ask(b"").result()
        except TransportError:
            return None  # no learner yet; the caller asks again

    def _adopted(self, payload: Part | None) -> Weights | None:
        """The message's weights once they are adopted; None if they are not newer, or refused."""
        if payload is None:
            return None
        try:
            weights = decode(Weights, payload)
            if weights.order <= self._order:
                return None
            self._adopt(weights)
        except (WireError, CheckpointError) as error:
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
