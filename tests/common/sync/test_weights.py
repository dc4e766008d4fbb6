"""A reader never returns torn or older weights, whatever arrives in whatever order."""

import time
from concurrent.futures import Future
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import DeadlineError, WireError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys

MESSAGES = st.tuples(
    st.integers(0, 2),  # epoch
    st.integers(0, 5),  # version
    st.sampled_from(["whole", "cut", "altered", "altered digest", "another's payload"]),
    st.integers(0, 10**6),  # where it is cut or altered
)


def payload_of(epoch: int, version: int) -> bytes:
    """A payload that differs between any two weights."""
    return bytes([epoch, version]) * 50


def message(epoch: int, version: int, fault: str, place: int) -> bytes:
    weights = Weights.of(epoch, version, 10 * version, payload_of(epoch, version))
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
    return data if fault == "whole" else msgpack.packb(table)


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
        future: Future[bytes] = Future()
        if self.answer is None:
            future.set_exception(DeadlineError("nobody answers"))
        else:
            future.set_result(self.answer)
        return future


def reader_of(wire: Wire) -> WeightsReader:
    return WeightsReader(wire, Keys("run"))  # type: ignore[arg-type]


@given(st.lists(MESSAGES, max_size=30))
def test_a_subscriber_never_sees_torn_or_older_weights(messages: list[Any]) -> None:
    wire = Wire()
    reader, newest, faults = reader_of(wire), (-1, -1), 0
    for epoch, version, fault, place in messages:
        wire.published = message(epoch, version, fault, place)
        found = reader.latest()
        faults += fault != "whole"
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
            found, deadline = None, time.monotonic() + 60
            while found is None:
                assert time.monotonic() < deadline, f"version {version} was not asked for"
                request = server.take(0.05)
                if request is not None:
                    request.reply(encode(newest))
                found = reader.latest(0.05)
            assert found == newest
