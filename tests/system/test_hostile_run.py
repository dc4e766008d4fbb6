"""A run among hostile peers ends by its owner's signal only, learns on, and keeps sound records.

The messages are those of benchmarks/hostile_messages.py; benchmarks/hostile_run.py sends them for
as long as one likes.
"""

from itertools import islice
from pathlib import Path

import pytest

from benchmarks.hostile_messages import HostileMessages
from benchmarks.hostile_run import run_among
from mrcdrl.common.config import Config
from mrcdrl.common.transport.keys import Keys

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]


def test_the_same_seed_gives_the_same_messages() -> None:
    first, again, other = (
        list(islice(HostileMessages(Keys("run"), Config(), seed), 50)) for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other


def test_a_run_among_hostile_peers_goes_on(tmp_path: Path) -> None:
    found = run_among(15.0, 0, tmp_path, at_length=False)
    assert found["faults"] == []
    assert found["stop_reason"] == "stopped (SIGTERM)"
    assert len(found["sent"]) > 8
    assert set(found["answered_in_place_of_others"]) <= {
        *("config", "insert", "leases", "priorities", "sample", "weights")
    }
    assert found["among"]["learner_steps"] > 0
    assert found["among"]["evaluations"] > 0
