"""Requests to one of the shards that share a table, sent ahead and answered in order.

Invariant: a shard that is away or holds back costs its reader no more than one wait: from then on
it is left out until it has answered.
"""

import logging
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from mrcdrl.common.errors import DeadlineError, ThrottledError
from mrcdrl.common.messages.trajectory import Float64Array, Samples
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.transport import Client, PendingReply

_LOG = logging.getLogger("replay-client")
_RETRY_S = 0.2
_SAME = 0.05  # of the probability with which a shard is drawn, the part that is the same for all


def shard_of(actor: str, num_shards: int) -> int:
    """Where an actor's chunks go: by the number its name ends with, else by its name's checksum."""
    digits = actor[len(actor.rstrip("0123456789")) :]
    return (int(digits) if digits else zlib.crc32(actor.encode())) % num_shards


def shares(total_priorities: Sequence[float | None]) -> Float64Array:
    """With which probability each shard is drawn, [S]; None: not heard of yet.

    In proportion to the totals, but for a small part that is the same for all: a total is heard
    of with the shard's samples only, and one that has risen must be drawn to be known.
    """
    known = [total for total in total_priorities if total is not None]
    typical = sum(known) / len(known) if known else 1.0
    totals = np.array([typical if total is None else total for total in total_priorities])
    result: Float64Array = _SAME / len(totals) + (1 - _SAME) * totals / totals.sum()
    return result


class ShardStream:
    """Sample requests to one shard; `request` makes the next one."""

    def __init__(
        self, client: Client, whom: str, request: Callable[[], bytes], requests_in_flight: int
    ) -> None:
        self._client = client
        self._whom = whom
        self._request = request
        self._in_flight = requests_in_flight
        self._pending: deque[PendingReply] = deque()
        self._given: PendingReply | None = None  # whose samples are being read
        self._reply_bytes = 0
        self._ask_at_s = 0.0
        self._away = False
        self.late = False
        """It was waited for in vain."""
        self.total_priority: float | None = None
        """As last heard of."""
        self.table_size = 0

    def ready(self, timeout_s: float = 0.0) -> bool:
        """Whether an answer is there to be taken; asks ahead, and waits up to `timeout_s`."""
        if time.monotonic() >= self._ask_at_s:
            while len(self._pending) < self._in_flight:
                asked = self._client.ask(self._request(), reply_bytes=self._reply_bytes)
                self._pending.append(asked)
        if self._pending and self._pending[0].wait(timeout_s):
            self.late = False
            return True
        return False

    def take(self) -> Samples:
        """The answer that is ready; its arrays are valid until the next call, or `release`.

        Raises ThrottledError where the shard holds back, DeadlineError where it is away,
        RefusedError with its reason.
        """
        self.release()
        pending = self._pending.popleft()
        try:
            payload = pending.result()
            samples = decode(Samples, payload)
        except ThrottledError:
            self.late = True
            raise
        except DeadlineError:
            self.late = True
            self._ask_at_s = time.monotonic() + _RETRY_S
            self._say(away=True)
            raise
        self._given, self._reply_bytes = pending, len(payload)
        self.total_priority, self.table_size = samples.total_priority, samples.table_size
        self._say(away=False)
        return samples

    def release(self) -> None:
        """What was taken is no longer read."""
        if self._given is not None:
            self._given.release()
            self._given = None

    def _say(self, *, away: bool) -> None:
        if away is not self._away:
            self._away = away
            _LOG.info("%s %s", self._whom, "does not answer" if away else "answers again")
