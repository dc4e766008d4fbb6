"""A reader never returns torn or older weights, whatever arrives in whatever order."""

import logging
import time
from concurrent.futures import Future
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import CheckpointError, DeadlineError, WireError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import PATIENCE_S

MESSAGES = st.tuples(
    st.integers(0, 2),  # epoch
    st.integers(0, 5),  # version
    st.sampled_from(["whole", "cut", "altered", "altered digest", "another's payload", "foreign"]),
    st.integers(0, 10**6),  # where it is cut or altered
)


def payload_of(epoch: int, version: int) -> bytes:
    """A payload that differs between any two weights."""
    return bytes([epoch, version]) * 50


FOREIGN = b"of another network"


def adopt(weights: Weights) -> None:
    if weights.payload == FOREIGN:
        raise CheckpointError("weights have view_px 40, not 60")


def message(epoch: int, version: int, fault: str, place: int) -> bytes:
    payload = FOREIGN if fault == "foreign" else payload_of(epoch, version)
    weights = Weights.of(epoch, version, 10 * version, payload)
    data = encode(weights)
    if fault == "cut":
        return data[: place % len(data)]
    table = msgpack.unpackb(data)
    if fault == "altered":
        altered = bytearray(weights.payload)
        altered[place % len(altered)] ^= 1 + place % 255
        table["payload"] = bytes(altered)
    if fault == "altered digest":
        at = place % len(weights.digest)
        other = "0" if weights.digest[at] != "0" else "1"
        table["digest"] = weights.digest[:at] + other + weights.digest[at + 1 :]
    if fault == "another's payload":
        table["payload"] = payload_of(epoch, version + 1)
    return data if fault in ("whole", "foreign") else msgpack.packb(table)


class Answered(Future[bytes]):
    """A reply that is there."""

    def wait(self, _timeout_s: float) -> bool:
        return True


class Wire:
    """A session whose newest publication and answer the test sets."""

    def __init__(self) -> None:
        self.published: bytes | None = None
        self.answer: bytes | None = None
        self.oversized = 0

    def latest_subscriber(self, _key: str) -> "Wire":
        return self

    def client(self, *_: Any, **__: Any) -> "Wire":
        return self

    def take(self, _timeout_s: float) -> bytes | None:
        newest, self.published = self.published, None
        return newest

    def ask(self, _request: bytes) -> Future[bytes]:
        future: Future[bytes] = Answered()
        if self.answer is None:
            future.set_exception(DeadlineError("nobody answers"))
        else:
            future.set_result(self.answer)
        return future


def reader_of(wire: Wire) -> WeightsReader:
    return WeightsReader(wire, Keys("run"), adopt)  # type: ignore[arg-type]


@given(st.lists(MESSAGES, max_size=30))
def test_a_subscriber_never_sees_torn_or_older_weights(messages: list[Any]) -> None:
    wire = Wire()
    reader, newest, faults = reader_of(wire), (-1, -1), 0
    for epoch, version, fault, place in messages:
        wire.published = message(epoch, version, fault, place)
        found = reader.latest()
        faults += fault not in ("whole", "foreign") or (
            fault == "foreign" and (epoch, version) > newest
        )
        assert reader.refused == faults
        if fault != "whole" or (epoch, version) <= newest:
            assert found is None
            continue
        assert found is not None
        assert found == Weights.of(epoch, version, 10 * version, payload_of(epoch, version))
        newest = found.order


@given(st.data())
def test_no_altered_byte_of_the_payload_gets_through(data: st.DataObject) -> None:
    whole = message(1, 2, "whole", 0)
    begin = whole.index(payload_of(1, 2))
    altered = bytearray(whole)
    altered[begin + data.draw(st.integers(0, 99))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(WireError, match="torn or altered"):
        decode(Weights, bytes(altered))


def test_a_torn_answer_is_not_taken_for_the_first_weights() -> None:
    wire = Wire()
    reader = reader_of(wire)
    wire.answer, wire.published = message(0, 7, "altered", 3), message(0, 4, "whole", 0)
    found = reader.wait(StopSignal())
    assert found is not None
    assert (found.version, reader.refused) == (4, 1)


@pytest.mark.parametrize("fault", ["foreign", "altered"])
@pytest.mark.parametrize("order", [(1, 10**9), (10**18, 0)])
def test_refused_weights_do_not_block_good_ones(fault: str, order: tuple[int, int]) -> None:
    wire = Wire()
    reader = reader_of(wire)
    wire.answer = message_of(1, 1)
    assert reader.wait(StopSignal()) is not None
    table = msgpack.unpackb(message(1, 1, fault, 7))
    table["epoch"], table["version"] = order
    for version in range(2, 5):
        wire.published = msgpack.packb(table)
        assert reader.latest() is None
        wire.published = message_of(1, version)
        found = reader.latest()
        assert found is not None
        assert found.order == (1, version)
    assert reader.refused == 3


def message_of(epoch: int, version: int) -> bytes:
    return message(epoch, version, "whole", 0)


def test_first_weights_that_are_refused_are_waited_on() -> None:
    """Not returned, and asked for again only after listening."""
    wire = Wire()
    reader, waits = reader_of(wire), 0

    def meanwhile() -> None:
        nonlocal waits
        waits += 1
        wire.answer = message_of(1, 3) if waits == 2 else wire.answer

    wire.answer = message(7, 7, "foreign", 0)
    found = reader.wait(StopSignal(), meanwhile=meanwhile)
    assert found is not None
    assert (found.order, reader.refused, waits) == ((1, 3), 2, 2)


def test_a_reader_that_hears_only_what_it_refuses_asks_the_learner() -> None:
    wire = Wire()
    reader = WeightsReader(wire, Keys("run"), adopt, silence_s=0.0)  # type: ignore[arg-type]
    wire.answer = message_of(1, 1)
    found = None
    for _ in range(4):
        wire.published = message(2, 2, "foreign", 0)
        found = found or reader.latest()
    assert found is not None
    assert found.order == (1, 1)


def test_good_weights_whose_place_a_refused_message_took_are_asked_for_soon(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A subscriber keeps the newest message only, whoever sent it."""
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    wire = Wire()
    reader, asked = reader_of(wire), []
    for _ in range(30):
        now += 0.1
        wire.published, wire.answer = b"torn!", message_of(1, len(asked))
        if reader.latest() is not None:
            asked.append(now)
    assert len(asked) >= 2
    assert asked[0] < 1.5


def test_many_refusals_are_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    wire = Wire()
    reader = reader_of(wire)
    with caplog.at_level(logging.WARNING, "weights"):
        for _ in range(1000):
            wire.published = b"torn!"
            assert reader.latest() is None
    assert reader.refused == 1000
    assert len(caplog.messages) == 10
    assert "weights refused, 512 so far: not msgpack" in caplog.messages[-1]


def test_a_reader_that_hears_nothing_asks_the_learner() -> None:
    endpoint, keys = free_endpoint(), Keys("silence")
    joined = TransportConfig(connect=(endpoint,))
    with (
        Session(TransportConfig(listen=(endpoint,))),
        Session(joined) as learner,
        Session(joined) as actor,
    ):
        server = learner.server(keys.weights)
        reader = WeightsReader(actor, keys, silence_s=0.1)
        for version in (1, 2):
            newest = Weights.of(0, version, 10 * version, payload_of(0, version))
            found, deadline = None, time.monotonic() + PATIENCE_S
            while found is None:
                assert time.monotonic() < deadline, f"version {version} was not asked for"
                request = server.take(0.05)
                if request is not None:
                    request.reply(encode(newest))
                found = reader.latest(0.05)
            assert found == newest
