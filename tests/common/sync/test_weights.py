"""A reader never returns torn or older weights, whatever arrives in whatever order."""

import logging
import mmap
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.errors import CheckpointError, DeadlineError, WireError
from mrcdrl.common.messages.trajectory import Weights, WeightsNotice
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.files import sha256
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.sync.host_share import HostShare
from mrcdrl.common.sync.weights import WeightsReader
from mrcdrl.common.transport.keys import Keys
from mrcdrl.common.transport.shared_memory import SealedMemory, SharedBuffer

KEYS = Keys("run")
MESSAGES = st.tuples(
    st.integers(0, 2),  # epoch
    st.integers(0, 5),  # version
    st.sampled_from(["whole", "cut", "altered", "altered digest", "another's payload", "foreign"]),
    st.integers(0, 10**6),  # where it is cut or altered
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of this host share in a directory of the test's."""
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))


def payload_of(epoch: int, version: int) -> bytes:
    """A payload that differs between any two weights."""
    return bytes([epoch % 256, version % 256]) * 50


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
    """A session whose newest notice and answers the test sets."""

    shares_memory = False

    def __init__(self) -> None:
        self.noticed: bytes | None = None
        self.answers: dict[str, bytes] = {}  # by key, without the run
        self.asked: list[str] = []
        self.oversized = 0

    def latest_subscriber(self, _key: str, opened: Callable[[bytes], Any]) -> "Wire":
        self.opened = opened
        return self

    def take(self, _timeout_s: float) -> Any:
        newest, self.noticed = self.noticed, None
        return None if newest is None else self.opened(newest)

    def client(self, key: str, *_: Any, **__: Any) -> "WireClient":
        return WireClient(self, key.split("/", 2)[2])

    def says(self, whole: bytes, epoch: int = 1, version: int = 1) -> None:
        """Announce weights, which the learner then answers with."""
        self.noticed = notice(epoch, version)
        self.answers = {"weights": whole, "weights/notice": notice(epoch, version)}


@dataclass
class WireClient:
    """A client of one key."""

    wire: Wire
    key: str

    def ask(self, _request: bytes) -> Future[bytes]:
        self.wire.asked.append(self.key)
        future: Future[bytes] = Answered()
        answer = self.wire.answers.get(self.key)
        if answer is None:
            future.set_exception(DeadlineError("nobody answers"))
        else:
            future.set_result(answer)
        return future


def notice(epoch: int, version: int, address: str = "") -> bytes:
    payload = payload_of(epoch, version)
    return encode(
        WeightsNotice(epoch, version, 10 * version, sha256(payload), len(payload), address)
    )


def reader_of(wire: Wire, silence_s: float = 20.0) -> WeightsReader:
    return WeightsReader(wire, KEYS, adopt, silence_s=silence_s)  # type: ignore[arg-type]


def heard(reader: WeightsReader) -> Weights | None:
    """What a reader has after it noticed, asked and looked for the answer."""
    return reader.latest() or reader.latest() or reader.latest()


@given(st.lists(MESSAGES, max_size=30))
def test_a_reader_never_has_torn_or_older_weights(messages: list[Any]) -> None:
    wire = Wire()
    reader, newest = reader_of(wire), (-1, -1)
    for epoch, version, fault, place in messages:
        wire.says(message(epoch, version, fault, place), epoch, version)
        refused, found = reader.refused, heard(reader)
        if found is not None:
            assert fault == "whole"
            assert found == Weights.of(epoch, version, 10 * version, payload_of(epoch, version))
            assert found.order > newest
            newest = found.order
        elif refused < reader.refused:
            assert fault != "whole"
    wire.says(message_of(3, 0), 3, 0)
    found = heard(reader)
    assert found is not None
    assert found.order == (3, 0)


@given(st.data())
def test_no_altered_byte_of_the_payload_gets_through(data: st.DataObject) -> None:
    whole = message(1, 2, "whole", 0)
    begin = whole.index(payload_of(1, 2))
    altered = bytearray(whole)
    altered[begin + data.draw(st.integers(0, 99))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(WireError, match="torn or altered"):
        decode(Weights, bytes(altered))


def message_of(epoch: int, version: int) -> bytes:
    return message(epoch, version, "whole", 0)


def test_a_torn_answer_is_not_taken_for_the_first_weights() -> None:
    wire, waits = Wire(), 0
    reader = reader_of(wire)

    def meanwhile() -> None:
        nonlocal waits
        waits += 1
        wire.says(message_of(0, 7), 0, 7)

    wire.says(message(0, 7, "altered", 3), 0, 7)
    found = reader.wait(StopSignal(), meanwhile=meanwhile)
    assert found is not None
    assert found == Weights.of(0, 7, 70, payload_of(0, 7))
    assert reader.refused >= 1
    assert waits >= 1


@pytest.mark.parametrize("fault", ["foreign", "altered"])
@pytest.mark.parametrize("order", [(1, 10**9), (10**18, 0)])
def test_refused_weights_do_not_block_good_ones(
    fault: str, order: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody announces weights of a great number, and the learner's answer is refused once."""
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    wire = Wire()
    reader = reader_of(wire)
    for version in range(1, 4):
        wire.says(message(1, version, fault, 7), *order)
        assert heard(reader) is None
        wire.says(message_of(1, version), 1, version)
        found = None
        for _ in range(20):
            now += 0.1
            found = found or heard(reader)
        assert found is not None
        assert found.order == (1, version)
    assert reader.refused == 3


def test_a_reader_that_hears_only_what_it_refuses_asks_the_learner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A subscriber keeps the newest message only, whoever sent it."""
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    wire = Wire()
    reader, times = reader_of(wire), []
    for _ in range(60):
        now += 0.1
        wire.says(message_of(1, 1 + len(times)), 1, 1 + len(times))
        wire.noticed = b"torn!"
        if heard(reader) is not None:
            times.append(now)
    assert len(times) >= 2
    assert times[0] < 1.5


def test_a_reader_that_hears_nothing_asks_the_learner() -> None:
    wire = Wire()
    reader = reader_of(wire, silence_s=0.0)
    wire.says(message_of(1, 1))
    wire.noticed = None
    found = None
    for _ in range(4):
        found = found or reader.latest()
    assert found is not None
    assert found.order == (1, 1)


def test_one_process_of_a_host_asks_and_hands_on(tmp_path: Path, here: None) -> None:
    """Others take what it fetched; who comes later finds it there."""
    wire = Wire()
    wire.shares_memory = True
    readers = [reader_of(wire) for _ in range(5)]
    found: list[Weights] = []
    for reader in readers:
        wire.says(message_of(1, 1))
        reader.latest()  # the first asks
    for _ in range(3):
        found += [weights for reader in readers if (weights := reader.latest()) is not None]
    late = reader_of(wire)
    wire.says(message_of(1, 1))
    found += [weights for weights in [late.latest()] if weights is not None]
    assert found == 6 * [Weights.of(1, 1, 10, payload_of(1, 1))]
    assert wire.asked == ["weights"]
    assert {path.name for path in tmp_path.rglob("*run*")} == {"weights-run", "weights-run.lock"}


def test_a_process_that_hangs_while_it_fetches_holds_nobody_up(
    here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    wire = Wire()
    wire.shares_memory = True
    hanging, other = reader_of(wire), reader_of(wire)
    wire.says(message_of(1, 1))
    assert hanging.latest() is None
    wire.says(message_of(1, 1))
    assert heard(other) is None
    now = 6.0
    found = heard(other)
    assert found is not None
    assert found.order == (1, 1)


def test_what_ended_runs_and_killed_writers_left_is_removed(tmp_path: Path, here: None) -> None:
    share = HostShare("run", enabled=True)
    folder = tmp_path / f"mrcdrl-{os.getuid()}"
    for name in (".half-written", "weights-ended", "weights-newer"):
        (folder / name).write_bytes(b"0" * 64)
    for name in (".half-written", "weights-ended"):
        os.utime(folder / name, (0, 0))
    share.offer(Weights.of(1, 1, 10, payload_of(1, 1)))
    assert {path.name for path in folder.iterdir()} == {"weights-run", "weights-newer"}


@pytest.mark.parametrize("damage", ["cut", "altered"])
def test_a_damaged_file_is_not_taken(damage: str, tmp_path: Path, here: None) -> None:
    share, payload = HostShare("run", enabled=True), payload_of(1, 1)
    share.offer(Weights.of(1, 1, 10, payload))
    assert share.take(sha256(payload), len(payload)) == payload
    path = tmp_path / f"mrcdrl-{os.getuid()}" / "weights-run"
    path.write_bytes(path.read_bytes()[:-1] + (b"" if damage == "cut" else b"!"))
    assert share.take(sha256(payload), len(payload)) is None


@pytest.mark.parametrize("odd", ["of another user", "for all to write", "a file"])
def test_nothing_is_shared_through_a_directory_that_others_may_change(
    odd: str, tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"mrcdrl-{os.getuid()}"
    if odd == "a file":
        path.touch()
    else:
        path.mkdir()
        path.chmod(0o777 if odd == "for all to write" else 0o700)
    if odd == "of another user":
        uid = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: uid + 1)
        path.rename(tmp_path / f"mrcdrl-{uid + 1}")
    share = HostShare("run", enabled=True)
    share.offer(Weights.of(1, 1, 10, payload_of(1, 1)))
    assert share.take(sha256(payload_of(1, 1)), len(payload_of(1, 1))) is None
    assert share.lead()
    assert [*tmp_path.rglob("weights*")] == []


def test_weights_of_the_learners_host_come_from_memory_even_after_it_has_ended(
    here: None,
) -> None:
    wire = Wire()
    wire.shares_memory = True
    reader = reader_of(wire)
    memory = SealedMemory(payload_of(1, 1))
    wire.noticed = notice(1, 1, memory.address)
    assert reader.latest() == Weights.of(1, 1, 10, payload_of(1, 1))
    held = SealedMemory(payload_of(1, 2))
    noticed = wire.opened(notice(1, 2, held.address))
    del held
    wire.opened = lambda _payload: noticed
    wire.noticed = b"heard before"
    assert reader.latest() == Weights.of(1, 2, 20, payload_of(1, 2))
    assert wire.asked == []


HERE = "00000000-0000-0000-0000-000000000000"


@pytest.mark.parametrize(
    "address",
    [
        f"{HERE} 1 3 " + "0" * 32,
        "../../etc/passwd",
        "/proc/self/environ",
        "gone",
        "of another length",
        "a slot, which can be written",
    ],
)
def test_an_address_of_anything_else_is_not_opened(address: str, here: None) -> None:
    """The reader asks the learner instead."""
    memory, slot = SealedMemory(b"too short"), SharedBuffer(100)
    if address == "gone":
        address = SealedMemory(payload_of(1, 1)).address
    elif address == "of another length":
        address = memory.address
    elif address.startswith("a slot"):
        address = slot.address
    wire = Wire()
    wire.shares_memory = True
    reader = reader_of(wire)
    wire.says(message_of(1, 1))
    wire.noticed = notice(1, 1, address)
    found = heard(reader)
    assert found == Weights.of(1, 1, 10, payload_of(1, 1))
    assert wire.asked == ["weights"]


def test_sealed_memory_cannot_be_altered() -> None:
    memory = SealedMemory(payload_of(1, 1))
    process, descriptor = memory.address.split()[1:3]
    opened = os.open(f"/proc/{process}/fd/{descriptor}", os.O_RDWR)
    try:
        with pytest.raises(PermissionError):
            os.write(opened, b"altered")
        with pytest.raises(PermissionError):
            os.ftruncate(opened, 0)
        with pytest.raises(PermissionError):
            mmap.mmap(opened, 0)
    finally:
        os.close(opened)


def test_many_refusals_are_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    wire = Wire()
    reader = reader_of(wire)
    with caplog.at_level(logging.WARNING, "weights"):
        for _ in range(1000):
            wire.noticed = b"torn!"
            assert reader.latest() is None
    assert reader.refused == 1000
    assert len(caplog.messages) == 10
    assert "weights refused, 512 so far: not msgpack" in caplog.messages[-1]
