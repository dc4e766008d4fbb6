"""The writer's patience with a replay service at which too many requests are waiting."""

import pytest

from mrcdrl.common.errors import ThrottledError
from mrcdrl.common.messages.trajectory import InsertReply
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay import client
from mrcdrl.services.replay.client import ReplayWriter
from tests.services.replay.harness import make_chunk


class FakeReplay:
    """Session, client and answer in one: throttles some requests at once, then acknowledges."""

    def __init__(self, throttles: int) -> None:
        self.throttles = throttles

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
        return encode(InsertReply(0, False, 3))

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
