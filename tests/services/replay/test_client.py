"""The writer's patience with a replay service at which too many requests are waiting."""

import itertools
import logging
from collections.abc import Sequence

import pytest

from mrcdrl.common.errors import RefusedError, ThrottledError
from mrcdrl.common.messages.trajectory import InsertReply
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay import client
from mrcdrl.services.replay.client import ReplayWriter
from tests.services.replay.harness import LENGTH, make_chunk


class FakeReplay:
    """Session, client and answer in one: throttles some requests at once, then acknowledges."""

    def __init__(
        self, throttles: int, replies: Sequence[InsertReply] = (), refusals: int = 0
    ) -> None:
        self.throttles = throttles
        self.refusals = refusals
        self.replies = iter(replies or itertools.repeat(InsertReply(0, False, 3)))

    def client(self, *_: object, **__: object) -> "FakeReplay":
        return self

    def ask(self, _: object) -> "FakeReplay":
        return self

    def wait(self, _: float) -> bool:
        return True

    def result(self) -> bytes:
        self.throttles -= 1
        if self.throttles >= 0:
            raise ThrottledError("256 requests are waiting")
        self.refusals -= 1
        if self.refusals >= 0:
            raise RefusedError("replay refused: no")
        return encode(next(self.replies))

    def release(self) -> None:
        pass


class Waits(StopSignal):
    """Notes each wait, and does not wait."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: list[float] = []

    def wait(self, timeout_s: float) -> bool:
        self.seconds.append(timeout_s)
        return False


def insert(throttles: int, stop: StopSignal) -> ReplayWriter:
    writer = ReplayWriter(FakeReplay(throttles), Keys("run"), 10.0, stop)  # type: ignore[arg-type]
    assert writer.insert([make_chunk(0)]) is not None
    return writer


def test_a_writer_throttled_at_once_asks_less_and_less_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(client.time, "monotonic", lambda: 100.0)
    stop = Waits()
    assert insert(7, stop).throttled == 7
    assert stop.seconds == pytest.approx([0.2, 0.4, 0.8, 1.6, 3.2, 3.2, 3.2])


def test_a_writer_throttled_after_a_wait_asks_again_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seconds = iter(range(0, 1000, 5))
    monkeypatch.setattr(client.time, "monotonic", lambda: float(next(seconds)))
    stop = Waits()
    assert insert(3, stop).throttled == 3
    assert stop.seconds == []


@pytest.mark.parametrize("refusals", [1, 9, 10**9])
def test_a_refusal_counts_once_it_has_been_repeated_for_a_while(
    refusals: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Until then it may be of another process, which answers in replay's place."""
    seconds = itertools.count(0, 0.1)
    monkeypatch.setattr(client.time, "monotonic", lambda: next(seconds))
    session = FakeReplay(0, refusals=refusals)
    writer = ReplayWriter(session, Keys("run"), 10.0, Waits())  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING, "replay-client"):
        if refusals < 10**9:
            assert writer.insert([make_chunk(0)]) is not None
        else:
            with pytest.raises(RefusedError, match="no"):
                writer.insert([make_chunk(0)])
    assert caplog.messages == ["replay refused: no; asking again"]


@pytest.mark.parametrize(
    ("replies", "uncounted"),
    [
        ([(LENGTH, False), (2 * LENGTH, False), (3 * LENGTH, False)], 0),
        ([(5 * LENGTH, False), (9 * LENGTH, False), (10 * LENGTH, False)], 0),  # of several actors
        ([(5 * LENGTH, True), (5 * LENGTH, True), (6 * LENGTH, False)], 0),  # repeated
        ([(5 * LENGTH, False), (5 * LENGTH, False), (6 * LENGTH, False)], 1),
        ([(5 * LENGTH, False), (0, False), (6 * LENGTH, False)], 1),
        ([(5 * LENGTH, False), (2**50, False), (6 * LENGTH, False)], 1),
        ([(0, False)] * 9, 8),
    ],
)
def test_an_acknowledgement_that_replay_does_not_count_is_told(
    replies: list[tuple[int, bool]], uncounted: int, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a process that acknowledges in replay's place, and stores nothing."""
    told = [InsertReply(0, duplicate, inserts) for inserts, duplicate in replies]
    session = FakeReplay(0, told)
    writer = ReplayWriter(session, Keys("run"), 10.0, Waits())  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING, "replay-client"):
        for number in range(len(replies)):
            assert writer.insert([make_chunk(number)]) is not None
    assert writer.uncounted == uncounted
    assert len(caplog.messages) == uncounted.bit_length()
    assert ("another process answers in its place" in caplog.text) == bool(uncounted)
