"""Replay is killed under load, and nothing that it acknowledged is lost, doubled or moved.

The ordeal is that of benchmarks/replay_kills.py, which kills as often as one likes.
"""

from pathlib import Path

import pytest

from benchmarks.replay_kills import ordeal

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def test_what_was_acknowledged_outlives_kill_9(tmp_path: Path) -> None:
    found = ordeal(tmp_path, kills=3, seed=1, capacity=50_000, longest_s=1.5)
    assert found["kills"] == 3
    assert found["acknowledged"] > 20
    assert (found["lost"], found["doubled"], found["moved"]) == ([], 0, [])
    assert (found["corrupt_records"], found["left_out_chunks"]) == (0, 0)
    assert found["stored_unacknowledged"] <= 2
    assert (found["snapshots_ignored"], found["tracebacks"]) == (0, 0)
