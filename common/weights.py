"""Live weights: the learner publishes, whoever joins late asks once, everyone holds the newest.

Invariants: what a reader returns only ever gets newer, by (epoch, version); a message that is
torn or foreign is counted and dropped. Bytes in, bytes out: nothing here knows torch.
"""

import logging
import threading

from common.errors import TransportError, WireError
from common.keys import Keys
from common.process import StopSignal
from common.trajectory import Weights
from common.transport import Session
from common.wire import decode, encode

_LOG = logging.getLogger("weights")
_TAKE_S = 0.2
_ASK_AGAIN_S = 0.5


class WeightsWriter:
    """Publishes weights, and answers late joiners with the newest from a thread of its own."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._publisher = session.publisher(keys.weights)
        self._server = session.server(keys.weights)
        self._newest: bytes | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="weights")
        self._thread.start()

    def publish(self, weights: Weights) -> None:
        """Raises TransportError where the session is gone."""
        payload = encode(weights)
        self._newest = payload
        self._publisher.put(payload)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._stopping.is_set():
            request = self._server.take(_TAKE_S)
            if request is None:
                continue
            if self._newest is None:
                request.hold("no weights yet")
            else:
                request.reply(self._newest)


class WeightsReader:
    """Follows the newest weights of a run."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self._subscriber = session.latest_subscriber(keys.weights)
        self._client = session.client(keys.weights, "the learner", timeout_s=2.0)
        self._order = (-1, -1)
        self.refused = 0

    def latest(self, timeout_s: float = 0.0) -> Weights | None:
        """Weights newer than the last returned; None where none came within the time."""
        return self._newer(self._subscriber.take(timeout_s))

    def wait(self, stop: StopSignal) -> Weights | None:
        """The first weights, asked for and listened for until they come; None when stopped."""
        told = False
        while not stop.is_set():
            weights = self._newer(self._ask()) or self.latest(_ASK_AGAIN_S)
            if weights is not None:
                return weights
            if not told:
                _LOG.info("waiting for the learner's first weights")
                told = True
        return None

    def _ask(self) -> bytes | None:
        try:
            return self._client.ask(b"").result()
        except TransportError:
            return None  # no learner yet; the caller asks again

    def _newer(self, payload: bytes | None) -> Weights | None:
        if payload is None:
            return None
        try:
            weights = decode(Weights, payload)
        except WireError as error:
            self.refused += 1
            _LOG.warning("weights refused: %s", error)
            return None
        if weights.order <= self._order:
            return None
        self._order = weights.order
        return weights
