"""A few lines of a long record file: bounded, in order, within the times that were asked for."""

import json
import math
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.services.monitor import sampling
from mrcdrl.services.monitor.sampling import sample_blocks, sample_lines, thinned


def write(path: Path, times: list[float], width: int = 40, torn: bytes = b"") -> Path:
    """A record file; width: bytes that each line has besides."""
    lines = (json.dumps({"time_s": t, "pad": "x" * width}) for t in times)
    path.write_bytes("".join(f"{line}\n" for line in lines).encode() + torn)
    return path


@pytest.fixture
def few_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of some kilobytes count as long."""
    monkeypatch.setattr(sampling, "_ALL_BYTES", 2000)
    monkeypatch.setattr(sampling, "_CLOSE_BYTES", 300)
    monkeypatch.setattr(sampling, "_BLOCK_BYTES", 500)


def times(records: list[sampling.Record]) -> list[float]:
    return [record["time_s"] for record in records]


def test_a_file_that_is_missing_or_empty_has_no_records(tmp_path: Path) -> None:
    assert sample_lines(tmp_path / "none", 9, 0, math.inf) == []
    assert sample_blocks(tmp_path / "none", 9, 0, math.inf) == []
    empty = write(tmp_path / "empty", [])
    assert sample_lines(empty, 9, 0, math.inf) == []
    assert sample_blocks(empty, 9, 5, 7) == []


@pytest.mark.usefixtures("few_bytes")
@pytest.mark.parametrize("num_lines", [1, 7, 100, 1000])
@pytest.mark.parametrize("stretch", [(0, math.inf), (10, 20), (0, 3), (90, math.inf), (2000, 3000)])
def test_lines_are_in_order_and_of_the_stretch(
    tmp_path: Path, num_lines: int, stretch: tuple[float, float]
) -> None:
    path = write(tmp_path / "m", [float(i) for i in range(num_lines)], torn=b'{"time_s": 5')
    begin_s, end_s = stretch
    wanted = [float(i) for i in range(num_lines) if begin_s <= i <= end_s]
    found = times(sample_lines(path, 20, begin_s, end_s))
    assert found == sorted(set(found))
    assert len(found) <= 20
    close = 300 // 50  # lines in which bisection may miss the border
    if wanted:
        assert abs(found[0] - wanted[0]) <= close
        assert abs(found[-1] - wanted[-1]) <= close


@pytest.mark.usefixtures("few_bytes")
def test_lines_are_spread_evenly(tmp_path: Path) -> None:
    path = write(tmp_path / "m", [float(i) for i in range(10_000)])
    found = times(sample_lines(path, 101, 0, math.inf))
    assert (found[0], found[-1]) == (0.0, 9999.0)
    steps = [b - a for a, b in pairwise(found)]
    assert max(steps) - min(steps) <= 6  # numbers of more digits make longer lines


@pytest.mark.usefixtures("few_bytes")
def test_lines_longer_than_any_buffer_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "_MOST_BYTES", 60_000)
    path = write(tmp_path / "m", [float(i) for i in range(50)], width=5000)
    assert times(sample_lines(path, 1000, 0, math.inf))[0] == 0.0
    assert len(sample_lines(path, 1000, 0, math.inf)) <= 60_000 // 5000
    assert 24 <= sample_lines(path, 3, 25, 26)[0]["time_s"] <= 26


@pytest.mark.usefixtures("few_bytes")
def test_a_damaged_line_is_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "m", [float(i) for i in range(500)])
    content = bytearray(path.read_bytes())
    content[3000:4000] = bytes(1000)
    path.write_bytes(content)
    found = times(sample_lines(path, 200, 0, math.inf))
    assert found == sorted(found)
    assert len(found) > 150


@pytest.mark.usefixtures("few_bytes")
@pytest.mark.parametrize("num_lines", [3, 20, 3000])
def test_blocks_are_neighbours_in_order(tmp_path: Path, num_lines: int) -> None:
    path = write(tmp_path / "e", [float(i) for i in range(num_lines)])
    blocks = sample_blocks(path, 10, 0, math.inf)
    assert 0 < len(blocks) <= 10
    for block in blocks:
        each = times(block)
        assert each == [each[0] + i for i in range(len(each))]
    starts = [block[0]["time_s"] for block in blocks]
    assert starts == sorted(starts)
    if num_lines <= 20:
        assert sum(map(len, blocks)) == num_lines
    else:
        assert max(map(len, blocks)) <= 500 // 40


@given(st.integers(0, 300), st.integers(2, 50))
def test_thinning_keeps_both_ends(length: int, num: int) -> None:
    records: list[sampling.Record] = [{"time_s": float(i)} for i in range(length)]
    found = thinned(records, num)
    assert len(found) == min(length, num)
    assert found[:1] == records[:1]
    assert found[-1:] == records[-1:]
