"""The spool between the arenas and replay: in order, nothing dropped, errors handed on."""

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

from mrcdrl.common.errors import RefusedError
from mrcdrl.common.messages.trajectory import Chunk, InsertReply
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.services.actor.sender import Sender
from tests.patience import PATIENCE_S


@dataclass
class FakeWriter:
    """Acknowledges a chunk when it is told to, or at once."""

    prompt: bool = True
    refuses: bool = False
    stopped: bool = False
    requests: int = 0
    inserted: queue.Queue[int] = field(default_factory=queue.Queue)
    go_on: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def insert(self, chunks: Sequence[Chunk]) -> InsertReply | None:
        for chunk in chunks:
            self.inserted.put(chunk.sequence)
        self.requests += 1
        if not self.prompt:
            assert self.go_on.acquire(timeout=PATIENCE_S)
        if self.refuses:
            raise RefusedError("replay refused: another arena")
        return None if self.stopped else InsertReply(chunks[-1].sequence, False, 0)

    def next(self) -> int:
        return self.inserted.get(timeout=PATIENCE_S)


def chunk(sequence: int, length: int = 3) -> Chunk:
    return Chunk(
        actor="a",
        incarnation=0,
        sequence=sequence,
        weights_version=0,
        records=np.zeros((length + 1, 4), np.uint8),
        actions=np.zeros(length, np.uint8),
        rewards=np.zeros(length, np.float32),
        discounts=np.ones(length, np.float32),
        bootstrap_offsets=np.ones(length, np.uint8),
        priorities=np.empty(0, np.float32),
    )


@contextmanager
def sending(writer: FakeWriter, spool_chunks: int = 8) -> Iterator[Sender]:
    sender = Sender(writer, spool_chunks)  # type: ignore[arg-type]
    try:
        yield sender
    finally:
        for _ in range(spool_chunks + 1):
            writer.go_on.release()
        sender.close()


def test_chunks_leave_in_order_and_are_counted() -> None:
    writer = FakeWriter()
    with sending(writer) as sender:
        for sequence in range(20):
            assert sender.put(chunk(sequence), PATIENCE_S)
        assert [writer.next() for _ in range(20)] == list(range(20))
    assert (sender.chunks, sender.transitions, sender.spooled) == (20, 60, 0)


def test_a_full_spool_makes_put_wait_and_drops_nothing() -> None:
    writer = FakeWriter(prompt=False)
    with sending(writer, spool_chunks=2) as sender:
        assert sender.put(chunk(0), PATIENCE_S)
        assert writer.next() == 0  # taken out of the spool, not acknowledged
        assert sender.put(chunk(1), 0.0)
        assert sender.put(chunk(2), 0.0)
        assert not sender.put(chunk(3), 0.01)
        assert sender.chunks == 0
        writer.go_on.release()
        assert writer.next() == 1
        assert sender.put(chunk(3), PATIENCE_S)
    assert [writer.next() for _ in range(2)] == [2, 3]
    assert sender.chunks == 4


def test_once_stopped_no_chunk_is_spooled_after_one_that_had_no_room() -> None:
    """It would look like one that was lost."""
    writer, stop = FakeWriter(prompt=False), StopSignal()
    with sending(writer, spool_chunks=1) as sender:
        sender.put_all([chunk(0)], stop, lambda: None)
        assert writer.next() == 0  # taken out of the spool, not acknowledged
        tried: list[int] = []

        def put_the_second(spooled: Chunk, timeout_s: float) -> bool:
            tried.append(spooled.sequence)
            return len(tried) > 1

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sender, "put", put_the_second)
            stop.set()
            sender.put_all([chunk(1), chunk(2)], stop, lambda: None)
    assert tried == [1]
    assert sender.chunks == 1


def test_a_full_spool_is_waited_for() -> None:
    writer = FakeWriter(prompt=False)
    with sending(writer, spool_chunks=1) as sender:
        chunks = [chunk(sequence) for sequence in range(4)]
        sender.put_all(chunks, StopSignal(), writer.go_on.release)
    assert [writer.next() for _ in range(4)] == list(range(4))


def test_all_that_waits_leaves_at_once() -> None:
    writer = FakeWriter(prompt=False)
    with sending(writer) as sender:
        assert sender.put(chunk(0), PATIENCE_S)
        assert writer.next() == 0
        for sequence in range(1, 6):
            assert sender.put(chunk(sequence), 0.0)
        writer.go_on.release()
        assert [writer.next() for _ in range(5)] == [1, 2, 3, 4, 5]
    assert writer.requests == 2
    assert sender.chunks == 6


def test_close_sends_what_is_spooled_and_ends_the_thread() -> None:
    writer = FakeWriter()
    before = threading.active_count()
    sender = Sender(writer, 8)  # type: ignore[arg-type]
    for sequence in range(5):
        sender.put(chunk(sequence), PATIENCE_S)
    sender.close()
    assert sender.chunks == 5
    assert threading.active_count() == before


def raises_soon(act: Callable[[], object]) -> RefusedError | None:
    """The error that comes of acting again and again."""
    for _ in range(100):
        try:
            act()
        except RefusedError as error:
            return error
    return None


def test_replays_refusal_reaches_the_actor() -> None:
    writer = FakeWriter(refuses=True)
    with sending(writer, spool_chunks=1) as sender:
        sender.put(chunk(0), PATIENCE_S)
        error = raises_soon(lambda: sender.put(chunk(1), 0.1))
        assert str(error) == "replay refused: another arena"
        with pytest.raises(RefusedError, match="another arena"):
            sender.put(chunk(2), 0.1)
    assert sender.chunks == 0


def test_a_writer_that_was_stopped_ends_the_sending() -> None:
    writer = FakeWriter(stopped=True)
    with sending(writer) as sender:
        sender.put(chunk(0), PATIENCE_S)
        assert writer.next() == 0
    assert sender.chunks == 0
