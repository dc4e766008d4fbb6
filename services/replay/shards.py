"""Sample requests to one of the shards of a table, sent ahead and answered in order.

Invariant: a shard that is unreachable or throttled costs its reader no more than one wait: from
then on it is left out until it answers.
"""

import logging
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from mrcdrl.common.errors import DeadlineError, ThrottledError, WireError
from mrcdrl.common.messages.trajectory import Float64Array, Samples
from mrcdrl.common.messages.wire import decode
from mrcdrl.common.transport import Client, PendingReply

_LOG = logging.getLogger("replay-client")
_RETRY_S = 0.2
_UNIFORM = 0.05  # part of a shard's probability that is the same for all shards


def shard_of(actor: str, num_shards: int) -> int:
    """The shard of an actor's chunks: by its name's trailing number, else by its checksum."""
    digits = actor[len(actor.rstrip("0123456789")) :]
    return (int(digits) if digits else zlib.crc32(actor.encode())) % num_shards


def shard_probabilities(total_priorities: Sequence[float | None]) -> Float64Array:
    """The probability of sampling from each shard, [S]; None: its total is not known yet.

    Proportional to the totals, but for a small part that is the same for all: a total arrives
    only with the shard's samples, so one that has risen stays unknown until it is sampled.
    """
    known = [total for total in total_priorities if total is not None]
    typical = sum(known) / len(known) if known else 1.0
    totals = np.array([typical if total is None else total for total in total_priorities])
    result: Float64Array = _UNIFORM / len(totals) + (1 - _UNIFORM) * totals / totals.sum()
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
        self._taken: PendingReply | None = None  # holds the samples being read
        self._reply_bytes = 0
        self._ask_at_s = 0.0
        self._reachable = True
        self.late = False
        """The last wait for it was in vain."""
        self.total_priority: float | None = None
        """Value in its last answer; None before the first."""
        self.table_size = 0

    def ready(self, timeout_s: float = 0.0) -> bool:
        """Whether `take` has an answer; sends requests ahead, and waits up to `timeout_s`."""
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

        Raises ThrottledError if the shard throttled it, DeadlineError if the shard is unreachable,
        RefusedError with the shard's reason, WireError if the answer cannot be read.
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
            self._note(reachable=False)
            raise
        except WireError:
            pending.release()
            raise
        self._taken, self._reply_bytes = pending, len(payload)
        self.total_priority, self.table_size = samples.total_priority, samples.table_size
        self._note(reachable=True)
        return samples

    def release(self) -> None:
        """Give back the memory of what was taken; it is no longer read."""
        if self._taken is not None:
            self._taken.release()
            self._taken = None

    def _note(self, *, reachable: bool) -> None:
        if reachable is not self._reachable:
            self._reachable = reachable
            _LOG.info("%s %s", self._whom, "answers again" if reachable else "does not answer")
