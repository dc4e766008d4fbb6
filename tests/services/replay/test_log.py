"""The segment log: what is appended comes back, whatever interrupts the writer."""

import errno
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.services.replay.log import SegmentLog


def open_log(directory: Path, segment_bytes: int = 100) -> SegmentLog:
    return SegmentLog(directory, segment_bytes=segment_bytes, fsync=False)


def recover(log: SegmentLog, per_payload: int = 10) -> list[bytes]:
    """All payloads, each standing for `per_payload` transitions."""
    found: list[bytes] = []
    first = log.first_key
    for payload in log.recover(lambda: first + per_payload * len(found)):
        found.append(payload)
    return found


def write(directory: Path, payloads: Sequence[bytes], first_key: int = 0) -> None:
    log = open_log(directory)
    recover(log)
    for number, payload in enumerate(payloads):
        log.append([payload], first_key + 10 * number, 10)
    log.close()


def segments(directory: Path) -> list[Path]:
    return sorted(directory.iterdir())


PAYLOADS = [bytes([n]) * 40 for n in range(12)]


def test_a_directory_is_one_log_s(tmp_path: Path) -> None:
    log = open_log(tmp_path)
    log.lock()
    with pytest.raises(RunDirectoryError, match="in use by another process"):
        open_log(tmp_path).lock()
    log.close()
    open_log(tmp_path).lock()


def test_what_was_appended_comes_back_in_order(tmp_path: Path) -> None:
    write(tmp_path, PAYLOADS)
    assert len(segments(tmp_path)) > 1
    assert recover(open_log(tmp_path)) == PAYLOADS


def test_a_record_is_a_length_a_crc_32_and_the_payload(tmp_path: Path) -> None:
    write(tmp_path, PAYLOADS[:1])
    (segment,) = segments(tmp_path)
    head = struct.pack("<II", 40, zlib.crc32(PAYLOADS[0]))
    assert segment.read_bytes() == head + PAYLOADS[0]


def test_any_number_of_records_is_appended_at_once(tmp_path: Path) -> None:
    payloads = [
        n.to_bytes(2, "big") for n in range(1500)
    ]  # two parts each: more than one call takes
    log = open_log(tmp_path)
    log.append(payloads, 0, 10 * len(payloads))
    assert recover(open_log(tmp_path)) == payloads


def test_a_reopened_log_continues(tmp_path: Path) -> None:
    write(tmp_path, PAYLOADS[:5])
    write(tmp_path, PAYLOADS[5:], first_key=50)
    assert recover(open_log(tmp_path)) == PAYLOADS


def test_an_unclosed_log_keeps_every_appended_record(tmp_path: Path) -> None:
    log = open_log(tmp_path)
    for number, payload in enumerate(PAYLOADS):
        log.append([payload], 10 * number, 10)
    assert recover(open_log(tmp_path)) == PAYLOADS
    log.close()


@settings(max_examples=40, deadline=None)
@given(cut=st.integers(1, 47))
def test_a_torn_tail_is_cut_off_and_the_log_continues(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    directory = tmp_path_factory.mktemp("log")
    write(directory, PAYLOADS[:2])
    (segment,) = segments(directory)
    os.truncate(segment, segment.stat().st_size - cut)
    write(directory, [b"new"], first_key=10)
    assert recover(open_log(directory)) == [PAYLOADS[0], b"new"]


def test_zeros_at_the_end_are_a_torn_tail(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A power cut leaves zeros in a file that grew before its bytes reached the disk."""
    write(tmp_path, PAYLOADS[:2])
    (segment,) = segments(tmp_path)
    with segment.open("ab") as file:
        file.write(bytes(1000))
    assert recover(open_log(tmp_path)) == PAYLOADS[:2]
    assert f"{segment}: cut off a torn tail of 1000 bytes" in caplog.text


def test_a_corrupt_record_is_skipped_counted_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, PAYLOADS)
    first = segments(tmp_path)[0]
    data = bytearray(first.read_bytes())
    data[20] ^= 1
    first.write_bytes(data)
    log = open_log(tmp_path)
    assert recover(log) == PAYLOADS[1:]
    assert log.corrupt == 1
    assert f"{first}: skipped a corrupt record at byte 0" in caplog.text


def test_segments_are_deleted_when_all_of_them_is_evicted(tmp_path: Path) -> None:
    log = open_log(tmp_path)
    for number, payload in enumerate(PAYLOADS):
        log.append([payload], 10 * number, 10)
    before = len(segments(tmp_path))
    log.forget(60)
    assert len(segments(tmp_path)) < before
    log.close()
    kept = recover(open_log(tmp_path))
    assert kept == PAYLOADS[-len(kept) :]
    assert set(PAYLOADS[6:]) <= set(kept)


def test_a_failed_append_leaves_the_log_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_log(tmp_path, segment_bytes=10_000)
    log.append([PAYLOADS[0]], 0, 10)
    real = os.write

    def short(descriptor: int, parts: Sequence[bytes]) -> int:
        return real(descriptor, b"".join(parts)[:7])

    def full(descriptor: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "writev", short)
    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space left"):
        log.append([PAYLOADS[1]], 10, 10)
    monkeypatch.undo()
    log.append([PAYLOADS[2]], 10, 10)
    log.close()
    assert recover(open_log(tmp_path)) == [PAYLOADS[0], PAYLOADS[2]]


def test_a_directory_that_cannot_be_made_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunDirectoryError, match="cannot make"):
        open_log(tmp_path / "file" / "log")
