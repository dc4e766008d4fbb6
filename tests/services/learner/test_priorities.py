"""TD errors go back in order; what replay cannot take in time is dropped, oldest first."""

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from mrcdrl.common.errors import RefusedError
from mrcdrl.common.messages.trajectory import Priorities, PrioritiesReply
from mrcdrl.services.learner import priorities
from mrcdrl.services.learner.priorities import PrioritiesSender
from tests.patience import PATIENCE_S


@dataclass
class FakeWriter:
    """Acknowledges a message for every `go_on`."""

    refuses: bool = False
    away: bool = False
    sent: queue.Queue[Priorities] = field(default_factory=queue.Queue)
    go_on: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def update(self, priorities: Priorities) -> PrioritiesReply | None:
        self.sent.put(priorities)
        assert self.go_on.acquire(timeout=PATIENCE_S)
        if self.refuses:
            raise RefusedError("replay refused: a priority is negative or not finite")
        return None if self.away else PrioritiesReply(len(priorities.keys), 0)

    def next(self) -> Priorities:
        return self.sent.get(timeout=PATIENCE_S)


@contextmanager
def sending(writer: FakeWriter, capacity: int = 4) -> Iterator[PrioritiesSender]:
    sender = PrioritiesSender(writer, capacity)  # type: ignore[arg-type]
    try:
        yield sender
    finally:
        for _ in range(10):
            writer.go_on.release()
        sender.close()


def put(sender: PrioritiesSender, *numbers: int) -> None:
    """Batches of two transitions; number 3 has the keys 30, 31 and the errors -3, 3.5."""
    for n in numbers:
        sender.put(np.array([10 * n, 10 * n + 1]), torch.tensor([-float(n), n + 0.5]))


def test_absolute_errors_are_sent_by_key() -> None:
    writer = FakeWriter()
    with sending(writer) as sender:
        put(sender, 3)
        message = writer.next()
    assert message.keys.tolist() == [30, 31]
    assert message.priorities.tolist() == [3.0, 3.5]
    assert (message.keys.dtype, message.priorities.dtype) == (np.int64, np.float32)
    assert sender.dropped == 0


def test_what_follows_soon_goes_along(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(priorities, "_GATHER_S", 0.5)
    writer = FakeWriter()
    with sending(writer) as sender:
        put(sender, 1, 2, 3)
        assert writer.next().keys.tolist() == [10, 11, 20, 21, 30, 31]


def test_enough_waits_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(priorities, "_GATHER_S", 2 * PATIENCE_S)
    monkeypatch.setattr(priorities, "_GATHER_BATCHES", 3)
    writer = FakeWriter()
    with sending(writer) as sender:
        put(sender, 1, 2, 3)
        assert len(writer.next().keys) == 6


def test_what_waits_is_one_message_in_order() -> None:
    writer = FakeWriter()
    with sending(writer) as sender:
        put(sender, 1)
        writer.next()
        put(sender, 2, 3, 4)
        writer.go_on.release()
        assert writer.next().keys.tolist() == [20, 21, 30, 31, 40, 41]


def test_a_full_queue_drops_the_oldest_and_counts() -> None:
    writer = FakeWriter()
    with sending(writer, capacity=2) as sender:
        put(sender, 1)
        writer.next()
        put(sender, 2, 3, 4, 5)
        assert sender.dropped == 2
        writer.go_on.release()
        assert writer.next().keys.tolist() == [40, 41, 50, 51]


def test_what_replay_does_not_acknowledge_is_counted() -> None:
    writer = FakeWriter(away=True)
    with sending(writer) as sender:
        put(sender, 1)
        writer.next()
        writer.go_on.release()
        put(sender, 2)
        writer.next()
    assert sender.dropped == 2


def test_replays_refusal_reaches_the_learner() -> None:
    writer = FakeWriter(refuses=True)
    with sending(writer) as sender:
        put(sender, 1)
        writer.next()
        writer.go_on.release()
        sender._thread.join(PATIENCE_S)
        with pytest.raises(RefusedError, match="negative or not finite"):
            put(sender, 2)


def test_close_ends_the_thread_with_the_message_under_way() -> None:
    writer, before = FakeWriter(), threading.active_count()
    with sending(writer) as sender:
        put(sender, 1)
        writer.next()
        put(sender, 2)
    assert writer.sent.empty()
    assert threading.active_count() == before


def test_errors_that_are_not_finite_stay_here() -> None:
    """Replay would refuse them; the learner itself says that and when it diverged."""
    writer = FakeWriter()
    with sending(writer) as sender:
        sender.put(np.array([1, 2]), torch.tensor([torch.nan, 1.0]))
        deadline = time.monotonic() + PATIENCE_S
        while not sender.dropped:
            assert time.monotonic() < deadline
            threading.Event().wait(0.01)
        assert sender.dropped == 1
        put(sender, 3)
        assert writer.next().keys.tolist() == [30, 31]
