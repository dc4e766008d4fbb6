"""From a configuration to a table: how many transitions, and how much memory."""

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.replay.build import build


def config_of(**replay: object) -> Config:
    given = {f"replay.{name}": str(value) for name, value in replay.items()}
    return load_config("smoke", {"replay.capacity": "5000", **given}, environ={})


def test_shards_share_capacity_and_least_size() -> None:
    table, limiter = build(config_of(shards=3))
    assert table.capacity == 1667
    assert limiter.min_size == -(-config_of().replay.min_size // 3)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
@pytest.mark.parametrize("shards", [1, 2])
def test_the_memory_of_all_shards_stays_below_its_limit(sampler: str, shards: int) -> None:
    limit = 300_000
    table, _ = build(config_of(capacity_bytes=limit, sampler=sampler, shards=shards))
    assert table.capacity < 5000 // shards
    assert 0.7 * limit < shards * table.nbytes <= 1.01 * limit  # a few rows more, for the wrap


def test_memory_that_suffices_changes_nothing() -> None:
    table, _ = build(config_of(capacity_bytes=1 << 30))
    assert table.capacity == 5000


def test_memory_for_less_than_the_least_size_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"holds \d+ transitions of \d+ bytes, fewer than"):
        build(config_of(capacity_bytes=1000))
