"""The segment log against a plain list of what was acknowledged, whatever interrupts writers."""

import errno
import os
import shutil
import tempfile
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from unittest import mock

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from mrcdrl.services.replay.log import SegmentLog, read_segment, segment_paths

PER_PAYLOAD = 10  # transitions that each payload stands for


class LogAgainstList(RuleBasedStateMachine):
    """All payloads differ; the list holds those that must come back, oldest first."""

    @initialize(segment_bytes=st.integers(1, 400), fsync=st.booleans())
    def make(self, segment_bytes: int, fsync: bool) -> None:
        self.directory = Path(tempfile.mkdtemp())
        self.segment_bytes, self.fsync = segment_bytes, fsync
        self.model: list[bytes] = []
        self.count = 0
        self.corrupt = 0
        self.start()

    def start(self) -> None:
        """A new process opens the log; the one before it was killed, or closed it."""
        self.log = SegmentLog(self.directory, segment_bytes=self.segment_bytes, fsync=self.fsync)
        self.found: list[bytes] = []
        self.first = self.log.first_key
        for payload in self.log.recover(lambda: self.key(len(self.found))):
            self.found.append(payload)

    def key(self, index: int) -> int:
        return self.first + PER_PAYLOAD * index

    def payload(self, size: int) -> bytes:
        self.count += 1
        return self.count.to_bytes(4, "big") + bytes([self.count % 255 + 1]) * size

    @rule(sizes=st.lists(st.integers(1, 150), min_size=1, max_size=6))
    def append(self, sizes: list[int]) -> None:
        payloads = [self.payload(size) for size in sizes]
        self.log.append(payloads, self.key(len(self.model)), PER_PAYLOAD * len(payloads))
        self.model += payloads

    @rule(sizes=st.lists(st.integers(1, 150), min_size=1, max_size=3), written=st.integers(0, 200))
    def append_to_a_full_disk(self, sizes: list[int], written: int) -> None:
        real = os.write

        def short(descriptor: int, parts: Sequence[bytes]) -> int:
            record = b"".join(parts)
            return real(descriptor, record[: min(written, len(record) - 1)])

        def full(descriptor: int, data: bytes) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with mock.patch("os.writev", short), mock.patch("os.write", full):
            try:
                payloads = [self.payload(size) for size in sizes]
                self.log.append(payloads, self.key(len(self.model)), PER_PAYLOAD * len(payloads))
            except OSError:
                return
        raise AssertionError("a failed write counted as complete")

    @rule(close=st.booleans())
    def start_again(self, close: bool) -> None:
        if close:
            self.log.close()
        self.start()
        assert self.found == self.model
        assert self.log.corrupt == self.corrupt

    @rule(data=st.data())
    def die_in_a_write(self, data: st.DataObject) -> None:
        """Part of the record being written reached the file, or zeros in its place."""
        if not (paths := segment_paths(self.directory)):
            return
        record = len(payload := self.payload(30)).to_bytes(4, "little") + b"crc?" + payload
        tail = record[: data.draw(st.integers(1, len(record) - 1))]
        with paths[-1].open("ab") as file:
            file.write(data.draw(st.sampled_from([tail, bytes(len(tail))])))
        self.start_again(False)

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def flip_a_bit_of_a_payload(self, data: st.DataObject) -> None:
        """Only that record is lost."""
        index = data.draw(st.integers(0, len(self.model) - 1))
        payload = self.model.pop(index)
        self.flip(payload, data.draw(st.integers(-32, 8 * len(payload) - 1)))  # its CRC too
        self.corrupt += 1
        self.start_again(False)

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def flip_a_bit_of_a_length(self, data: st.DataObject) -> None:
        """The next record's begin is unknown: later ones in the file may be lost too."""
        index = data.draw(st.integers(0, len(self.model) - 1))
        payload = self.model[index]
        path = self.flip(payload, data.draw(st.integers(-64, -33)))
        before = {record for _, _, record in read_segment(path)}
        self.start()
        lost = [record for record in self.model if record not in self.found]
        assert [record for record in self.model if record not in lost] == self.found
        assert payload in lost
        assert lost == self.model[index : index + len(lost)]
        assert before <= {*self.found, None}
        self.model = self.found
        self.corrupt = self.log.corrupt

    def flip(self, payload: bytes, bit: int) -> Path:
        """The segment with one bit changed, counted from where the payload begins."""
        for path in segment_paths(self.directory):
            data = bytearray(path.read_bytes())
            if (place := data.find(payload)) >= 0:
                data[place + bit // 8] ^= 1 << bit % 8
                path.write_bytes(data)
                return path
        raise AssertionError("an acknowledged payload is in no file")

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def forget(self, data: st.DataObject) -> None:
        """Only whole files are deleted, with nothing newer than the key."""
        index = data.draw(st.integers(0, len(self.model)))
        self.log.forget(self.key(index))
        files = b"".join(path.read_bytes() for path in segment_paths(self.directory))
        kept = [payload for payload in self.model if payload in files]
        assert kept == self.model[len(self.model) - len(kept) :]
        assert len(kept) >= len(self.model) - index
        self.first += PER_PAYLOAD * (len(self.model) - len(kept))
        self.model = kept
        self.corrupt = 0
        for path in segment_paths(self.directory):
            self.corrupt += sum(payload is None for _, _, payload in read_segment(path))

    @invariant()
    def a_reader_beside_it_sees_what_is_acknowledged(self) -> None:
        seen = (
            payload for path in segment_paths(self.directory) for *_, payload in read_segment(path)
        )
        whole = (payload for payload in seen if payload is not None)
        assert list(islice(whole, len(self.model) + 1)) == self.model

    def teardown(self) -> None:
        if hasattr(self, "log"):
            self.log.close()
            shutil.rmtree(self.directory)


TestLogAgainstList = LogAgainstList.TestCase
TestLogAgainstList.settings = settings(max_examples=60, stateful_step_count=20, deadline=None)
