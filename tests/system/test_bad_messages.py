"""A real replay service refuses malformed messages, counts them, and continues.

The messages are those of benchmarks/bad_messages.py, which sends as many as one likes.
"""

from pathlib import Path

import pytest

from benchmarks.bad_messages import KINDS, flood

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]

COUNT = 4000
GROWTH_KIB = 24 << 10  # of the process's memory after the first thousand


def test_every_bad_message_is_refused_counted_and_leaves_no_trace(tmp_path: Path) -> None:
    found = flood(COUNT, 0, tmp_path)
    assert set(found["refused"]) == set(KINDS)
    assert sum(found["refused"].values()) == COUNT
    assert found["counted_by_replay"] == COUNT
    assert found["transitions"] == found["inserted"] > 0
    assert found["good_answered"] > COUNT // 60
    assert all(found["reasons"])
    assert found["grown_kib"] < GROWTH_KIB, found["rss_kib"]
