"""Names that fit a key expression and a file name, and the keys made of them."""

import pytest

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.transport.keys import Keys, role_and_worker


@pytest.mark.parametrize("name", ["a", "7", "quick-2robots-20261122-101500", "A.b_c", "x" * 64])
def test_a_plain_name_is_taken(name: str) -> None:
    assert check_name(name, "run name") == name
    assert Keys(name).run == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        ".hidden",
        "-flag",
        "a/b",
        "a b",
        "a*",
        "**",
        "a?b",
        "a#",
        "$",
        "é",
        "a\n",
        "x" * 65,
    ],
)
def test_a_name_that_would_break_a_key_or_a_path_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"run name .*beginning with a letter or digit"):
        Keys(name)


def test_the_keys_of_a_run() -> None:
    keys = Keys("run-1")
    expected = {
        keys.insert(): "mrcdrl/run-1/replay/0/insert",
        keys.sample(): "mrcdrl/run-1/replay/0/sample",
        keys.insert(2): "mrcdrl/run-1/replay/2/insert",
        keys.sample(2): "mrcdrl/run-1/replay/2/sample",
        keys.priorities(): "mrcdrl/run-1/replay/0/priorities",
        keys.priorities(2): "mrcdrl/run-1/replay/2/priorities",
        keys.config: "mrcdrl/run-1/config",
        keys.leases: "mrcdrl/run-1/leases",
        keys.weights: "mrcdrl/run-1/weights",
        keys.evaluation("e"): "mrcdrl/run-1/evaluation/e",
        keys.every_evaluation: "mrcdrl/run-1/evaluation/*",
        keys.episodes("a"): "mrcdrl/run-1/episodes/a",
        keys.every_episode: "mrcdrl/run-1/episodes/*",
        keys.stats("actor", "a"): "mrcdrl/run-1/stats/actor/a",
        keys.every_stats: "mrcdrl/run-1/stats/*/*",
        keys.live("actor", "a"): "mrcdrl/run-1/live/actor/a",
        keys.everyone("actor"): "mrcdrl/run-1/live/actor/*",
        keys.everyone(): "mrcdrl/run-1/live/*/*",
    }
    for key, literal in expected.items():
        assert key == literal
    assert len(expected) == 18


def test_role_and_worker_are_read_back_from_a_live_key() -> None:
    assert role_and_worker(Keys("r").live("learner", "learner-0")) == ("learner", "learner-0")
