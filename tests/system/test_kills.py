"""Replay is killed under load, and nothing that it acknowledged is lost, doubled or moved.

The ordeal is that of benchmarks/replay_kills.py, which kills as often as one likes.
"""

from pathlib import Path

import pytest

from benchmarks.replay_kills import CONFIG, WRITERS, compare, ordeal
from benchmarks.replay_load import counting_chunk
from mrcdrl.common.config import load_config
from mrcdrl.common.messages.wire import encode
from mrcdrl.services.replay.inspect.contents import read_contents
from mrcdrl.services.replay.log import SegmentLog

pytestmark = pytest.mark.timeout(900)


@pytest.mark.system
def test_what_was_acknowledged_outlives_kill_9(tmp_path: Path) -> None:
    found = ordeal(tmp_path, kills=3, seed=1, capacity=1_000_000, longest_s=1.5)
    assert found["kills"] == 3
    assert found["acknowledged"] > 20
    assert (found["lost"], found["doubled"], found["moved"]) == ([], 0, [])
    assert (found["corrupt_records"], found["left_out_chunks"]) == (0, 0)
    assert found["stored_unacknowledged"] <= 12
    assert (found["snapshots_ignored"], found["tracebacks"]) == (0, 0)


CHUNKS = 6  # of each writer, in turns
TAMPERED: dict[str, tuple[list[int], dict[str, object]]] = {
    "nothing": (list(range(12)), {"lost": [], "doubled": 0, "moved": []}),
    "the newest lost": (list(range(11)), {"lost": ["actor-1 5"], "moved": []}),
    "one lost": ([0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11], {"lost": ["actor-1 1"]}),
    "one doubled": ([*range(12), 9], {"lost": [], "doubled": 1}),
    "two exchanged": ([0, 1, 2, 3, 5, 4, *range(6, 12)], {"moved": ["actor-0 2", "actor-1 2"]}),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_the_ordeal_would_notice(tmp_path: Path, name: str) -> None:
    """What a log holds of the chunks acknowledged in the order 0 … 11, and what is said of it."""
    order, said = TAMPERED[name]
    config = load_config("smoke", CONFIG, environ={})
    length = config.actor.chunk_length
    for writer, actor in enumerate(WRITERS):
        lines = [f"{s} {(2 * s + writer) * length}" for s in range(CHUNKS)]
        (tmp_path / f"{actor}.acknowledged").write_text("\n".join([*lines, "done"]), "utf-8")
    log = SegmentLog(tmp_path / "0", segment_bytes=10**9, fsync=False)
    for place, number in enumerate(order):
        chunk = counting_chunk(config, WRITERS[number % 2], 1, number // 2)
        log.append([encode(chunk)], place * length, length)
    log.close()
    contents = read_contents(tmp_path / "0", config, records=True)
    found = compare(config, contents, tmp_path)
    assert {key: found[key] for key in said} == said
