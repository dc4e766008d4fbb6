"""Shared memory: large messages go through it, and anything odd is refused."""

import mmap
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from mrcdrl.common.config import TransportConfig
from mrcdrl.common.errors import DeadlineError, SharedMemoryError, ThrottledError
from mrcdrl.common.transport import (
    Request,
    Server,
    Session,
    free_endpoint,
    queries,
    shared_memory,
)
from mrcdrl.common.transport.compression import compressed
from mrcdrl.common.transport.shared_memory import (
    LARGE_BYTES,
    BufferPool,
    OpenedBuffers,
    SharedBuffer,
    put,
    room,
)
from tests.common.transport.test_transport import until_served
from tests.patience import PATIENCE_S

KEY = "mrcdrl/slots/query"
LARGE = bytes(range(256)) * (LARGE_BYTES // 128)
SMALL = b"small"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="shared memory needs Linux")


def test_two_ends_see_the_same_memory() -> None:
    buffer = SharedBuffer(1000)
    memory = OpenedBuffers().open(buffer.address)
    assert len(memory) == len(buffer.memory) >= 1000
    memory[10:15] = b"hello"
    assert buffer.memory[10:15] == b"hello"
    buffer.memory[10] = ord("j")
    assert memory[10:15] == b"jello"


def test_memory_begins_at_a_multiple_of_64() -> None:
    address: int = np.frombuffer(SharedBuffer(1).memory, np.uint8).__array_interface__["data"][0]
    assert address % 64 == 0


def open_descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_nothing_is_left_of_a_buffer() -> None:
    before = open_descriptors()
    for _ in range(20):
        buffer, opened = SharedBuffer(1 << 20), OpenedBuffers()
        opened.open(buffer.address)
        del buffer, opened
    assert open_descriptors() == before


def test_the_buffers_of_many_clients_are_mapped_once() -> None:
    opened, shared = OpenedBuffers(), [SharedBuffer(10) for _ in range(100)]
    mapped = [opened.open(buffer.address) for buffer in shared]
    assert all(opened.open(s.address) is m for s, m in zip(shared, mapped, strict=True))


def test_buffers_of_dead_clients_are_forgotten() -> None:
    opened, buffer, other = OpenedBuffers(), SharedBuffer(10), SharedBuffer(10)
    first = buffer.address
    opened.open(first)
    del buffer
    opened.open(other.address)
    with pytest.raises(SharedMemoryError):
        opened.open(first)


def test_a_further_buffer_costs_the_same_however_many_are_mapped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked: list[Path] = []
    opened, shared = OpenedBuffers(), [SharedBuffer(10) for _ in range(100)]
    monkeypatch.setattr(shared_memory, "_is_named", lambda path, _name: not looked.append(path))
    for buffer in shared:
        opened.open(buffer.address)
    assert len(looked) <= 3 * len(shared)


def test_all_buffers_of_dead_clients_are_forgotten_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    opened, shared = OpenedBuffers(), [SharedBuffer(10) for _ in range(60)]
    for buffer in shared[:40]:
        opened.open(buffer.address)
    dead = {Path(buffer.address.split()[2]) for buffer in shared[:40:2]}
    monkeypatch.setattr(shared_memory, "_is_named", lambda path, _name: Path(path.name) not in dead)
    for buffer in shared[40:]:
        opened.open(buffer.address)
    assert opened._mapped.keys() == {s.address for s in (*shared[1:40:2], *shared[40:])}


def foreign(buffer: SharedBuffer, **parts: str) -> str:
    names = ("boot", "process", "descriptor", "token")
    fields = dict(zip(names, buffer.address.split(), strict=True)) | parts
    return " ".join(fields[name] for name in names)


ODD = {
    "nonsense": (lambda _: "x", "no address"),
    "a path": (lambda s: foreign(s, process="../1"), "no address"),
    "another host": (lambda s: foreign(s, boot="0" * 36), "another host"),
    "no process": (lambda s: foreign(s, process="4194999999"), "container or user"),
    "no descriptor": (lambda s: foreign(s, descriptor="99999"), "container or user"),
    "standard input": (lambda s: foreign(s, descriptor="0"), "container or user"),
    "another token": (lambda s: foreign(s, token="0" * 32), "another process"),
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_address_is_refused(name: str) -> None:
    change, reason = ODD[name]
    buffer = SharedBuffer(10)
    with pytest.raises(SharedMemoryError, match=reason):
        OpenedBuffers().open(change(buffer))


def test_memory_that_could_shrink_under_its_reader_is_refused() -> None:
    descriptor = os.memfd_create("mrcdrl-slot", os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, mmap.PAGESIZE)
        unsealed = foreign(SharedBuffer(10), descriptor=str(descriptor))
        with pytest.raises(SharedMemoryError, match="no sealed memory"):
            OpenedBuffers().open(unsealed)
    finally:
        os.close(descriptor)


def test_a_message_is_put_around_what_lies_there_already() -> None:
    memory = SharedBuffer(1000).memory
    last = room(memory, 300)
    assert last is not None
    last[:] = b"z" * 300
    place = put(memory, [b"abc", last])
    assert place is not None
    start, length = place
    assert bytes(memory[start : start + length]) == b"abc" + b"z" * 300
    assert np.shares_memory(np.frombuffer(memory, np.uint8), np.frombuffer(last, np.uint8))


def test_what_does_not_fit_is_not_put() -> None:
    memory = SharedBuffer(1000).memory
    assert put(memory, [bytes(len(memory) + 1)]) is None
    assert room(memory, len(memory) + 1) is None
    everything = room(memory, len(memory))
    assert everything is not None
    assert put(memory, [b"no room before", everything]) is None


class Pair:
    """A client and a server across a router, and a thread that serves."""

    def __init__(self, server_session: Session, client_session: Session) -> None:
        self.server: Server = server_session.server(KEY)
        until_served(client_session, KEY, self.server)
        self.client = client_session.client(KEY, "the peer", shared_memory=True)
        self.pool: BufferPool = self.client._pool
        self.thread = ThreadPoolExecutor(1)

    def exchange(self, request: bytes, reply: bytes) -> tuple[bytes, bytes, Request]:
        """What the server and the client got."""
        taken = self.thread.submit(self.server.take, PATIENCE_S)
        pending = self.client.ask(request, reply_bytes=len(reply))
        asked = taken.result()
        assert asked is not None
        got = bytes(asked.payload)
        asked.reply(reply)
        answer = bytes(pending.result())
        pending.release()
        return got, answer, asked


@pytest.fixture
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    endpoint = free_endpoint()
    shared = getattr(request, "param", True)
    with (
        Session(TransportConfig(listen=(endpoint,))) as router,
        Session(TransportConfig(connect=(endpoint,), shared_memory=shared)) as client,
    ):
        opened = Pair(router, client)
        yield opened
        opened.thread.shutdown()


def test_the_first_exchange_tells_whether_memory_is_shared(
    pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    got, answer, _ = pair.exchange(SMALL, SMALL)
    assert (got, answer) == (SMALL, SMALL)
    assert pair.pool.near is True
    assert caplog.messages == ["large messages to and from the peer go through shared memory"]


def test_large_messages_go_through_one_buffer_both_ways(pair: Pair) -> None:
    pair.exchange(SMALL, SMALL)
    descriptors = set()
    for _ in range(5):
        got, answer, asked = pair.exchange(LARGE, LARGE[::-1])
        assert (got, answer) == (LARGE, LARGE[::-1])
        assert isinstance(asked.payload, memoryview)
        descriptors.add(open_descriptors())
    assert len(descriptors) == 1


@pytest.mark.parametrize("pair", [False], indirect=True)
def test_where_it_is_switched_off_all_goes_over_the_network(pair: Pair) -> None:
    for _ in range(2):
        got, answer, asked = pair.exchange(LARGE, LARGE)
        assert (got, answer) == (LARGE, LARGE)
        assert isinstance(asked.payload, bytes)


def test_a_peer_that_cannot_open_a_buffer_is_served_over_the_network(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(
        "mrcdrl.common.transport.shared_memory._boot_id", iter(["0" * 36, *["1" * 36] * 9]).__next__
    )
    sent: list[bytes] = []
    monkeypatch.setattr(
        queries, "compressed", lambda parts: sent.append(compressed(parts)) or sent[-1]
    )
    for _ in range(3):
        got, answer, asked = pair.exchange(LARGE, LARGE)
        assert (got, answer) == (LARGE, LARGE)
        assert isinstance(asked.payload, bytes)
    assert len(sent) == 5  # all but the first request, before which nothing is known
    assert max(map(len, sent)) < len(LARGE) / 10
    assert caplog.messages == [
        "large messages to and from the peer go over the network: another host"
    ]


def test_a_buffer_that_is_out_of_reach_later_makes_the_client_ask_over_the_network(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair.exchange(SMALL, SMALL)
    with monkeypatch.context() as patched:
        patched.setattr("mrcdrl.common.transport.shared_memory._is_named", lambda *_: False)
        pair.server._buffers = OpenedBuffers()
        taken = pair.thread.submit(pair.server.take, PATIENCE_S)
        pending = pair.client.ask(LARGE)
        assert taken.result() is None
        with pytest.raises(ThrottledError, match="another container or user"):
            pending.result()
    got, answer, asked = pair.exchange(LARGE, LARGE)
    assert (got, answer) == (LARGE, LARGE)
    assert isinstance(asked.payload, bytes)


def test_a_buffer_whose_answer_did_not_come_is_not_reused(pair: Pair) -> None:
    pair.exchange(SMALL, SMALL)
    pair.client._timeout_s = -0.9  # of our own wait: at once, whatever Zenoh does
    silent = pair.client.ask(LARGE)
    with pytest.raises(DeadlineError):
        silent.result()
    silent.release()
    late = pair.server.take(PATIENCE_S)
    assert late is not None
    pair.client._timeout_s = PATIENCE_S
    got, answer, _ = pair.exchange(LARGE[::-1], LARGE)
    assert bytes(late.payload) == LARGE
    assert (got, answer) == (LARGE[::-1], LARGE)


OTHER_PROCESS = f"""
import sys
from mrcdrl.common.config import TransportConfig
from mrcdrl.common.transport import Session
with Session(TransportConfig(connect=(sys.argv[1],))) as session:
    client = session.client({KEY!r}, "the peer", shared_memory=True)
    for _ in range(3):
        pending = client.ask(bytes(range(256)) * 1000, reply_bytes=256_000)
        print(bytes(pending.result())[::-1] == bytes(range(256)) * 1000)
        pending.release()
"""


def test_two_processes_share_memory() -> None:
    endpoint = free_endpoint()
    with Session(TransportConfig(listen=(endpoint,))) as session:
        server = session.server(KEY)
        with subprocess.Popen(
            [sys.executable, "-c", OTHER_PROCESS, endpoint],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            payloads = []
            for _ in range(3):
                request = server.take(60.0)
                assert request is not None
                payloads.append(request.payload)
                request.reply(bytes(request.payload)[::-1])
            out, err = process.communicate(timeout=PATIENCE_S)
    assert (out, process.returncode) == ("True\n" * 3, 0), err
    assert [type(payload) for payload in payloads] == [bytes, memoryview, memoryview]
