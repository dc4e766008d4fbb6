"""The learner is killed again and again: versions never go back, and training goes on.

The ordeal is that of benchmarks/learner_kills.py, which kills as often as one likes.
"""

from pathlib import Path

import pytest

from benchmarks.learner_kills import Order, backwards, mixed, ordeal
from tests.system.system_processes import SMALL

pytestmark = pytest.mark.timeout(900)

KILLS, STEPS = 3, 20


@pytest.mark.system
def test_versions_never_go_back_and_training_goes_on(tmp_path: Path) -> None:
    configured = ["--config", "smoke", *SMALL, "--run.learner_steps=0"]
    configured += ["--learner.average_for=all"]  # robots act by what is published
    found = ordeal(tmp_path, configured, kills=KILLS, seed=0, steps=STEPS, longest_s=0.5)
    assert found["kills"] == KILLS
    assert (found["went_back"], found["mixed"]) == ([], [])
    assert found["epochs"] == 1
    assert found["learner_steps"] >= (KILLS + 1) * STEPS
    assert found["published"] > KILLS
    assert min(found["acted_by"]) > KILLS
    assert len(found["resumed"]) == KILLS
    assert found["evaluations"]
    assert found["ended"] == (0, True), "in order, and from a checkpoint"


def test_the_ordeal_would_notice() -> None:
    orders: list[Order] = [(1, 1), (1, 10_002), (1, 10_002), (1, 3), (0, 20_000)]
    assert len(backwards("taken", orders)) == 3
    assert len(backwards("judged", orders, again=True)) == 2
    digests = {(1, 1): "one", (1, 2): "two"}
    acted = [((1, 1), "one"), ((1, 2), "one"), ((1, 3), "never heard of")]
    assert mixed(acted, digests) == ["acted by (1, 2), with other parameters than published"]
